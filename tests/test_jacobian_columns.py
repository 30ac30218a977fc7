"""Columns of Jacobians, computed side by side."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from enerjax._programs.sparsity.jacobian_columns import (
    columns_along,
    columns_in_turn,
    jacobian_columns,
)
from enerjax._solvers.linear.dense import inverse


X = jnp.linspace(0.2, 0.8, 6)
TABLE = jnp.sin(jnp.arange(12.0).reshape(3, 4))


def arithmetic(x):
    y = jnp.sin(x[:3]) * x[3:] / (1 + x[:3] ** 2) - jnp.exp(x[0])
    return jnp.where(x > 0.5, jnp.concatenate([y, -y]), x**3) + 2


def moves(x):
    table = jnp.pad(x.reshape(2, 3).T, ((1, 0), (0, 2)))
    parts = jnp.split(table[::2, 1:], [1], axis=1)
    parts.append(jax.lax.reshape(table, (2, 8), (1, 0)))
    return jnp.concatenate([part.ravel() for part in parts] + [jnp.ones(2)])


def lines_up(x):
    """With operands of which only some depend on `x`."""
    padded = jax.lax.pad(jnp.ones(2), x[0], ((1, 2, 1),))
    return jnp.concatenate([padded, x, jnp.stack([x[1], jnp.ones(())])])


def products(x):
    matrix = x.reshape(2, 3)
    return jnp.concatenate([TABLE.T @ x[:3], (matrix @ matrix.T).ravel(), (x @ x)[None]])


def large_sums(x):
    """Of 768 entries for each column, which are taken in parts, and of too many."""
    few = jnp.sin(jnp.arange(128.0))[:, None] * x[None]
    many = jnp.cos(jnp.arange(6000.0))[:, None] * x[None] / 100
    return jnp.concatenate([jnp.sum(few, axis=1), jnp.sum(few, axis=0), many.sum(axis=0)])


def loops(x):
    after = jax.lax.fori_loop(0, 3, lambda k, y: y * x + jnp.roll(y, 1), x)
    sums = jax.lax.scan(lambda c, y: (c + y, c * y), 1.0, x)[1]
    return jnp.concatenate([after, sums, jnp.cumsum(x), x[jnp.array([4, 0])]])


def others(x):
    matrix = inverse(jnp.eye(4) + jnp.outer(x[:4], x[2:]))
    top = jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x).at[1].add(x[2])
    return jnp.concatenate([matrix[0], top, jnp.sort(-x), jax.nn.relu(x - 0.5)])


@jax.custom_jvp
def asks(x):
    return x**2


@asks.defjvp
def _asks_jvp(primals, tangents):
    (x,), (t,) = primals, tangents
    return asks(x), jnp.where(t == 0, 0, 2 * x * t) + jnp.where(t != 0, 0, t)


def parts(x):
    """Of the unknowns in groups, which come together later."""
    first, second, third = x[:2], x[2:3], x[3:]
    y = jnp.sin(third) * jnp.outer(first, third).sum(axis=0)
    return jnp.concatenate([y, asks(first), asks(x[1:]), second * first, first[::-1]])


def reordered(x):
    """With an axis that has no entries."""
    none = jnp.sum(x[6:].reshape(-1, 3), axis=0)
    return jnp.concatenate([x.reshape(2, 3).ravel(order="F"), x[:3] + none])


def nothing(x):
    return jnp.ones(2)


FUNCTIONS = [
    arithmetic,
    moves,
    lines_up,
    products,
    large_sums,
    loops,
    others,
    parts,
    reordered,
    nothing,
]


@pytest.mark.parametrize("fn", FUNCTIONS)
def test_columns_are_those_of_the_jacobian(fn):
    """Alone, of each lane of a batch, and their own derivatives."""
    at = jax.jit(lambda x: jacobian_columns(fn, x))(X)
    np.testing.assert_allclose(at, jax.jacfwd(fn)(X), rtol=0, atol=1e-14)  # round-off
    xs = jnp.stack([X, X**2])
    for transform in (
        lambda jacobian: jax.vmap(jacobian)(xs),
        lambda jacobian: jax.jvp(jacobian, (X,), (jnp.cos(X),))[1],
        lambda jacobian: jax.grad(lambda x: jnp.sum(jnp.sin(jacobian(x))))(X),
    ):
        ours = jax.jit(lambda f=transform: f(lambda x: jacobian_columns(fn, x)))()
        theirs = jax.jit(lambda f=transform: f(jax.jacfwd(fn)))()
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-13)  # round-off


def test_columns_along_seeds():
    """Of a function whose values have axes of their own."""
    fn = lambda x: jnp.sin(x.reshape(2, 3)) * x[0]
    seeds = np.cos(np.arange(24.0).reshape(6, 4))
    ours = columns_along(fn, X, seeds)
    assert ours.shape == (2, 3, 4)
    np.testing.assert_allclose(ours, jax.jacfwd(fn)(X) @ seeds, rtol=0, atol=1e-14)


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_columns_in_turn(monkeypatch, backend):
    """The same columns, also their derivatives; on CPUs by a program of one product."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    fn = lambda x: jnp.sin(x.reshape(2, 3)) * x[0]
    for count in (4, 40):
        seeds = np.cos(np.arange(6.0 * count).reshape(6, count))
        in_turn = lambda x, seeds=seeds: columns_in_turn(fn, x, seeds)
        together = lambda x, seeds=seeds: columns_along(fn, x, seeds)
        for of in (lambda f: f(X), lambda f: jax.jvp(f, (X,), (jnp.cos(X),))[1]):
            ours, theirs = of(in_turn), of(together)
            assert ours.shape == (2, 3, count)
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-14)  # round-off
        equations = jax.make_jaxpr(in_turn)(X).jaxpr.eqns
        scans = [e.outvars[0].aval.shape for e in equations if e.primitive.name == "scan"]
        assert scans == ([(count, 2, 3)] if backend == "cpu" else [])


def test_columns_that_are_zero_are_not_computed():
    """Of values that depend on two of the six unknowns, also as a part of more."""
    whole = lambda x: jnp.append(jnp.sin(jnp.sin(x[2:4])), x[4:] * x[:2])
    part = lambda x: jnp.sin(jnp.append(jnp.sin(x[2:4]), x[:2])[:2])
    for fn in (whole, part):
        program = jax.make_jaxpr(lambda x, fn=fn: jacobian_columns(fn, x))(X)
        products = [e for e in program.jaxpr.eqns if e.primitive.name == "mul"]
        assert {e.outvars[0].aval.shape for e in products} <= {(2,), (2, 2)}
        assert len(products) >= 2
