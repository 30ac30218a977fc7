"""The poses of the bodies of a scene and the places of its joints, along a run."""

from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._analysis import ConsistentStart, Equilibrium
from .._programs import compiled
from .._run import must_be_known, ReachedRows, Solution
from .._system import State
from ._frames import Numbers
from ._interpolation import Frames, frames_at
from ._laws import Alignment
from ._layout import Layout, Link
from ._parameters import Parameters
from ._pose_view import lift, View
from ._symbols import Symbol, symbol_of
from .shapes import AbstractShape


Array: TypeAlias = np.ndarray


# A pin that is open by more than this part of the size of the scene is a mistake.
_OPEN = 0.05


class BodyMotion(NamedTuple):
    """A body along a run. A point `x` of it is in space at `position + rotation @ x`.

    - `name`: of the body, or `"ground"`.
    - `shapes`: what is seen of it, fixed in its frame.
    - `position`: of its mass centre, shape `(times, d)` (length).
    - `rotation`: shape `(times, d, d)`, the body axes along the columns.
    """

    name: str
    shapes: tuple[AbstractShape, ...]
    position: Float[Array, "times d"]
    rotation: Float[Array, "times d d"]


class LinkMotion(NamedTuple):
    """A joint, force or drive along a run.

    - `name`, `kind`: its name and its class, such as `"Revolute"` or `"Spring"`.
    - `bodies`: the names of its bodies; the first is `"ground"` for a load.
    - `start`, `end`: its points on both bodies in space, shape `(times, d)` (length). A
      part without points (an angle) is where a joint connects its bodies.
    - `axes`: the axes of the part in space, each of shape `(times, d)` and length one: one
      of a hinge or slider, two of a universal joint, else none.
    - `symbol`: what it looks like, also where its class is one of yours; see `Symbol`.
    """

    name: str
    kind: str
    bodies: tuple[str, str]
    start: Float[Array, "times d"]
    end: Float[Array, "times d"]
    axes: tuple[Float[Array, "times d"], ...]
    symbol: Symbol


class Motion(NamedTuple):
    """All that pictures show of a run, as NumPy arrays.

    - `ts`: the times, shape `(times,)`.
    - `bodies`: the bodies in the order of the scene; before them the ground, if it has
      shapes.
    - `links`: joints, forces and drives, in this order.
    - `outcome`: why the run ended before its time, or nothing.
    """

    ts: Float[Array, " times"]
    bodies: tuple[BodyMotion, ...]
    links: tuple[LinkMotion, ...]
    outcome: str


class Rows(NamedTuple):
    """The states to show: those rows of a run that it reached, or one state."""

    ts: Array
    q: Array
    v: Array
    outcome: str


def states_of(layout: Layout, sol: Any) -> Rows:
    """The reached rows of a run, or one state, whose time counts as zero.

    **Raises:** `TypeError` or `ValueError` for what is no run of this scene.
    """
    of_run = isinstance(sol, Solution)
    ys = sol.ys if of_run else sol
    if isinstance(sol, ConsistentStart | Equilibrium):
        ys = sol.state
    if not isinstance(ys, State):
        raise TypeError(
            "A scene shows the states of a run, a `Solution` whose `ys` are states, or a "
            f"`State`; got {type(ys).__name__}. Runs with `SaveAt(fn=...)` keep none."
        )
    must_be_known(ys)
    q, v = np.asarray(ys.q), np.asarray(ys.v)
    wanted = (layout.num_coordinates,), (layout.num_velocities,)
    if (q.shape[-1:], v.shape[-1:]) != wanted:
        raise ValueError(
            f"The state is not one of this scene, which has {layout.num_coordinates} "
            f"coordinates and {layout.num_velocities} velocities: its `q` has shape "
            f"{q.shape}, its `v` {v.shape}."
        )
    if of_run:
        rows = ReachedRows(sol)
        return Rows(rows.ts, rows(q), rows(v), rows.outcome)
    if q.ndim > 1:
        raise ValueError(
            f"A picture is of one state, but here are {q.shape[0]}: pass the run, and "
            "`times` to see more than its last row, or pick one, "
            "`jax.tree.map(lambda x: x[3], sol.ys)`."
        )
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise ValueError(
            "There is nothing to show: the state has NaN, as after a step that failed. The "
            "last good state of a run is `sol.end`."
        )
    return Rows(np.zeros(1), q[None], v[None], "")


@compiled
def _frames(layout: Layout, q: Any, v: Any) -> tuple[Any, Any]:
    """Origins, axes and angles of all bodies in all rows, and their rates."""

    def of_row(q: Any, v: Any) -> tuple[Any, Any]:
        def parts(x: Any) -> tuple[Any, Any, Any]:
            view = View(layout, x)
            return view.origins, view.axes, view.angles

        return jax.jvp(parts, (q,), (lift(layout, q, v),))

    return jax.vmap(of_row)(q, v)


def frames_of(layout: Layout, rows: Rows) -> Frames:
    """The frames of all bodies, the ground first, in all rows."""
    # The number of rows is part of the program: powers of two, so that few are compiled.
    count = len(rows.ts)
    room = 1 << max(count - 1, 0).bit_length()
    padded = (np.concatenate([x, np.repeat(x[-1:], room - count, axis=0)])
              for x in (rows.q, rows.v))  # fmt: skip
    found = jax.device_get(_frames(layout, *map(jnp.asarray, padded)))
    (origins, axes, angles), rates = jax.tree.map(lambda x: x[:count], found)
    return Frames.from_axes((origins, axes, angles), rates)


