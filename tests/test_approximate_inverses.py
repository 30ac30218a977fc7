"""Approximate inverses, improved from one step to the next."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._solvers import solve_definite
from enerjax._solvers.linear.dense import Inverse, inverse, inverse_by_cofactors

from .helpers import EPS


SIZE = 6
TURN = np.sin(np.arange(1.0, 1 + SIZE**2)).reshape(SIZE, SIZE)
# Rows of very different size, as those of multipliers and momenta are.
ROWS = 10.0 ** np.arange(-3, 3)[:, None]


def matrix(t):
    return jnp.asarray(ROWS * (3 * np.eye(SIZE) + np.sin(t) * TURN))


@pytest.mark.parametrize("off", [1e-6, 1e-3, 0.02, 0.2, 2.0])
def test_an_inverse_is_improved_or_recomputed(off):
    """Both by improvements and by a new inversion."""
    old = Inverse(jnp.linalg.inv(matrix(0.0)))
    new = jax.jit(lambda at: old.renewed(at))(matrix(off))
    left = np.asarray(matrix(off) @ new.inverse) / ROWS * ROWS.T - np.eye(SIZE)
    # Truncation: errors of 1e-7 are small enough for a chord iteration.
    assert np.max(np.abs(left)) < 1e-7


@pytest.mark.parametrize("size", [2, 3, 6])
@pytest.mark.parametrize("sign", [1, -1])
def test_pivots_are_the_largest_entries(size, sign):
    """Of either sign; with another pivot no digit would be left."""
    matrix = np.eye(size) + TURN[:size, :size]
    matrix[:, 0] = sign * np.abs(matrix[:, 0])
    matrix[0, 0] = -sign * 1e-17
    # Round-off.
    exact = np.linalg.inv(matrix)
    bound = 10 * EPS * np.linalg.cond(matrix) * np.max(np.abs(exact))
    np.testing.assert_allclose(inverse(jnp.asarray(matrix)), exact, rtol=0, atol=bound)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_cofactors_give_the_inverse_whatever_the_scales(size):
    rng = np.random.default_rng(size)
    matrix = rng.normal(size=(size, size)) + 2 * np.eye(size)
    matrix *= 10.0 ** rng.integers(-9, 9, (size, 1)) * 10.0 ** rng.integers(-9, 9, size)
    found = inverse_by_cofactors(jnp.asarray(matrix))
    # Round-off, times the condition of a matrix of order one.
    np.testing.assert_allclose(found, np.linalg.inv(matrix), rtol=2e-13)
    assert not np.any(np.isfinite(inverse_by_cofactors(jnp.zeros((size, size)))))


@pytest.mark.parametrize("size", [1, 2, 7, 20])
@pytest.mark.slow_for("20")
def test_definite_matrices_need_no_pivots(size):
    root = np.random.default_rng(0).normal(size=(size, size))
    matrix, right = jnp.asarray(root @ root.T + np.eye(size)), jnp.arange(1.0, 1 + size)
    change = jnp.asarray(root + root.T)

    def seen(solve):
        """The solution, and its rates: by the matrix, and by the right-hand side."""
        by_matrix = jax.jvp(lambda m: solve(m, right), (matrix,), (change,))[1]
        by_right = jax.vjp(lambda r: solve(matrix, r), right)[1](right)[0]
        return solve(matrix, right), by_matrix, by_right

    for x, y in zip(seen(solve_definite), seen(jnp.linalg.solve), strict=True):
        # Round-off, times the condition of the matrix.
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-10)


@pytest.mark.parametrize("size", [2, 5, 12])
def test_an_entry_that_is_no_number_leaves_no_number(size):
    square = np.array(TURN.ravel()[: size * size] if size < 7 else np.eye(12).ravel())
    for place in range(0, size * size, 3):
        broken = square.copy()
        broken[place] = np.nan
        assert np.all(np.isnan(inverse(jnp.asarray(broken.reshape(size, size)))))


def test_a_singular_matrix_has_no_inverse():
    old = Inverse(jnp.eye(2))
    assert not np.any(np.isfinite(old.renewed(jnp.ones((2, 2))).inverse))


@pytest.mark.parametrize(("brake", "load"), [(1e10, 1e-6), (1e10, 1e-13), (1e8, 1e-8)])
@pytest.mark.slow_for("10000000000.0-1e-06", "100000000.0-1e-08")
def test_an_inverse_is_recomputed_when_an_equation_becomes_soft(brake, load):
    """A body whose brake is released: inverses of before do not see what is left of its
    equation, while the corrections of another body shrink as they should."""

    def force(q, v, t, args):
        return jnp.stack([0.0 * t, jnp.where(t < 1, -args["c"] * v[1], args["w"])])

    system = ej.System(lambda v, _: 0.5 * v @ v, lambda q, _: 0.5 * q[0] ** 2, force=force)
    start = ej.State(jnp.array([1.0, 0.0]), jnp.zeros(2))
    args = {"c": brake, "w": load}
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=1e-2, num_steps=300)
    # Round-off, and what the brake lets pass until then.
    atol = 300 * EPS * load + 2 * load / brake
    assert float(sol.end.v[1]) == pytest.approx(2 * load, rel=0, abs=atol)
