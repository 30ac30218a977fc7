"""Programs as machine code: the values and derivatives of XLA, for lanes too."""

import concurrent.futures
import functools
import math
import time

import jax
import jax.numpy as jnp
import llvmlite.binding
import numpy as np
import pytest
from jax.ad_checkpoint import checkpoint_name

import enerjax as ej
from enerjax._programs import at_places, in_one_function, why_not_one_function
from enerjax._programs.machine_code import (
    compiler,
    emission,
    graph,
    library,
    loops,
    scheduling,
)
from enerjax._solvers.linear.dense import Inverse

from .helpers import EPS, long


pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="machine code is for CPUs"
)
SMALL = jnp.linspace(0.15, 0.85, 6).reshape(2, 3)
K = jnp.arange(1, 7).reshape(2, 3)


def elementwise(x, k):
    lax = jax.lax
    bits = k.astype(jnp.uint64)
    return [
        *(f(x) for f in (jnp.abs, jnp.acos, jnp.asin, jnp.atan, jnp.asinh, jnp.atanh)),
        *(f(x) for f in (jnp.ceil, jnp.floor, jnp.round, jnp.sign, jnp.cos, jnp.sin)),
        *(f(x) for f in (jnp.tan, jnp.cosh, jnp.sinh, jnp.tanh, jnp.exp, jnp.exp2)),
        *(f(x) for f in (jnp.expm1, jnp.log, jnp.log1p, jnp.sqrt, jnp.cbrt, lax.rsqrt)),
        *(f(x) for f in (jnp.isfinite, jax.nn.sigmoid, lax.erf, lax.erfc)),
        *(f(x) for f in (jnp.square, lax.neg)),
        jnp.acosh(1 + x),
        *(f(x, 1 - x) for f in (jnp.atan2, jnp.maximum, jnp.minimum, lax.rem, lax.div)),
        *(f(x, 1 - x) for f in (jnp.nextafter, lax.eq, lax.ne, lax.lt, lax.le, lax.gt)),
        *(f(x, 1 - x) for f in (lax.ge, lax.pow, lax.sub, lax.mul, lax.add)),
        x**3,
        lax.clamp(0.2, x, 0.6),
        lax.bitcast_convert_type(lax.bitcast_convert_type(x, jnp.int64) + k, float),
        *(f(k, k + 1) for f in (lax.bitwise_and, lax.bitwise_or, lax.bitwise_xor)),
        lax.bitwise_not(k),
        *(f(bits, bits) for f in (lax.shift_left, lax.shift_right_logical)),
        lax.shift_right_arithmetic(k, k),
        k.astype(float),
    ]


def moves(x, k):
    lax = jax.lax
    i = k[0, 0] - 1
    return [
        jnp.concatenate([x, x]),
        *(jnp.stack([x, 2 * x]), *jnp.unstack(x)),
        lax.dynamic_slice(x, (i, i), (1, 2)),
        lax.dynamic_update_slice(x, x[:1, :1], (i, i)),
        *(jnp.expand_dims(x, 1), jnp.squeeze(x[:1]), x.T, x.reshape(-1), x[:, ::-1]),
        *(x[:, jnp.array([2, 0])], x[i], lax.rev(x, (0,)), jnp.pad(x, 1)),
        *jnp.split(x, [1], axis=1),
        jnp.arange(6.0).reshape(2, 3) + x,
        *(jnp.where(x > 0.5, x, -x), jnp.copy(x), lax.stop_gradient(x), jnp.diag(x[0])),
        *(jnp.take(x, jnp.array([1, 0]), axis=0), jnp.tile(x, (2, 3))),
    ]


def sums(x, k):
    return [
        *(f(x, axis=1) for f in (jnp.sum, jnp.max, jnp.min, jnp.prod)),
        *(f(x, axis=1) for f in (jnp.argmax, jnp.argmin)),
        *(jnp.any(x > 0.5), jnp.all(k > 1), x @ x.T, x @ x[0], jnp.vdot(x, x)),
        jnp.einsum("ij,kj->ik", x, x),
    ]


@jax.custom_jvp
def _with_own_jvp(x):
    return jnp.sin(x)


_with_own_jvp.defjvp(lambda x, t: (_with_own_jvp(*x), t[0]))


@jax.custom_vjp
def _with_own_vjp(x):
    return jnp.cos(x)


_with_own_vjp.defvjp(lambda x: (jnp.cos(x), x), lambda x, t: (t,))


@jax.custom_batching.custom_vmap
def _with_own_vmap(x):
    return 2 * x


@_with_own_vmap.def_vmap
def _(size, is_batched, x):
    return 2 * x, True


_kept = functools.partial(jax.checkpoint, prevent_cse=False)


def _both(x, y):
    return jnp.sin(x * y), x * y


def calls(x, k):
    lax = jax.lax
    return [
        *(_with_own_jvp(x), _with_own_vjp(x), _with_own_vmap(x), jax.jit(jnp.sin)(x)),
        jax.checkpoint(jnp.sin)(x),
        lax.platform_dependent(x, cpu=jnp.sin, default=jnp.cos),
        jax.grad(lambda x: jnp.sum(x * x + jnp.sin(x)))(x),
        jax.grad(lambda x: jnp.sum(jnp.diagonal(x[:, :2])))(x),
        *(
            checkpoint_name(x, "x"),
            lax.optimization_barrier(x),
            in_one_function(jnp.sin)(x),
        ),
        jax.grad(lambda x: jnp.sum(_kept(lambda x: lax.scan(_kept(_both), x[0], x)[1])(x)))(
            x
        ),
        lax.while_loop(lambda c: c[0] < k[0, 1], lambda c: (c[0] + 1, 2 * c[1]), (0, x))[1],
        lax.cond(k[0, 0] > 0, jnp.sin, jnp.cos, x),
        lax.scan(lambda c, y: (c + y, c * y), x[0], x),
        lax.fori_loop(0, 5, lambda n, c: c + n * x, x),
    ]


GROUPS = [elementwise, moves, sums, calls]


def is_compiled(fn, *args):
    """Whether a program calls a function of machine code."""
    return "call @enerjax_" in jax.jit(fn).lower(*args).as_text()


@pytest.mark.parametrize("group", GROUPS)
def test_operations(group):
    out = in_one_function(group)
    assert is_compiled(out, SMALL, K)
    plain, whole = jax.jit(group)(SMALL, K), jax.jit(out)(SMALL, K)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(whole), strict=True):
        # Round-off, of sums whose terms are of order one.
        np.testing.assert_allclose(a, b, rtol=4e-15, atol=4e-15)


