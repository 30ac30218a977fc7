"""Programs are rewritten so that they can be one function, with the same values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._programs import at_places, in_one_function, why_not_one_function

from .helpers import long
from .test_one_function import is_marked, pytestmark


__all__ = ["pytestmark"]

X = jnp.sin(jnp.arange(1.0, 13.0)).reshape(3, 4)
TWICE = np.array([2, 0, 2, 2])
ROWS, COLUMNS = np.array([[0], [2]]), np.array([[3, 1], [0, 3]])
OUTSIDE = np.array([-1, 7, 1, 4])
MANY = np.array([0, 1, 0, 0, 2] * 4)


def matrices(x, y, subscripts):
    return jnp.einsum(subscripts, jnp.tile(x, (4, 3)), jnp.tile(y, (4, 3)))


def large(x):
    return jnp.tile(jnp.sin(x), (70, 11))[:, None] * jnp.ones((1, 2, 1), x.dtype)


SUMS = (
    lambda x, axis: jnp.sum(1e-3 * x, axis),
    jnp.max,
    jnp.min,
    lambda x, axis: jnp.prod(1 + 1e-3 * x, axis),
    lambda x, axis: jnp.all(x > -0.5, axis).astype(x.dtype),
    lambda x, axis: jnp.any(x > 0.9, axis).astype(x.dtype),
)
AXES = (None, 0, 1, (0, 2), 2)


def every_place(x):
    """With shared axes, as `vmap` makes them."""
    one = lambda row, k: row.at[k].add(row[:2])
    return jax.vmap(one)(x, COLUMNS[[0, 1, 0]])


def of_loops(x):
    lax = jax.lax
    add = lambda x: jnp.sin(x).at[:, TWICE].add(x)
    turn = lambda c, y: (add(c), c[0].at[TWICE].set(y))
    until = lambda c: (c[0] + jnp.zeros(9, int).at[TWICE].add(1)[0], add(c[1]))
    return [
        lax.scan(turn, x, x, reverse=True),
        lax.scan(lambda c, _: (add(c), None), x, None, length=3)[0],
        lax.while_loop(lambda c: c[0] < 3, until, (0, x)),
        lax.cond(x[0, 0] > 0, add, jnp.cos, x),
        lax.switch((9 * x[0, 0]).astype(int), [jnp.sin, add, jnp.cos], x),
        jax.jit(add)(x),
        jax.checkpoint(add)(x),
        in_one_function(add)(x),
    ]


def sorting(x):
    """With equal entries, which keep their order, and with entries that are no numbers."""
    ties = jnp.round(2 * x)
    broken = jnp.where(x > 0.9, jnp.nan, jnp.where(x < -0.9, jnp.inf, x))
    return [
        *(jnp.sort(x, axis=axis) for axis in (0, 1)),
        *(jnp.argsort(y, axis=1) for y in (ties, -ties, broken)),
        jax.lax.sort((ties, x), dimension=0, num_keys=1)[1],
        jnp.argsort(TWICE + (4 * x[0]).astype(int)),
    ]


def definite(x):
    return x @ x.T + jnp.eye(3)


def factors(x):
    square = x[:, :3] + jnp.array([[0.0, 2.0, 0.0], [0.0, 0.0, 3.0], [1.0, 0.0, 0.0]])
    both = jnp.stack([square, square.T])
    return [
        jnp.linalg.cholesky(definite(x)),
        jnp.linalg.det(both),
        jnp.linalg.slogdet(square)[1],
        jnp.linalg.inv(both),
        jax.lax.linalg.lu(jnp.exp(x * x))[0],
        *(y.astype(x.dtype) for y in jax.lax.linalg.lu(jnp.exp(x * x).T)),
    ]


def solutions(x):
    lower, upper = jnp.tril(definite(x)), jnp.triu(definite(x))
    solve = jax.scipy.linalg.solve_triangular
    right = jax.lax.linalg.triangular_solve
    return [
        jnp.linalg.solve(x[:, :3] + 2 * jnp.eye(3)[::-1], x),
        solve(lower, x, lower=True),
        solve(upper, x, trans=1, unit_diagonal=True),
        solve(upper, x[:, 0]),
        right(lower, x.T, lower=True),
        right(lower, x.T, lower=True, transpose_a=True),
        jax.scipy.linalg.cho_solve((lower, True), x),
    ]


IN_OTHER_WORDS = {
    "put": lambda x: x.at[ROWS, COLUMNS].set(jnp.cos(x[:2, :2])),
    "put twice": lambda x: x.at[:, TWICE].set(1 + 0 * x),
    "add twice": lambda x: x.at[:, TWICE].add(jnp.cos(x)),
    "add many times": lambda x: x.at[0, MANY].add(jnp.sin(jnp.tile(x[1], 10)[: MANY.size])),
    "rows": lambda x: x.at[jnp.array([2, 0])].add(jnp.cos(x[:2])),
    "windows": lambda x: x.at[1:, 1:3].add(x[:2, :2]).at[0].set(2.0),
    "outside": lambda x: x.at[0, OUTSIDE].add(x[1]).at[2, OUTSIDE].set(x[1], mode="drop"),
    "clipped": lambda x: x.at[0, OUTSIDE].add(x[1], mode="clip"),
    "whole numbers": lambda x: x[0].astype(int).at[TWICE].add(3),
    "places": every_place,
    "long sums": lambda x: [f(large(x), axis) for f in SUMS for axis in AXES],
    "running": lambda x: [
        f(1 + 0.1 * x, axis=axis)
        for f in (jnp.cumsum, jnp.cumprod, jax.lax.cummax, jax.lax.cummin)
        for axis in (0, 1)
    ],
    "running back": lambda x: [jax.lax.cumsum(x, axis=1, reverse=True), jnp.cumsum(x[:0])],
    "running far": lambda x: [
        jnp.cumsum(jnp.tile(x, 5), 1),
        jax.lax.cummax(jnp.asarray(TWICE)),
    ],
    "sorted": sorting,
    "factors": factors,
    "solutions": solutions,
    "nothing": lambda x: (2 * x).at[np.zeros(0, int)].add(1.0),
    "slope": jax.grad(lambda x: jnp.sum(jnp.sin(x[:, TWICE] * x) ** 2)),
    "curvature": jax.hessian(lambda x: jnp.sum(jnp.sin(x[ROWS, COLUMNS]) ** 3)),
    "matrices": lambda x: matrices(x, x, "ij,kj->ik"),
    "transposed": lambda x: matrices(x, x.T[:3, :2], "ij,ik->jk"),
    "long rows": lambda x: jnp.einsum("ij,jkl->ikl", x, jnp.tile(x[0, :, None, None], 4)),
    "many matrices": lambda x: jnp.einsum("nij,nkj->nki", *[jnp.tile(x, (4, 3, 3))] * 2),
    "loops": of_loops,
}


@pytest.mark.parametrize("name", IN_OTHER_WORDS)
def test_rewritten_programs_have_the_same_values_and_derivatives(name):
    fn = IN_OTHER_WORDS[name]
    other = in_one_function(fn)
    assert is_marked(other, X)

    def seen(fn):
        total = lambda x: sum(jnp.sum(jnp.sin(y)) for y in jax.tree.leaves(fn(x)))
        # (A `while` has no reverse mode.)
        reverse = jax.grad(total) if name != "loops" else jnp.sin
        return fn(X), jax.jvp(fn, (X,), (jnp.cos(X),))[1], reverse(X)

    # Round-off, of sums whose terms are of order one.
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)
    float0 = jax.dtypes.float0
    numbers = lambda tree: [x for x in jax.tree.leaves(tree) if x.dtype != float0]
    jax.tree.map(close, numbers(jax.jit(lambda: seen(other))()), numbers(seen(fn)))


@pytest.mark.parametrize(
    "name", long(["four_bar", "car_axis", "heavy_top_directors"], "four_bar", "car_axis")
)
def test_scenes_are_one_function(name):
    system, start, args = getattr(ej.problems, name)()
    run = lambda args: ej.simulate(
        system, ej.EnergyPreserving(), start, args, h=1e-3, num_steps=20, throw=False
    )
    assert is_marked(run, args)


@pytest.mark.parametrize(("num_pivots", "num_rows"), [(5, 9), (16, 16), (20, 40)])
def test_the_order_of_rows_after_their_exchanges(num_pivots, num_rows):
    rng = np.random.default_rng(0)
    first = np.arange(num_pivots)
    pivots = jnp.asarray(rng.integers(first, num_rows), jnp.int32)
    expected = np.arange(num_rows)
    for k, pivot in enumerate(np.asarray(pivots)):
        expected[[k, pivot]] = expected[[pivot, k]]
    order = lambda pivots: jax.lax.linalg.lu_pivots_to_permutation(pivots, num_rows)
    assert not why_not_one_function(order, pivots)
    np.testing.assert_array_equal(jax.jit(in_one_function(order))(pivots), expected)


@pytest.mark.parametrize(
    ("places", "operation"),
    [
        (np.arange(12), "no operation"),
        (np.arange(2, 8).reshape(2, 3), "slice"),
        (np.arange(1, 12, 3), "slice"),
        (np.array([5]), "slice"),
        (np.array([[3, 3], [0, 7]]), "gather"),
        (np.array([4, 3, 2]), "gather"),
        (np.zeros((2, 0), int), "slice"),
    ],
)
def test_entries_at_known_places(places, operation):
    x = jnp.arange(24.0).reshape(12, 2)
    np.testing.assert_array_equal(at_places(x, places), np.asarray(x)[places])
    program = jax.make_jaxpr(lambda x: at_places(x, places))(x)
    names = {eqn.primitive.name for eqn in program.jaxpr.eqns}
    assert names & {"slice", "gather"} == {operation} - {"no operation"}
