"""What all systems have in common, and the conventions of the whole package.

Equations of motion (paper eq. 12), for coordinates `q` (nq), velocities `v = L(q) qdot`
(nv), constant inertia `M`, potential `V(q)` and holonomic constraints `Phi(q) = 0`:

    L^T M vdot + G(M v) qdot + dV/dq + B^T lambda = 0,   B = dPhi/dq
    v = L qdot,   Phi(q) = 0

or, for any Hamiltonian `H(q, p)`,

    pdot + dH/dq + B^T lambda = 0,   qdot = dH/dp,   Phi(q) = 0

so the force of a constraint on the coordinates is `-B^T lambda`, and a potential acts
with `-dV/dq`. Units are the user's own, as long as they are consistent: a multiplier has
the dimension of an energy per unit of its constraint.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linear import Symmetric
from .._types import Args, Coordinates, Multipliers, Scalar


def inexact(x: Any) -> Array:
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)


class State(eqx.Module):
    """Coordinates and velocities at one instant (in a `Solution`: at each saved time).

    - `q`: coordinates, shape `(nq,)`, in the units of the user's own coordinates.
    - `v`: velocities, shape `(nv,)`: `L(q) qdot` of a system with `kinematics`, else
      `qdot`; of a `System.from_hamiltonian` the momenta `p`.
    """

    q: Float[Array, "... nq"] = eqx.field(converter=inexact)
    v: Float[Array, "... nv"] = eqx.field(converter=inexact)


class AbstractSystem(eqx.Module):
    """A conservative mechanical system with holonomic constraints."""

    constraint: eqx.AbstractVar[Callable[[Coordinates, Args], Multipliers] | None]

    @abc.abstractmethod
    def kinetic_energy(self, state: State, args: Args = None) -> Scalar:
        """The energy of the motion in one state."""

    @abc.abstractmethod
    def potential_energy(self, state: State, args: Args = None) -> Scalar:
        """The energy of one configuration at rest."""

    @abc.abstractmethod
    def energy(self, state: State, args: Args = None) -> Scalar:
        """Total energy of one state."""

    @abc.abstractmethod
    def inertia(self, state: State, args: Args) -> Symmetric:
        """The symmetric matrix that takes velocities to momenta."""


def check_function(
    name: str, signature: str, value: Any, *, optional: bool = False
) -> None:
    """Raises for what is no function."""
    if not (callable(value) or (optional and value is None)):
        raise TypeError(
            f"`{name}` must be a function of {signature}, got {type(value).__name__}."
        )
