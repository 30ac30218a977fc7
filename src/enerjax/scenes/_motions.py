"""Small motions of the second body of a joint: gaps and reactions are measured by them."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar
from ._frames import Frame, Numbers, Point
from ._functions import constraint, driven, drives_at, evaluate, redundancy
from ._layout import Layout, Links
from ._parameters import Parameters
from ._view import View


class Gap(NamedTuple):
    """How far a joint is from closed: lengths, and lengths per time.

    Angles count as the length of an arc over the size of the scene.
    """

    position: float
    velocity: float


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


@eqx.filter_jit
def gaps(
    layout: Layout, q: Coordinates, qdot: Coordinates, args: Parameters
) -> tuple[list[tuple[Array, Array]], Scalar]:
    """For every group of joints how far each is off, and its rate; the scene's size.

    Joints come first, constraints next, drives last.
    """
    view = View(layout, q)
    size = _size(view, args)
    found, of_drives = [], []
    for group, numbers in zip(layout.joint_groups, args.tables["joints"], strict=True):
        rows = lambda x, group=group, numbers=numbers: evaluate(
            group, View(layout, x), numbers
        )
        pair = jax.jvp(rows, (q,), (qdot,))
        found.append(_lengths(pair, _slopes(group, view, numbers, size)))
    t = jnp.zeros((), q.dtype)
    for k, (group, numbers) in enumerate(drives_at(layout, t, args)):

        def driven_rows(x: Coordinates, t: Scalar, k: int = k) -> Array:
            group, numbers = drives_at(layout, t, args)[k]
            return evaluate(group, View(layout, x), numbers)

        pair = jax.jvp(driven_rows, (q, t), (qdot, jnp.ones_like(t)))
        of_drives.append(_lengths(pair, _slopes(group, view, numbers, size)))
    for _, function in layout.constraints:
        of_q = lambda x, function=function: function(View(layout, x), args)
        value, rate = jax.jvp(of_q, (q,), (qdot,))
        slope = jnp.linalg.norm(jax.jacfwd(of_q)(q), axis=1)
        found.append(tuple(jnp.linalg.norm(x / slope)[None] for x in (value, rate)))
    return found + of_drives, size


def _lengths(pair: tuple[Array, Array], slope: Array) -> tuple[Array, Array]:
    value, rate = (jnp.linalg.norm(x / slope, axis=1) for x in pair)
    return value, rate


def _slopes(
    group: Links, view: View, numbers: Numbers, size: Scalar
) -> Float[Array, "joints rows"]:
    """How fast every row changes with a motion of the second body."""

    def slope(a: Frame, b: Frame, numbers: Numbers) -> Array:
        pivot = pivot_of(b, numbers)
        rows = lambda shift, turn: group.law(a, moved(b, pivot, shift, turn), numbers)
        rest = still(pivot.size, pivot.dtype)
        shift, turn = jax.jacfwd(rows, argnums=(0, 1))(*rest)
        return jnp.linalg.norm(jnp.concatenate([shift, turn / size], axis=1), axis=1)

    a, b = (
        Frame(view.origins[k], view.axes[k], view.angles[k]) for k in (group.a, group.b)
    )
    slopes = jax.vmap(slope)(a, b, numbers)
    return jnp.where(slopes > 0, slopes, 1)


def _size(view: View, args: Parameters) -> Scalar:
    """The extent of the scene: of its bodies and of the points of its joints."""
    points = [view.origins]
    groups = view.layout.joint_groups
    for group, numbers in zip(groups, args.tables["joints"], strict=True):
        for side, key in ((group.a, "point_a"), (group.b, "point_b")):
            if key in numbers:
                frames = Frame(view.origins[side], view.axes[side])
                points.append(jax.vmap(Frame.point)(frames, numbers[key]))
    cloud = jnp.concatenate(points)
    extent = jnp.max(jnp.max(cloud, axis=0) - jnp.min(cloud, axis=0))
    return jnp.where(extent > 0, extent, 1)


def reaction(
    group: Links, a: Frame, b: Frame, numbers: Numbers, multipliers: Array
) -> tuple[Point, Array]:
    """Force and torque of a joint on its second body, about its point there."""
    pivot = pivot_of(b, numbers)

    def work(shift: Point, turn: Array) -> Scalar:
        return -jnp.sum(multipliers * group.law(a, moved(b, pivot, shift, turn), numbers))

    return jax.grad(work, argnums=(0, 1))(*still(pivot.size, pivot.dtype))


def first_dependent(
    layout: Layout, q: Coordinates, args: Parameters, places: dict[str, slice]
) -> str | None:
    """The first joint with a row that those before it determine already."""
    start = jnp.zeros((), q.dtype)
    held = []
    if layout.has_constraints:
        held += [*jax.jacfwd(lambda x: constraint(layout, x, args))(q)]
    if layout.drives:
        held += [*jax.jacfwd(lambda x: driven(layout, x, start, args))(q)]
    joined = {k for place in places.values() for k in range(place.start, place.stop)}
    # What bodies have of their own stands before.
    taken = [row for k, row in enumerate(held) if k not in joined]
    taken += [*jax.jacfwd(lambda x: redundancy(layout, x, args))(q)]
    for name, place in places.items():
        taken += held[place]
        if np.linalg.matrix_rank(np.array(taken)) < len(taken):
            return name
    return None
