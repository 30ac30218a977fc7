"""What joints and forces compute from the frames of two bodies.

Laws are plain functions of one joint; those of a kind are evaluated together. Like kinds of
bodies they are compared by value. Constraints are made of differences of points and of dot
products of body-fixed directions: the chain rule for difference quotients keeps energy and
momenta of these to round-off.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array
from typing_extensions import TypeAliasType

from .._types import Args, Multipliers, Scalar
from ._frames import Frame, Numbers, Point
from ._measures import AbstractLaw, AbstractMeasure, offset


@dataclass(frozen=True)
class Alignment(AbstractLaw):
    """Points stay together, axes stay perpendicular.

    - `along`: axes of the first frame along which the points may not part; `None` for all.
    - `square`: pairs of axes, of the first and second frame, that stay perpendicular.
    """

    along: tuple[int, ...] | None
    square: tuple[tuple[int, int], ...] = ()

    @property
    def has_frames(self) -> bool:
        return bool(self.square or self.along)

    @property
    def keeps_directions(self) -> bool:
        """Whether the second frame does not turn against the first."""
        return len(self.square) == 3

    @property
    def keeps_axis(self) -> bool:
        """Whether the last axis of the first frame stays one of the second."""
        return self.square == ((2, 0), (2, 1))

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        apart = offset(a, b, numbers)
        if not self.has_frames:
            return apart
        of_a = [a.direction(numbers["frame_a"][k]) for k in range(apart.size)]
        of_b = [b.direction(numbers["frame_b"][k]) for k in range(apart.size)]
        rows = [apart]
        if self.along is not None:
            rows = [jnp.sum(apart * of_a[k])[None] for k in self.along]
        rows += [jnp.sum(of_a[i] * of_b[j])[None] for i, j in self.square]
        return jnp.concatenate(rows)


@dataclass(frozen=True)
class Length(AbstractLaw):
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return (jnp.sum(offset(a, b, numbers) ** 2) - numbers["length"] ** 2)[None]


@dataclass(frozen=True)
class Curve(AbstractLaw):
    function: Callable[[Point, Numbers], Multipliers]

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        apart = b.point(numbers["point_b"]) - a.origin
        if a.axes is not None:
            apart = jnp.sum(a.axes * apart[None], axis=1)
        return self.function(apart, numbers)


class AbstractStored(AbstractLaw):
    """An energy that depends on a measure; its force is minus the slope."""

    measure: AbstractMeasure

    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return self.energy(self.measure(a, b, numbers), numbers)

    @abc.abstractmethod
    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        """The energy, for the value of the measure."""


@dataclass(frozen=True)
class Elastic(AbstractStored):
    """A linear spring, without force where the measure is `numbers[rest]`."""

    measure: AbstractMeasure
    rest: str

    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        return 0.5 * numbers["stiffness"] * (value - numbers[self.rest]) ** 2


@dataclass(frozen=True)
class Steady(AbstractStored):
    """A push that is `numbers[load]` for good."""

    measure: AbstractMeasure
    load: str

    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        return -jnp.sum(numbers[self.load] * value)


# Laws that time or velocities enter -----------------------------------------------------

# A function of time and of the `args` of the system.
Signal = TypeAliasType("Signal", Callable[[Scalar, Args], Array])


@dataclass(frozen=True)
class Driven(AbstractLaw):
    """A measure that is held at a value of the time, which `numbers["value"]` is now."""

    measure: AbstractMeasure
    signal: Signal

    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return self.measure.away(a, b, numbers, numbers["value"])


@dataclass(frozen=True)
class Missed(AbstractLaw):
    """How far a drive is from `numbers["value"]`."""

    measure: AbstractMeasure

    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return self.measure.missed(a, b, numbers, numbers["value"])


class AbstractPush(AbstractLaw):
    """A force along a measure, that no potential has."""

    measure: AbstractMeasure
    signal: Callable[..., Array] | None

    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Any:
        return self.measure(a, b, numbers)

    @abc.abstractmethod
    def push(self, b: Frame, rate: Array, numbers: Numbers) -> Array:
        """The force, for the rate of the measure."""


@dataclass(frozen=True)
class Viscous(AbstractPush):
    measure: AbstractMeasure
    signal: None = None

    def push(self, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return -numbers["damping"] * rate


@dataclass(frozen=True)
class Acting(AbstractPush):
    """A force that is `numbers["value"]` now.

    With `feedback` its signal is a function of the bodies in motion too.
    """

    measure: AbstractMeasure
    signal: Callable[..., Array]
    feedback: bool

    def push(self, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return numbers["value"]


@dataclass(frozen=True)
class Following(Acting):
    """A force that is told in the axes of its body."""

    def push(self, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return b.direction(numbers["value"])
