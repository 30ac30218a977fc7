import abc
from collections.abc import Callable
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._discrete import AbstractDerivative
from .._operators import AbstractModel, Drive, Increment, Time
from .._results import RESULTS
from .._system import State
from .._types import Coordinates, JointMultipliers, Multipliers, Scalar, Velocities
from .energies import Energies


# The levels at which joints are held: positions and velocities, stabilised as by Gear,
# Gupta and Leimkuhler; or positions only.
Formulation: TypeAlias = Literal["ggl", "index3"]
# A force as a function of coordinates, velocities and time: all of it, or a part.
Law: TypeAlias = Callable[[Coordinates, Velocities, Time], Velocities]
Z = TypeVar("Z")
P = TypeVar("P")


class StepProblem(eqx.Module):
    """Everything that is known when a step starts."""

    model: AbstractModel
    start: State
    h: Scalar
    derivative: AbstractDerivative
    formulation: Formulation = eqx.field(static=True)

    @property
    def lapse(self) -> Time:
        """The time that passes, where time enters."""
        return None if self.start.t is None else self.h

    @property
    def end_time(self) -> Time:
        return None if self.start.t is None else self.start.t + self.h

    @property
    def middle_time(self) -> Time:
        return None if self.start.t is None else self.start.t + 0.5 * self.h

    def at(self, increment: Increment) -> Coordinates:
        """The configuration that an increment leads to."""
        return self.start.q + self.h * increment.rate

    def node(self, increment: Increment, t: Time) -> State:
        """The state that an increment leads to, where momenta are unknowns."""
        return State(self.at(increment), increment.momentum, t)

    def drive(self, a: State, b: State, increment: Increment) -> Drive:
        """The discrete gradient over `a -> b`."""
        return self.model.drive(self.derivative, a, b, self.h, increment)

    def drive_work(self, a: State, b: State, increment: Increment) -> Scalar | None:
        """The work of the driven constraints over `a -> b`; `None` without any."""
        if self.model.system.driven is None:
            return None
        return self.drive(a, b, increment).work

    def velocity(self, end: Increment) -> Velocities:
        """`Lm (q1 - q0)/h`: free of what multipliers add to velocities."""
        return self.model.push(self.start.q, self.at(end), end.rate)

    def step_load(self, b: State, end: Increment) -> Coordinates | None:
        """`h Lm^T f` in the middle of the step; `None` for a system without forces."""
        if self.model.system.force is None:
            return None
        return self.load(self.model.force, self.start, b, end, self.velocity(end))

    def load(
        self, law: Law, a: State, b: State, end: Increment, velocity: Velocities
    ) -> Coordinates:
        """`h Lm^T f` in the middle of `a -> b`, with `Lm` that of the step to `end`."""
        assert a.t is not None
        assert b.t is not None
        force = law(0.5 * (a.q + b.q), velocity, 0.5 * (a.t + b.t))
        return self.h * self.model.pull(self.start.q, self.at(end), force)

    def step_work(self, b: State, end: Increment) -> Callable[[Law], Scalar]:
        """The work that a force does in the middle of the step."""
        velocity = self.velocity(end)
        return lambda law: self.load(law, self.start, b, end, velocity) @ end.rate

    def account(
        self, dissipated: Scalar, work: Callable[[Law], Scalar], drive_work: Scalar | None
    ) -> Energies:
        """The energies of a step, given the work that a force does in it."""
        if self.model.system.force is None:
            return Energies(dissipated, None, None, drive_work)
        total, damping = work(self.model.force), work(self.model.damping)
        return Energies(dissipated, total, -damping, drive_work)

    def joint_rate(self, state: State) -> JointMultipliers:
        """`psi(q, v)` where the formulation holds it, else no rows."""
        if self.formulation == "index3":
            return jnp.zeros((0,), state.q.dtype)
        return self.model.joint_rate(state.q, state.v, state.t)

    def rows(
        self, z: Increment, node: State, drive: Drive, moving: State | None = None
    ) -> Increment:
        """The rows of one node: the structure residual, and the constraints held there.

        (Their rates those of the node `moving`, if it is another.)
        """
        structure = self.model.structure(self.start, node, self.h, z.rate, drive)
        return Increment(
            self.model.constraint(node.q, node.t) / self.h,
            structure.impulse,
            structure.drift,
            self.joint_rate(node if moving is None else moving),
        )

    def guess(self, acceleration: Velocities, multipliers: Multipliers) -> Increment:
        """The increment of a Taylor step of the whole length."""
        q, v, h = self.start.q, self.start.v, self.h
        momentum = v + h * acceleration
        num_rates = jax.eval_shape(self.joint_rate, self.start).size
        return Increment(
            h * multipliers,
            self.model.lift(q, v + 0.5 * h * acceleration),
            momentum if self.model.has_own_momenta else momentum[:0],
            jnp.zeros((num_rates,), q.dtype),
        )


