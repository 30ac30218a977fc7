"""The function of positions and rates whose discrete gradient is the one of a step."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from .._discrete import RotationRule
from .._system import State
from .._types import Coordinates, Scalar
from .base import AbstractModel
from .interval import Gradient, Increment, Time


def action_of(
    model: AbstractModel, h: Scalar, fixed: Increment, nonholonomic: Increment
) -> Callable[[Coordinates, Coordinates], Scalar]:
    """`h (V + lambda . Phi + eta . psi)` of coordinates and their rates.

    It is without the driven constraints. `fixed` and `nonholonomic` have the multipliers of
    such constraints alone.
    """

    def action(q: Coordinates, rates: Coordinates) -> Scalar:
        out = h * model.potential(State(q, rates))
        num_fixed = fixed.velocity_impulse.size
        if num_fixed > 0:
            # Both from one evaluation, which the transpose then passes once.
            rows, psi = jax.jvp(model.all_fixed, (q,), (rates,))
            out = out + fixed.impulse @ rows
            out = out + h * fixed.velocity_impulse @ psi[:num_fixed]
        elif fixed.impulse.size > 0:
            out = out + fixed.impulse @ model.all_fixed(q)
        if model.has_slip_rate(nonholonomic):
            psi = model.nonholonomic(q) @ rates
            out = out + h * nonholonomic.velocity_impulse @ psi
        return out

    return action


def gradient_in_rows(
    model: AbstractModel,
    rule: RotationRule,
    a: State,
    b: State,
    h: Scalar,
    increment: Increment,
) -> Gradient:
    """The discrete gradient with respect to the rows, in coordinates, rates and time
    together."""
    fixed, driven, nonholonomic = model.split(increment, a.q)
    action = action_of(model, h, fixed, nonholonomic)

    def both(x: tuple[Coordinates, Coordinates, Time]) -> Scalar:
        q, rates, t = x
        if model.system.driven is None:
            return action(q, rates)
        return action(q, rates) + model.driven_action(q, rates, t, h, driven)

    at = lambda state: (state.q, model.lift(state.q, state.v), state.t)
    rows, _, work = rule.gradient(both, at(a), at(b))
    impulse = model.nonholonomic_impulse(a.q[:0], a, b, nonholonomic)
    work = None if model.system.driven is None else work
    return Gradient(impulse, jnp.zeros((0,), h.dtype), work, rows)
