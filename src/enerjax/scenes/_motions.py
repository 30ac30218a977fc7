"""Small motions of the second body of a joint: gaps and reactions are measured by them."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar
from ._frames import Frame, Numbers, Point
from ._functions import constraint, evaluate, redundancy
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
    return Frame(origin, frame.axes + jax.vmap(rotated)(frame.axes), frame.angle)


def pivot_of(frame: Frame, numbers: Numbers) -> Point:
    """The point of the second body that a joint holds."""
    return frame.point(numbers["point_b"])


def still(dimension: int, dtype: Any) -> tuple[Array, Array]:
    """No translation and no rotation."""
    return jnp.zeros((dimension,), dtype), jnp.zeros((2 * dimension - 3,), dtype)


@eqx.filter_jit
def gaps(
    layout: Layout, q: Coordinates, qdot: Coordinates, args: Parameters
) -> tuple[list[tuple[Array, Array]], Scalar]:
    """For every group of joints how far each is off, and its rate; the scene's size."""
    view = View(layout, q)
    size = _size(view, args)
    found = []
    for group, numbers in zip(layout.joint_groups, args.tables["joints"], strict=True):
        rates = lambda x, group=group, numbers=numbers: evaluate(
            group, View(layout, x), numbers
        )
        value, rate = jax.jvp(rates, (q,), (qdot,))
        slope = _slopes(group, view, numbers, size)
        measure = lambda x, slope=slope: jnp.linalg.norm(x / slope, axis=1)
        found.append((measure(value), measure(rate)))
    for _, function in layout.constraints:
        of_q = lambda x, function=function: function(View(layout, x), args)
        value, rate = jax.jvp(of_q, (q,), (qdot,))
        slope = jnp.linalg.norm(jax.jacfwd(of_q)(q), axis=1)
        found.append(tuple(jnp.linalg.norm(x / slope)[None] for x in (value, rate)))
    return found, size


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

    a, b = (Frame(view.origins[k], view.axes[k]) for k in (group.a, group.b))
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
    joints = jax.jacfwd(lambda x: constraint(layout, x, args))(q)
    redundant = jax.jacfwd(lambda x: redundancy(layout, x, args))(q)
    joined = sum(place.stop - place.start for place in places.values())
    taken = [*joints[joined:], *redundant]  # what bodies have of their own comes last
    for name, place in places.items():
        taken += [*joints[place]]
        if np.linalg.matrix_rank(np.array(taken)) < len(taken):
            return name
    return None
