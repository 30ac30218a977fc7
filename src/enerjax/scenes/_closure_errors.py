"""The closure errors of joints, which users know as their gaps."""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._programs import compiled_for_once
from .._types import Coordinates, Scalar
from ._frames import Frame, Numbers
from ._functions import drives_at, inerters_at
from ._laws import AbstractNonholonomicLaw, all_rows, Deviation, Driven, Flywheel, Length
from ._layout import Layout, Links
from ._measures import Separation, Slide
from ._parameters import Parameters
from ._pose_view import evaluate, evaluate_slip, View
from ._reactions import moved, no_motion, pivot_of
from ._row_index import members
from ._user_functions import vector_of


class Gap(NamedTuple):
    """How far a joint is from closed: a length, and a length per time.

    An angle counts as the length of its arc, with the size of the bodies as radius.
    """

    position: float
    velocity: float


class Measured(NamedTuple):
    """A gap, and the size and speed of the bodies that the joint connects."""

    position: float
    velocity: float
    size: float
    speed: float


# The entries of `Measured` for all joints of a group.
Columns: TypeAlias = tuple[Array, Array, Array, Array]


@compiled_for_once
def measured(
    layout: Layout, q: Coordinates, qdot: Coordinates, t: Scalar, args: Parameters
) -> list[Columns]:
    """The gaps of every group of joints, then of the user's constraints, then of inerters,
    then of drives."""

    def kept(x: Coordinates, t: Scalar) -> list[tuple[Links, dict[str, Array]]]:
        return [*inerters_at(layout, x, args), *drives_at(layout, t, args)]

    joints = list(zip(layout.joint_groups, args.tables["joints"], strict=True))
    bodies = _Bodies(layout, q, qdot, args, [*joints, *kept(q, t)])
    found, at = [], View(layout, q)
    for group, numbers in joints:

        def rows(x: Coordinates, group: Links = group, numbers: Numbers = numbers) -> Array:
            values = evaluate(group, View(layout, x), numbers)
            if not isinstance(group.law, AbstractNonholonomicLaw):
                return values
            slip = evaluate_slip(group, View(layout, x), at, numbers)
            return jnp.concatenate([values, slip], axis=1)

        pair = jax.jvp(rows, (q,), (qdot,))
        found.append(bodies.compared(group, numbers, pair))
    for name, function in layout.constraints:
        of_q = lambda x, name=name, function=function: vector_of(
            name, function, View(layout, x), args
        )
        pair = jax.jvp(of_q, (q,), (qdot,))
        slope = _never_zero(jnp.linalg.norm(jax.jacfwd(of_q)(q), axis=1))
        value, rate = (jnp.linalg.norm(x / slope)[None] for x in pair)
        found.append((value, rate, bodies.extent[None], jnp.full((1,), jnp.inf)))
    for k, (group, numbers) in enumerate(kept(q, t)):
        assert isinstance(group.law, Driven | Flywheel)
        deviation = group._replace(law=Deviation(group.law.measure))

        def rows_at(
            x: Coordinates, t: Scalar, k: int = k, deviation: Links = deviation
        ) -> Array:
            return evaluate(deviation, View(layout, x), kept(x, t)[k][1])

        pair = jax.jvp(rows_at, (q, t), (qdot, jnp.ones_like(t)))
        found.append(bodies.compared(deviation, numbers, pair))
    return found


def by_name(layout: Layout, found: list[Columns]) -> dict[str, Measured]:
    """The gap of each joint, constraint, inerter and drive, as numbers."""
    found = jax.device_get(found)
    return {
        name: Measured(*(float(x[row]) for x in gaps))
        for names, gaps in zip(members(layout), found, strict=True)
        for row, name in enumerate(names)
    }


class _Bodies:
    """The sizes and speeds of the bodies that joints connect."""

    def __init__(
        self,
        layout: Layout,
        q: Coordinates,
        qdot: Coordinates,
        args: Parameters,
        links: list[tuple[Links, Numbers]],
    ):
        self.view = View(layout, q)
        self.extent = _extent(self.view, args)
        sizes = jnp.zeros((len(layout.turning),), q.dtype)
        for group, numbers in links:
            arms = _arms(group, numbers, q)
            sizes = sizes.at[group.a].max(arms).at[group.b].max(arms)
        self.sizes = sizes.at[0].set(0)  # the ground has no size

        def frames(x: Coordinates) -> tuple[Array, Array]:
            view = View(layout, x)
            return view.origins, view.axes

        moving, turning = jax.jvp(frames, (q,), (qdot,))[1]
        self.speeds = jnp.linalg.norm(moving, axis=1)
        self.spins = jnp.sqrt(jnp.sum(turning**2, axis=(1, 2)) / 2)

    def compared(
        self, group: Links, numbers: Numbers, pair: tuple[Array, Array]
    ) -> Columns:
        """The gaps of a group, from its rows and their rates."""
        size = jnp.maximum(self.sizes[group.a], self.sizes[group.b])
        size = jnp.where(size > 0, size, self.extent)
        speed = [self.speeds[k] + self.spins[k] * size for k in (group.a, group.b)]
        slope = self._slopes(group, numbers, size)
        value, rate = (jnp.linalg.norm(x / slope, axis=1) for x in pair)
        return value, rate, size, jnp.maximum(*speed)

    def _slopes(
        self, group: Links, numbers: Numbers, size: Float[Array, " joints"]
    ) -> Float[Array, "joints rows"]:
        """The derivative of every row with respect to a motion of the second body."""

        def slope(a: Frame, b: Frame, numbers: Numbers, size: Scalar) -> Array:
            pivot = pivot_of(b, numbers)
            rows = lambda shift, turn: all_rows(
                group.law, a, moved(b, pivot, shift, turn), (a, b), numbers
            )
            zero = no_motion(pivot.size, pivot.dtype)
            shift, turn = jax.jacfwd(rows, argnums=(0, 1))(*zero)
            return jnp.linalg.norm(jnp.concatenate([shift, turn / size], axis=1), axis=1)

        view = self.view
        a, b = (
            Frame(view.origins[k], view.axes[k], view.angles[k]) for k in (group.a, group.b)
        )
        return _never_zero(jax.vmap(slope)(a, b, numbers, size))


def _never_zero(slope: Array) -> Array:
    return jnp.where(slope == 0, 1, slope)


def _arms(group: Links, numbers: Numbers, q: Coordinates) -> Float[Array, " joints"]:
    """The distance of the joints' points from mass centres, or of the bodies they hold."""
    arms = jnp.zeros((len(group.names),), q.dtype)
    for side, key in ((group.a, "point_a"), (group.b, "point_b")):
        if key in numbers:
            arm = jnp.linalg.norm(numbers[key], axis=1)
            arms = jnp.maximum(arms, jnp.where(jnp.asarray(side > 0), arm, 0))
    if isinstance(group.law, Length):
        arms = jnp.maximum(arms, jnp.abs(numbers["length"]))
    lengths = Separation | Slide
    if isinstance(group.law, Driven | Flywheel) and isinstance(group.law.measure, lengths):
        arms = jnp.maximum(arms, jnp.abs(numbers["value"]))
    return arms


def _extent(view: View, args: Parameters) -> Scalar:
    """The size of the scene, including the points of its joints."""
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
