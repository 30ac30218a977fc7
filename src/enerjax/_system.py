r"""What the user declares, and the conventions of the whole package.

Equations of motion (paper eq. 12), for coordinates `q` (nq), velocities `v = L(q) qdot`
(nv), constant inertia `M`, potential `V(q)` and holonomic constraints `Phi(q) = 0`:

    L^T M vdot + G(M v) qdot + dV/dq + B^T lambda = 0,   B = dPhi/dq
    v = L qdot,   Phi(q) = 0

so the force of a constraint on the coordinates is `-B^T lambda`, and a potential acts
with `-dV/dq`. Units are the user's own, as long as they are consistent: a multiplier has
the dimension of an energy per unit of its constraint.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._kinematics import (
    AbstractKinematics,
    ConfigurationKinematics,
    IdentityKinematics,
)
from ._types import Args, Coordinates, Multipliers, Scalar, Velocities


def _inexact(x: Any) -> Array:
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)


class State(eqx.Module):
    """Coordinates and velocities at one instant (in a `Solution`: at each saved time).

    - `q`: coordinates, shape `(nq,)`, in the units of the user's own coordinates.
    - `v`: velocities `L(q) qdot`, shape `(nv,)`; `qdot` itself where no `kinematics` is
      given.
    """

    q: Float[Array, "... nq"] = eqx.field(converter=_inexact)
    v: Float[Array, "... nv"] = eqx.field(converter=_inexact)


class System(eqx.Module):
    """A conservative mechanical system with holonomic constraints.

    **Arguments:**

    - `kinetic`: `kinetic(v, args)`, a scalar (energy) that is quadratic in `v` with
      constant inertia; or the inertia matrix itself, `(nv, nv)`, symmetric positive
      definite.
    - `potential`: `potential(q, args)`, a scalar (energy).
    - `constraint`: `constraint(q, args)`, a vector that vanishes in every admissible
      configuration: joints, rods. Leave it out if there is none.
    - `kinematics`: `L(q, args)`, the `(nv, nq)` matrix in `v = L(q) qdot`. Leave it out
      where the velocities are the rates of the coordinates.
    - `coordinate_constraint`: `coordinate_constraint(q, args)`, a vector of `nq - nv`
      relations that the coordinates obey by definition, such as `p @ p - 1` for a unit
      quaternion. Its time derivative vanishes for every `v`, so it is imposed at
      position level only. Needs `kinematics`.

    `args` is any pytree; the functions must be smooth and written with `jax.numpy`.

    A function of the wrong shape, an inertia that is not symmetric positive definite and
    a kinetic energy that is not quadratic raise a `ValueError` when a start is made or a
    run begins, where args and sizes are known.
    """

    kinetic: Callable[[Velocities, Args], Scalar] | Float[Array, "nv nv"]
    potential: Callable[[Coordinates, Args], Scalar]
    constraint: Callable[[Coordinates, Args], Multipliers] | None
    kinematics: AbstractKinematics
    coordinate_constraint: Callable[[Coordinates, Args], Multipliers] | None

    def __init__(
        self,
        kinetic: Callable[[Velocities, Args], Scalar] | ArrayLike,
        potential: Callable[[Coordinates, Args], Scalar],
        constraint: Callable[[Coordinates, Args], Multipliers] | None = None,
        *,
        kinematics: Callable[[Coordinates, Args], Float[Array, "nv nq"]] | None = None,
        coordinate_constraint: Callable[[Coordinates, Args], Multipliers] | None = None,
    ):
        for name, value in [
            ("potential", potential),
            ("constraint", constraint),
            ("kinematics", kinematics),
            ("coordinate_constraint", coordinate_constraint),
        ]:
            if not (callable(value) or (value is None and name != "potential")):
                raise TypeError(
                    f"`System({name}=...)` must be a function of (q, args), got "
                    f"{type(value).__name__}."
                )
        if coordinate_constraint is not None and kinematics is None:
            raise ValueError(
                "`System(coordinate_constraint=...)` without `kinematics`: where the "
                "velocities are the rates of the coordinates, a relation between the "
                "coordinates is an ordinary constraint. Pass it in `constraint`, or "
                "give `kinematics`."
            )
        self.kinetic = kinetic if callable(kinetic) else _inexact(kinetic)
        self.potential = potential
        self.constraint = constraint
        self.coordinate_constraint = coordinate_constraint
        self.kinematics = (
            IdentityKinematics()
            if kinematics is None
            else ConfigurationKinematics(kinematics)
        )

    def kinetic_energy(self, state: State, args: Args = None) -> Scalar:
        """`1/2 v . M v` of one state (energy)."""
        if callable(self.kinetic):
            return self.kinetic(state.v, args)
        return 0.5 * state.v @ self.kinetic @ state.v

    def potential_energy(self, state: State, args: Args = None) -> Scalar:
        """`V(q)` of one state (energy)."""
        return self.potential(state.q, args)

    def energy(self, state: State, args: Args = None) -> Scalar:
        """Total energy `1/2 v . M v + V(q)` of one state."""
        return self.kinetic_energy(state, args) + self.potential_energy(state, args)
