"""The positions and orientations of bodies for the coordinates of a scene."""

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import at_all_places, at_places, is_known
from .._types import Coordinates, Scalar, Vector, Velocities
from ._frames import Frame, Point
from ._laws import AbstractNonholonomicLaw
from ._layout import Layout, Links


# Of more bodies than this, frames of less than this part are computed for these bodies
# alone: a pin at one end of a beam needs no axes of all of its sections.
_MANY, _FEW = 16, 0.25
# The property of a view that contains each field of all frames.
_TABLES = dict(origin="origins", axes="axes", angle="angles")


def _of_ground(field: str, dimension: int, dtype: Any) -> np.ndarray:
    """A field of the frame of the ground."""
    fields = dict(origin=np.zeros(dimension), axes=np.eye(dimension), angle=np.zeros(()))
    return fields[field].astype(dtype)


class View:
    """A scene with the coordinates `q`; quantities are computed when they are needed.

    `position(body, point)`, `direction(body, axis)` and `angle(body)` are for potentials
    and constraints of your own; `q` are the coordinates of all bodies.
    """

    def __init__(self, layout: Layout, q: Coordinates):
        self.layout = layout
        self.q = q

    @cached_property
    def origins(self) -> Float[Array, "bodies d"]:
        return self._table("origin")

    @cached_property
    def axes(self) -> Float[Array, "bodies d d"]:
        return self._table("axes")

    @cached_property
    def angles(self) -> Float[Array, " bodies"]:
        return self._table("angle")

    def _table(self, field: str, only: np.ndarray | None = None) -> Array:
        """A field of the ground and of all bodies, or of `only` these, in their order."""
        ground = _of_ground(field, self.layout.dimension, self.q.dtype)
        parts, first = [ground[None]], 1
        for group in self.layout.body_groups:
            count = len(group.names)
            chosen = np.arange(count) if only is None else only - first
            chosen = chosen[(chosen >= 0) & (chosen < count)]
            first += count
            if chosen.size > 0:
                q = at_places(self.q, group.q[chosen])
                parts.append(jax.vmap(getattr(group.kind, field))(q))
        return jnp.concatenate(parts)

    def frames(self, bodies: np.ndarray, reads: tuple[str, ...]) -> Frame:
        """The frames of some bodies, stacked, with the fields that are read."""
        return self.all_frames([(bodies, reads)])[0]

    def all_frames(
        self, wanted: Sequence[tuple[np.ndarray, tuple[str, ...]]]
    ) -> list[Frame]:
        """`frames` for several arrays of bodies, with the fields that are read of each."""
        fields: list[dict[str, Array]] = [{} for _ in wanted]
        for field in _TABLES:
            read = [k for k, (_, reads) in enumerate(wanted) if field in reads]
            if field == "axes":
                read = [k for k in read if self.layout.turning[wanted[k][0]].any()]
            found = self._of(field, [wanted[k][0] for k in read])
            for k, x in zip(read, found, strict=True):
                fields[k][field] = x
        return [Frame(**own) for own in fields]

    def _of(self, field: str, wanted: Sequence[np.ndarray]) -> list[Array]:
        """A field of several arrays of bodies, stacked."""
        moving = [x for x in wanted if x.any()]
        found = iter(self._of_moving(field, moving) if moving else ())
        fixed = _of_ground(field, self.layout.dimension, self.q.dtype)
        return [
            next(found) if x.any() else jnp.broadcast_to(fixed, (x.size, *fixed.shape))
            for x in wanted
        ]

    def _of_moving(self, field: str, wanted: Sequence[np.ndarray]) -> list[Array]:
        """The same for arrays that each contain a body that moves. The field of a few
        bodies is computed for these alone."""
        few = np.unique(np.concatenate(wanted))
        few, count = few[few > 0], len(self.layout.turning)
        if count <= _MANY or few.size > _FEW * count:
            return at_all_places(getattr(self, _TABLES[field]), wanted)
        rows = [np.where(x > 0, 1 + np.searchsorted(few, x), 0) for x in wanted]
        return at_all_places(self._table(field, few), rows)

    def frame(self, body: str) -> Frame:
        """The frame of one body, with all its fields."""
        k = self._number(body)
        return Frame(self.origins[k], self.axes[k], self.angles[k])

    def _number(self, body: str) -> int:
        if not isinstance(body, str):
            raise TypeError(
                f"Bodies are identified by name, got a {type(body).__name__}: write "
                f"'{getattr(body, 'name', '...')}'."
            )
        try:
            return self.layout.numbers_of_bodies[body]
        except KeyError:
            raise ValueError(
                f"There is no body '{body}'; there are {[*self.layout.numbers_of_bodies]}."
            ) from None

    def position(self, body: str, point: Vector | None = None) -> Point:
        """A point of a body in space; by default its mass centre."""
        k = self._number(body)
        if point is None:
            return self.origins[k]
        axes = self.axes[k] if self.layout.turning[k] else None
        return Frame(self.origins[k], axes).point(self._vector(body, "point", point))

    def direction(self, body: str, axis: Vector) -> Point:
        """A direction of a body in space."""
        axes = self.axes[self._number(body)]
        return Frame(axes=axes).direction(self._vector(body, "axis", axis))

    def _vector(self, body: str, role: str, value: Vector) -> Point:
        """A checked point or axis in the frame of a body that has an orientation."""
        vector, dimension = jnp.asarray(value, self.q.dtype), self.layout.dimension
        if vector.shape != (dimension,):
            raise ValueError(
                f"A `{role}` of '{body}' must be of {dimension} entries, got shape "
                f"{vector.shape}."
            )
        k = self._number(body)
        at_centre = is_known(value) and not np.any(np.asarray(value))
        if k > 0 and not self.layout.turning[k] and not at_centre:
            raise ValueError(
                f"'{body}' is a point mass, without an orientation: it has no `{role}` of "
                "its own."
            )
        return vector

    def angle(self, body: str) -> Scalar:
        """The angle of a body in the plane."""
        k = self._number(body)
        if self.layout.dimension == 3:
            raise ValueError(
                f"'{body}' is in space, where a body has no angle: ask for a `direction`."
            )
        if k > 0 and not self.layout.turning[k]:
            raise ValueError(f"'{body}' is a point mass: it has no angle.")
        return self.angles[k]


