"""Independent blocks of the maps from rates to velocities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax import problems
from enerjax._operators import make_model, SeparableModel
from enerjax._programs import jacobian_pattern
from enerjax._solvers import (
    constant_entries,
    independent_blocks,
    inverse,
    multiply_by_blocks,
    solve_by_blocks,
)
from enerjax._system.kinematics import ConfigurationKinematics


# Two ones, one by one, two by two and three by three, rows and columns shuffled.
SIZES = (1, 1, 1, 2, 3)
RNG = np.random.default_rng(1)
ROWS, COLUMNS = RNG.permutation(8), RNG.permutation(8)


def block_matrix(ones=2):
    whole, at = np.zeros((8, 8)), 0
    for k, size in enumerate(SIZES):
        part = slice(at, at + size)
        whole[part, part] = RNG.normal(size=(size, size)) if k >= ones else 1
        at += size
    return whole[ROWS][:, COLUMNS]


MATRIX = block_matrix()
BLOCKS = independent_blocks(np.where((MATRIX == 0) | (MATRIX == 1), MATRIX, np.nan))
RIGHT = RNG.normal(size=8)


def test_blocks_are_found():
    assert BLOCKS is not None
    shapes = [(kind, rows.shape) for kind, rows, _ in BLOCKS.groups]
    assert shapes == [(0, (2, 1)), (1, (1, 1)), (2, (1, 2)), (3, (1, 3))]


def test_solutions_are_those_of_the_whole_matrix():
    x = solve_by_blocks(BLOCKS, jnp.asarray(MATRIX), jnp.asarray(RIGHT))
    # Round-off, times the condition of the blocks.
    error = np.max(np.abs(x - np.linalg.solve(MATRIX, RIGHT)))
    assert error <= 1e-15 * np.linalg.cond(MATRIX) * np.max(np.abs(x))


def test_products_are_those_of_the_whole_matrix():
    assert BLOCKS is not None
    product = multiply_by_blocks(BLOCKS, jnp.asarray(MATRIX), jnp.asarray(RIGHT))
    # Round-off of three terms of order one.
    np.testing.assert_allclose(product, MATRIX @ RIGHT, rtol=0, atol=4e-15)


@pytest.mark.slow
def test_derivatives_of_solutions():
    change = np.where(MATRIX == 0, 0, RNG.normal(size=(8, 8)))
    change = np.where(MATRIX == 1, 0, change)
    of_blocks = lambda s: solve_by_blocks(BLOCKS, MATRIX + s * change, RIGHT + s)
    of_whole = lambda s: jnp.linalg.solve(MATRIX + s * change, RIGHT + s)
    for derivative in (jax.jacfwd, jax.jacrev, lambda f: jax.jacfwd(jax.jacrev(f))):
        a, b = derivative(of_blocks)(0.0), derivative(of_whole)(0.0)
        # Round-off, times the square of the condition.
        assert np.max(np.abs(a - b)) <= 1e-15 * np.linalg.cond(MATRIX) ** 2 * np.max(
            np.abs(b)
        )


def test_a_connected_or_singular_matrix_has_no_blocks():
    assert independent_blocks(np.full((3, 3), np.nan)) is None
    singular = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert independent_blocks(singular) is None


def test_zeros_at_one_point_only_are_not_constant():
    def fn(inputs):
        q, args = inputs
        sometimes = jnp.where(q[0] > 5, q[0], 0), jnp.where(q[0] > 5, 1.0, 0.0)
        by_steps = jnp.floor(q[0]), jnp.sign(q[0] - 3), jnp.eye(9)[q[0].astype(int), 1]
        by_loop = jax.lax.fori_loop(0, 3, lambda k, x: jnp.minimum(x, k * q[0]), 0.0)
        moving = *sometimes, *by_steps, by_loop
        return jnp.stack([*moving, args["a"] * 0.0 + 1, jnp.zeros(()), jnp.ones(())])

    constants = constant_entries(fn, (jnp.zeros(1), {"a": 2.0 * jnp.ones(())}))
    assert constants is not None
    np.testing.assert_array_equal(np.isnan(constants), 6 * [True] + 3 * [False])
    np.testing.assert_array_equal(constants[6:], [1, 0, 1])


@pytest.mark.parametrize("jit", [False, True])
@pytest.mark.slow
def test_a_body_in_euler_parameters_has_blocks_for_position_and_rotation(jit):
    """The three entries of the place of the top are themselves."""
    system, start, args = problems.heavy_top()
    found = []

    def look(start, args):
        model = make_model(system, start, args)
        assert isinstance(model, SeparableModel)
        assert isinstance(model.kinematics, ConfigurationKinematics)
        found.append(model.kinematics.blocks)
        return start.q

    (jax.jit(look) if jit else look)(start, args)
    assert [(kind, rows.shape) for kind, rows, _ in found[0].groups] == [
        (0, (3, 1)),
        (4, (1, 4)),
    ]


@pytest.mark.slow
def test_derivatives_of_inverses_keep_the_pattern():
    """They keep the name of the inverse, and have more inputs and outputs."""
    matrix = lambda x: jnp.outer(x, jnp.sin(x)) + 3 * jnp.eye(x.size)
    value = lambda x: x @ inverse(matrix(x)) @ x
    a, b = jnp.array([0.3, 0.5, 0.9]), jnp.array([0.5, 0.4, 1.3])
    along = lambda x: jax.jvp(value, (x,), (jnp.cos(x),))[1]
    for fn in (value, along, jax.grad(value), jax.hessian(value)):
        change = ej.discrete_jvp(fn, a, b)(b - a)
        # Round-off of numbers of order one.
        np.testing.assert_allclose(change, fn(b) - fn(a), rtol=0, atol=1e-15)
    apart = lambda x: jnp.sum(jax.vmap(value)(x.reshape(10, 4)))
    found = jacobian_pattern(jax.grad(apart), jnp.linspace(0.1, 0.9, 40))
    assert found is not None
    np.testing.assert_array_equal(found.toarray(), np.kron(np.eye(10), np.ones((4, 4))))