class Parts(NamedTuple):
    """The parts of a scene by name: their classes, the bodies of links, and the shapes of
    bodies, in the order of pictures."""

    kinds: dict[str, str]
    ends: dict[str, tuple[str, str]]
    shapes: dict[str, tuple[AbstractShape, ...]]


def numbers_by_name(layout: Layout, args: Parameters) -> dict[str, dict[str, Numbers]]:
    """The numbers of all parts as NumPy arrays, by section and name."""
    tables = jax.device_get(args.tables)
    return {
        section: {
            name: {key: table[row] for key, table in tables[section][group].items()}
            for name, (group, row) in names.items()
        }
        for section, names in layout.places.items()
    }


def motion_of(
    layout: Layout,
    rows: Rows,
    times: Any,
    numbers: dict[str, dict[str, Numbers]],
    parts: Parts,
) -> Motion:
    """The motion in the rows, or at some times within them."""
    frames, ts = frames_of(layout, rows), rows.ts
    if times is not None:
        ts = _checked(times, rows)
        frames = frames_at(rows.ts, frames, ts)
    row = layout.numbers_of_bodies
    bodies = tuple(
        BodyMotion(
            name, shapes, frames.position[:, row[name]], frames.rotation[:, row[name]]
        )
        for name, shapes in parts.shapes.items()
    )
    places = _Places(layout, frames, numbers)
    links = tuple(
        LinkMotion(
            link.name,
            parts.kinds[link.name],
            parts.ends[link.name],
            *places(section, link),
            symbol_of(link.law),
        )
        for section in ("joints", "forces", "drives", "contacts")
        for link in getattr(layout, section)
    )
    _check_closed(links, frames)
    return Motion(ts, bodies, links, rows.outcome)


def _check_closed(links: tuple[LinkMotion, ...], frames: Frames) -> None:
    """Raises an error for pins that are open: the state is not of this scene."""
    centres = frames.position.reshape(-1, frames.position.shape[-1])
    ends = [x for link in links for x in (link.start, link.end)]
    size = np.ptp(np.concatenate([centres, *ends]), axis=0).max()
    for link in links:
        gap = np.abs(link.end - link.start).max()
        if link.symbol in ("pin", "weld") and gap > _OPEN * size:
            raise ValueError(
                f"'{link.name}' is open by {gap:.3g} in these states: they are not of this "
                "scene, or of one with other lengths. Pass the `args` of the run."
            )


def _checked(times: Any, rows: Rows) -> Array:
    ts = np.atleast_1d(np.asarray(times, float))
    first, last = rows.ts[0], rows.ts[-1]
    room = 1e-9 * max(abs(first), abs(last))
    if ts.ndim != 1 or not np.all((ts >= first - room) & (ts <= last + room)):
        why = f" ({rows.outcome})" if rows.outcome else ""
        raise ValueError(
            f"`times` must be within the rows that the run reached{why}, from t = "
            f"{first:.6g} to t = {last:.6g}, got {times}."
        )
    return np.clip(ts, first, last)


class _Places:
    """The points and axes of links in space, from the frames of their bodies."""

    def __init__(
        self, layout: Layout, frames: Frames, numbers: dict[str, dict[str, Numbers]]
    ):
        self._frames, self._numbers = frames, numbers
        pointed = [x for x in layout.joints if "point_b" in numbers["joints"][x.name]]
        self._hubs = {frozenset((link.a, link.b)): link for link in reversed(pointed)}

    def __call__(self, section: str, link: Link) -> tuple[Array, Array, tuple[Array, ...]]:
        own = self._numbers[section][link.name]
        start, end = self._points(own, link)
        if end is None:  # an angle: where a joint connects its bodies
            hub = self._hubs.get(frozenset((link.a, link.b)), link)
            place = self._numbers["joints"].get(hub.name, {})
            origin = np.zeros(self._frames.position.shape[-1])
            end = self._point(hub.b, place.get("point_b", origin))
        return end if start is None else start, end, tuple(self._axes(own, link))

    def _points(self, own: Numbers, link: Link) -> tuple[Array | None, Array | None]:
        ends = zip(("point_a", "point_b"), (link.a, link.b), strict=True)
        start, end = (self._point(k, own[x]) if x in own else None for x, k in ends)
        return start, start if end is None else end

    def _point(self, body: int, point: Array) -> Array:
        return self._frames.position[:, body] + self._direction(body, point)

    def _direction(self, body: int, direction: Array) -> Array:
        return self._frames.rotation[:, body] @ direction

    def _axes(self, own: Numbers, link: Link) -> Iterator[Array]:
        law, which = link.law, 2 if self._frames.position.shape[-1] == 3 else 0
        if "frame_a" not in own:
            return
        if isinstance(law, Alignment) and law.along is None:
            if law.square == ((2, 2),):
                yield self._direction(link.b, own["frame_b"][which])
            elif law.keeps != "axis":  # all directions are kept
                return
        yield self._direction(link.a, own["frame_a"][which])
