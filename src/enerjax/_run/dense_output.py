"""States within a step, of the order of the scheme, on the constraints."""

import equinox as eqx
import jax
import jax.numpy as jnp

from .._analysis import project_position, project_velocity
from .._operators import AbstractModel
from .._system import State
from .._types import Scalar
from .collocation import end_of, integral, rates, rates_along


class Bracket(eqx.Module):
    """A step, and a time within it.

    - `start`, `end`: the states at its ends.
    - `h`: its length.
    - `part`: from 0 at its start to 1 at its end; there the states are those of the step.
    """

    start: State
    end: State
    h: Scalar
    part: Scalar


def state_within(model: AbstractModel, bracket: Bracket, order: int) -> State:
    """The state at a time within a step, with an error of `h^(order + 1)`.

    The collocation polynomial through the rates in the step, moved onto its end, and the
    nearest state to it that satisfies the constraints at position and velocity level.
    """
    a, b, h, part = bracket.start, bracket.end, bracket.h, bracket.part
    at_ends = rates(model, a), rates(model, b)
    nodes, turns = max(order, 3), max(order - 4, 0)
    f = rates_along(model, a, b, h, at_ends, nodes, turns)
    q, v = integral(f, part)
    arrived = end_of(a, h, f, b.t)
    blend = part**2 * (3 - 2 * part)
    q = a.q + h * q + blend * (b.q - arrived.q)
    v = a.v + h * v + blend * (b.v - arrived.v)
    t = None if a.t is None else a.t + part * h
    q, _ = project_position(model, State(q, v, t), ())
    v, _ = project_velocity(model, State(q, v, t), ())
    whole = lambda x, x0, x1: jnp.where(part == 0, x0, jnp.where(part == 1, x1, x))
    return jax.tree.map(whole, State(q, v, t), a, b)