NOT_POSSIBLE = {
    "sort": lambda x: jnp.sort(jnp.tile(x[0], 2000)),
    "eigenvalues": lambda x: jnp.linalg.eigvalsh(x @ x.T + jnp.eye(2)),
    "in a loop": lambda x: jax.lax.fori_loop(0, 3, lambda _, y: jnp.linalg.qr(y.T)[0].T, x),
    "function of what is there": lambda x: x.at[1].apply(jnp.exp),
    "precision": lambda x: jax.lax.reduce_precision(x, 5, 3),
    "a batch of loops": lambda x: jax.vmap(
        lambda x: jax.lax.while_loop(lambda y: jnp.sum(y) < 5, lambda y: y + 1, x)
    )(x),
    "prints": lambda x: (x, jax.debug.print("x"))[0] + 1,
    "random": lambda x: x + jax.random.uniform(jax.random.key((9 * x[0, 0]).astype(int))),
}


@pytest.mark.parametrize("name", NOT_POSSIBLE)
def test_other_operations_are_compiled_by_xla(name):
    fn = NOT_POSSIBLE[name]
    left = in_one_function(fn)
    assert not is_compiled(left, SMALL)
    np.testing.assert_array_equal(jax.jit(left)(SMALL), jax.jit(fn)(SMALL))
    (obstacle,) = why_not_one_function(fn, SMALL)
    assert "test_machine_code.py" in obstacle


# Programs -------------------------------------------------------------------------------

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
        *(jnp.argsort(jnp.tile(y, (3, 13)), axis=1, descending=True) for y in (x, ties)),
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


def shifted(x):
    """Long rows that are read from one place further on, with another number at an end."""
    x = jnp.tile(jnp.sin(x), (1, 10))
    turn = lambda c, _: (0.9 * jnp.roll(c, 1, axis=1) + x, jnp.mean(c))
    return [
        jnp.roll(x, 1, axis=1) * x,
        jnp.pad(x, ((0, 0), (1, 0)))[:, :-1] + x,
        jnp.pad(x, ((0, 0), (0, 1)), constant_values=3.0)[:, 1:] + x,
        jnp.concatenate([x[:, 4:5], x[:, 1:-1], x[:, :1]], axis=1) * 2,
        jax.lax.scan(turn, x, None, length=5),
    ]


def carries(x):
    """Numbers of a carry that change places, or are a history, in loops within loops."""
    history = lambda c, row: ((row, *c[:-1]), c[0] + 2 * c[2])
    swapped = lambda c, _: ((c[1], c[0] * 0.9, c[2][::-1]), c[2][0])
    inner = lambda c, row: jax.lax.scan(history, (c[0], row, c[2]), jnp.stack([c[1], row]))
    first = x[0], x[1], x[2]
    return [
        jax.lax.scan(history, first, x),
        jax.lax.scan(swapped, first, None, length=9),
        jax.lax.scan(inner, first, x[::-1]),
        jax.lax.scan(history, tuple(jnp.tile(y, 6) for y in first), jnp.tile(x, 6)),
    ]


def searched(x):
    """Also for zeros of both signs, and for NaN, which comes last."""
    table = jnp.array([-jnp.inf, -1.0, -0.0, 0.0, 0.5, jnp.inf, jnp.nan, jnp.nan])
    keys = jnp.append(x[0], jnp.array([0.0, -0.0, jnp.inf, jnp.nan, -jnp.nan]))
    return [
        jnp.searchsorted(jnp.sort(x[0]), x[1]),
        *(jnp.searchsorted(table, keys, side=side) for side in ("left", "right")),
        jnp.searchsorted(jnp.asarray(TWICE), jnp.arange(4)),
    ]


PROGRAMS = {
    "searched": searched,
    "shifted": shifted,
    "carries": carries,
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


@pytest.mark.parametrize("name", long(PROGRAMS, "long sums"))
def test_values_and_derivatives(name):
    if name == "searched" and jax.__version_info__ >= (0, 12):
        pytest.skip("`searchsorted` is an operation of its own, without machine code")
    fn = PROGRAMS[name]
    other = in_one_function(fn)
    assert is_compiled(other, X)

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


@pytest.mark.parametrize("kind", ["add", "subtract", "multiply", "min", "max", "divide"])
@pytest.mark.parametrize(
    "places",
    [np.array([1, 2, 4, 0]), np.array([0, 3, 3, 5]), np.zeros(4, int), slice(1, 5)],
    ids=["once", "twice", "often", "slice"],
)
def test_updates_that_join_what_is_at_a_place(kind, places):
    x = jnp.cos(jnp.arange(18.0)).reshape(6, 3)
    fn = lambda x, updates: getattr(x.at[places], kind)(updates) * x
    assert not why_not_one_function(fn, x, x[2:] + 3)
    found, expected = (f(x, x[2:] + 3) for f in (jax.jit(in_one_function(fn)), fn))
    np.testing.assert_allclose(found, expected, rtol=1e-15)
    # At a place that is computed, of integers.
    whole = lambda x, place: getattr(x.at[place], kind)(x[1])
    if kind != "divide":
        x = jnp.arange(18).reshape(6, 3) % 7
        assert not why_not_one_function(whole, x, jnp.array(4))
        found = jax.jit(in_one_function(whole))(x, jnp.array(4))
        np.testing.assert_array_equal(found, whole(x, jnp.array(4)))


@pytest.mark.parametrize("mode", ["clip", "fill"])
def test_rows_at_computed_places_whose_other_axis_has_a_place_too(mode):
    """That is how JAX differentiates `x[k]` of an array, in a loop over `k`."""
    modes = jax.lax.GatherScatterMode
    how = dict(clip=modes.CLIP, fill=modes.FILL_OR_DROP)[mode]
    dims = jax.lax.ScatterDimensionNumbers((0,), (0,), (0, 1))

    def fn(x, row, place):
        to = jnp.stack([place, jnp.zeros_like(place)])
        added = jax.lax.scatter_add(x, to, row, dims, mode=how)
        moved = jax.lax.scatter_add(x, to[::-1], row, dims, mode=how)
        return added, moved

    x, row = jnp.cos(jnp.arange(12.0)).reshape(4, 3), jnp.arange(1.0, 4.0)
    assert not why_not_one_function(fn, x, row, jnp.array(2))
    for place in (-1, 0, 2, 4):
        found = jax.jit(in_one_function(fn))(x, row, jnp.array(place))
        jax.tree.map(np.testing.assert_array_equal, found, fn(x, row, jnp.array(place)))


def test_the_gradient_of_a_loop_over_rows_is_one_function():
    def energy(x):
        pair = lambda k, total: total + jnp.sum((x[k] - x[0]) ** 2) / (1 + x[k] @ x[k])
        return jax.lax.fori_loop(0, len(x), pair, 0.0)

    x = jnp.cos(jnp.arange(15.0)).reshape(5, 3)
    assert not why_not_one_function(jax.grad(energy), x)
    found = jax.jit(in_one_function(jax.grad(energy)))(x)
    np.testing.assert_allclose(found, jax.grad(energy)(x), rtol=1e-14)


def test_known_places_stay_known():
    """JAX counts negative places from the end, which many updates must not compute."""
    places = jnp.asarray(np.arange(150)[::-1])
    fn = lambda x: jnp.zeros(150).at[places].add(x)
    x = jnp.arange(150.0)
    assert not why_not_one_function(fn, x)
    np.testing.assert_array_equal(jax.jit(in_one_function(fn))(x), x[::-1])


@pytest.mark.parametrize("rows", [8, 27])
def test_inverses_are_renewed(rows):
    start = Inverse(jnp.eye(rows))
    change = jnp.sin(jnp.arange(1.0, 1 + rows**2)).reshape(rows, rows) / rows

    def inverses(change):
        matrix = lambda t: jnp.eye(rows) + 0.1 * t * change
        turn = lambda kept, t: (kept.renewed(matrix(t)),) * 2
        return jax.lax.scan(turn, start, jnp.arange(0.0, 5.0))[1].inverse

    whole = in_one_function(inverses)
    assert is_compiled(whole, change)
    exact = np.linalg.inv(np.eye(rows) + 0.4 * np.asarray(change))
    # Truncation: errors of 1e-7 are small enough for a chord iteration.
    np.testing.assert_allclose(jax.jit(whole)(change)[-1], exact, rtol=0, atol=1e-6)


@pytest.mark.parametrize("rows", [20, 45])
def test_factors_of_larger_matrices(rows):
    rng = np.random.default_rng(rows)
    matrix, right = rng.normal(size=(2, rows, rows))
    definite = matrix @ matrix.T + np.eye(rows)
    solve = jax.scipy.linalg.solve_triangular
    fn = lambda a, d, b: (
        jnp.linalg.solve(a, b),
        *jax.lax.linalg.lu(a),
        jnp.linalg.cholesky(d),
        solve(d, b, lower=True),
        solve(d, b[:, 0], trans=1, unit_diagonal=True) / jnp.max(jnp.abs(d)) ** 9,
        a @ b,
    )
    assert is_compiled(in_one_function(fn), matrix, definite, right)
    found = jax.jit(in_one_function(fn))(matrix, definite, right)
    for a, b in zip(found, jax.jit(fn)(matrix, definite, right), strict=True):
        # Round-off, amplified by the condition of the matrices.
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8 * np.max(np.abs(b)))


