"""Whole steps as one function of machine code, with the same values."""

import functools

import jax
import jax.numpy as jnp
import jax.scipy.special as special
import numpy as np
import pytest
from jax.ad_checkpoint import checkpoint_name

from enerjax._programs import in_one_function, unmerged
from enerjax._programs.jaxprs import programs_within
from enerjax._programs.one_function import marks, possible
from enerjax._solvers.linear.dense import Inverse


pytestmark = pytest.mark.skipif(
    not marks.KNOWS_MARKS or jax.default_backend() != "cpu",
    reason="for versions of XLA that know the marks",
)
X = jnp.linspace(0.15, 0.85, 6).reshape(2, 3)
K = jnp.arange(1, 7).reshape(2, 3)


def is_marked(fn, *args):
    """Whether a program calls a function of ours. (XLA itself makes some of loops.)"""
    text = jax.jit(fn).lower(*args).compile().as_text() or ""
    calls = [line for line in text.splitlines() if "to_apply=%with_witness" in line]
    return any('xla_cpu_small_call="true"' in line for line in calls)


def names(jaxpr):
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        for inner in programs_within(eqn):
            yield from names(inner)


def elementwise(x, k):
    lax = jax.lax
    bits = k.astype(jnp.uint64)
    return [
        *(f(x) for f in (jnp.abs, jnp.acos, jnp.asin, jnp.atan, jnp.asinh, jnp.atanh)),
        *(f(x) for f in (jnp.ceil, jnp.floor, jnp.round, jnp.sign, jnp.cos, jnp.sin)),
        *(f(x) for f in (jnp.tan, jnp.cosh, jnp.sinh, jnp.tanh, jnp.exp, jnp.exp2)),
        *(f(x) for f in (jnp.expm1, jnp.log, jnp.log1p, jnp.sqrt, jnp.cbrt, lax.rsqrt)),
        *(f(x) for f in (jnp.isfinite, jax.nn.sigmoid, lax.erf, lax.erfc, lax.erf_inv)),
        *(f(x) for f in (special.gammaln, special.digamma, jnp.square, lax.neg)),
        jnp.acosh(1 + x),
        *(f(x, 1 - x) for f in (jnp.atan2, jnp.maximum, jnp.minimum, lax.rem, lax.div)),
        *(f(x, 1 - x) for f in (jnp.nextafter, lax.eq, lax.ne, lax.lt, lax.le, lax.gt)),
        *(f(x, 1 - x) for f in (lax.ge, lax.pow, lax.sub, lax.mul, lax.add)),
        x**3,
        lax.clamp(0.2, x, 0.6),
        *(f(k, k + 1) for f in (lax.bitwise_and, lax.bitwise_or, lax.bitwise_xor)),
        lax.bitwise_not(k),
        lax.population_count(bits),
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
        *unmerged(lambda x: (x @ x.T, 2 * x))(x),
        lax.while_loop(lambda c: c[0] < k[0, 1], lambda c: (c[0] + 1, 2 * c[1]), (0, x))[1],
        lax.cond(k[0, 0] > 0, jnp.sin, jnp.cos, x),
        lax.scan(lambda c, y: (c + y, c * y), x[0], x),
        lax.fori_loop(0, 5, lambda n, c: c + n * x, x),
    ]


GROUPS = [elementwise, moves, sums, calls]


@pytest.mark.parametrize("group", GROUPS)
def test_operations_that_are_possible(group):
    out = in_one_function(group)
    assert is_marked(out, X, K)
    plain, whole = jax.jit(group)(X, K), jax.jit(out)(X, K)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(whole), strict=True):
        # Round-off, of sums whose terms are of order one.
        np.testing.assert_allclose(a, b, rtol=4e-15, atol=4e-15)


def test_every_possible_operation_is_tested():
    tried = {name for f in GROUPS for name in names(jax.make_jaxpr(f)(X, K).jaxpr)}
    assert possible.POSSIBLE | possible.POSSIBLE_IF_SMALL <= tried


NOT_POSSIBLE = {
    "sort": lambda x: jnp.sort(jnp.tile(x[0], 20)),
    "scatter": lambda x: x.at[0, (3 * x[0]).astype(int)].add(1.0),
    "eigenvalues": lambda x: jnp.linalg.eigvalsh(x @ x.T + jnp.eye(2)),
    "matrices": lambda x: jnp.tile(x, (30, 4)) @ jnp.tile(x, (6, 20)),
    "in a loop": lambda x: jax.lax.fori_loop(0, 3, lambda _, y: jnp.linalg.qr(y.T)[0].T, x),
}


@pytest.mark.parametrize("name", NOT_POSSIBLE)
def test_impossible_operations_are_compiled_as_usual(name):
    fn = NOT_POSSIBLE[name]
    left = in_one_function(fn)
    assert not is_marked(left, X)
    np.testing.assert_array_equal(jax.jit(left)(X), jax.jit(fn)(X))


@pytest.mark.parametrize("rows", [8, 9, 27, 32])
def test_inverses_are_renewed_in_one_function(rows):
    """Without a part that several threads would share, however large."""
    start = Inverse(jnp.eye(rows))
    change = jnp.sin(jnp.arange(1.0, 1 + rows**2)).reshape(rows, rows) / rows

    def inverses(change):
        matrix = lambda t: jnp.eye(rows) + 0.1 * t * change
        turn = lambda kept, t: (kept.renewed(matrix(t)),) * 2
        return jax.lax.scan(turn, start, jnp.arange(0.0, 5.0))[1].inverse

    whole = in_one_function(inverses)
    assert is_marked(whole, change)
    last = np.eye(rows) + 0.4 * np.asarray(change)
    exact = np.linalg.inv(last)
    # Truncation: errors of 1e-7 are small enough for a chord iteration.
    np.testing.assert_allclose(jax.jit(whole)(change)[-1], exact, rtol=0, atol=1e-6)


def test_inputs_that_are_not_used():
    """They would end the process."""

    def run(x, unused, empty):
        out = in_one_function(lambda x, y: (jnp.sin(x), 0 * empty, 0 * unused[:1] * K + K))
        turn = lambda c, _: (out(c, 2 * c)[0], out(c, 2 * c))
        loop = jax.lax.scan(turn, x, None, length=400)
        return loop[1][2].sum()

    assert is_marked(run, X, K, jnp.zeros((0, 3)))
    assert jax.jit(run)(X, K, jnp.zeros((0, 3))) == 400 * K.sum()


@pytest.mark.parametrize("length", [1000, 20000])
def test_tables_that_are_looked_up(length):
    """Large constants end the process inside of such a function: they become inputs."""
    table = np.sin(np.linspace(0, 1, length))

    def follow(x):
        """To places that the table tells."""
        place = lambda x: jnp.floor(x * length).astype(int)
        return jax.lax.fori_loop(0, 5, lambda _, x: jnp.asarray(table)[place(x)], x)

    whole = in_one_function(follow)
    assert is_marked(whole, 0.9)
    assert jax.jit(whole)(0.9) == follow(0.9)
    # Where all is known XLA folds what it can.
    assert jax.jit(lambda: whole(0.9))() == follow(0.9)
