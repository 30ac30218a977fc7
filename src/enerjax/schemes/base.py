"""The base classes of schemes, and the data, the equations and the result of a step."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, Generic, Literal, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._discrete import AbstractDerivative, ChainRule
from .._operators import (
    AbstractModel,
    ChordTerms,
    DelassusMatrix,
    Gradient,
    Increment,
    Reaction,
    SeparableModel,
    Time,
)
from .._results import RESULTS
from .._system import State
from .._types import (
    Coordinates,
    Increments,
    JointMultipliers,
    Multipliers,
    Scalar,
    Velocities,
)


# The levels at which joints are imposed: positions and velocities, with the stabilisation
# of Gear, Gupta and Leimkuhler, or positions only.
Formulation: TypeAlias = Literal["ggl", "index3"]
# A force law `f(q, v, t)`, the whole force of a system or a part of it.
ForceLaw: TypeAlias = Callable[[Coordinates, Velocities, Time], Velocities]
Z = TypeVar("Z")
P = TypeVar("P")


class Energies(eqx.Module):
    """The energy balance of a step, or of all steps since the last saved state.

    - `dissipated`: the energy that the scheme removes, by its energy identity.
    - `work`: the work of the forces, dampers included.
    - `damped`: the energy that dampers remove: minus the work of the part of the forces
      that is odd in the velocity.
    - `drive_work`: the work of the driven constraints.
    - `impact`: the energy that events remove at the end of the step; schemes leave it out.

    All are energies: scalars in a step, with a leading axis of saved states in a solution.
    `work` and `damped` are `None` for a system without forces, `drive_work` for one without
    driven constraints, and `impact` for a run without events. The balance is

        E1 = E0 - dissipated + work + drive_work - impact
    """

    dissipated: Float[Array, "..."]
    work: Float[Array, "..."] | None
    damped: Float[Array, "..."] | None
    drive_work: Float[Array, "..."] | None
    impact: Float[Array, "..."] | None = None


class StepProblem(eqx.Module):
    """The data of a step that are known before it is solved.

    - `model`: the system with its `args`.
    - `start`: the model's state at the start; `v` contains velocities or momenta.
    - `h`: the length of the step, a scalar (time); negative in a backward stage.
    - `derivative`: the discrete gradient; not used by schemes without one.
    - `formulation`: the levels at which joints are imposed, `"ggl"` or `"index3"`.
    - `is_one_interval`: whether discrete gradients are those of the whole step, from its
      start to its end. Only then can the velocity-level multipliers of bodies that are
      moved by rotations conserve angular momentum.
    """

    model: AbstractModel
    start: State
    h: Scalar
    derivative: AbstractDerivative = ChainRule()
    formulation: Formulation = eqx.field(default="ggl", static=True)
    is_one_interval: bool = eqx.field(default=False, static=True)

    @classmethod
    def with_constant_inertia(
        cls,
        scheme: str,
        model: AbstractModel,
        start: State,
        h: Scalar,
        formulation: Formulation = "ggl",
    ) -> "StepProblem":
        """A problem for schemes that need constant inertia and `v = qdot`.

        Raises a `ValueError`, which names the `scheme`, for any other system.
        """
        if model.has_canonical_rates and not model.has_own_momenta:
            return cls(model, start, h, formulation=formulation)
        has = "`kinematics`"
        if model.has_own_momenta:
            has = "varying inertia or a Hamiltonian"
        raise ValueError(
            f"`{scheme}` needs constant inertia and velocities that are the rates of the "
            f"coordinates, and this system has {has}. Use `EnergyPreserving` or "
            "`EnergyDecaying`, or compare on points, directors (`bodies.RigidBody`) or "
            "planar bodies."
        )

    @property
    def separable_model(self) -> SeparableModel:
        """The model of a problem that `with_constant_inertia` has returned."""
        assert isinstance(self.model, SeparableModel)
        return self.model

    @property
    def duration(self) -> Time:
        """`h` where time enters the system, else `None`."""
        return None if self.start.t is None else self.h

    @property
    def end_time(self) -> Time:
        """The time at the end of the step, where time enters, else `None`."""
        return None if self.start.t is None else self.start.t + self.h

    @property
    def middle_time(self) -> Time:
        """The time in the middle of the step, where time enters, else `None`."""
        return None if self.start.t is None else self.start.t + 0.5 * self.h

    def position(self, increment: Increment) -> Coordinates:
        """The coordinates at the node that an increment leads to, shape `(nq,)`."""
        return self.start.q + self.displacement(increment)

    def displacement(self, increment: Increment) -> Coordinates:
        """The change of the coordinates to the node of an increment, shape `(nq,)`."""
        return self.model.displacement(self.start.q, self.h * increment.rate)

    def velocity(self, end: Increment) -> Velocities:
        """`Lm (q1 - q0)/h`: the mean velocity, without the terms of the multipliers."""
        return self.model.push(self.start.q, self.position(end), end.rate)

    def nodes(
        self,
        velocities: Callable[[Reaction], tuple[Velocities, ...]],
        *ends: tuple[Increment, Time],
    ) -> tuple[State, ...]:
        """The states at the nodes whose increments and times are `ends`.

        `velocities(reaction)` must return the velocities at the nodes, solved from the rows
        `S_mu`, where `reaction(a, b, eta)` is the mean of `M^-1 C(q, t)^T eta` over the
        interval between the positions `a = (q, t)` and `b`. It is not called where the
        momenta are unknowns.
        """
        momenta = tuple(z.momentum for z, _ in ends)
        step = self.h * ends[-1][0].rate if self.is_one_interval else None
        found = self.model.node_momenta(momenta, velocities, self.derivative, step)
        return tuple(
            State(self.position(z), v, t) for (z, t), v in zip(ends, found, strict=True)
        )

    def discrete_gradient(self, a: State, b: State, increment: Increment) -> Gradient:
        """The discrete gradient over `a -> b` with the multipliers of `increment`."""
        return self.model.discrete_gradient(
            self.derivative, a, b, self.h, increment, is_step=self.is_one_interval
        )

    def drive_work(self, a: State, b: State, increment: Increment) -> Scalar | None:
        """The work of the driven constraints over `a -> b`; `None` if there are none."""
        if self.model.system.driven is None:
            return None
        return self.discrete_gradient(a, b, increment).work

    def load(
        self, law: ForceLaw, a: State, b: State, end: Increment, velocity: Velocities
    ) -> Increments:
        """`h Lm^T f` in the middle of `a -> b`; `Lm` is that of the whole step to `end`."""
        assert a.t is not None
        assert b.t is not None
        force = law(0.5 * (a.q + b.q), velocity, 0.5 * (a.t + b.t))
        return self.h * self.model.pull(self.start.q, self.position(end), force)

    def step_load(self, b: State, end: Increment) -> Increments | None:
        """`h Lm^T f` in the middle of the step; `None` for a system without forces."""
        if self.model.system.force is None:
            return None
        return self.load(self.model.force, self.start, b, end, self.velocity(end))

    def step_work(self, b: State, end: Increment) -> Callable[[ForceLaw], Scalar]:
        """The work of a force that acts in the middle of the step, as a function of it."""
        velocity = self.velocity(end)
        return lambda law: self.load(law, self.start, b, end, velocity) @ end.rate

    def account(
        self,
        dissipated: Scalar,
        work: Callable[[ForceLaw], Scalar],
        drive_work: Scalar | None,
    ) -> Energies:
        """The energy balance; `work(law)` is the work of a force law in the step."""
        if self.model.system.force is None:
            return Energies(dissipated, None, None, drive_work)
        total, damping = work(self.model.force), work(self.model.damping)
        return Energies(dissipated, total, -damping, drive_work)

    def measured_account(
        self,
        end: State,
        work: Callable[[ForceLaw], Scalar],
        drive_work: Scalar | None,
    ) -> Energies:
        """The energy balance of a scheme without an energy identity.

        `dissipated` is the measured loss `E0 + work + drive_work - E1`, of either sign.
        """
        energy = lambda state: self.model.kinetic(state) + self.model.potential(state)
        account = self.account(energy(self.start) - energy(end), work, drive_work)
        loss = account.dissipated
        for supplied in (account.work, drive_work):
            loss = loss if supplied is None else loss + supplied
        return eqx.tree_at(lambda account: account.dissipated, account, loss)

    def joint_rate(self, state: State) -> JointMultipliers:
        """`psi(q, v)` if the formulation imposes it, else an array of shape `(0,)`."""
        if self.formulation == "index3":
            return jnp.zeros((0,), state.q.dtype)
        return self.model.joint_rate(state.q, state.v, state.t)

    def delassus_matrix(
        self, end: Increment, elastic: Scalar | None = None
    ) -> DelassusMatrix:
        """The Delassus matrix in the middle of the step to `end`.

        With a length of time `elastic`, such as `h`, it includes the stiffness of strains,
        `elastic^2/4 K`.
        """
        middle = 0.5 * (self.start.q + self.position(end))
        state = State(middle, self.start.v, self.middle_time)
        return self.model.delassus_matrix(state, elastic)

    def constraint_rows(
        self, z: Increment, state: State, jump: tuple[Increment, State] | None = None
    ) -> Multipliers:
        """The constraints at the node that `z` leads to, divided by `h`.

        Nonholonomic constraints forbid displacements: from the start to the node, or from
        the start to a node `jump` before it and from there to the node.
        """
        model, h = self.model, self.h
        if model.system.nonholonomic is None:
            return model.constraint(state.q, state.t) / h
        displacement, slip, before = self.displacement(z), 0.0, self.start
        if jump is not None:
            to_jump = self.displacement(jump[0])
            slip, before = model.slip(self.start.q, jump[1].q, to_jump), jump[1]
            displacement = displacement - to_jump
        slip = slip + model.slip(before.q, state.q, displacement)
        joints, relations = model.joint(state.q, state.t), model.coordinate(state.q)
        return jnp.concatenate([joints, slip, relations]) / h

    def rows(
        self,
        z: Increment,
        state: State,
        gradient: Gradient,
        jump: tuple[Increment, State] | None = None,
    ) -> Increment:
        """The equations of one node: those of motion, and the constraints at the node.

        `jump` is the node at which the interval of `gradient` begins; by default this is
        the start.
        """
        h = self.h
        balance, rates = self.model.structure(self.start, state, h, z.rate, gradient)
        return Increment(
            impulse=self.constraint_rows(z, state, jump),
            rate=balance,
            momentum=rates,
            velocity_impulse=self.joint_rate(state),
        )

    def rows_of_balance(self, z: Increment, balance: Coordinates, end: State) -> Increment:
        """The equations of a step: `balance`, and the constraints at the end of the step.

        `balance` is a residual of the balance of momentum, shape `(nq,)` (momentum). The
        problem must be one that `with_constant_inertia` has returned.
        """
        return Increment(
            impulse=self.constraint_rows(z, end),
            rate=balance,
            momentum=jnp.zeros((0,), balance.dtype),
            velocity_impulse=self.joint_rate(end),
        )

    def guess(self, acceleration: Velocities, multipliers: Multipliers) -> Increment:
        """The increment of a Taylor expansion over the whole step."""
        q, v, h = self.start.q, self.start.v, self.h
        num_rates = jax.eval_shape(self.joint_rate, self.start).size
        return Increment(
            impulse=h * multipliers,
            rate=self.model.rates(q, v + 0.5 * h * acceleration),
            momentum=self.model.momentum_rows(v + h * acceleration),
            velocity_impulse=jnp.zeros((num_rates,), q.dtype),
        )


class StepEnd(eqx.Module):
    """The result of a solved step.

    - `state`: the model's state at the end of the step.
    - `displacement`: the change of the coordinates, shape `(nq,)`, as `h` times the rate
      that was solved for. It is more accurate than the difference of two rounded `q`.
    - `multipliers`: `lambda` of the step, shape `(nc,)`, joints first (energy per
      constraint unit).
    - `energies`: the energy balance.
    - `details`: further results of the scheme, or `None`.
    - `result`: success, or a failure that the scheme detects.
    - `carried`: the data that a scheme with a memory passes to its next step; `None` for
      other schemes.
    """

    state: State
    displacement: Coordinates
    multipliers: Multipliers
    energies: Energies
    details: PyTree[Any] = None
    result: RESULTS = eqx.field(default_factory=lambda: RESULTS.successful)
    carried: PyTree[Any] = None


class AbstractScheme(eqx.Module):
    """A time integration scheme, as `step` and `simulate` accept it."""

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """The order of accuracy of `q` and `v`, with and without constraints."""

    @property
    @abc.abstractmethod
    def stages(self) -> tuple[float, ...]:
        """The lengths of the solves of which a step consists, as fractions of `h`."""

    @property
    @abc.abstractmethod
    def stage(self) -> "AbstractOneSolveScheme":
        """The scheme of each of these solves."""


class AbstractOneSolveScheme(AbstractScheme, Generic[Z, P]):
    """A scheme whose step is one nonlinear solve: the base class for schemes of your own.

    `Z` is the type of the unknowns: a pytree of one `Increment` for each node of the step,
    that of the end of the step last, and of further scalar unknowns of the scheme, which
    must be dimensionless. `residual` returns the same pytree with equations in place of the
    unknowns. `P` is the type of the data of a step, a `StepProblem` or a module that
    contains one.

    A subclass is an `equinox.Module` that defines `order`, `formulation`, `symmetric`,
    `problem`, `predict`, `residual` and `finish`. It does not solve its equations: they are
    scaled, solved and differentiated in the same way for all schemes.
    """

    @property
    def stages(self) -> tuple[float, ...]:
        return (1.0,)

    @property
    def stage(self) -> "AbstractOneSolveScheme":
        return self

    @property
    @abc.abstractmethod
    def formulation(self) -> Formulation:
        """The levels at which joints are imposed: `"ggl"` or `"index3"`."""

    @property
    @abc.abstractmethod
    def symmetric(self) -> bool:
        """Whether a step of `-h` undoes a step of `h`: such a scheme can be composed."""

    @abc.abstractmethod
    def problem(self, model: AbstractModel, start: State, h: Scalar) -> P:
        """The data of a step. Raises a `ValueError` for a system that it cannot treat."""

    @abc.abstractmethod
    def predict(self, problem: P, acceleration: Velocities, multipliers: Multipliers) -> Z:
        """An initial guess from the accelerations and multipliers at the start."""

    @abc.abstractmethod
    def residual(self, z: Z, problem: P) -> Z:
        """The step equations; zero at the solution."""

    @abc.abstractmethod
    def finish(self, z: Z, problem: P) -> StepEnd:
        """The end of the step from the solved unknowns."""


class AbstractSchemeWithMemory(AbstractOneSolveScheme[Z, P], Generic[Z, P]):
    """A scheme that passes more data from step to step than the state.

    These data are returned as `StepEnd.carried` and are differentiated like the state. A
    step of such a scheme is not a map from state to state, so it cannot be composed.
    """

    @abc.abstractmethod
    def begin(
        self, model: AbstractModel, start: State, h: Scalar, acceleration: Velocities
    ) -> PyTree[Any]:
        """The data that the first step of a run receives."""

    @abc.abstractmethod
    def resume(self, problem: P, carried: PyTree[Any]) -> P:
        """The data of a step, including `carried`, the data from the step before."""


class AbstractSchemeWithChord(AbstractOneSolveScheme[Z, P], Generic[Z, P]):
    """A scheme with an approximate Jacobian for the chord method.

    The approximate Jacobian contains the inertia and the gradients of the constraints, and
    those of `chord_terms` that the system has. It differs from the exact one by terms
    of relative size `h^2` times the other stiffness divided by inertia. Where these are
    small, the chord method with this matrix converges quickly, and its linear systems have
    the Delassus matrix `B M^-1 B^T`. Where it fails, the exact Jacobian is used.
    """

    @property
    @abc.abstractmethod
    def chord_terms(self) -> tuple[ChordTerms, ...]:
        """The terms that the approximate Jacobian also contains, so that they do not slow
        its convergence: `("strains",)` for the stiffness of springs and beams,
        `("dampers",)` for the resistance of dampers, or both.

        Of several choices the first one is taken that the system has, and for which the
        elimination is short; without any it contains none.
        """

    @abc.abstractmethod
    def delassus_matrix(self, z: Z, problem: P) -> DelassusMatrix:
        """The Delassus matrix in the middle of the step that `z` describes."""

    @abc.abstractmethod
    def chord(self, rows: Z, problem: P, delassus: DelassusMatrix) -> Z:
        """The unknowns `x` that solve `J x = rows` with the approximate Jacobian `J`."""


class AbstractSchemeWithRotations(AbstractSchemeWithChord[Z, P], Generic[Z, P]):
    """A scheme that moves rigid bodies by rotations.

    It obtains positions from `StepProblem.position` and displacements from
    `StepProblem.displacement`; the velocities of a body in space are `(xdot, W)`, with the
    angular velocity `W` in body axes. For other schemes the directors of rigid bodies are
    coordinates with constraints, and steps of bodies in the plane are those of their
    coordinates.

    - `rotates_in`: the dimensions in which bodies are moved by rotations, 2 in the plane
      and 3 in space.
    """

    rotates_in: ClassVar[tuple[int, ...]] = (2, 3)