def test_factors_of_an_infinite_matrix_are_rows_that_exist():
    matrix = np.random.default_rng(1).normal(size=(40, 40))
    matrix[3, 39] = np.inf
    assert is_compiled(in_one_function(jax.lax.linalg.lu), matrix)
    _, pivots, order = jax.jit(in_one_function(jax.lax.linalg.lu))(matrix)
    assert np.all(pivots < 40)
    np.testing.assert_array_equal(np.sort(order), np.arange(40))


@pytest.mark.parametrize("length", [1000, 20000])
def test_tables_that_are_looked_up(length):
    table = np.sin(np.linspace(0, 1, length))

    def follow(x):
        """To places that the table tells."""
        place = lambda x: jnp.floor(x * length).astype(int)
        return jax.lax.fori_loop(0, 5, lambda _, x: jnp.asarray(table)[place(x)], x)

    assert is_compiled(in_one_function(follow), 0.9)
    assert jax.jit(in_one_function(follow))(0.9) == follow(0.9)


def _change(blocks, at, value):
    return jax.lax.dynamic_update_slice(blocks, value[None], (at, *[0] * value.ndim))


def _chain_of_blocks(blocks, table):
    """Each pass changes one block by two others; some it changes more than once."""

    def body(blocks, row):
        at, one, other = row
        return _change(blocks, at, blocks[at] - blocks[one] @ blocks[other].T), at

    return jax.lax.scan(body, blocks, table)


def _blocks_that_are_read_again(blocks, table):
    """The array that is changed is needed as a whole too."""

    def body(carry, row):
        blocks, total = carry
        blocks = _change(blocks, row[0], blocks[row[1]] + 1)
        return (blocks, total + blocks[row[2]]), None

    return jax.lax.scan(body, (blocks, blocks[0]), table)[0]


def _blocks_while_small(blocks, table):
    """A loop whose number of passes is not known, with two slices and their exchange."""

    def body(carry):
        k, blocks, rows = carry
        at, one, other = table[k]
        new = 0.5 * blocks[one] + rows[other][None]
        rows = jax.lax.dynamic_update_slice(rows, blocks[at][:1], (one, 0))
        return k + 1, _change(blocks, at, new), rows

    within = lambda carry: (carry[0] < 9) & (jnp.max(jnp.abs(carry[1])) < 2.0)
    return jax.lax.while_loop(within, body, (0, blocks, blocks[:, 0]))


@pytest.mark.parametrize(
    "fn", [_chain_of_blocks, _blocks_that_are_read_again, _blocks_while_small]
)
@pytest.mark.parametrize("width", [1, 4, 7])
def test_loops_that_change_slices(fn, width):
    rng = np.random.default_rng(width)
    blocks = 0.3 * jnp.asarray(rng.normal(size=(6, width, width)))
    table = jnp.asarray(rng.integers(0, 6, size=(11, 3)))
    whole = in_one_function(fn)
    assert is_compiled(whole, blocks, table)
    plain, found = jax.jit(fn)(blocks, table), jax.jit(whole)(blocks, table)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-13, atol=1e-13)
    jax.tree.map(close, found, plain)  # round-off
    # Lanes of which the first end early.
    lanes = jnp.stack([4 * blocks, 2 * blocks, blocks, 0.5 * blocks, 0.1 * blocks])
    batch = jax.jit(jax.vmap(whole, (0, None)))(lanes, table)
    jax.tree.map(close, batch, jax.jit(jax.vmap(fn, (0, None)))(lanes, table))
    tables = jnp.stack([(table + k) % 6 for k in range(5)])
    batch = jax.jit(jax.vmap(whole))(lanes, tables)
    jax.tree.map(close, batch, jax.jit(jax.vmap(fn))(lanes, tables))


