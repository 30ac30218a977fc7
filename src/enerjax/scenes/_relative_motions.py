"""Small motions of the second body of a joint: gaps and reactions are measured by them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._types import Coordinates, Scalar
from ._frames import Frame, Numbers, Point
from ._laws import Driven
from ._layout import Layout, Links
from ._parameters import Parameters
from ._view import View


class Reaction(NamedTuple):
    """What a joint does to its second body, in space, at each saved time.

    - `force`: shape `(times, d)`; of one state `(d,)`.
    - `torque`: about the joint's point on that body, `(times, 3)`, in the plane
      `(times, 1)`.
    """

    force: Array
    torque: Array


def moved(frame: Frame, pivot: Point, shift: Point, turn: Array) -> Frame:
    """A frame after a small translation and a small rotation about a point."""
    if pivot.size == 2:
        rotated = lambda x: turn[0] * jnp.stack([-x[1], x[0]])
    else:
        rotated = lambda x: jnp.cross(turn, x)
    origin = frame.origin + shift + rotated(frame.origin - pivot)
    angle = frame.angle + turn[0] if pivot.size == 2 else frame.angle
    return Frame(origin, frame.axes + jax.vmap(rotated)(frame.axes), angle)


def pivot_of(frame: Frame, numbers: Numbers) -> Point:
    """The point of the second body that a joint holds; its origin, of an angle."""
    return frame.point(numbers["point_b"]) if "point_b" in numbers else frame.origin


def still(dimension: int, dtype: Any) -> tuple[Array, Array]:
    """No translation and no rotation."""
    return jnp.zeros((dimension,), dtype), jnp.zeros((2 * dimension - 3,), dtype)


def reaction(
    layout: Layout,
    q: Coordinates,
    multipliers: Array,
    joint: str,
    ends: tuple[str, str],
    args: Parameters,
) -> Reaction:
    """Of a joint or drive between two bodies, in one state."""
    group, numbers = _link(layout, joint, args)
    a, b = (View(layout, q).frame(body) for body in ends)
    pivot = pivot_of(b, numbers)

    def work(shift: Point, turn: Array) -> Scalar:
        return -jnp.sum(multipliers * group.law(a, moved(b, pivot, shift, turn), numbers))

    return Reaction(*jax.grad(work, argnums=(0, 1))(*still(pivot.size, pivot.dtype)))


def _link(layout: Layout, name: str, args: Parameters) -> tuple[Links, Numbers]:
    """What a joint or drive holds, and its numbers."""
    places = layout.places
    if name in places["joints"]:
        number, _ = places["joints"][name]
        return layout.joint_groups[number], args["joints"][name]
    number, _ = places["drives"][name]
    group = layout.drive_groups[number]
    assert isinstance(group.law, Driven)
    # What it prescribes has the slope of its measure.
    return group._replace(law=group.law.measure), args["drives"][name]


def each(function: Callable, q: Array, *others: Array) -> Any:
    """A function of one state, for all along the leading axes."""
    for _ in range(q.ndim - 1):
        function = jax.vmap(function)
    return function(q, *others)
