"""How a run chooses its steps."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from .._operators import AbstractModel
from .._programs import is_known
from .._results import RESULTS
from .._system import State
from .._types import Flag, Real, Scalar
from ..schemes import AbstractScheme
from .inputs import positive_integer
from .step import StepOutput, Warm


class Verdict(eqx.Module):
    """What becomes of a step that was tried.

    - `accepted`: whether the run goes on from its end.
    - `result`: a failure, if there is nothing more to try.
    - `memory`: for the next step.
    """

    accepted: Flag
    result: RESULTS
    memory: PyTree[Any]


class AbstractPlan(eqx.Module):
    """The steps of one run. Places in the run are counted in units of `unit` from `t0`.

    - `t0`, `t1`: the times of its start and its end.
    - `unit`: the time that is counted in: the length of equal steps, or of the whole run.
    - `last`: the place of the end, in this unit.
    - `max_attempts`: steps that may be tried, rejected ones included.
    - `is_counted`: whether exactly `max_attempts` steps lead to the end.
    """

    t0: eqx.AbstractVar[Scalar]
    t1: eqx.AbstractVar[Scalar]
    unit: eqx.AbstractVar[Scalar]
    last: eqx.AbstractVar[Scalar]
    max_attempts: eqx.AbstractVar[int]
    is_counted: eqx.AbstractVar[bool]

    def time(self, place: Scalar) -> Scalar:
        """The time at a place: counted, and not summed up."""
        return jnp.where(place >= self.last, self.t1, self.t0 + self.unit * place)

    @abc.abstractmethod
    def begin(self, model: AbstractModel, start: State) -> PyTree[Any]:
        """The memory at the start of the run."""

    @abc.abstractmethod
    def first(self) -> Scalar:
        """The length of the first step."""

    @abc.abstractmethod
    def next(self, memory: PyTree[Any], place: Scalar) -> tuple[Scalar, Scalar]:
        """Where the step from `place` ends, and its length."""

    @abc.abstractmethod
    def warm(self, memory: PyTree[Any], warm: Warm, length: Scalar) -> Warm:
        """What the last steps leave for one of this length."""

    @abc.abstractmethod
    def kept(self, new: Warm, old: Warm) -> Warm:
        """What an accepted step leaves; `old` is what those before it have left."""

    @abc.abstractmethod
    def judge(
        self,
        memory: PyTree[Any],
        model: AbstractModel,
        begin: State,
        out: StepOutput,
        length: Scalar,
    ) -> Verdict:
        """What becomes of a step of this length from `begin`."""

    @abc.abstractmethod
    def num_rejected(self, memory: PyTree[Any]) -> Any:
        """How many steps were repeated with another length; `None` where none can be."""


class AbstractController(eqx.Module):
    """What chooses the steps of a run: `EqualSteps` or a `StepController`."""

    @abc.abstractmethod
    def plan(
        self, scheme: AbstractScheme, h: Scalar, t0: Scalar, end: "End"
    ) -> AbstractPlan:
        """The steps of a run from `t0` on, of which `h` is the first."""


class End(eqx.Module):
    """Where a run ends: after a number of steps, or at a time, with a bound on the steps.

    - `num_steps`: or `None`.
    - `t1`: or `None`; then `needed` is how many steps of the length `h` lead there.
    - `max_steps`: or `None`.
    """

    num_steps: int | None = eqx.field(static=True)
    t1: Scalar | None
    needed: Scalar | None
    max_steps: int | None = eqx.field(static=True)


class EqualSteps(AbstractController):
    """Steps of one length: `h`, or in a run to `t1` shortened so that a whole number fits.

    The first step that fails ends the run.
    """

    def plan(self, scheme: AbstractScheme, h: Scalar, t0: Scalar, end: End) -> "_EqualPlan":
        if end.num_steps is not None:
            number = jnp.asarray(end.num_steps, h.dtype)
            return _EqualPlan(
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
                "`max_steps` is missing: with `h`, `t0` or `t1` traced by a transformation "
                "the number of steps is not known when the program is made. Give a bound, "
                "such as the number of steps at the shortest `h`."
            )
        number = jnp.asarray(end.needed, h.dtype)
        return _EqualPlan(
            t0=t0,
            t1=end.t1,
            unit=(end.t1 - t0) / number,
            last=number,
            max_attempts=int(end.needed) if end.max_steps is None else end.max_steps,
            is_counted=False,
        )


class _EqualPlan(AbstractPlan):
    t0: Scalar
    t1: Scalar
    unit: Scalar
    last: Scalar
    max_attempts: int = eqx.field(static=True)
    is_counted: bool = eqx.field(static=True)

    def begin(self, model: AbstractModel, start: State) -> None:
        return None

    def first(self) -> Scalar:
        return jnp.ones_like(self.unit)

    def next(self, memory: None, place: Scalar) -> tuple[Scalar, Scalar]:
        return place + 1, self.first()

    def warm(self, memory: None, warm: Warm, length: Scalar) -> Warm:
        return warm

    def kept(self, new: Warm, old: Warm) -> Warm:
        return new

    def judge(
        self,
        memory: None,
        model: AbstractModel,
        begin: State,
        out: StepOutput,
        length: Scalar,
    ) -> Verdict:
        return Verdict(out.result == RESULTS.successful, out.result, None)

    def num_rejected(self, memory: None) -> None:
        return None


def find_end(
    num_steps: Any,
    t1: Any,
    max_steps: Any,
    controller: Any,
    h: Real,
    t0: Real,
    dtype: Any,
) -> End:
    """Where a run ends, checked."""
    if not isinstance(controller, AbstractController):
        raise TypeError(
            "`controller` must be `EqualSteps()` or a `StepController(rtol, atol)`, got "
            f"{controller!r}"
            + (": the parentheses are missing." if isinstance(controller, type) else ".")
        )
    if (num_steps is None) == (t1 is None):
        raise ValueError(
            "Say how long the run is in one of two ways: a number of steps of the length "
            "`h`, `num_steps`, or the time of its end, `t1`. Got "
            + ("neither." if t1 is None else "both.")
        )
    if num_steps is not None:
        if max_steps is not None or not isinstance(controller, EqualSteps):
            raise ValueError(
                "`num_steps` counts equal steps: a `StepController` and `max_steps` belong "
                "to runs to an end time. Give `t1` instead."
            )
        return End(positive_integer("num_steps", num_steps), None, None, None)
    if jnp.ndim(t1) != 0 or (is_known((t0, t1)) and not _real(t0) < _real(t1) < np.inf):
        raise ValueError(
            f"`t1` must be a finite time after the start of the run, got t1 = {t1} with "
            f"t0 = {t0}."
        )
    if max_steps is not None:
        max_steps = positive_integer("max_steps", max_steps)
    needed: Any = _steps_that_fit(h, t0, t1, dtype)
    return End(None, jnp.asarray(t1, dtype), needed, max_steps)


def _real(number: Real) -> float:
    return float(np.real(number))


def _steps_that_fit(h: Real, t0: Real, t1: Real, dtype: Any) -> Scalar | float:
    """`ceil((t1 - t0)/h)`, but for the round-off of the times and of the quotient.

    A number where all three are known.
    """
    numbers: Any = np if is_known((h, t0, t1)) else jnp
    length, begin, end = (numbers.asarray(x, dtype) for x in (h, t0, t1))
    steps, size = (end - begin) / length, abs(end) / length
    rounding = numbers.asarray(16 * jnp.finfo(dtype).eps, dtype)
    return numbers.maximum(numbers.ceil(steps - rounding * (steps + size)), 1)
