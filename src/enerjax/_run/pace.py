"""How a run to an end time chooses its steps, as parts of the whole time."""

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
from .._types import Count, Flag, Real, Scalar
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


class AbstractPace(eqx.Module):
    """What chooses the steps. Times are parts of the run: 0 at its start, 1 at its end."""

    @abc.abstractmethod
    def begin(self, model: AbstractModel, start: State) -> PyTree[Any]:
        """The memory at the start of the run."""

    @abc.abstractmethod
    def first(self) -> Scalar:
        """The length of the first step."""

    @abc.abstractmethod
    def next(
        self, memory: PyTree[Any], begin: Scalar, completed: Count
    ) -> tuple[Scalar, Scalar]:
        """Where the next step ends, and its length."""

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
        h: Scalar,
        length: Scalar,
    ) -> Verdict:
        """What becomes of a step from `begin` of the length `h`, a part `length`."""


class EqualSteps(AbstractPace):
    """A whole number of steps of one length; the first that fails ends the run."""

    number: Scalar

    def begin(self, model: AbstractModel, start: State) -> None:
        return None

    def first(self) -> Scalar:
        return 1 / self.number

    def next(self, memory: None, begin: Scalar, completed: Count) -> tuple[Scalar, Scalar]:
        return (completed + 1).astype(self.number.dtype) / self.number, self.first()

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
        h: Scalar,
        length: Scalar,
    ) -> Verdict:
        return Verdict(out.result == RESULTS.successful, out.result, None)


def steps_that_fit(h: Real, t0: Real, t1: Real, dtype: Any) -> Scalar | float:
    """`ceil((t1 - t0)/h)`, but for the round-off of the times and of the quotient.

    A number where all three are known.
    """
    numbers: Any = np if is_known((h, t0, t1)) else jnp
    length, begin, end = (numbers.asarray(x, dtype) for x in (h, t0, t1))
    steps, size = (end - begin) / length, abs(end) / length
    rounding = numbers.asarray(16 * jnp.finfo(dtype).eps, dtype)
    return numbers.maximum(numbers.ceil(steps - rounding * (steps + size)), 1)
