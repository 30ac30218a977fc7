"""What joints and forces compute from the frames of two bodies.

Laws are plain functions of one joint; those of a kind are evaluated together. Like kinds of
bodies they are compared by value. Constraints are made of differences of points and of dot
products of body-fixed directions: the chain rule for difference quotients keeps energy and
momenta of these to round-off.
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp

from .._types import Multipliers, Scalar
from ._frames import Frame, Numbers, Point


class AbstractLaw(abc.ABC):
    """A function of the frames of two bodies; `reads` are the fields of a frame in use."""

    reads: ClassVar[tuple[str, ...]] = ("origin", "axes")

    @abc.abstractmethod
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Any:
        """Rows that vanish, of a joint; an energy, of a force."""


def offset(a: Frame, b: Frame, numbers: Numbers) -> Point:
    """From the point on the first body to the one on the second."""
    return b.point(numbers["point_b"]) - a.point(numbers["point_a"])


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


@dataclass(frozen=True)
class SpringEnergy(AbstractLaw):
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        length = jnp.sqrt(jnp.sum(offset(a, b, numbers) ** 2))
        return 0.5 * numbers["stiffness"] * (length - numbers["length"]) ** 2


@dataclass(frozen=True)
class PlanarTorsion(AbstractLaw):
    reads = ("angle",)

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return 0.5 * numbers["stiffness"] * (b.angle - a.angle - numbers["angle"]) ** 2


@dataclass(frozen=True)
class Torsion(AbstractLaw):
    reads = ("axes",)

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        x, y = (a.direction(numbers["frame_a"][k]) for k in (0, 1))
        turned = b.direction(numbers["frame_b"][0])
        angle = jnp.arctan2(jnp.sum(turned * y), jnp.sum(turned * x))
        return 0.5 * numbers["stiffness"] * (angle - numbers["angle"]) ** 2


@dataclass(frozen=True)
class Pull(AbstractLaw):
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return -jnp.sum(numbers["force"] * b.point(numbers["point_b"]))


@dataclass(frozen=True)
class PlanarTwist(AbstractLaw):
    reads = ("angle",)

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return -numbers["torque"] * (b.angle - a.angle)
