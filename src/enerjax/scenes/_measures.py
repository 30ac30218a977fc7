"""Functions of the frames of two bodies, and those with a number for a value: measures.

Springs stretch along a measure, forces work along one (a push `F` along `x` has the power
`F xdot`), and drives prescribe one; the multiplier of a drive is minus its force or torque.
"""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp

from .._types import Multipliers, Scalar, Vector
from ._ends import Ends
from ._frames import Frame, Numbers, Point


class AbstractLaw(abc.ABC):
    """What a part computes from the frames of two bodies.

    Written for one part. Parts with equal laws are evaluated together, and scenes with
    equal laws share their programs: a law is a frozen dataclass, and what differs from
    part to part is in its `numbers`.

    - `reads`: the fields of a frame in use, of `"origin"`, `"axes"` and `"angle"`.
    """

    reads: ClassVar[tuple[str, ...]] = ("origin", "axes")

    @abc.abstractmethod
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Any:
        """Rows that vanish, of a joint; an energy, of a force; the value of a measure.

        `numbers` are those of one part, from its `resolve`: floats and arrays by name.
        """


def offset(a: Frame, b: Frame, numbers: Numbers) -> Point:
    """From the point on the first body to the one on the second."""
    return b.point(numbers["point_b"]) - a.point(numbers["point_a"])


class AbstractMeasure(AbstractLaw):
    """A length, an angle (`is_angle`), or a vector (`is_vector`), as a place in space."""

    is_angle: ClassVar[bool] = False
    is_vector: ClassVar[bool] = False

    def away(self, a: Frame, b: Frame, numbers: Numbers, value: Any) -> Multipliers:
        """Rows that vanish where the measure has this value, of slope one there."""
        return (self(a, b, numbers) - value).reshape(-1)

    def missed(self, a: Frame, b: Frame, numbers: Numbers, value: Any) -> Multipliers:
        """How far the measure is from this value, for reports."""
        return self.away(a, b, numbers, value)


@dataclass(frozen=True)
class Separation(AbstractMeasure):
    """The distance of two points."""

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return jnp.sqrt(jnp.sum(offset(a, b, numbers) ** 2))


@dataclass(frozen=True)
class Slide(AbstractMeasure):
    """How far the second point is along an axis of the first body."""

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        apart = offset(a, b, numbers)
        axis = 0 if apart.size == 2 else 2  # of a `basis`
        return jnp.sum(apart * a.direction(numbers["frame_a"][axis]))


@dataclass(frozen=True)
class Place(AbstractMeasure):
    """Where a point of the second body is."""

    is_vector = True

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Point:
        return b.point(numbers["point_b"])


@dataclass(frozen=True)
class PlanarTurn(AbstractMeasure):
    """The difference of two angles, over any number of turns."""

    is_angle = True
    reads = ("angle",)

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return b.angle - a.angle


@dataclass(frozen=True)
class Turn(AbstractMeasure):
    """The angle about a common axis in space: it jumps at half a turn, but not its rate."""

    is_angle = True
    reads = ("axes",)

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        along, across = self._components(a, b, numbers)
        return jnp.arctan2(across, along)

    def away(self, a: Frame, b: Frame, numbers: Numbers, value: Any) -> Multipliers:
        # The sine of the difference: smooth over any number of turns.
        return self._turned_back(a, b, numbers, value)[1].reshape(-1)

    def missed(self, a: Frame, b: Frame, numbers: Numbers, value: Any) -> Multipliers:
        # The sine vanishes half a turn away too.
        along, across = self._turned_back(a, b, numbers, value)
        return jnp.arctan2(across, along).reshape(-1)

    def _turned_back(
        self, a: Frame, b: Frame, numbers: Numbers, value: Any
    ) -> tuple[Scalar, Scalar]:
        """Cosine and sine of the angle less a value."""
        along, across = self._components(a, b, numbers)
        c, s = jnp.cos(value), jnp.sin(value)
        return along * c + across * s, across * c - along * s

    def _components(self, a: Frame, b: Frame, numbers: Numbers) -> tuple[Scalar, Scalar]:
        x, y = (a.direction(numbers["frame_a"][k]) for k in (0, 1))
        turned = b.direction(numbers["frame_b"][0])
        return jnp.sum(turned * x), jnp.sum(turned * y)


def turn_of(ends: Ends, axis: Vector | None) -> tuple[AbstractMeasure, Numbers]:
    """The angle between two bodies, in space about an axis; its numbers."""
    if ends.dimension == 2:
        ends.refuse_axes(axis)
        ends.only_bodies_that_turn()
        return PlanarTurn(), {}
    return Turn(), ends.about(axis)