def test_single_precision_and_whole_numbers():
    def fn(x, k):
        small = x.astype(jnp.float32)
        counts = jax.lax.scan(lambda c, y: (c + y, c * y), k[0], k)
        return jnp.sin(small) @ small.T, small.sum(), counts, k // (k - 2), k % 3, -k

    found = jax.jit(in_one_function(fn))(X, K - 3)
    for a, b in zip(
        jax.tree.leaves(found), jax.tree.leaves(jax.jit(fn)(X, K - 3)), strict=True
    ):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=2e-6)  # round-off of single precision


def whole_numbers(k):
    """At the ends of their range, where they are known only in part."""
    last, least = np.int32(2**31 - 1), np.int32(-(2**31))
    ends = jnp.concatenate([k, jnp.array([last, least, 0, -9], jnp.int32)])
    divisor = jnp.where(ends == 0, 3, jnp.where(ends == least, -1, ends // 2 + 4))
    bits = ends.astype(jnp.uint32)
    return [
        *(ends + 1, (ends + 1) > 0, (ends + 1) // 2, jnp.abs(ends), -ends, ends * ends),
        *(jax.lax.div(ends, divisor), jax.lax.rem(ends, divisor), ends // divisor),
        *((~bits).astype(float), (bits + 7).astype(float), ends % divisor),
        jax.lax.div(jnp.full(3, 2**62 + 1), 3) + k,
        jax.lax.shift_right_arithmetic(ends, jnp.full(7, -2, jnp.int32)),
        jax.lax.dot_general(
            jnp.tile(k.astype(jnp.int8) + 40, (50, 20)),
            jnp.tile(k.astype(jnp.int8) + 40, (60, 20)),
            (((1,), (1,)), ((), ())),
            preferred_element_type=jnp.int32,
        ),
    ]


def bits_of_known_numbers(k):
    x = np.array([-0.0, np.nan, -np.inf, 5e-324, 1.5])
    return [
        jax.lax.bitcast_convert_type(jnp.asarray(x, t), whole) + jnp.max(k).astype(whole)
        for t, whole in ((jnp.float64, jnp.int64), (jnp.float32, jnp.int32))
    ]


def conversions(k):
    x = jnp.concatenate([k.astype(float), jnp.array([1e30, -1e30, jnp.nan, -3.7])])
    return [x.astype(t) for t in (jnp.int32, jnp.int64, jnp.uint32, bool, jnp.float32)]


@pytest.mark.parametrize(
    "fn", [whole_numbers, bits_of_known_numbers, conversions], ids=lambda fn: fn.__name__
)
def test_numbers_at_the_ends_of_their_range(fn):
    k = jnp.array([7, -5, 3], jnp.int32)
    assert is_compiled(in_one_function(fn), k)
    found, expected = jax.jit(in_one_function(fn))(k), jax.jit(fn)(k)
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def loops_over_the_same(x):
    """Rows that are one row, or constant in part; a branch that no pass decides."""
    turn = lambda c, row: (jnp.sin(c) + row, c * row)
    branch = lambda k, c: jax.lax.cond(jnp.sum(x) > 0, lambda c: 1.01 * c, jnp.cos, c)
    return [
        jax.lax.scan(turn, x[0, 0], jnp.broadcast_to(x[0, 1], (60,))),
        jax.lax.scan(turn, x[0, 0], jnp.stack([x[0, 1], 5.0])),
        jax.lax.fori_loop(0, 50, branch, x),
    ]


def large_carry(x):
    """More numbers than a kernel holds, each of which moves on."""
    numbers = tuple(jnp.arange(4.0) + 4 * k + x[0, 0] for k in range(160))
    turn = lambda c: (c[0] + 1, (c[1][-1], *c[1][:-1]))
    return jax.lax.while_loop(lambda c: c[0] < 5, turn, (0, numbers))[1]


def backwards(x):
    """Rows from the last to the first, and arrays of a carry that change places."""
    table = jnp.outer(x.ravel(), jnp.linspace(0.5, 1, 30))
    turn = lambda c, row: ((c[1], c[0], jnp.max(c[0]) * jnp.cos(row)), c[0] - row)
    return jax.lax.scan(turn, (table[0], table[1], table[2]), table, reverse=True)


def turned_tables(x):
    """Entries at computed places of an array whose columns are in memory as rows."""
    table = jnp.outer(jnp.arange(1.0, 31), jnp.linspace(0.5, 1, 24)) * x[0, 0]

    def turn(k, table):
        column = table[:, k % 7]
        chosen = jnp.argmax(jnp.abs(column))
        row = table.T[:, chosen] + table[::-1][chosen]
        entry = jax.lax.dynamic_slice(table[::2, ::3], (k % 5, k % 4), (2, 3)).sum()
        return jnp.cos(table - column[:, None] * row[None] / (1 + entry**2))

    return jax.lax.fori_loop(0, 9, turn, table)


def scattered_entries(x):
    """Loops that read entries far apart, of what they change and of what they do not."""
    table = jnp.outer(jnp.linspace(0.1, 0.3, 16), jnp.linspace(0.5, 1, 9)) * x[0, 0]
    places = np.array([7, 2, 11, 0, 5, 9, 9, 3, 14, 1, 12, 4])

    def inner(k, row):
        # The table changes around this loop, `x` and the constants do not.
        row = 0.5 * row[places % 12] * table_before[places, 3] + 0.1 * places
        row = jnp.where(k > 2, jnp.sin(row), row - x.ravel()[places % x.size])
        smaller = lambda: row * table_before[:12, 1]
        return jax.lax.cond(row[0] > 0.01, smaller, lambda: 0.5 * row)

    def outer(k, carry):
        nonlocal table_before
        table, row = carry
        table_before = table + jnp.sin(table) * jnp.sum(row)
        row = jax.lax.fori_loop(0, 4, inner, row)
        row = jax.lax.fori_loop(0, k + 1, inner, row)
        table = 0.2 * jnp.cos(table + row[places[:3]].sum()).at[:12, 2].set(row)
        # Read by several operations in one pass.
        return table, 0.1 * (row + table[places, 4] * jnp.cumsum(table[places, 4]))

    table_before = table
    return jax.lax.fori_loop(0, 5, outer, (table, jnp.ones(12)))


@pytest.mark.parametrize(
    "fn",
    [loops_over_the_same, large_carry, backwards, turned_tables, scattered_entries],
    ids=lambda fn: fn.__name__,
)
def test_loops_that_are_written_as_loops(fn, monkeypatch):
    monkeypatch.setattr(loops, "_WRITTEN_OUT", 0)
    # So that kernels are divided.
    monkeypatch.setattr(scheduling, "LONGEST", 300)
    assert is_compiled(in_one_function(fn), X)
    found, expected = jax.jit(in_one_function(fn))(X), jax.jit(fn)(X)
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)
    jax.tree.map(close, found, expected)


def constants_between_ends(x):
    """The first constants of a program: no cell is before them."""
    row = jnp.concatenate([x[:1, 0], np.linspace(0.1, 0.9, 20), x[:1, 1]])
    return row * jnp.sin(row) + row


def neighbours_in_branches(x):
    """Both branches read neighbouring cells, and others at the ends."""
    places = np.r_[5, 0:28, 7]
    row = jnp.resize(x.ravel(), (30,)) + jnp.linspace(0, 0.1, 30)

    def turn(k, row):
        one = lambda: 0.5 * jnp.sin(row[places]) + 0.1
        return jax.lax.cond(row[0] > 0.3, one, lambda: 0.3 * jnp.cos(row[places]))

    return jax.lax.fori_loop(0, 7, turn, row)


def neighbours_of_which_the_last_is_computed_later(x):
    """The first of eight numbers follows eight others from which it is computed."""
    first = jnp.sin(jnp.resize(x.ravel(), (8,)) + jnp.linspace(0, 0.1, 8))
    both = jnp.concatenate([first, jnp.cos(first) * jnp.sum(first**2)])
    without = np.array([[k, 5, 6, 7, (k + 1) % 5] for k in range(5)])
    with_last = np.array([[k, 5, 6, 7, 8] for k in range(5)])
    all_neighbours = np.arange(3, 8)[:, None] + np.arange(5)[None]
    # The same cells are read first without the last number, and then with it.
    columns = np.concatenate([without, with_last, all_neighbours])
    return jnp.stack([both[x.T] ** 2 for x in columns.reshape(3, 5, 5)])


@pytest.mark.parametrize(
    "fn",
    [
        constants_between_ends,
        neighbours_in_branches,
        neighbours_of_which_the_last_is_computed_later,
    ],
    ids=lambda fn: fn.__name__,
)
def test_neighbouring_cells_with_others_at_the_ends(fn):
    assert is_compiled(in_one_function(fn), X)
    found, expected = jax.jit(in_one_function(fn))(X), jax.jit(fn)(X)
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_loops_do_not_gather_what_they_do_not_change():
    table, places = jnp.arange(60.0).reshape(10, 6), np.array([7, 2, 9, 0, 5])

    def fn(table):
        step = lambda k, row: jnp.sin(row * k + table[:5, 3]) * table[places, 1]
        return jax.lax.fori_loop(0, 20, step, table[:5, 0])

    closed = jax.make_jaxpr(fn)(table)
    known = [*map(np.asarray, closed.consts), None]
    cellar, _, outputs = library.graph_of(closed.jaxpr, known)
    regions = list(scheduling.all_regions(cellar.graph.root))
    kernels = scheduling.kernels_of(cellar, regions, [places for _, places in outputs])
    gathers = [
        region.depth
        for (region, *_), nodes in kernels.items()
        for node in nodes
        if any(is_gather(x) for x in node.operands)
    ]
    assert gathers
    assert not any(gathers)


@pytest.mark.parametrize("lanes", [64, 512, 513])
def test_lanes_of_many_numbers_spread_over_the_cache(lanes):
    """A cache keeps only 8 lines whose addresses differ by multiples of 4 kB."""
    program = jax.make_jaxpr(lambda x: jnp.cumsum(jnp.sin(x), axis=1))(
        jnp.ones((lanes, 32))
    )
    cellar, _, _ = library.graph_of(program.jaxpr, [None])
    numbers = [
        node
        for region in scheduling.all_regions(cellar.graph.root)
        for node in region.found.values()
        if node.op == "call"
    ]
    assert len(numbers) == 32
    lines = [cellar.place_of(node, "f8") // 8 % 64 for node in numbers]
    assert max(lines.count(line) for line in lines) <= 2


def test_only_what_is_read_from_the_memory_is_written():
    """Joined arrays have cells, but operations on all of them need none."""

    def fn(x):
        both = jnp.concatenate([jnp.sin(x), jnp.cos(x)])
        return jnp.max(both * both), jnp.sum(jnp.abs(both))

    program = jax.make_jaxpr(fn)(jnp.ones(64))
    cellar, _, outputs = library.graph_of(program.jaxpr, [None])
    emission.Emission(cellar, [places for _, places in outputs])
    regions = list(scheduling.all_regions(cellar.graph.root))
    numbers = [x for region in regions for x in region.nodes if x.lanes]
    assert len(numbers) > 4
    assert not [x for x in numbers if x.place is not None and not x.is_reduced]


def test_lanes_are_not_along_an_axis_that_is_summed():
    """A sum over lanes costs more than sums of two numbers for each lane."""

    def fn(blocks, x):
        # As vectors of few bodies: the lanes of `y` are along the axis that is summed.
        y = jnp.sin(x)
        return jnp.sum(blocks * y[:, None, :], axis=-1), jnp.einsum("kij,kj->ki", blocks, y)

    program = jax.make_jaxpr(fn)(jnp.ones((5, 6, 6)), jnp.ones((5, 6)))
    cellar, _, _ = library.graph_of(program.jaxpr, [None, None])
    regions = list(scheduling.all_regions(cellar.graph.root))
    nodes = [x for region in regions for x in region.found.values()]
    assert [x for x in nodes if x.lanes and x.op == "mul"]
    assert not [x for x in nodes if x.is_reduced]


def test_a_sum_of_one_known_number():
    fn = lambda x: jnp.sum(2.0) * x + jnp.mean(np.float64(3.0))
    assert is_compiled(in_one_function(fn), X)
    np.testing.assert_array_equal(jax.jit(in_one_function(fn))(X), 2.0 * X + 3.0)


def test_numbers_of_lanes_begin_with_a_line_of_the_cache():
    def fn(x):
        step = lambda y, k: (jnp.sin(y) * k + jnp.arange(13.0), y[3])
        return jax.lax.scan(step, x, jnp.arange(1.0, 80))

    program = jax.make_jaxpr(fn)(jnp.ones(13))
    known = [*map(np.asarray, program.consts), None]
    cellar, inputs, outputs = library.graph_of(program.jaxpr, known)
    of_code = emission.Emission(cellar, [places for _, places in outputs])
    regions = list(scheduling.all_regions(cellar.graph.root))
    own = [x.place for region in regions for x in region.nodes if x.lanes == 13]
    places = [x for x in own if x is not None] + [first for _, first, _ in inputs]
    places += [int(places[0]) for _, places in outputs]
    assert len(places) > 3
    assert all(of_code.address(place) % 8 == 0 for place in places)
    sizes = list(map(len, cellar.constants))
    assert 13 in sizes
    assert sum(sizes[: sizes.index(13)]) % 8 == 0


@pytest.mark.parametrize("count", [9, 64])
def test_slices_across_the_parts_of_a_carry(count):
    """An inner loop takes over a carry of two columns, and changes entries of both."""

    def fn(x):
        last = 12 + jnp.int32(3 * jnp.abs(x[0])) % 3

        def outer(y, add):
            def change(s):
                k, y = s
                return k + 1, jax.lax.dynamic_update_slice(y, (y[k] + add)[None], (k,))

            _, y = jax.lax.while_loop(lambda s: s[0] < last, change, (0, y))
            return y, y[0]

        both = jnp.concatenate([jnp.sin(x), jnp.cos(x)])
        return jax.lax.scan(outer, both, jnp.arange(80.0))

    x = jnp.linspace(0.1, 1, count)
    assert is_compiled(in_one_function(fn), x)
    found, expected = jax.jit(in_one_function(fn))(x), jax.jit(fn)(x)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_code_ordered_quickly_gives_the_same_numbers(monkeypatch):
    fn = jax.vmap(lambda x: jnp.cumsum(jnp.sin(x)[::-1] / (2 + x * x)) @ jnp.exp(-x))
    other = lambda x: (fn(x), jnp.cos(x))
    usual = jax.jit(in_one_function(fn))(X)
    options, set_option = [], llvmlite.binding.set_option

    def recorded(program, option):
        options.append(option)
        set_option(program, option)

    monkeypatch.setattr(llvmlite.binding, "set_option", recorded)
    monkeypatch.setattr(compiler, "_LONG_TEXT", 0)
    np.testing.assert_array_equal(jax.jit(in_one_function(other))(X)[0], usual)
    # They do not stay.
    assert options == [*compiler._QUICK, *compiler._USUAL]


def is_gather(x):
    """Whether a number of lanes is read from cells that are not neighbours."""
    is_read = isinstance(x, graph.Node) and x.op == "load" and x.lanes
    return bool(is_read) and x.extra[1:] != (1, None)


@pytest.mark.parametrize("count", [1, 7], ids=["one", "several"])
def test_sine_cosine_and_arctangent(count):
    right_angles = np.arange(-500, 500) * (np.pi / 2)
    spread = np.random.default_rng(1).uniform(-1, 1, 1000)
    ends = [0.0, -0.0, 1e-300, 1e5, -1e9, 1e300]
    angles = np.concatenate([right_angles, spread, 9e4 * spread, 1e-5 * spread, ends])
    angles = np.resize(angles, (-(-angles.size // count), count))

    def each(x):
        of_row = lambda row: jnp.stack([jnp.sin(row), jnp.cos(row), jnp.atan(row)])
        return jax.lax.map(of_row, x)

    found = np.asarray(jax.jit(in_one_function(each))(angles))
    for k, function in enumerate((math.sin, math.cos, math.atan)):
        exact = np.vectorize(function)(angles)
        assert np.array_equal(np.signbit(found[:, k]), np.signbit(exact))
        # Rounding errors of both.
        assert np.all(np.abs(found[:, k] - exact) <= 1.5 * np.spacing(np.abs(exact)))
    beyond = jax.jit(in_one_function(each))(np.full((2, count), [[np.inf], [np.nan]]))
    assert np.all(np.isnan(beyond[:, :2]))
    assert np.all(beyond[0, 2] == np.pi / 2)


# Lanes ----------------------------------------------------------------------------------

LANES = 18  # which is no multiple of the width of a vector


def arithmetic(x, y):
    matrix = jnp.outer(x, x) + jnp.diag(y)
    return jnp.sin(x) @ matrix, jnp.max(x / y), x**3 - 1 / (1 + y**2), jnp.any(x > y)


def computed_places(x, y):
    first = jnp.argmax(x > 0.3)
    chosen = jnp.where(x[0] > 0, 1, 2)
    ordered = x.at[jnp.array([2, 0])].add(y[:2])[jnp.array([1, 2, 0])]
    window = jax.lax.dynamic_slice(y, (chosen,), (1,))
    return ordered, x[chosen], window, first, jnp.pad(x, (1, 2)), x[::-1].reshape(3, 1)


def loops_of_lanes(x, y):
    def halves(carry):
        x, count = carry
        return jnp.where(jnp.arange(3) == count, x, 0.5 * x), count + 1

    small, count = jax.lax.while_loop(lambda c: jnp.max(c[0]) > 0.05, halves, (y, 0))
    turn = lambda c, row: (jnp.cos(c) * row + x[0], c[:2])
    end, rows = jax.lax.scan(turn, small, jnp.arange(4.0))
    last = jax.lax.cond(x[1] > 0, lambda: end + 1, lambda: 2 * end)
    return small, count, rows, last


def tables_of_lanes(x, y):
    row, column = jnp.where(x[0] > 0, 2, 1), jnp.where(y[0] > 0.5, 2, 0)
    table, beyond = jnp.arange(9.0).reshape(3, 3), jnp.where(x > 0, 1, 4)
    filled = [
        values.at[beyond].get(mode="fill", fill_value=other)
        for values in (y, jnp.arange(3), jnp.arange(3, dtype=jnp.uint8), y > 0.5)
        for other in (None, 1)
    ]
    one_axis = jax.lax.dynamic_slice(table, (row, 5), (1, 1))
    return table[row, 1], table[2, column], one_axis, filled


def running_sums(x, y):
    table = jnp.stack([x, y, x * y])
    back = jax.lax.cumsum(table, axis=1, reverse=True)
    return jnp.cumsum(table, axis=0), jnp.cumprod(table, axis=1), back, jax.lax.cummin(x)


def factors_of_lanes(x, y):
    matrix = jnp.diag(4 + y) + x[:, None] * jnp.roll(x, 1)[None] / 9
    definite = matrix @ matrix.T
    root = jnp.linalg.cholesky(definite)
    half = jax.scipy.linalg.solve_triangular(root, x, lower=True)
    return root, half, jnp.linalg.solve(matrix, y), jnp.sort(x), jnp.linalg.inv(definite)


def long_rows(x, y):
    """With arrays that have lanes of their own, in loops that each lane leaves alone."""
    table = jnp.outer(jnp.linspace(0.1, 1, 20), x)

    def turn(carry):
        k, rows, kept = carry
        rows = jnp.where(k % 2 == 0, rows[::-1] * 0.9, jnp.cos(rows + y[0]))
        return k + 1, rows, kept.at[k].set(jnp.max(rows))

    count, rows, kept = jax.lax.while_loop(
        lambda c: (c[0] < 6) & (jnp.max(c[1]) > 0.3 * y[1]), turn, (0, table, jnp.zeros(6))
    )
    several = jax.lax.scan(lambda c, row: (c * 0.5 + row, c[:2]), rows[0], rows)
    return count, rows.sum(axis=0), kept, several, jnp.roll(table[:, 1], 3) @ rows[:, 0]


def loops_in_loops(x, y):
    """Inner loops whose first values are those of the outer carry, read by others or not.

    Their conditions would hold in lanes that have left the outer loop.
    """
    table = jnp.outer(jnp.linspace(0.1, 1, 20), x) + y[0]
    steps = jnp.where(x[1] > 0, 3, 1)

    def inner(count, table):
        change = lambda c: (c[0] + 1, jnp.sin(1.3 * c[1][::-1]) + y[1])
        return jax.lax.while_loop(lambda c: c[0] < count, change, (0, table))[1]

    def turn(carry):
        k, first, second, third = carry
        first = inner(2, inner(steps, first))
        changed = inner(steps, second)
        swapped = jax.lax.while_loop(
            lambda c: c[0] < steps,
            lambda c: (c[0] + 1, c[2], c[1]),
            (0, third, third[::-1]),
        )
        branch = jax.lax.cond(k > 1, lambda z: inner(1, z), jnp.cos, swapped[2])
        return k + 1, changed, first + 0.1 * second, branch

    carry = 0, table, table[::-1], 2 * table
    last = jnp.where(y[2] > 0.6, 4, 2)
    _, *out = jax.lax.while_loop(lambda c: c[0] < last, turn, carry)
    return [x.sum(axis=0) for x in out]


def loops_in_conditions(x, y):
    """A loop begins with the carry of the loop whose condition it is a part of."""
    table = jnp.outer(jnp.linspace(0.1, 1, 20), x)
    change = lambda c: (c[0] + 1, jnp.sin(1.3 * c[1]))
    ahead = lambda z: jax.lax.while_loop(lambda c: c[0] < 3, change, (0, z))[1]
    goes_on = lambda c: (c[0] < 4) & (jnp.max(ahead(c[1])) > 0.1 * y[0])
    count, z = jax.lax.while_loop(
        goes_on, lambda c: (c[0] + 1, 0.9 * c[1] - 0.01), (0, table)
    )
    doubled = lambda z: jax.lax.while_loop(lambda d: d < 5, lambda d: 2 * d, z)
    single = jax.lax.while_loop(
        lambda c: (doubled(c[0]) < 100) & (c[1] < 4),
        lambda c: (c[0] + 1, c[1] + 1),
        (y[1], 0),
    )
    return count, z.sum(axis=0), single


def carries_that_stay(x, y):
    """The tangent that an inner loop only reads is what another one begins with."""
    table = jnp.outer(x, jnp.linspace(0.1, 1, 30)).ravel()

    def turned(n, z):
        change = lambda c: (c[0] + 1, jnp.sin(1.3 * c[1]) + y[0])
        return jax.lax.while_loop(lambda c: c[0] < n, change, (0, z))[1]

    def body(carry):
        k, z, tangent = carry
        total = 0.1 * turned(2, z).mean()

        def inner(z):
            change = lambda c: (c[0] + 1, c[1] + jnp.sin(c[2]) * total, c[2] + 1.0)
            first = (0, jnp.full(z.shape, total), z)
            return jax.lax.while_loop(lambda c: c[0] < 3, change, first)[1:]

        (sums, _), (rates, stays) = jax.jvp(inner, (0.5 * table,), (tangent,))
        return k + 1, 0.1 * sums + rates, turned(3, stays)

    carry = 0, table, table[::-1]
    _, *out = jax.lax.while_loop(lambda c: c[0] < 4, body, carry)
    return [jnp.sum(z.reshape(3, -1), axis=1) for z in out]


def rows_after_the_first(x, y):
    """The cell before the rows belongs to a number that all lanes may share."""

    def turn(x, _):
        # It contracts, so that rounding errors do not grow.
        x = jnp.sin(0.3 * x * y[0]) + jnp.cos(y)
        shared = jnp.stack([x[0], jnp.cos(y[1]), jnp.sin(y[1])])
        return x, (shared[jnp.where(x[1] > 0.3, 1, 2)], x)

    shared, rows = jax.lax.scan(turn, x, None, length=40)[1]
    rows = jnp.concatenate([x[None], rows])
    return jnp.sum(rows**2, axis=1), jnp.sum(shared)


def known_numbers_among_others(x, y):
    """Of small tables at computed places: each pass has them in its own memory."""
    k = jnp.where(x[1] > 0, 1, 2)
    table = jnp.stack([0.5, x[0] * y[0], y[1], 2.0])
    return table[k], table[3 - k], jnp.stack([0.0, x[2] + y[2]])[k - 1]


OF_LANES = [
    arithmetic,
    known_numbers_among_others,
    computed_places,
    loops_of_lanes,
    tables_of_lanes,
    running_sums,
    factors_of_lanes,
    long_rows,
    loops_in_loops,
    loops_in_conditions,
    carries_that_stay,
    rows_after_the_first,
]


@pytest.mark.parametrize("written_out", [0, 150])
@pytest.mark.parametrize("fn", OF_LANES, ids=lambda fn: fn.__name__)
def test_lanes_equal_single_calls(fn, written_out, monkeypatch):
    """Shared inputs, too. The differences are round-off: sums have another order."""
    monkeypatch.setattr(loops, "_WRITTEN_OUT", written_out)
    rng = np.random.default_rng(3)
    x, y = jnp.asarray(rng.normal(size=(2, LANES, 3)))
    y = jnp.abs(y) + 0.1
    for shared in (False, True):
        axes, ys = (0, None if shared else 0), y[0] if shared else y
        batch = jax.vmap(in_one_function(fn), in_axes=axes)
        assert is_compiled(batch, x, ys)
        found = jax.jit(batch)(x, ys)
        expected = jax.vmap(fn, in_axes=axes)(x, ys)
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)
        jax.tree.map(close, found, expected)


def test_lanes_have_their_own_iterations():
    """And each is as it is alone, to the bit."""

    def turn(carry):
        turns, x = carry
        return turns + 1, jnp.sin(x) + x

    count = lambda x: jax.lax.while_loop(lambda c: c[0] < x[0, 0], turn, (0.0, x))
    whole, xs = in_one_function(count), jnp.arange(12000.0).reshape(2000, 2, 3) / 3000
    turns, ends = jax.jit(jax.vmap(whole))(xs)
    for lane in (0, 7, 1999):
        alone = jax.jit(whole)(xs[lane])
        assert turns[lane] == alone[0] == np.ceil(xs[lane, 0, 0])
        np.testing.assert_array_equal(ends[lane], alone[1])


def test_threads_share_lanes():
    """Also of calls within loops of XLA, which run on the same threads, and of calls at the
    same time."""

    def turns(x):
        turn = lambda c: (c[0] + 1, jnp.sin(c[1]) + x)
        return jax.lax.while_loop(lambda c: c[0] < 5 + 10 * x, turn, (0, x))

    batch = jax.vmap(in_one_function(turns))
    alone = jax.jit(in_one_function(turns))
    again = jax.jit(lambda x: jax.lax.fori_loop(0, 20, lambda k, y: 0.5 * batch(y)[1], x))
    batch, lengths = jax.jit(batch), (4, 5, 9, 64, 1000)
    xs = [jnp.linspace(0, 1, n) for n in lengths]
    expected = [np.array([alone(x)[1] for x in of[:5]]) for of in xs]
    in_loops = [again(x) for x in xs]

    def calls(_):
        for x, values, end in zip(xs, expected, in_loops, strict=True):
            for _ in range(30):
                np.testing.assert_array_equal(batch(x)[1][:5], values)
                np.testing.assert_array_equal(again(x), end)

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        list(pool.map(calls, range(4)))


def long_branch(x):
    """A loop with branches of so many operations that they are compiled when taken."""
    turns = jnp.arange(60.0).reshape(20, 3)

    def many(x):
        for k in range(20):
            x = jnp.sin(x + turns[k]) + jnp.roll(x, 1) * jnp.outer(x, turns[k])[0, 1:2]
        return x

    def branch(x):
        return jax.lax.cond(x[0] > 0.55, many, jnp.cos, many(x))

    turn = lambda k, x: jax.lax.cond(x[k % 3] > 0.5, branch, lambda x: x + 0.1, x)
    return jax.lax.fori_loop(0, 6, turn, x)


def test_a_long_branch_is_compiled_when_it_is_taken(monkeypatch):
    monkeypatch.setattr(emission, "_LARGE_BRANCH", 50)
    kept = library._library()._kept
    before = set(kept)
    fn = jax.jit(in_one_function(long_branch))
    never, often = jnp.full(3, -1.0), jnp.array([0.6, 0.2, 0.9])
    np.testing.assert_allclose(fn(never), never + 0.6, rtol=4 * EPS)
    (name,) = set(kept) - before
    assert len(kept[name]._engines) == 1
    expected = jax.jit(long_branch)(often)
    # Round-off of the sums in six turns.
    np.testing.assert_allclose(fn(often), expected, rtol=1e-13, atol=1e-13)
    assert len(kept[name]._engines) == 3
    np.testing.assert_array_equal(fn(often), fn(often))
    assert len(kept[name]._engines) == 3
    # Several threads come to the branches of a batch at the same time.
    xs = jnp.linspace(-2, 1, 600).reshape(200, 3)
    batch = jax.jit(jax.vmap(in_one_function(long_branch)))
    np.testing.assert_allclose(batch(xs), jax.vmap(long_branch)(xs), rtol=0, atol=1e-12)


def test_code_of_a_large_system_hardly_grows_with_its_rows(monkeypatch):
    texts = []
    added = library._Library.added

    def count(self, code, is_kept):
        texts.append(sum(map(len, code.texts)))
        return added(self, code, is_kept)

    monkeypatch.setattr(library._Library, "added", count)
    problem = ej.problems.chain(70)
    sizes = []
    for num_steps in (30, 250):
        texts.clear()
        run = (problem.system, ej.EnergyPreserving(), problem.start, problem.args)
        ej.simulate(*run, h=1e-4, num_steps=num_steps)
        sizes.append(sum(texts))
    few, many = sizes
    assert few > 0
    # 1.3, because rows that are not reached become NaN together. If all rows were observed
    # together too, the code would grow 1.8 times.
    assert many <= 1.5 * few


def test_an_interrupt_while_a_branch_is_compiled_comes_after_it(monkeypatch):
    """No exception can pass through machine code."""
    monkeypatch.setattr(emission, "_LARGE_BRANCH", 50)
    compile_text, names = library._Compiled._address, []

    def interrupted(self, text, name):
        names.append(name)
        if names.count("branch") == 1:
            raise KeyboardInterrupt
        return compile_text(self, text, name)

    monkeypatch.setattr(library._Compiled, "_address", interrupted)
    fn, x = lambda x: 2 * long_branch(x), jnp.array([0.6, 0.2, 0.9])
    compiled = jax.jit(in_one_function(fn))

    def run():
        jax.block_until_ready(compiled(x))
        time.sleep(5)

    with pytest.raises(KeyboardInterrupt):
        run()
    assert names[:3] == ["handler", "branch", "branch"]
    np.testing.assert_allclose(compiled(x), jax.jit(fn)(x), rtol=1e-13, atol=1e-13)


def test_other_processors_compute_all_lanes_at_the_same_time(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    fn, xs = lambda x: (jnp.sin(x) * x).sum(), jnp.arange(21.0).reshape(7, 3)
    lanes = jax.jit(jax.vmap(in_one_function(fn)))
    text = lanes.trace(xs).lower(lowering_platforms=("cuda",)).as_text()
    assert "while" not in text  # a loop over the lanes
    np.testing.assert_allclose(lanes(xs), jax.vmap(fn)(xs), rtol=4 * EPS)
    rates = jax.jit(jax.vmap(jax.grad(in_one_function(fn))))(xs)
    np.testing.assert_allclose(rates, jax.vmap(jax.grad(fn))(xs), rtol=4 * EPS)


@pytest.mark.slow
def test_results_of_many_lanes_are_computed_in_chunks(monkeypatch):
    from enerjax._programs.machine_code import calls

    monkeypatch.setattr(calls, "_MOST_OF_LANES", 50)
    xs = jnp.arange(57.0).reshape(19, 3)
    fn = lambda x: (jnp.sin(x), x.sum())
    found = jax.jit(jax.vmap(in_one_function(fn)))(xs)
    # Sines of this project and of XLA differ in the last digit.
    close = functools.partial(np.testing.assert_allclose, rtol=EPS)
    jax.tree.map(close, found, jax.jit(jax.vmap(fn))(xs))
