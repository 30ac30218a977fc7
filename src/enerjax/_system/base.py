"""The interface of all systems, and the conventions of the whole package.

Equations of motion (paper eq. 12), for coordinates `q` (nq), velocities `v = L(q) qdot`
(nv), constant inertia `M`, potential `V(q)` and holonomic constraints `Phi(q) = 0`:

    L^T M vdot + G(M v) qdot + dV/dq + B^T lambda = 0,   B = dPhi/dq
    v = L qdot,   Phi(q) = 0

or, for any Hamiltonian `H(q, p)`,

    pdot + dH/dq + B^T lambda = 0,   qdot = dH/dp,   Phi(q) = 0

so the force of a constraint on the coordinates is `-B^T lambda`, and a potential acts
with `-dV/dq`. Units are the user's own, as long as they are consistent: a multiplier has
the dimension of an energy per unit of its constraint.

Forces `f(q, v, t)` add `L^T f` to the right-hand side of the first equation. Driven
constraints `g(q, t) = 0` add rows to `Phi`, and `g_q^T lambda` to `B^T lambda`.
Nonholonomic constraints `A(q) qdot = 0` add `A^T lambda`. The multipliers are ordered:
joints first, driven constraints next, then nonholonomic constraints, and relations between
coordinates last.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float
from typing_extensions import TypeAliasType

from .._solvers import Symmetric
from .._types import Args, Coordinates, JointMultipliers, Multipliers, Scalar, Velocities
from .names import Names


def inexact(x: Any) -> Array:
    try:
        x = jnp.asarray(x)
    except (TypeError, ValueError, DeprecationWarning):
        raise TypeError(
            "Coordinates, velocities and inertia must be arrays or lists of numbers, got "
            f"{x!r}."
        ) from None
    return x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)


# The types of the functions of a system have names, so that signatures can be read.
Potential = TypeAliasType("Potential", Callable[[Coordinates, Args], Scalar])
Constraint = TypeAliasType("Constraint", Callable[[Coordinates, Args], Multipliers])
Kinematics = TypeAliasType(
    "Kinematics", Callable[[Coordinates, Args], Float[Array, "nv nq"]]
)
KineticEnergy = TypeAliasType("KineticEnergy", Callable[[Velocities, Args], Scalar])
Force = TypeAliasType(
    "Force", Callable[[Coordinates, Velocities, Scalar, Args], Velocities]
)
Driven = TypeAliasType("Driven", Callable[[Coordinates, Scalar, Args], JointMultipliers])
Nonholonomic = TypeAliasType(
    "Nonholonomic", Callable[[Coordinates, Args], Float[Array, "k nq"]]
)
Symmetry = TypeAliasType("Symmetry", Callable[[Coordinates, Args], Float[Array, "ns nv"]])


class State(eqx.Module):
    """Coordinates and velocities at one instant (in a `Solution`: at each saved time).

    - `q`: coordinates, shape `(nq,)`, in the units of the user's own coordinates.
    - `v`: velocities, shape `(nv,)`: `L(q) qdot` of a system with `kinematics`, else
      `qdot`; of a `System.from_hamiltonian` the momenta `p`.
    - `t`: the time. It is for schemes, which set it if the system has a `force` or is
      `driven`; it is `None` in every state that is returned to users. To start at a time
      other than 0, pass it to `initial_state` and `simulate`.
    """

    q: Float[Array, "... nq"] = eqx.field(converter=inexact)
    v: Float[Array, "... nv"] = eqx.field(converter=inexact)
    t: Float[Array, "..."] | None = None


class AbstractSystem(eqx.Module):
    """A mechanical system with constraints, forces and drives."""

    constraint: eqx.AbstractVar[Constraint | None]
    force: eqx.AbstractVar[Force | None]
    driven: eqx.AbstractVar[Driven | None]
    nonholonomic: eqx.AbstractVar[Nonholonomic | None]
    symmetry: eqx.AbstractVar[Symmetry | None]
    redundant: eqx.AbstractVar[bool]
    names: eqx.AbstractVar[Names | None]
    events: eqx.AbstractVar[tuple]

    @property
    def is_timed(self) -> bool:
        """Whether the equations of motion need the time."""
        return self.force is not None or self.driven is not None

    @abc.abstractmethod
    def kinetic_energy(self, state: State, args: Args = None) -> Scalar:
        """The kinetic energy of one state."""

    @abc.abstractmethod
    def potential_energy(self, state: State, args: Args = None) -> Scalar:
        """The potential energy of one state: its energy at rest."""

    @abc.abstractmethod
    def energy(self, state: State, args: Args = None) -> Scalar:
        """Total energy of one state."""

    @abc.abstractmethod
    def inertia(self, state: State, args: Args) -> Symmetric:
        """The symmetric matrix that maps velocities to momenta."""


SIGNATURES = dict(
    potential="(q, args)",
    hamiltonian="(q, p, args)",
    constraint="(q, args)",
    coordinate_constraint="(q, args)",
    force="(q, v, t, args)",
    driven="(q, t, args)",
    nonholonomic="(q, args)",
    symmetry="(q, args)",
    kinematics="(q, args)",
)
_OPTIONAL = (
    "constraint", "coordinate_constraint", "force", "driven", "nonholonomic", "symmetry",
)  # fmt: skip


def check_function(name: str, value: Any, signature: str) -> None:
    """Raises a `TypeError` unless `value` is a function."""
    if not callable(value):
        raise TypeError(
            f"`{name}` must be a function of {signature}, got {type(value).__name__}."
        )


def check_functions(system: AbstractSystem, required: str) -> None:
    """Raises a `TypeError` unless all fields of a system that should be functions are."""
    check_function(required, getattr(system, required), SIGNATURES[required])
    for name in _OPTIONAL:
        value = getattr(system, name, None)
        if value is not None:
            check_function(name, value, SIGNATURES[name])


def order_for(system: AbstractSystem, order: int) -> int:
    """The order of a scheme of this order on a system: forces limit it to 2."""
    return order if system.force is None else min(order, 2)
