"""Kinds of coordinates: how velocities and the increments of a step move them.

A step from `q_a` to `q_b` has the unknowns `step`, a displacement. A kind of coordinates
consists of these maps:

- the displacement `q_b - q_a = P step`, where `P` may depend on `q_a` and `step`, so that
  `q_b` is a retraction of the step; the transpose of `P` pulls gradients with
  respect to `q` back to the rows of the step equations;
- the velocity `Lm step`, which is the mean velocity of the step times its duration;
- the change of momentum in these rows, such that its product with `step` is the change of
  the kinetic energy;
- the discrete gradients of `psi = Phi'(q) Y`, where `Y` are the rates of the coordinates,
  with respect to `q` and to the velocities.

A kind may have velocities of its own, which a step uses instead of those of the user, and
constraints of its own, which follow those of the user.

Each kind has its own file. For plain coordinates all maps are trivial.
"""

import abc
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
from jaxtyping import Array, Float

from ..._discrete import RotationRule
from ..._solvers import IndependentBlocks, solve_by_blocks, Symmetric
from ..._types import (
    Args,
    Coordinates,
    Flag,
    Increments,
    JointMultipliers,
    Scalar,
    Velocities,
)
from ..base import State


# The coordinate constraints as a function of the coordinates, and their Jacobian.
Relations: TypeAlias = Callable[[Coordinates], Float[Array, " ncc"]]
RelationsJacobian: TypeAlias = Callable[[Coordinates], Float[Array, "ncc nq"]]
# The rates of the coordinates at a position.
Rates: TypeAlias = Callable[[Coordinates], Coordinates]
# The kinetic energy as a function of the user's velocities.
KineticEnergy: TypeAlias = Callable[[Velocities], Scalar]
# A position, and the gradient of a function of the rates of the coordinates there.
ByRates: TypeAlias = tuple[Coordinates, Coordinates]
# The momenta of such a gradient: its product with `L^+(q)`.
Lowered: TypeAlias = Callable[[Coordinates, Coordinates], Velocities]


class Frames(eqx.Module):
    """The invertible matrix of `L` stacked on `B_c` at one position, shape `(nq, nq)`.

    It maps rates of coordinates to velocities and to the rates of the coordinate
    constraints.
    """

    blocks: IndependentBlocks | None = eqx.field(static=True)
    matrix: Float[Array, "nq nq"]

    def rates(self, motion: Float[Array, " nq"]) -> Coordinates:
        """The rates of the coordinates of velocities and rates of the constraints."""
        return solve_by_blocks(self.blocks, self.matrix, motion)

    def forces(self, rows: Coordinates) -> Float[Array, " nq"]:
        """The transpose of `rates`."""
        _, transpose = jax.vjp(self.rates, rows)
        return transpose(rows)[0]


