"""The laws of joints, forces and drives: functions of the frames of two bodies.

Laws are compared by value, and equal ones are evaluated together. Constraints consist of
differences of points and dot products of body-fixed directions, because with these the
chain rule for difference quotients conserves energy and momenta to round-off.
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
    """Keeps two points together and pairs of axes perpendicular.

    - `along`: the axes of the first frame along which the points must coincide; `None` if
      they must coincide altogether.
    - `square`: pairs of axes, of the first and second frame, that stay perpendicular.
    """

    along: tuple[int, ...] | None
    square: tuple[tuple[int, int], ...] = ()

    @property
    def has_frames(self) -> bool:
        return bool(self.square or self.along)

    @property
    def keeps_directions(self) -> bool:
        """Whether the second frame cannot turn relative to the first."""
        return len(self.square) == 3

    @property
    def keeps_axis(self) -> bool:
        """Whether the last axis of both frames stays the same."""
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


class AbstractElastic(AbstractLaw):
    """A potential energy of a measure; the force along the measure is minus its slope."""

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
class Elastic(AbstractElastic):
    """A linear spring, whose force vanishes if the measure is `numbers[rest]`."""

    measure: AbstractMeasure
    rest: str

    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        return 0.5 * numbers["stiffness"] * (value - numbers[self.rest]) ** 2


@dataclass(frozen=True)
class Steady(AbstractElastic):
    """A constant force `numbers[load]` along a measure."""

    measure: AbstractMeasure
    load: str

    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        return -jnp.sum(numbers[self.load] * value)


# Laws that depend on time or velocities -------------------------------------------------

# A function of time and of the `args` of the system.
Signal = TypeAliasType("Signal", Callable[[Scalar, Args], Array])


@dataclass(frozen=True)
class Driven(AbstractLaw):
    """Keeps a measure at the value of a signal, which is in `numbers["value"]`."""

    measure: AbstractMeasure
    signal: Signal

    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return self.measure.away(a, b, numbers, numbers["value"])


@dataclass(frozen=True)
class Missed(AbstractLaw):
    """The difference of a driven measure from `numbers["value"]`."""

    measure: AbstractMeasure

    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return self.measure.missed(a, b, numbers, numbers["value"])


class AbstractPush(AbstractLaw):
    """A force along a measure that has no potential."""

    measure: AbstractMeasure
    signal: Callable[..., Array] | None

    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Any:
        return self.measure(a, b, numbers)

    @abc.abstractmethod
    def push(self, b: Frame, rate: Array, numbers: Numbers) -> Array:
        """The force for this rate of the measure."""


@dataclass(frozen=True)
class Viscous(AbstractPush):
    measure: AbstractMeasure
    signal: None = None

    def push(self, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return -numbers["damping"] * rate


@dataclass(frozen=True)
class Acting(AbstractPush):
    """A force with the value of a signal, which is in `numbers["value"]`.

    With `feedback` the signal also depends on the motion of the bodies.
    """

    measure: AbstractMeasure
    signal: Callable[..., Array]
    feedback: bool

    def push(self, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return numbers["value"]


@dataclass(frozen=True)
class Following(Acting):
    """A force whose signal is a vector in the axes of its body."""

    def push(self, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return b.direction(numbers["value"])