class StepEnd(eqx.Module):
    """What a solved step yields.

    - `state`: at the end of the step.
    - `displacement`: of the configuration over the step, not yet rounded to that of `q`.
    - `multipliers`: `lambda` of the step, joints first (energy per constraint unit).
    - `energies`: where the energy went.
    - `details`: what the scheme reports of its own, or `None`.
    - `result`: a failure that the scheme itself can see.
    - `carried`: what a scheme with a memory hands to its next step; of others `None`.
    """

    state: State
    displacement: Coordinates
    multipliers: Multipliers
    energies: Energies
    details: PyTree[Any]
    result: RESULTS
    carried: PyTree[Any] = None


class AbstractScheme(eqx.Module):
    """A one-step method: what `step` and `simulate` accept."""

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Order of accuracy in `q` and `v`, constrained or not."""

    @property
    @abc.abstractmethod
    def stages(self) -> tuple[float, ...]:
        """The lengths of the solves that make up a step, as parts of `h`."""

    @property
    @abc.abstractmethod
    def stage(self) -> "AbstractSingleSolve":
        """The scheme of each of these solves."""


class AbstractSingleSolve(AbstractScheme, Generic[Z, P]):
    """A scheme whose step is one nonlinear solve.

    `Z` is a pytree of `Increment`s, one for each node of the step, and of the scheme's
    own scalar unknowns, which must be dimensionless. `residual` returns the same
    structure, with rows in the places of the unknowns. `P` is what stays fixed in a step.
    """

    @property
    def stages(self) -> tuple[float, ...]:
        return (1.0,)

    @property
    def stage(self) -> "AbstractSingleSolve":
        return self

    @property
    @abc.abstractmethod
    def formulation(self) -> Formulation:
        """The levels at which joints are held."""

    @property
    @abc.abstractmethod
    def symmetric(self) -> bool:
        """Whether a step of `-h` undoes a step of `h`: such a scheme can be composed."""

    @abc.abstractmethod
    def problem(self, model: AbstractModel, start: State, h: Scalar) -> P:
        """The data of a step: a `StepProblem`, or one with more that stays fixed."""

    @abc.abstractmethod
    def predict(self, problem: P, acceleration: Velocities, multipliers: Multipliers) -> Z:
        """A first guess from the accelerations and multipliers at the start."""

    @abc.abstractmethod
    def residual(self, z: Z, problem: P) -> Z:
        """The step equations; zero at the solution."""

    @abc.abstractmethod
    def finish(self, z: Z, problem: P) -> StepEnd:
        """The end of the step from the solved unknowns."""


class AbstractSimplifiedSolve(AbstractSingleSolve[Z, P], Generic[Z, P]):
    """A scheme with weak couplings between neighbours, which a search can do without."""

    @abc.abstractmethod
    def simplified(self, z: Z, held: Z, problem: P) -> Z:
        """The residual where `held` is `z`; weak couplings stay at `held`.

        A large system is searched with the Jacobian of this: fewer unknowns meet in a row.
        """


class AbstractCarryingSolve(AbstractSingleSolve[Z, P], Generic[Z, P]):
    """A scheme that remembers more of the last step than the state at its end.

    What it remembers travels beside the state, as `StepEnd.carried`, and is differentiated
    like it. Such a scheme is no map from state to state, so it cannot be composed.
    """

    @abc.abstractmethod
    def begin(
        self, model: AbstractModel, start: State, h: Scalar, acceleration: Velocities
    ) -> PyTree[Any]:
        """What the first step of a run is handed."""

    @abc.abstractmethod
    def resume(self, problem: P, carried: PyTree[Any]) -> P:
        """The data of a step, with what the step before has handed on."""