class AbstractKinematics(eqx.Module):
    """A kind of coordinates `q` with velocities `v = L(q) qdot`."""

    @property
    @abc.abstractmethod
    def has_canonical_rates(self) -> bool:
        """Whether `L = I`, and steps are added to the coordinates."""

    @property
    @abc.abstractmethod
    def has_own_velocities(self) -> bool:
        """Whether a step uses velocities other than those of the user."""

    @abc.abstractmethod
    def chain_rule(self, step: Increments) -> RotationRule | None:
        """The chain rule over a step, with respect to the rows instead of the coordinates.

        It is for coordinates that are not linear in the steps. Then the discrete gradients
        of functions of coordinates and rates are taken in both together. `None` where the
        chain rule in the coordinates conserves momenta.
        """

    @abc.abstractmethod
    def has_inertia(self, energy: KineticEnergy, inertia: Symmetric) -> Flag:
        """Whether coordinates of this kind can have this kinetic energy, and the inertia
        `inertia` of the user's velocities."""

    @abc.abstractmethod
    def is_definite(self, inertia: Symmetric, rounding: float) -> Flag:
        """Whether each velocity that the coordinates can have has a positive energy.

        `rounding` is the relative round-off of a body's moments of inertia.
        """

    @abc.abstractmethod
    def is_regular(self, inertia: Symmetric, rounding: float) -> Flag:
        """Whether bodies have inertia along all of their axes, so that none is flat."""

    @abc.abstractmethod
    def describe(self, q: Coordinates, v: Velocities) -> str:
        """How the coordinates move, in words."""

    @abc.abstractmethod
    def with_rotations(
        self, q: Coordinates, dimensions: tuple[int, ...]
    ) -> "AbstractKinematics":
        """The kind that moves bodies with these coordinates by rotations.

        It is the same kind if there are no such bodies in these dimensions: 2 in the plane,
        3 in space.
        """

    @abc.abstractmethod
    def with_blocks(
        self, q: Coordinates, relations: Relations, args: Args
    ) -> "AbstractKinematics":
        """The same kind, with the independent blocks of `L` stacked on `B_c`."""

    @abc.abstractmethod
    def constraint(self, q: Coordinates) -> JointMultipliers:
        """The constraints that the coordinates need, besides those of the user.

        Raises a `ValueError` if there are not enough coordinates.
        """

    @abc.abstractmethod
    def velocity(self, q: Coordinates, v: Velocities) -> Velocities:
        """The velocities of this kind that belong to velocities `v` of the user."""

    @abc.abstractmethod
    def user_velocity(self, q: Coordinates, v: Velocities) -> Velocities:
        """The inverse of `velocity`."""

    @abc.abstractmethod
    def inertia(
        self, of_user: Callable[[], Symmetric], energy: KineticEnergy, dtype: Any
    ) -> Symmetric:
        """`M`, which is constant. `of_user` returns that of the user's velocities."""

    @abc.abstractmethod
    def regular_inertia(self, q: Coordinates, inertia: Symmetric) -> Symmetric:
        """A regular matrix with the energy of `inertia` for velocities that satisfy
        `constraint`, and with more for others."""

    @abc.abstractmethod
    def metric(
        self, q: Coordinates, inertia: Symmetric, relations: Relations, args: Args
    ) -> Symmetric:
        """The inertia matrix of the increments, regular also where they are redundant."""

    @abc.abstractmethod
    def velocity_scale(self, inertia: Symmetric) -> Velocities:
        """The scales of the velocities. Scales are the roots of inertias."""

    @abc.abstractmethod
    def step_scale(
        self, q: Coordinates, inertia: Symmetric, relations: Relations, args: Args
    ) -> Increments:
        """The scales of the increments."""

    @abc.abstractmethod
    def coordinate_scale(self, step: Increments) -> Coordinates:
        """The scales of the coordinates, given those of the increments."""

    @abc.abstractmethod
    def by_inertia(
        self, q: Coordinates, change: Coordinates, inertia: Symmetric, args: Args
    ) -> Coordinates:
        """`W change`, where `change . W change / 2` is the kinetic energy of the motion at
        `q` whose coordinates have these rates."""

    @abc.abstractmethod
    def frames(
        self, q: Coordinates, jacobian: RelationsJacobian, args: Args
    ) -> Frames | None:
        """`L` stacked on `B_c`; `None` if coordinates are not redundant."""

    @abc.abstractmethod
    def displacement(self, q: Coordinates, step: Increments) -> Coordinates:
        """`P step`, the change of the coordinates in a step from `q`."""

    @abc.abstractmethod
    def pull_back(
        self,
        qa: Coordinates,
        qb: Coordinates,
        step: Increments,
        gradient: Coordinates,
    ) -> Increments:
        """`P^T gradient`, the rows of a gradient with respect to the coordinates."""

    @abc.abstractmethod
    def push(
        self, qa: Coordinates, qb: Coordinates, step: Increments, args: Args
    ) -> Velocities:
        """`Lm step`, the mean velocity of a step times its duration."""

    @abc.abstractmethod
    def pull(
        self, qa: Coordinates, qb: Coordinates, force: Velocities, args: Args
    ) -> Increments:
        """The rows of a force that is conjugate to the velocities of the user."""

    @abc.abstractmethod
    def rates(
        self, q: Coordinates, v: Velocities, jacobian: RelationsJacobian, args: Args
    ) -> Increments:
        """The steps per time, for steps of zero length, of a motion with velocity `v`."""

    @abc.abstractmethod
    def lift(
        self, q: Coordinates, v: Velocities, jacobian: RelationsJacobian, args: Args
    ) -> Coordinates:
        """`L(q)^+ v`, the rates of the coordinates.

        It solves `L qdot = v` together with `B_c qdot = 0`, where `B_c` is the Jacobian of
        the coordinate constraints.
        """

    @abc.abstractmethod
    def momentum_rows(self, q: Coordinates, momentum: Velocities, args: Args) -> Increments:
        """The rows of a momentum at a position."""

    @abc.abstractmethod
    def momentum_change(
        self,
        qa: Coordinates,
        qb: Coordinates,
        change: Velocities,
        mean: Velocities,
        step: Increments,
        args: Args,
    ) -> Increments:
        """The rows of the change of momentum in a step, including gyroscopic terms.

        `change` and `mean` are the difference and the mean of the momenta at the ends.
        """

    @abc.abstractmethod
    def gyroscopic(
        self, q: Coordinates, momentum: Velocities, rates: Increments, args: Args
    ) -> Increments | None:
        """The rows of the rate of change of momentum at constant velocities, or `None`."""

    # Let `S` be a discrete gradient of `eta . psi` over a step from `a` to `b`, so that
    # `S_q . step + S_v . (v_b - v_a)` is the difference of `eta . psi`. The rows `S_q`
    # consist of the gradient of `psi` with respect to `q` at rates `Y(q)`, and of further
    # rows. `S_v` is a momentum, and it does not depend on the velocities.

    @abc.abstractmethod
    def mean_rates(
        self,
        a: State,
        b: State,
        lift: Callable[[Coordinates, Velocities], Coordinates],
        by_rates: Callable[[], tuple[ByRates, ByRates]],
    ) -> tuple[Rates, Increments | None]:
        """The rates `Y(q)`, and the further rows of `S_q`; `None` if there are none.

        `by_rates` returns the gradients of `eta . psi` with respect to the rates at `a` and
        `b`.
        """

    @abc.abstractmethod
    def momentum_of_rates(
        self, a: ByRates, b: ByRates, step: Increments, lowered: Lowered
    ) -> Velocities:
        """The momentum `S_v`, from the gradients with respect to the rates at both ends."""


def mean_momentum(a: ByRates, b: ByRates, lowered: Lowered) -> Velocities:
    """The mean over an interval of the momenta of gradients with respect to the rates."""
    return 0.5 * (lowered(*a) + lowered(*b))


class AbstractFlatKinematics(AbstractKinematics):
    """A kind of coordinates whose velocities are the user's."""

    @property
    def has_own_velocities(self):
        return False

    def velocity(self, q, v):
        return v

    def user_velocity(self, q, v):
        return v

    def inertia(self, of_user, energy, dtype):
        return of_user()

    def coordinate_scale(self, step):
        return step

    def mean_rates(self, a, b, lift, by_rates):
        mean = 0.5 * (a.v + b.v)
        return lambda q: lift(q, mean), None

    def momentum_of_rates(self, a, b, step, lowered):
        return mean_momentum(a, b, lowered)


class AbstractAddedKinematics(AbstractFlatKinematics):
    """A kind of coordinates to which steps are added."""

    def displacement(self, q, step):
        return step

    def pull_back(self, qa, qb, step, gradient):
        return gradient

    def chain_rule(self, step):
        return None
