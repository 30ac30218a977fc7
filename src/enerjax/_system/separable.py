from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from .._solvers import BlockDiagonal, hessian, in_blocks, Symmetric
from .._types import Args, Coordinates, Scalar, Vector, Velocities
from .base import (
    AbstractSystem,
    check_function,
    Constraint,
    Driven,
    Force,
    inexact,
    Kinematics,
    KineticEnergy,
    Potential,
    State,
    Symmetry,
)
from .canonical import HamiltonianSystem, LagrangianSystem
from .kinematics import AbstractKinematics, ConfigurationKinematics, IdentityKinematics


class System(AbstractSystem):
    """A mechanical system with holonomic constraints, forces and drives.

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
    - `force`: `force(q, v, t, args)`, the forces that no potential has, shape `(nv,)`,
      conjugate to `v`: their power is `force . v`. For a body with `v = (xdot, Omega)`
      the force in space and the torque in body axes. Dampers, motors, loads that depend
      on the time `t`. `Composed` cannot take them, and others are of order 2 with them.
    - `driven`: `driven(q, t, args)`, a vector that vanishes in every admissible
      configuration at time `t`: a pivot that is moved, a prescribed angle. Held as
      `constraint` is, and twice differentiable in `t`.
    - `symmetry`: `symmetry(q, args)`, shape `(ns, nv)`: in each row the velocities of a
      motion that is expected to change no energy and no constraint, such as a common
      translation or rotation. It changes nothing but the audit, which then follows the
      momenta that belong to them.
    - `redundant`: whether constraints may repeat each other, as those of over-constrained
      mechanisms do. Multipliers are then of least norm (each in the measure of its
      constraint), to the order of the scheme; the motion does not depend on it.

    `args` is any pytree; the functions must be smooth and written with `jax.numpy`.

    A function of the wrong shape, an inertia that is not symmetric positive definite and
    a kinetic energy that is not quadratic raise a `ValueError` when a start is made or a
    run begins, where args and sizes are known.
    """

    kinetic: KineticEnergy | Symmetric
    potential: Potential
    constraint: Constraint | None
    kinematics: AbstractKinematics
    coordinate_constraint: Constraint | None
    force: Force | None
    driven: Driven | None
    symmetry: Symmetry | None
    redundant: bool = eqx.field(static=True)

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
        symmetry: Symmetry | None = None,
        redundant: bool = False,
    ):
        check_function("potential", "(q, args)", potential)
        for name, value in [
            ("constraint", constraint),
            ("kinematics", kinematics),
            ("coordinate_constraint", coordinate_constraint),
        ]:
            check_function(name, "(q, args)", value, optional=True)
        check_function("force", "(q, v, t, args)", force, optional=True)
        check_function("driven", "(q, t, args)", driven, optional=True)
        check_function("symmetry", "(q, args)", symmetry, optional=True)
        if coordinate_constraint is not None and kinematics is None:
            raise ValueError(
                "`System(coordinate_constraint=...)` without `kinematics`: where the "
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
            kinetic = in_blocks(inexact(kinetic))
        self.kinetic = kinetic
        self.potential = potential
        self.constraint = constraint
        self.coordinate_constraint = coordinate_constraint
        self.force = force
        self.driven = driven
        self.symmetry = symmetry
        self.redundant = redundant
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
        symmetry: Symmetry | None = None,
        redundant: bool = False,
    ) -> LagrangianSystem:
        """A system whose inertia depends on its coordinates.

        For minimal coordinates (angles of an arm), which need no constraint at all, and
        wherever velocities are the rates of the coordinates but `System` asks for a
        constant inertia. Everything runs as with a `System`: schemes, derivatives, audit.
        The schemes work with the momenta `p = dT/dqdot`, unknowns of their own here, and
        the energy `1/2 p . A(q)^-1 p + V(q)`, `A` the Hessian of `kinetic`. Where the
        inertia is constant a `System` does the same work with half the unknowns.

        **Arguments:**

        - `kinetic`: `kinetic(q, qdot, args)`, a scalar (energy), quadratic in `qdot`.
        - `potential`: `potential(q, args)`, a scalar (energy).
        - `constraint`: `constraint(q, args)`, a vector that vanishes in every admissible
          configuration. Leave it out if there is none.
        - `force`: `force(q, qdot, t, args)`, shape `(nq,)`, conjugate to `qdot`.
        - `driven`: `driven(q, t, args)`; `symmetry`, `redundant`: see `System`.

        **Returns:** what all functions take for a `System`; the `v` of a `State` is
        `qdot`, shape `(nq,)`.
        """
        return LagrangianSystem(
            kinetic=kinetic,
            potential=potential,
            constraint=constraint,
            force=force,
            driven=driven,
            symmetry=symmetry,
            redundant=redundant,
        )

    @staticmethod
    def from_hamiltonian(
        hamiltonian: Callable[[Coordinates, Coordinates, Args], Scalar],
        constraint: Constraint | None = None,
        *,
        force: Force | None = None,
        driven: Driven | None = None,
        symmetry: Symmetry | None = None,
        redundant: bool = False,
    ) -> HamiltonianSystem:
        """A system given by its Hamiltonian.

        For canonical coordinates (a unit quaternion and its momentum), and for energies
        that are no quadratic form of a velocity: magnetic forces, rotating frames,
        relativistic particles.

        **Arguments:**

        - `hamiltonian`: `hamiltonian(q, p, args)`, a scalar (energy) whose Hessian in `p`
          is positive definite: give redundant momenta an energy too, such as
          `(q . p)^2 / 2` of a quaternion.
        - `constraint`: as for `from_lagrangian`. It is held in `q`, and
          `B(q) dH/dp = 0` in `p`.
        - `force`: `force(q, qdot, t, args)`, shape `(nq,)`, conjugate to `qdot = dH/dp`.
        - `driven`: `driven(q, t, args)`; `symmetry` (rows of `qdot`), `redundant`: see
          `System`.

        **Returns:** what all functions take for a `System`; the `v` of a `State` is the
        momentum `p`, shape `(nq,)`. The audit counts `H(q, 0)` as potential energy.
        """
        return HamiltonianSystem(
            hamiltonian=hamiltonian,
            constraint=constraint,
            force=force,
            driven=driven,
            symmetry=symmetry,
            redundant=redundant,
        )
