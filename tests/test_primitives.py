"""One classification of the primitives of JAX serves every reader of programs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._programs import (
    evaluate,
    interpret,
    jacobian_pattern,
    num_operations,
    primitives,
    shape_of,
    simplified,
)
from enerjax._programs.numpy_primitives import evaluated


BASIC = [
    "ARITHMETIC",
    "ELEMENTARY",
    "CHOICES",
    "COMPONENTS",
    "PIECEWISE_CONSTANT",
    "COMPARISONS",
    "LOGIC",
    "BITS",
    "DATA_MOVEMENT",
    "REDUCTIONS",
    "LOGICAL_REDUCTIONS",
    "PLACES_OF_EXTREMES",
    "CUMULATIVE",
    "CALLS",
    "CONTROL_FLOW",
]


def test_a_primitive_is_in_one_basic_class_only():
    for pair in itertools.combinations(BASIC, 2):
        one, other = (set(getattr(primitives, name)) for name in pair)
        assert not one & other, pair


# What these move had a rule in some modules only, while each had a list of its own.
MOVES = {
    "tile": lambda x: jnp.tile(x, 2),
    "unstack": lambda x: jnp.concatenate(jnp.unstack(x.reshape(2, -1))),
    "stack": lambda x: jnp.stack([x, x]),
}


@pytest.mark.parametrize("name", MOVES)
def test_moved_entries_have_a_discrete_rule(name):
    move = MOVES[name]
    fn = lambda x: jnp.sum(jnp.sin(move(x)) ** 3)
    a, b = jnp.linspace(0.1, 0.7, 6), jnp.linspace(0.4, -0.3, 6)
    assert ej.discrete_fallbacks(fn)(a, b) == []
    change = ej.discrete_grad(fn)(a, b) @ (b - a)
    np.testing.assert_allclose(change, fn(b) - fn(a), rtol=1e-14)


@pytest.mark.parametrize("name", MOVES)
def test_moved_entries_keep_the_pattern_sparse(name):
    fn = lambda x: jnp.ravel(MOVES[name](x))
    x = jnp.linspace(0.1, 0.7, 6)
    pattern = jacobian_pattern(fn, x)
    assert pattern is not None
    assert shape_of(pattern) == (fn(x).size, x.size)
    np.testing.assert_array_equal(pattern.toarray(), jax.jacobian(fn)(x) != 0)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("axis", [0, 1])
def test_running_sums_join_what_is_before(axis, reverse):
    fn = lambda x: jax.lax.cumsum(x.reshape(2, 3), axis=axis, reverse=reverse).ravel()
    x = jnp.linspace(0.1, 0.7, 6)
    pattern = jacobian_pattern(fn, x)
    assert pattern is not None
    np.testing.assert_array_equal(pattern.toarray(), jax.jacobian(fn)(x) != 0)


SPARSE = np.array([[0.0, 2.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 3.0], [0.0, 4.0, 5.0]])
PRODUCTS = {
    "left": lambda x: SPARSE @ x,
    "right": lambda x: x.T @ SPARSE.T,
    "batch": lambda x: jnp.einsum("ki,kj->kij", x, np.eye(3)),
    "batch first": lambda x: jnp.einsum("kj,ki->kij", np.eye(3), x),
    "both": lambda x: jnp.einsum("nkj,kl->nlj", jnp.stack([x, x[::-1]]), SPARSE.T),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_known_zeros_of_products_keep_the_pattern_sparse(name):
    fn = lambda x: jnp.ravel(PRODUCTS[name](x.reshape(3, 2)))
    x = jnp.linspace(0.1, 0.7, 6)
    pattern = jacobian_pattern(fn, x)
    assert pattern is not None
    np.testing.assert_array_equal(pattern.toarray(), jax.jacobian(fn)(x) != 0)


ROWS = np.array([2, 0, 1])
# Programs with indices, which are evaluated with NumPy while others are traced.
WITH_INDICES = {
    "rows": lambda x: x[ROWS],
    "columns": lambda x: x[:, ROWS + 1],
    "entries": lambda x: x[ROWS, ROWS[::-1]],
    "blocks": lambda x: x[ROWS[:, None], ROWS[None]],
    "parts of rows": lambda x: x[ROWS][:, 1:3],
    "batch": lambda x: jnp.take_along_axis(x, ROWS[:, None], axis=1),
    "batch of vectors": lambda x: jax.vmap(lambda row, k: row[k])(x, ROWS),
    "slice": lambda x: jax.lax.dynamic_slice(x, (1, 9), (2, 3)),
    "outside": lambda x: x.at[ROWS + 2].get(mode="fill", fill_value=-1),
    "triangle": lambda x: jnp.where(jnp.tri(3, 4, dtype=bool), x, -x),
    "stack": lambda x: jnp.stack([x, x + 1], axis=1),
    "unstack": lambda x: jnp.concatenate(jnp.unstack(x, axis=1)[::-1]),
    "numbers": lambda x: jnp.arange(3)[:, None] * x - jnp.maximum(x, 4),
}


@pytest.mark.parametrize("name", WITH_INDICES)
def test_indices_are_those_of_jax(name):
    x = np.arange(12).reshape(3, 4)
    program = jax.make_jaxpr(WITH_INDICES[name])(x)

    def equation(eqn, values):
        inner = eqn.params.get("jaxpr")
        if inner is not None:
            return interpret(inner.jaxpr, inner.consts, values, equation)
        found = evaluated(eqn.primitive, values, eqn.params)
        exact = evaluate(eqn.primitive, list(map(jnp.asarray, values)), eqn.params)
        for one, other in zip(found, exact, strict=True):
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
        return found

    interpret(program.jaxpr, program.consts, [x], equation)


def test_a_simplified_program_has_each_operation_once():
    def repeating(x):
        unused = jnp.exp(x)
        a, b, _ = jnp.sum(jnp.sin(x) ** 2), jnp.sum(jnp.sin(x) ** 2), jnp.sum(unused)
        return dict(sum=a + b, product=a * b)

    def once(x):
        a = jnp.sum(jnp.sin(x) ** 2)
        return dict(sum=a + a, product=a * a)

    x = jnp.linspace(0.1, 0.9, 4)
    lean = simplified(repeating)
    assert num_operations(lean, x) == num_operations(once, x)
    assert num_operations(lean, x) < num_operations(repeating, x)
    assert lean(x) == repeating(x)
    slope = lambda fn: jax.grad(lambda x: fn(x)["product"])(x)
    np.testing.assert_array_equal(slope(lean), slope(repeating))


def test_equal_tables_of_a_simplified_program_are_one():
    # Each call of the function brings an array of its own.
    turned = lambda x: jnp.asarray(np.eye(3)) + x[:, None] * x[None]
    repeating = lambda x: dict(a=turned(x) ** 2, b=turned(x) ** 3)

    def once(x):
        frame = turned(x)
        return dict(a=frame**2, b=frame**3)

    x = jnp.linspace(0.1, 0.9, 3)
    lean = simplified(repeating)
    assert num_operations(lean, x) == num_operations(once, x)
    assert num_operations(lean, x) < num_operations(repeating, x)
    jax.tree.map(np.testing.assert_array_equal, lean(x), repeating(x))


def test_random_keys_can_be_constants_of_a_simplified_program():
    key = jax.random.key(1)
    noisy = lambda x: x * jax.random.uniform(key) + jax.random.uniform(key)
    np.testing.assert_array_equal(simplified(noisy)(2.0), noisy(2.0))
