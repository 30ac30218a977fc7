"""Reactions of joints, which are defined by small motions of the second body."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._types import Coordinates, Scalar
from ._frames import Frame, Numbers, Point
from ._laws import all_rows, Driven, Flywheel
from ._layout import Layout, Links
from ._parameters import Parameters
from ._pose_view import View


class Reaction(NamedTuple):
    """The force and torque of a joint on its second body, in space, at each saved time.

    - `force`: shape `(times, d)`; for one state `(d,)`.
    - `torque`: about the joint's point on that body, shape `(times, 3)`, in the plane
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
    """The joint's point on the second body; for an angle, the origin of this body."""
    return frame.point(numbers["point_b"]) if "point_b" in numbers else frame.origin


def no_motion(dimension: int, dtype: Any) -> tuple[Array, Array]:
    """A translation and a rotation of zero."""
    return jnp.zeros((dimension,), dtype), jnp.zeros((2 * dimension - 3,), dtype)


def reaction(
    layout: Layout,
    q: Coordinates,
    multipliers: Array,
    joint: str,
    ends: tuple[str, str],
    args: Parameters,
) -> Reaction:
    """The reaction of a joint, drive or inerter between two bodies, in one state."""
    group, numbers = _link(layout, joint, args)
    a, b = (View(layout, q).frame(body) for body in ends)
    pivot = pivot_of(b, numbers)

    def work(shift: Point, turn: Array) -> Scalar:
        end = moved(b, pivot, shift, turn)
        return -jnp.sum(multipliers * all_rows(group.law, a, end, (a, b), numbers))

    return Reaction(*jax.grad(work, argnums=(0, 1))(*no_motion(pivot.size, pivot.dtype)))


def _link(layout: Layout, name: str, args: Parameters) -> tuple[Links, Numbers]:
    """A joint, drive or inerter with the law of its rows, and its numbers."""
    places = layout.places
    if name in places["joints"]:
        number, _ = places["joints"][name]
        return layout.joint_groups[number], args["joints"][name]
    section = "drives" if name in places["drives"] else "inerters"
    number, _ = places[section][name]
    inerters = [group.links for group in layout.inerter_groups]
    group = (layout.drive_groups if section == "drives" else inerters)[number]
    assert isinstance(group.law, Driven | Flywheel)
    # The rows of drives and inerters have the derivatives of their measures.
    return group._replace(law=group.law.measure), args[section][name]


def each(function: Callable, q: Array, *others: Array) -> Any:
    """The values of a function of one state for all states along the leading axes."""
    for _ in range(q.ndim - 1):
        function = jax.vmap(function)
    return function(q, *others)