def evaluate(group: Links, view: View, numbers: dict[str, Array]) -> Array:
    """The values of a law for all its links, one row each."""
    return evaluate_all([(group, numbers)], view)[0]


def evaluate_all(
    groups: Iterable[tuple[Links, dict[str, Array]]], view: View
) -> list[Array]:
    """`evaluate` for several groups of links, with the numbers of each."""
    pairs = list(groups)
    ends = [(bodies, x.law.reads) for x, _ in pairs for bodies in (x.a, x.b)]
    frames = iter(view.all_frames(ends))
    return [
        jax.vmap(group.law)(next(frames), next(frames), numbers) for group, numbers in pairs
    ]


def evaluate_slip(group: Links, view: View, at: View, numbers: dict[str, Array]) -> Array:
    """The slip of all contacts of a group, from the coordinates of `at` to those of
    `view`, one row each."""
    assert isinstance(group.law, AbstractNonholonomicLaw)
    frames = lambda view: [view.frames(k, group.law.reads) for k in (group.a, group.b)]
    (a, b), first = frames(view), frames(at)
    return jax.vmap(group.law.slip)(a, b, tuple(first), numbers)


def lift(layout: Layout, q: Coordinates, v: Velocities) -> Coordinates:
    """The rates of the coordinates."""
    if not any(group.kind.num_redundant for group in layout.body_groups):
        return v
    rates = jnp.zeros_like(q)
    for group in layout.body_groups:
        lifted = jax.vmap(group.kind.lift)(at_places(q, group.q), at_places(v, group.v))
        rates = rates.at[group.q].set(lifted)
    for group in layout.inerter_groups:
        rates = rates.at[group.q].set(v[group.v])
    return rates
