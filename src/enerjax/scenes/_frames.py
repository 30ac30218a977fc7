"""Frames of bodies, of which joints and forces are functions."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float


GROUND = "ground"
Point: TypeAlias = Float[Array, " d"]
Numbers: TypeAlias = dict[str, Any]


class Frame(NamedTuple):
    """The origin of a body, and its axes as the rows of a matrix, in space.

    Fields that a law does not read are `None`. So are the axes of bodies without an
    orientation, whose frames stay parallel to that of space.
    """

    origin: Any = None
    axes: Any = None
    angle: Any = None

    def point(self, point: Point) -> Point:
        """A point of the body in space, linear in the origin and the axes."""
        return self.origin + self.direction(point)

    def direction(self, direction: Point) -> Point:
        """A direction of the body in space."""
        if self.axes is None:
            return direction
        return jnp.sum(direction[:, None] * self.axes, axis=0)
