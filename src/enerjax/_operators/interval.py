"""What an interval is described by: its unknowns and rows, its drive, their scales."""

from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Coordinates, JointMultipliers, Multipliers, Scalar


# Of the states of a system with forces or drives; of others `None`.
Time: TypeAlias = Scalar | None


def lapse_of(t: Time) -> Time:
    """The rate of change of time."""
    return None if t is None else jnp.ones_like(t)


class Increment(eqx.Module):
    """The unknowns that lead to one node of a step, and the rows that determine them.

    | field | as unknown | as row |
    |---|---|---|
    | `impulse` | `h lambda` | `Phi(q)/h` |
    | `rate` | `(q - q0)/h` | balance of momentum, `S_q` |
    | `momentum` | `p`; empty where velocities are eliminated | `S_mu/h` |
    | `velocity_impulse` | `eta` | `psi(q, v)`; empty for index 3 |

    The rate and not `q` is the unknown: the rounding of `q`, divided by `h`, would
    otherwise enter the velocities. Each unknown and its row have reciprocal units, so
    one set of `Scales` serves both. The order puts those together that velocities depend
    on: Jacobians are found for neighbouring unknowns at a time.
    """

    impulse: Multipliers
    rate: Coordinates
    momentum: Float[Array, " np"]
    velocity_impulse: JointMultipliers


class Drive(eqx.Module):
    """What drives an interval: `h w_q`, and `w_mu` where momenta are unknowns.

    `work` is `h w_t`, the work of driven constraints over it; `None` where there are none.
    """

    impulse: Coordinates
    drift: Float[Array, " np"]
    work: Scalar | None = None

    def less(self, load: Coordinates | None) -> "Drive":
        """With forces, given as `h Lm^T f`."""
        if load is None:
            return self
        return Drive(self.impulse - load, self.drift, self.work)


class Scales(eqx.Module):
    """How large a unit of each unknown is in the square root of an energy.

    `coordinate`: of a rate of change of each coordinate (square root of a mass).
    `constraint`: of the rate of change of each constraint, in the same measure; so
    `rate * coordinate`, `constraint rate / constraint` and
    `impulse * constraint` all have the dimension of the square root of an energy.
    """

    coordinate: Float[Array, " nq"]
    constraint: Float[Array, " nc"]
    # What the constraints are differences of: their round-off, divided by eps.
    constraint_size: Float[Array, " nc"]
