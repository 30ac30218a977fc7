"""The motion within a step as a polynomial, from the rates of change along it.

The equations of motion, their constraints differentiated twice, say how positions and
velocities change in any state. Between the two ends of a step, where states and rates are
known, a cubic Hermite polynomial gives states at a few nodes, of error `h^4`. The rates
there, integrated, give better ones: each turn gains one order (Picard's iteration), up to
the order of the nodes. The integral over the whole step is a second opinion about its end.
"""

import functools
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._operators import AbstractModel, Time
from .._system import State
from .._types import Coordinates, Scalar, Velocities


# Positions and velocities (or momenta), or their rates of change.
Pair: TypeAlias = tuple[Coordinates, Velocities]
Numbers: TypeAlias = np.ndarray[Any, np.dtype[np.floating]]


def rates(model: AbstractModel, state: State) -> Pair:
    """`(qdot, vdot)` by the equations of motion."""
    return model.lift(state.q, state.v), model.accelerations(state)[0]


@functools.cache
def _lobatto(num: int) -> tuple[Numbers, Numbers]:
    """Lobatto's nodes on [0, 1], and the integrals from 0 of the Lagrange polynomials.

    The latter as coefficients: row `j` belongs to node `j`, column `k` to `x^(k+1)`.
    """
    inner = np.polynomial.legendre.Legendre.basis(num - 1).deriv().roots()
    nodes = 0.5 * (1 + np.concatenate([[-1.0], np.sort(inner.real), [1.0]]))
    values = np.vander(nodes, increasing=True)
    return nodes, np.linalg.inv(values).T / np.arange(1, num + 1)


def _weights(num: int, x: Any) -> Any:
    """The integrals from 0 to `x` of the Lagrange polynomials: last axis, the nodes."""
    _, integrals = _lobatto(num)
    numbers: Any = np if isinstance(x, np.ndarray) else jnp
    powers = numbers.stack([x**k for k in range(1, num + 1)], axis=-1)
    return (powers[..., None, :] * numbers.asarray(integrals, x.dtype)).sum(-1)


def _combine(weights: Float[Array, "... n"], values: Any) -> Any:
    """Sums over the leading axis of `values`, written out: small products in a loop."""

    def combined(x: Array) -> Array:
        rows = x.reshape(*[1] * (weights.ndim - 1), *x.shape)
        return jnp.sum(weights.reshape(*weights.shape, 1) * rows, axis=-2)

    return jax.tree.map(combined, values)


def _hermite(x: Numbers, h: Scalar, a: Pair, b: Pair, fa: Pair, fb: Pair) -> Pair:
    """The cubic polynomial with these ends and rates, at the numbers `x`."""
    of_ends = (1 + 2 * x) * (1 - x) ** 2, x**2 * (3 - 2 * x)
    of_rates = x * (1 - x) ** 2, x**2 * (x - 1)
    weights = jnp.asarray(np.stack([*of_ends, *of_rates], axis=1), h.dtype)
    stacked = jax.tree.map(
        lambda a, b, fa, fb: jnp.stack([a, b, h * fa, h * fb]), a, b, fa, fb
    )
    return _combine(weights, stacked)


def rates_along(
    model: AbstractModel,
    start: State,
    end: State,
    h: Scalar,
    at_ends: tuple[Pair, Pair],
    num_nodes: int,
    turns: int,
) -> Pair:
    """The rates at Lobatto's nodes of a step, whose error is `h^(4 + turns)`."""
    nodes, _ = _lobatto(num_nodes)
    inner = nodes[1:-1]
    first, last = at_ends
    begin = start.q, start.v
    weights = jnp.asarray(_weights(num_nodes, inner), h.dtype)

    def rates_at(states: Pair) -> Pair:
        times = None if start.t is None else start.t + h * jnp.asarray(inner, h.dtype)
        rate = lambda q, v, t: rates(model, State(q, v, t))
        between = jax.vmap(rate)(*states, times)
        join = lambda a, x, b: jnp.concatenate([a[None], x, b[None]])
        return jax.tree.map(join, first, between, last)

    def improve(f: Pair, _: None) -> tuple[Pair, None]:
        moved = _combine(weights, f)
        return rates_at(jax.tree.map(lambda a, x: a[None] + h * x, begin, moved)), None

    f = rates_at(_hermite(inner, h, begin, (end.q, end.v), first, last))
    return jax.lax.scan(improve, f, None, length=turns)[0] if turns > 0 else f


def integral(f: Pair, x: Scalar) -> Pair:
    """What the rates at the nodes, `(nodes, n)` each, add from 0 to `x`, divided by `h`."""
    return _combine(_weights(f[0].shape[0], x), f)


def end_of(start: State, h: Scalar, f: Pair, t: Time) -> State:
    """Where the integrated rates lead."""
    q, v = integral(f, jnp.ones((), h.dtype))
    return State(start.q + h * q, start.v + h * v, t)
