"""Laws and measures: functions of the frames of two bodies.

The energy of a spring is a function of a measure, a force acts along a measure (`F` along
`x` has the power `F xdot`), and a drive prescribes one. The multiplier of a drive is minus
its force or torque.
"""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp

from .._types import Multipliers, Scalar, Vector
from ._ends import Ends
from ._frames import Frame, Numbers, Point


class AbstractLaw(abc.ABC):
    """A function of the frames of two bodies, written for one part.

    Parts with equal laws are evaluated together, and scenes with equal laws share their
    programs. A law is therefore a frozen dataclass, and what differs from part to part is
    in its `numbers`.

    - `reads`: the fields of a frame that it uses, of `"origin"`, `"axes"` and `"angle"`.
    """

    reads: ClassVar[tuple[str, ...]] = ("origin", "axes")

    @abc.abstractmethod
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Any:
        """The constraint of a joint, the energy of a force, or the value of a measure.

        `numbers` are those of one part, from its `resolve`: floats and arrays by name.
        """


def offset(a: Frame, b: Frame, numbers: Numbers) -> Point:
    """The vector from the point on the first body to that on the second."""
    return b.point(numbers["point_b"]) - a.point(numbers["point_a"])


class AbstractMeasure(AbstractLaw):
    """A length, an angle (`is_angle`), or a vector (`is_vector`) such as a position."""

    is_angle: ClassVar[bool] = False
    is_vector: ClassVar[bool] = False

    def constraint(self, a: Frame, b: Frame, numbers: Numbers, value: Any) -> Multipliers:
        """Rows that vanish if the measure has this value, with slope one there."""
        return (self(a, b, numbers) - value).reshape(-1)

    def deviation(self, a: Frame, b: Frame, numbers: Numbers, value: Any) -> Multipliers:
        """The difference of the measure from this value, for reports."""
        return self.constraint(a, b, numbers, value)


@dataclass(frozen=True)
class Separation(AbstractMeasure):
    """The distance between two points."""

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return jnp.sqrt(jnp.sum(offset(a, b, numbers) ** 2))


@dataclass(frozen=True)
class Slide(AbstractMeasure):
    """The component of the offset along an axis of the first body."""

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        apart = offset(a, b, numbers)
        axis = 0 if apart.size == 2 else 2  # see `basis`
        return jnp.sum(apart * a.direction(numbers["frame_a"][axis]))


@dataclass(frozen=True)
class Height(AbstractMeasure):
    """The height of a sphere of the second body over a plane of the first."""

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        height = jnp.sum(offset(a, b, numbers) * a.direction(numbers["normal"]))
        return height - numbers["radius"]


@dataclass(frozen=True)
class Clearance(AbstractMeasure):
    """The gap between two spheres, of which the second may be `inside` of the first."""

    inside: bool

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        apart = Separation()(a, b, numbers)
        if self.inside:
            return numbers["radius_a"] - numbers["radius_b"] - apart
        return apart - numbers["radius_a"] - numbers["radius_b"]


@dataclass(frozen=True)
class Place(AbstractMeasure):
    """The position of a point of the second body."""

    is_vector = True

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Point:
        return b.point(numbers["point_b"])


@dataclass(frozen=True)
class Orientation(AbstractMeasure):
    """The components of all axes of the second body, in space."""

    is_vector = True
    reads = ("axes",)

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Vector:
        return b.axes.ravel()


@dataclass(frozen=True)
class PlanarTurn(AbstractMeasure):
    """The difference of two angles, over any number of turns."""

    is_angle = True
    reads = ("angle",)

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return b.angle - a.angle


class AbstractTurn(AbstractMeasure):
    """An angle in space, which jumps at half a turn; its rate does not."""

    is_angle = True

    @abc.abstractmethod
    def components(self, a: Frame, b: Frame, numbers: Numbers) -> tuple[Scalar, Scalar]:
        """Cosine and sine of the angle."""

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        along, across = self.components(a, b, numbers)
        return jnp.arctan2(across, along)

    def constraint(self, a: Frame, b: Frame, numbers: Numbers, value: Any) -> Multipliers:
        # The sine of the difference is smooth over any number of turns.
        return self._turned_back(a, b, numbers, value)[1].reshape(-1)

    def deviation(self, a: Frame, b: Frame, numbers: Numbers, value: Any) -> Multipliers:
        # The sine also vanishes half a turn away from the value, so the angle is reported.
        along, across = self._turned_back(a, b, numbers, value)
        return jnp.arctan2(across, along).reshape(-1)

    def _turned_back(
        self, a: Frame, b: Frame, numbers: Numbers, value: Any
    ) -> tuple[Scalar, Scalar]:
        """Cosine and sine of the difference of the angle and a value."""
        along, across = self.components(a, b, numbers)
        c, s = jnp.cos(value), jnp.sin(value)
        return along * c + across * s, across * c - along * s


@dataclass(frozen=True)
class Turn(AbstractTurn):
    """The angle about an axis that both bodies have in common.

    - `seen_from_b`: whether the angle is that of a direction of the first body in the axes
      of the second.
    """

    reads = ("axes",)
    seen_from_b: bool = False

    def components(self, a: Frame, b: Frame, numbers: Numbers) -> tuple[Scalar, Scalar]:
        ends = (a, numbers["frame_a"]), (b, numbers["frame_b"])
        (fixed, axes), (moved, directions) = reversed(ends) if self.seen_from_b else ends
        x, y = (fixed.direction(axes[k]) for k in (0, 1))
        turned = moved.direction(directions[0])
        return jnp.sum(turned * x), jnp.sum(turned * y)


@dataclass(frozen=True)
class Room(AbstractMeasure):
    """What is left to another measure before it reaches a limit, from above if `lower`."""

    measure: AbstractMeasure
    lower: bool

    # The room left to an angle is not an angle itself: it has no full turns to count.
    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        room = numbers["limit"] - self.measure(a, b, numbers)
        return -room if self.lower else room


def turn_of(ends: Ends, axis: Vector | None) -> tuple[AbstractMeasure, Numbers]:
    """The measure of the angle between two bodies, in space about an axis, and its
    numbers."""
    if ends.dimension == 2:
        ends.refuse_axes(axis)
        ends.only_bodies_that_turn()
        return PlanarTurn(), {}
    return Turn(), ends.common_axis(axis)
