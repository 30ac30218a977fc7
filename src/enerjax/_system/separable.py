from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._programs import call_traced_once
from .._solvers import BlockDiagonal, hessian, in_blocks, Symmetric
from .._types import Args, Coordinates, Scalar, Vector, Velocities
from .base import (
    AbstractSystem,
    check_function,
    check_functions,
    Constraint,
    Driven,
    Force,
    inexact,
    Kinematics,
    KineticEnergy,
    Nonholonomic,
    Potential,
    SIGNATURES,
    State,
    Symmetry,
)
from .canonical import HamiltonianSystem, LagrangianSystem
from .kinematics import (
    AbstractKinematics,
    body_table,
    ConfigurationKinematics,
    DirectorKinematics,
    IdentityKinematics,
    PlanarKinematics,
)
from .names import Names


class System(AbstractSystem):
    """A mechanical system with constraints, forces and drives.

    **Arguments:**

    - `kinetic`: `kinetic(v, args)`, a scalar (energy) that is quadratic in `v` with
      constant inertia; or the inertia matrix itself, `(nv, nv)`, symmetric positive
      definite.
    - `potential`: `potential(q, args)`, a scalar (energy).
    - `constraint`: `constraint(q, args)`, a vector that vanishes in every admissible
      configuration: joints, rods. Leave it out if there is none.
    - `kinematics`: `L(q, args)`, the `(nv, nq)` matrix in `v = L(q) qdot`. Leave it out
      if the velocities are the rates of the coordinates.
    - `coordinate_constraint`: `coordinate_constraint(q, args)`, a vector of `nq - nv`
      relations that the coordinates obey by definition, such as `p @ p - 1` for a unit
      quaternion. Its time derivative vanishes for every `v`, so it is enforced at
      position level only. It needs `kinematics`.
    - `force`: `force(q, v, t, args)`, forces without a potential, such as dampers, motors
      and loads that depend on the time `t`; shape `(nv,)`, conjugate to `v`: their power is
      `force . v`. For a body with `v = (xdot, Omega)` they are the force in space and the
      torque in body axes. With forces schemes are of order 2, and `Composed` cannot be
      used.
    - `driven`: `driven(q, t, args)`, a vector that vanishes in every admissible
      configuration at time `t`: a moving pivot, a prescribed angle. It must be twice
      differentiable in `t`.
    - `nonholonomic`: `A(q, args)`, the `(k, nq)` matrix of constraints `A(q) qdot = 0` on
      the rates of the coordinates, such as rolling without slip or a knife edge; also with
      `kinematics` one column for each coordinate. The constraint forces `-A^T lambda` do no
      work. A constraint that is the derivative of a function of `q` belongs in
      `constraint`, where positions do not drift.
    - `symmetry`: `symmetry(q, args)`, shape `(ns, nv)`. Each row contains the velocities of
      a motion that changes neither energy nor constraints, such as a common translation or
      rotation. The audit then reports the momenta that belong to these motions; nothing
      else changes.
    - `redundant`: whether constraints may be redundant, as in over-constrained mechanisms.
      Multipliers of the joints and their derivatives are then those of least norm (each in
      the measure of its constraint), up to terms of order `h`; the motion and its
      derivatives do not depend on this choice.
    - `rigid_bodies`: the indices of the coordinates of each rigid body in space, shape
      `(bodies, 12)`: its mass centre, then its three body axes as vectors in space (the
      directors). Leave it out if there is none. The library keeps the axes orthonormal, so
      write no constraints for that. Velocities are the rates of all coordinates, and the
      kinetic energy of a body is `m |xdot|^2/2 + sum_ij E_ij d_i_dot . d_j_dot/2` with
      `E = tr(J)/2 I - J` and the inertia `J` in body axes. `EnergyPreserving`,
      `EnergyDecaying`, `EnergyMomentumDecaying` and their compositions move these bodies by
      rotations, with six unknowns each; the first and the third conserve angular momentum
      to round-off where rotations change neither the potential nor the constraints. Other
      schemes impose six constraints on each body, whose multipliers follow those of
      `constraint`; they refuse flat bodies, for which `E` is singular. In the plane the
      shape is `(bodies, 3)`: the mass centre, then the angle from the axes of space to
      those of the body, and the kinetic energy is `m |xdot|^2/2 + J angle_rate^2/2`.
      `EnergyPreserving`, `EnergyMomentumDecaying` and their compositions move such bodies
      by rotations and conserve angular momentum to round-off, if functions depend on angles
      by their sines and cosines and by differences of two angles.
    - `names`: names of coordinates, velocities and constraints for tables; see `Names`.
    - `events`: events that belong to the system, such as its impacts, in a list. `simulate`
      looks for them in every run.

    `args` is any pytree; the functions must be smooth and written with `jax.numpy`.

    A function of the wrong shape, an inertia that is not symmetric positive definite and
    a kinetic energy that is not quadratic raise a `ValueError` when `initial_state` or a
    run is called, because sizes and `args` are not known before.
    """

    kinetic: KineticEnergy | Symmetric
    potential: Potential
    constraint: Constraint | None
    kinematics: AbstractKinematics
    coordinate_constraint: Constraint | None
    force: Force | None
    driven: Driven | None
    nonholonomic: Nonholonomic | None
    symmetry: Symmetry | None
    redundant: bool = eqx.field(static=True)
    names: Names | None
    events: tuple

    def __init__(
        self,
        kinetic: KineticEnergy | Vector | BlockDiagonal,
        potential: Potential,
        constraint: Constraint | None = None,
        *,
        kinematics: Kinematics | None = None,
        coordinate_constraint: Constraint | None = None,
        force: Force | None = None,
        driven: Driven | None = None,
        nonholonomic: Nonholonomic | None = None,
        symmetry: Symmetry | None = None,
        redundant: bool = False,
        rigid_bodies: Any = None,
        names: Names | None = None,
        events: Any = (),
    ):
        if rigid_bodies is not None and kinematics is not None:
            raise ValueError(
                "`System(rigid_bodies=...)` with `kinematics`: the velocities of a system "
                "with rigid bodies are the rates of its coordinates. Leave one of them out."
            )
        if kinematics is not None:
            check_function("kinematics", kinematics, SIGNATURES["kinematics"])
        if coordinate_constraint is not None and kinematics is None:
            raise ValueError(
                "`System(coordinate_constraint=...)` without `kinematics`: if the "
                "velocities are the rates of the coordinates, a relation between the "
                "coordinates is an ordinary constraint. Pass it in `constraint`, or "
                "give `kinematics`."
            )
        if not (callable(kinetic) or isinstance(kinetic, BlockDiagonal)):
            if kinetic is None or isinstance(kinetic, str) or jnp.iscomplexobj(kinetic):
                raise TypeError(
                    "`kinetic` must be a function of (v, args) or the real inertia matrix, "
                    f"got {kinetic!r}."
                )
            kinetic = _in_blocks(inexact(kinetic))
        self.kinetic = kinetic
        self.potential = potential
        self.constraint = constraint
        self.coordinate_constraint = coordinate_constraint
        self.force = force
        self.driven = driven
        self.nonholonomic = nonholonomic
        self.symmetry = symmetry
        self.redundant = redundant
        self.names = names
        self.events = tuple(events)
        if rigid_bodies is not None:
            table = body_table(rigid_bodies)
            in_plane = table.array.shape[1] == 3
            kind = PlanarKinematics if in_plane else DirectorKinematics
            self.kinematics = kind(table)
        elif kinematics is not None:
            self.kinematics = ConfigurationKinematics(kinematics)
        else:
            self.kinematics = IdentityKinematics()

    def __check_init__(self):
        check_functions(self, required="potential")

    def kinetic_energy(self, state: State, args: Args = None) -> Scalar:
        """`1/2 v . M v` of one state (energy)."""
        if callable(self.kinetic):
            return call_traced_once(self.kinetic, state.v, args)
        return 0.5 * state.v @ self.kinetic @ state.v

    def potential_energy(self, state: State, args: Args = None) -> Scalar:
        """`V(q)` of one state (energy)."""
        return call_traced_once(self.potential, state.q, args)

    def energy(self, state: State, args: Args = None) -> Scalar:
        """Total energy `1/2 v . M v + V(q)` of one state."""
        return self.kinetic_energy(state, args) + self.potential_energy(state, args)

    def inertia(self, state: State, args: Args) -> Symmetric:
        """`M`, constant."""
        if not callable(self.kinetic):
            return jax.tree.map(lambda x: x.astype(state.v.dtype), self.kinetic)
        energy = lambda v: self.kinetic_energy(State(state.q, v), args)
        return hessian(energy, jnp.zeros_like(state.v))

    @staticmethod
    def from_lagrangian(
        kinetic: Callable[[Coordinates, Velocities, Args], Scalar],
        potential: Potential,
        constraint: Constraint | None = None,
        *,
        force: Force | None = None,
        driven: Driven | None = None,
        nonholonomic: Nonholonomic | None = None,
        symmetry: Symmetry | None = None,
        redundant: bool = False,
        names: Names | None = None,
        events: Any = (),
    ) -> LagrangianSystem:
        """A system whose inertia depends on its coordinates.

        It suits minimal coordinates, such as the angles of an arm, which need no
        constraint. Schemes, derivatives and the audit work as for a `System`. The schemes
        have the momenta `p = dT/dqdot` as additional unknowns, and keep the energy `1/2 p .
        A(q)^-1 p + V(q)`, where `A` is the Hessian of `kinetic`. If the inertia is
        constant, use `System`: it needs half the unknowns.

        **Arguments:**

        - `kinetic`: `kinetic(q, qdot, args)`, a scalar (energy), quadratic in `qdot`.
        - `potential`: `potential(q, args)`, a scalar (energy).
        - `constraint`: `constraint(q, args)`, a vector that vanishes in every admissible
          configuration. Leave it out if there is none.
        - `force`: `force(q, qdot, t, args)`, shape `(nq,)`, conjugate to `qdot`.
        - `driven`: `driven(q, t, args)`; `nonholonomic`: `A(q, args)`, shape `(k, nq)`;
          `symmetry`, `redundant`, `names`, `events`: see `System`.

        **Returns:** a system that all functions accept like a `System`; the `v` of a
        `State` is `qdot`, shape `(nq,)`.
        """
        return LagrangianSystem(
            kinetic=kinetic,
            potential=potential,
            constraint=constraint,
            force=force,
            driven=driven,
            nonholonomic=nonholonomic,
            symmetry=symmetry,
            redundant=redundant,
            names=names,
            events=tuple(events),
        )

    @staticmethod
    def from_hamiltonian(
        hamiltonian: Callable[[Coordinates, Coordinates, Args], Scalar],
        constraint: Constraint | None = None,
        *,
        force: Force | None = None,
        driven: Driven | None = None,
        nonholonomic: Nonholonomic | None = None,
        symmetry: Symmetry | None = None,
        redundant: bool = False,
        names: Names | None = None,
        events: Any = (),
    ) -> HamiltonianSystem:
        """A system given by its Hamiltonian.

        It suits canonical coordinates, such as a unit quaternion and its momentum, and
        energies that are not quadratic in a velocity: magnetic forces, rotating frames,
        relativistic particles.

        **Arguments:**

        - `hamiltonian`: `hamiltonian(q, p, args)`, a scalar (energy) whose Hessian in `p`
          is positive definite. Redundant momenta need an energy too, such as
          `(q . p)^2 / 2` for a quaternion.
        - `constraint`: as for `from_lagrangian`. It is enforced for `q`, and
          `B(q) dH/dp = 0` for `p`.
        - `force`: `force(q, qdot, t, args)`, shape `(nq,)`, conjugate to `qdot = dH/dp`.
        - `driven`: `driven(q, t, args)`; `nonholonomic`: `A(q, args)`, the matrix of
          constraints `A(q) dH/dp = 0`; `symmetry` (rows of `qdot`), `redundant`, `names`,
          `events`: see `System`.

        **Returns:** a system that all functions accept like a `System`; the `v` of a
        `State` is the momentum `p`, shape `(nq,)`. The audit counts `H(q, 0)` as potential
        energy.
        """
        return HamiltonianSystem(
            hamiltonian=hamiltonian,
            constraint=constraint,
            force=force,
            driven=driven,
            nonholonomic=nonholonomic,
            symmetry=symmetry,
            redundant=redundant,
            names=names,
            events=tuple(events),
        )


def _in_blocks(inertia: Array) -> Symmetric:
    if inertia.ndim != 2:
        raise ValueError(
            f"The inertia matrix has shape {inertia.shape}: give a square matrix. That of "
            "masses is `jnp.diag(masses)`."
        )
    return in_blocks(inertia)
