"""The motion within a step as a polynomial, from the rates of change along it.

The equations of motion, with constraints differentiated twice, give the rates of positions
and velocities in any state. A cubic Hermite polynomial through the states and rates at
both ends of a step gives the states at a few nodes, with an error of `h^4`. Integrating
the rates there gives better states (Picard's iteration): each iteration gains one order,
up to that of the nodes. The integral over the whole step is an independent estimate of its
end.
"""

import functools
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._analysis import project_position, project_velocity
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

    The integrals are coefficients: row `j` belongs to node `j`, column `k` to `x^(k+1)`.
    """
    inner = np.polynomial.legendre.Legendre.basis(num - 1).deriv().roots()
    nodes = 0.5 * (1 + np.concatenate([[-1.0], np.sort(inner.real), [1.0]]))
    values = np.vander(nodes, increasing=True)
    return nodes, np.linalg.inv(values).T / np.arange(1, num + 1)


def _weights(num: int, x: Any) -> Any:
    """The integrals from 0 to `x` of the Lagrange polynomials, with the nodes last."""
    _, integrals = _lobatto(num)
    numbers: Any = np if isinstance(x, np.ndarray) else jnp
    powers = numbers.stack([x**k for k in range(1, num + 1)], axis=-1)
    return (powers[..., None, :] * numbers.asarray(integrals, x.dtype)).sum(-1)


def _combine(weights: Float[Array, "... n"], values: Any) -> Any:
    """Weighted sums over the leading axis of `values`.

    They are written out: a loop runs small matrix products more slowly than sums.
    """

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
    iterations: int,
) -> Pair:
    """The rates at Lobatto's nodes of a step, with an error of `h^(4 + iterations)`."""
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
    return jax.lax.scan(improve, f, None, length=iterations)[0] if iterations > 0 else f


def integral(f: Pair, x: Scalar) -> Pair:
    """The integral of the rates at the nodes, `(nodes, n)`, from 0 to `x`, over `h`."""
    return _combine(_weights(f[0].shape[0], x), f)


def end_of(start: State, h: Scalar, f: Pair, t: Time) -> State:
    """The end of a step by the integral of the rates."""
    q, v = integral(f, jnp.ones((), h.dtype))
    return State(start.q + h * q, start.v + h * v, t)


def state_within(
    model: AbstractModel, a: State, b: State, h: Scalar, part: Scalar, order: int
) -> State:
    """The state at the fraction `part` of a step from `a` to `b`, to `h^(order + 1)`.

    It is that of the collocation polynomial, which is shifted so that it ends in `b`,
    projected onto the constraints at position and velocity level. At the ends of the step
    it is `a` or `b` itself.
    """
    at_ends = rates(model, a), rates(model, b)
    f = rates_along(model, a, b, h, at_ends, max(order, 3), max(order - 4, 0))
    q, v = integral(f, part)
    reached = end_of(a, h, f, b.t)
    blend = part**2 * (3 - 2 * part)
    q = a.q + h * q + blend * (b.q - reached.q)
    v = a.v + h * v + blend * (b.v - reached.v)
    t = None if a.t is None else a.t + part * h
    q, _ = project_position(model, State(q, v, t), ())
    v, _ = project_velocity(model, State(q, v, t), ())
    at_end = lambda x, x0, x1: jnp.where(part == 0, x0, jnp.where(part == 1, x1, x))
    return jax.tree.map(at_end, State(q, v, t), a, b)
