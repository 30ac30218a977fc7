"""The interface of step controllers, and steps of equal length."""

import abc
import dataclasses
import sys
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._operators import AbstractModel
from .._programs import as_array, is_known, module_of
from .._results import RESULTS
from .._system import State
from .._types import Flag, Real, Scalar
from ..schemes import AbstractScheme
from .inputs import positive_integer
from .step import Warm


class Verdict(eqx.Module):
    """The decision about an attempted step.

    - `accepted`: whether the run continues from its end.
    - `result`: a failure, if the run must end here.
    - `memory`: the memory of the plan for the next step.
    """

    accepted: Flag
    result: RESULTS
    memory: PyTree[Any]


class AbstractPlan(eqx.Module):
    """The steps of one run. A place in the run is the time since `t0` in units of `unit`.

    - `t0`, `t1`: the times of the start and the end.
    - `unit`: the length of equal steps, or of the whole run.
    - `last`: the place of the end.
    - `max_attempts`: the number of steps that may be attempted, including rejected ones.
    - `is_counted`: whether the run has exactly `max_attempts` steps.
    """

    t0: eqx.AbstractVar[Scalar]
    t1: eqx.AbstractVar[Scalar]
    unit: eqx.AbstractVar[Scalar]
    last: eqx.AbstractVar[Scalar]
    max_attempts: eqx.AbstractVar[int]
    is_counted: eqx.AbstractVar[bool]

    def time(self, place: Scalar) -> Scalar:
        """The time at a place; a product, so that no round-off accumulates."""
        return jnp.where(place >= self.last, self.t1, self.t0 + self.unit * place)

    @abc.abstractmethod
    def begin(self, model: AbstractModel, start: State) -> PyTree[Any]:
        """The memory of the plan at the start of the run."""

    @abc.abstractmethod
    def first(self) -> Scalar:
        """The length of the first step."""

    @abc.abstractmethod
    def next(self, memory: PyTree[Any], place: Scalar) -> tuple[Scalar, Scalar]:
        """The place where the step from `place` ends, and the length of this step."""

    @abc.abstractmethod
    def usual(self, memory: PyTree[Any]) -> Scalar:
        """The length of a step that no event and no end of the run makes shorter."""

    @property
    @abc.abstractmethod
    def least_hop(self) -> Scalar:
        """The part of the largest gap below which hops between impacts are neglected."""

    @abc.abstractmethod
    def after_event(
        self,
        old: PyTree[Any],
        new: PyTree[Any],
        model: AbstractModel,
        state: State,
        happened: Flag,
    ) -> PyTree[Any]:
        """The memory after a step that an event has ended, if it has `happened`.

        `old` and `new` are those before and after the step, and `state` is that after the
        event.
        """

    @abc.abstractmethod
    def warm(self, memory: PyTree[Any], warm: Warm, length: Scalar) -> Warm:
        """What the last steps pass to a step of this length."""

    @abc.abstractmethod
    def kept(self, new: Warm, old: Warm) -> Warm:
        """What an accepted step passes on; `old` is what the step before passed to it."""

    @abc.abstractmethod
    def judge(
        self,
        memory: PyTree[Any],
        model: AbstractModel,
        ends: tuple[State, State],
        result: RESULTS,
        length: Scalar,
    ) -> Verdict:
        """The decision about a step of this length between the states `ends`."""

    @abc.abstractmethod
    def num_rejected(self, memory: PyTree[Any]) -> Any:
        """The number of steps that were repeated with another length; `None` if a plan
        never does that."""

    @abc.abstractmethod
    def rounded_up(self) -> "AbstractPlan":
        """The same steps, in a program that runs of other lengths can share.

        `max_attempts` is rounded up to a power of two. Attempts that are not needed cost
        next to nothing.
        """

    @property
    @abc.abstractmethod
    def numbers(self) -> PyTree[Any]:
        """The numbers that all steps depend on.

        Runs with the same numbers make the same steps, up to the end of the shorter one.
        """

    @abc.abstractmethod
    def with_events(self, attempts: int) -> "AbstractPlan":
        """The same steps, some of which end early; `attempts` more may be needed."""

    def unlimited(self) -> "AbstractPlan":
        """The same steps, without a limit on their number."""
        return dataclasses.replace(self, max_attempts=sys.maxsize, is_counted=False)


class AbstractController(eqx.Module):
    """Chooses the steps of a run: `EqualSteps` or a `StepController`."""

    @abc.abstractmethod
    def plan(
        self, scheme: AbstractScheme, h: Scalar, t0: Scalar, end: "End"
    ) -> AbstractPlan:
        """The steps of a run that starts at `t0` with a step of length `h`."""


class End(NamedTuple):
    """Where a run ends: after `num_steps`, or at the time `t1`.

    In a run to `t1`, `needed` is the number of steps of the length `h` to this time, and
    `max_steps` an optional bound on the number of steps.
    """

    num_steps: int | None = None
    t1: Scalar | None = None
    needed: Scalar | None = None
    max_steps: int | None = None


