"""Energies and constraint residuals along a run, to judge it by."""

import equinox as eqx
import jax
from jaxtyping import Array, Float

from ._model import AbstractModel
from ._system import State


class Audit(eqx.Module):
    """What a run did to the energy and to the constraints, at each saved time.

    - `kinetic`, `potential`, `energy`: shape `(times,)` (energy).
    - `dissipated`: shape `(times,)`, the energy that the scheme removed since the row
      before, by its own identity; 0 in row 0.
    - `work`, `drive_work`: shape `(times,)`, the work of `force` and that of `driven`
      constraints on the system since the row before; 0 where the system has none.
      `energy[k] = energy[k-1] + work[k] + drive_work[k] - dissipated[k]` up to round-off
      and what Newton left.
    - `constraint`: shape `(times, nc)`, residuals of the constraints: joints, driven ones,
      relations between coordinates, in their own units.
    - `constraint_rate`: shape `(times, nj)`, residuals of joints and driven constraints
      at velocity level.
    """

    kinetic: Float[Array, " times"]
    potential: Float[Array, " times"]
    dissipated: Float[Array, " times"]
    work: Float[Array, " times"]
    drive_work: Float[Array, " times"]
    constraint: Float[Array, "times nc"]
    constraint_rate: Float[Array, "times nj"]

    @property
    def energy(self) -> Float[Array, " times"]:
        return self.kinetic + self.potential


def audit(
    model: AbstractModel,
    states: State,
    dissipated: Float[Array, " times"],
    work: Float[Array, " times"] | None,
    drive_work: Float[Array, " times"] | None,
) -> Audit:
    """The audit of states with a leading time axis."""

    def at(state: State):
        return (
            model.kinetic(state),
            model.potential(state),
            model.constraint(state.q, state.t),
            model.joint_rate(state.q, state.v, state.t),
        )

    kinetic, potential, constraint, rate = jax.vmap(at)(states)
    # Where a row is not a number, none of its entries is.
    none = 0 * dissipated
    return Audit(
        kinetic,
        potential,
        dissipated,
        none if work is None else work,
        none if drive_work is None else drive_work,
        constraint,
        rate,
    )
