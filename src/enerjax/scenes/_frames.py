"""Frames of bodies, of which joints and forces are functions."""

from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float


GROUND = "ground"
Point: TypeAlias = Float[Array, " d"]
Numbers: TypeAlias = dict[str, Any]


class Frame(NamedTuple):
    """The origin of a body, and its axes as the rows of a matrix, in space.

    - `origin`: the mass centre, shape `(d,)` (length).
    - `axes`: shape `(d, d)`, the transpose of the `rotation` matrix; `None` for bodies
      without an orientation, whose frames stay parallel to that of space.
    - `angle`: in the plane, over any number of turns (radians).

    Fields that a law does not read are `None`.
    """

    origin: Any = None
    axes: Any = None
    angle: Any = None

    @property
    def rotation(self) -> Float[Array, "d d"]:
        """The rotation matrix: the body axes in space along its columns."""
        if self.axes is None:
            return jnp.eye(self.origin.size, dtype=self.origin.dtype)
        return self.axes.T

    def point(self, point: Point) -> Point:
        """A point of the body in space, linear in the origin and the axes."""
        return self.origin + self.direction(point)

    def direction(self, direction: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """A direction of the body in space, or several as rows."""
        if self.axes is None:
            return direction
        return direction @ self.axes

    def components(self, direction: Point) -> Point:
        """A direction in space, in the axes of the body."""
        if self.axes is None:
            return direction
        return self.axes @ direction