class EqualSteps(AbstractController):
    """Steps of equal length: `h`, or in a run to `t1` the next shorter length that fits.

    The first failed step ends the run.
    """

    def plan(self, scheme: AbstractScheme, h: Scalar, t0: Scalar, end: End) -> "EqualPlan":
        if end.num_steps is not None:
            number = module_of(h, t0).asarray(end.num_steps, h.dtype)
            return EqualPlan(
                t0=t0,
                t1=t0 + h * number,
                unit=h,
                last=number,
                max_attempts=end.num_steps,
                is_counted=True,
            )
        assert end.t1 is not None
        assert end.needed is not None
        if end.max_steps is None and not is_known(end.needed):
            raise ValueError(
                "`max_steps` is missing: if `h`, `t0` or `t1` are traced by a "
                "transformation, the number of steps is not known at compile time. Give a "
                "bound, such as the number of steps at the shortest `h`."
            )
        number = module_of(h, t0, end.needed).asarray(end.needed, h.dtype)
        return EqualPlan(
            t0=t0,
            t1=end.t1,
            unit=(end.t1 - t0) / number,
            last=number,
            max_attempts=int(end.needed) if end.max_steps is None else end.max_steps,
            is_counted=False,
        )


# The fraction of an equal step that is too short for a step of its own.
NEAR = 1e-12
# The part of the largest gap below which a hop in a run of equal steps is neglected.
_LEAST_HOP = 1e-3


class EqualPlan(AbstractPlan):
    """The steps of `EqualSteps`."""

    t0: Scalar
    t1: Scalar
    unit: Scalar
    last: Scalar
    max_attempts: int = eqx.field(static=True)
    is_counted: bool = eqx.field(static=True)
    # Whether an event may end a step early. The next step then leads to its planned end.
    may_end_early: bool = eqx.field(static=True, default=False)

    def begin(self, model: AbstractModel, start: State) -> None:
        return None

    def first(self) -> Scalar:
        return jnp.ones_like(self.unit)

    def next(self, memory: None, place: Scalar) -> tuple[Scalar, Scalar]:
        if not self.may_end_early:
            return place + 1, self.first()
        following = jnp.floor(place + 1 + NEAR)
        return following, following - place

    def usual(self, memory: None) -> Scalar:
        return self.first()

    @property
    def least_hop(self) -> Scalar:
        return jnp.asarray(_LEAST_HOP, self.unit.dtype)

    def after_event(
        self, old: None, new: None, model: AbstractModel, state: State, happened: Flag
    ) -> None:
        return None

    def warm(self, memory: None, warm: Warm, length: Scalar) -> Warm:
        return warm

    def kept(self, new: Warm, old: Warm) -> Warm:
        return new

    def judge(
        self,
        memory: None,
        model: AbstractModel,
        ends: tuple[State, State],
        result: RESULTS,
        length: Scalar,
    ) -> Verdict:
        return Verdict(result == RESULTS.successful, result, None)

    def num_rejected(self, memory: None) -> None:
        return None

    @property
    def numbers(self) -> PyTree[Any]:
        return self.t0, self.unit

    def with_events(self, attempts: int) -> "EqualPlan":
        more = self.max_attempts + attempts
        changes = dict(max_attempts=more, is_counted=False, may_end_early=True)
        return dataclasses.replace(self, **changes)

    def rounded_up(self) -> "EqualPlan":
        if (
            not self.is_counted
            and is_known(self.last)
            and float(self.last) > self.max_attempts
        ):
            # The bound of the user ends this run.
            return self
        room = 1 << (self.max_attempts - 1).bit_length()
        return dataclasses.replace(self, max_attempts=room, is_counted=False)


def find_end(
    num_steps: Any,
    t1: Any,
    max_steps: Any,
    controller: Any,
    h: Real,
    t0: Real,
    dtype: Any,
) -> End:
    """The checked end of a run."""
    if not isinstance(controller, AbstractController):
        raise TypeError(
            "`controller` must be `EqualSteps()` or a `StepController(rtol, atol)`, got "
            f"{controller!r}"
            + (": the parentheses are missing." if isinstance(controller, type) else ".")
        )
    if (num_steps is None) == (t1 is None):
        raise ValueError(
            "Pass either `num_steps`, the number of steps of the length `h`, or `t1`, the "
            "time of the end. Got " + ("neither." if t1 is None else "both.")
        )
    if num_steps is not None:
        if max_steps is not None or not isinstance(controller, EqualSteps):
            raise ValueError(
                "`num_steps` counts equal steps: a `StepController` and `max_steps` belong "
                "to runs to an end time. Give `t1` instead."
            )
        return End(num_steps=positive_integer("num_steps", num_steps))
    if jnp.ndim(t1) != 0 or (is_known((t0, t1)) and not _real(t0) < _real(t1) < np.inf):
        raise ValueError(
            f"`t1` must be a finite time after the start of the run, got t1 = {t1} with "
            f"t0 = {t0}."
        )
    if max_steps is not None:
        max_steps = positive_integer("max_steps", max_steps)
    needed: Any = _steps_that_fit(h, t0, t1, dtype)
    return End(t1=as_array(t1, dtype), needed=needed, max_steps=max_steps)


def _real(number: Real) -> float:
    return float(np.real(number))


def _steps_that_fit(h: Real, t0: Real, t1: Real, dtype: Any) -> Scalar | float:
    """`ceil((t1 - t0)/h)`, except for the round-off of the times and of the quotient.

    The result is a NumPy number if all three are known.
    """
    numbers: Any = module_of(h, t0, t1)
    length, begin, end = (numbers.asarray(x, dtype) for x in (h, t0, t1))
    steps, size = (end - begin) / length, abs(end) / length
    rounding = numbers.asarray(16 * jnp.finfo(dtype).eps, dtype)
    return numbers.maximum(numbers.ceil(steps - rounding * (steps + size)), 1)
