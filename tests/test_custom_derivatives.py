"""Functions with a custom derivative, and selections with an undefined branch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._programs import why_not_one_function

from .helpers import EPS


def _by_parts(q):
    mantissa, exponent = jnp.frexp(q)
    return mantissa * 2.0 ** exponent.astype(float)


def test_a_function_of_bits_has_the_force_of_its_derivative():
    """The number made of its mantissa and exponent: harmonic motion, in closed form."""
    system = ej.System(
        lambda v, args: 0.5 * v @ v, lambda q, args: 0.5 * jnp.sum(args * _by_parts(q) ** 2)
    )
    stiffness, q = jnp.array([1.0, 4.0]), jnp.array([0.7, 1.1])
    start = ej.State(q, jnp.zeros(2))
    scheme = ej.EnergyPreserving()
    run = ej.simulate(system, scheme, start, stiffness, h=0.01, num_steps=100)
    # Truncation, of second order; steps across a power of two are corrected.
    exact = q * np.cos(np.sqrt(stiffness))
    np.testing.assert_allclose(run.ys.q[-1], exact, rtol=0, atol=1e-3)
    fallbacks = ej.discrete_fallbacks(_by_parts)(q, q + 0.1)
    # The name depends on the version of JAX.
    assert fallbacks


@jax.custom_jvp
def _norm(x):
    return jnp.sqrt(x @ x)


@_norm.defjvp
def _norm_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    size = _norm(x)
    return size, jnp.where(size > 0, x @ dx / jnp.where(size > 0, size, 1), 0.0)


@jax.custom_vjp
def _table(x):
    return jnp.sum(jnp.round(100 * x) / 100)


_table.defvjp(lambda x: (_table(x), x), lambda x, ct: (ct * jnp.ones_like(x),))


@jax.custom_jvp
def _outside(x):
    like = jax.ShapeDtypeStruct((), x.dtype)
    square = lambda x: np.sum(np.asarray(x) ** 2)
    return jax.pure_callback(square, like, x, vmap_method="sequential")


@_outside.defjvp
def _outside_jvp(primals, tangents):
    return _outside(*primals), 2 * primals[0] @ tangents[0]


@pytest.mark.parametrize("fn", [_norm, _table, _outside], ids=["norm", "table", "callback"])
def test_a_custom_derivative_is_used(fn):
    a, b = jnp.array([0.0, 0.0]), jnp.array([0.3, -0.4])
    D = ej.discrete_grad(fn)
    # Round-off.
    for x, y in ((a, b), (b, 2 * b)):
        assert abs(D(x, y) @ (y - x) - (fn(y) - fn(x))) <= 10 * EPS
    for x in (a, b):
        np.testing.assert_allclose(D(x, x), jax.grad(fn)(x), rtol=0, atol=10 * EPS)
    assert ej.discrete_fallbacks(fn)(a, b)


def test_functions_of_jax_are_walked_through():
    """They keep the momenta that the function shows, as their programs inside do."""
    cubic = lambda x: jnp.polyval(jnp.array([2.0, -1.0, 3.0, 0.5]), x)
    for fn in (jax.nn.relu, jnp.sinc, cubic, lambda x: jax.scipy.special.xlogy(x, x)):
        assert ej.discrete_fallbacks(fn)(1.0, 2.0) == []
    assert why_not_one_function(jax.grad(cubic), 1.0) == ()


LOGS = (jnp.log, jnp.log1p, lambda x: jnp.log(x) + jnp.arctanh(x))


@pytest.mark.parametrize("other", LOGS)
def test_a_branch_that_is_not_chosen_does_not_spread_nan(other):
    fn = lambda q: jnp.where(q > -5, q**2, other(q))
    for a, b in ((-1.5, -1.2), (-3.0, -1.5), (-3.0, 3.0), (-2.0, -2.0), (2.0, 4.0)):
        assert ej.discrete_grad(fn)(a, b) == pytest.approx(a + b, abs=10 * EPS)
        slope = jax.jacfwd(ej.discrete_grad(fn), 1)(a, b)
        assert slope == pytest.approx(1, abs=10 * EPS)


def test_a_chosen_undefined_branch_is_nan():
    assert np.isnan(ej.discrete_grad(jnp.log)(-1.0, -0.9))
