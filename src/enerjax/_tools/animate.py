"""Films of runs of any system, from a function that gives points."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import scipy
from typing_extensions import TypeAliasType

from .._run import must_be_close, ReachedRows, Solution, warn_if_visible


# A function of one row of `sol.ys` that returns points, shape `(n, 2)` or `(n, 3)`.
Points = TypeAliasType("Points", Callable[[Any], Any])


def animate(
    sol: Solution,
    points: Points,
    *,
    lines: Sequence[Sequence[int]] = (),
    traces: Sequence[int] = (),
    speed: float = 1.0,
    fps: float = 25.0,
    ax: Any = None,
    energy: bool = False,
    units: dict[str, str] | None = None,
) -> Any:
    """A film of points along a run, with frames at equal times whatever its steps were.

        def masses(y):  # of a double pendulum, with the pivot
            return jnp.concatenate([jnp.zeros((1, 2)), y.q.reshape(2, 2)])

        ej.animate(sol, masses, lines=[[0, 1, 2]]).save("run.gif")

    `Scene.animate` needs no such function. Between rows, points are interpolated by cubic
    splines.

    **Arguments:**

    - `sol`: a run, of which the rows that it reached are shown.
    - `points`: a function of a row of `sol.ys` (a `State` with `q` and `v`, or what
      `SaveAt(fn=...)` saved) that returns points, shape `(n, 2)` or `(n, 3)`. Fixed points
      may be among them.
    - `lines`: sequences of numbers of points, counted from 0, each joined by a line.
    - `traces`: numbers of the points whose paths are drawn.
    - `speed`, `fps`, `ax`, `energy`, `units`: as for `Scene.animate`.

    **Returns:** the film, as of `Scene.animate`.

    **Raises:** `ValueError` or `TypeError` for points of another shape, numbers of points
    that do not exist, a batch of runs, a run with too few rows, and one that is too short
    or too long for a film at this speed.
    """
    from .._pictures import film, frame_times, Trail

    rows = ReachedRows(sol)
    places = _places(points, jax.tree.map(rows, sol.ys))
    for number in (*traces, *(k for line in lines for k in line)):
        if not 0 <= number < places.shape[1]:
            raise ValueError(
                f"There is no point {number}: `points` returns {places.shape[1]}, counted "
                "from 0."
            )
    ts = frame_times(rows.ts[0], rows.ts[-1], speed, fps)
    shown = _at(rows.ts, places, ts)
    # Paths are along the rows or the frames, of whichever there are more.
    finer = (rows.ts, places) if len(rows.ts) > len(ts) else (ts, shown)
    trails = {k: Trail(finer[0], finer[1][:, k]) for k in traces}
    shown_too = [trail.points for trail in trails.values()]
    cloud = np.concatenate([shown.reshape(-1, shown.shape[-1]), *shown_too])
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    room = 0.05 * max(float(np.max(high - low)), 1e-12)
    return film(
        _Sketch(ts, shown, lines, trails),
        (low - room, high + room),
        ts,
        ax,
        fps,
        speed,
        units,
        outcome=rows.outcome,
        beside=sol.plot_energy if energy else None,
    )


def _places(points: Points, ys: Any) -> np.ndarray:
    """The points in all rows, shape `(rows, n, d)`."""
    found = np.asarray(jax.vmap(points)(ys))
    if found.ndim != 3 or found.shape[2] not in (2, 3) or found.shape[1] == 0:
        raise ValueError(
            "`points` must return points, shape (n, 2) or (n, 3), for one row of `sol.ys`; "
            f"it returns shape {found.shape[1:]}."
        )
    return found


def _at(ts: np.ndarray, places: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Points at times between the rows."""
    if np.isin(times, ts).all():
        return places[np.searchsorted(ts, times)]
    must_be_close(len(ts))
    size = np.ptp(places.reshape(-1, places.shape[-1]), axis=0).max()
    if len(ts) > 3 and size > 0:
        # Through every other row; over twice the distance the error is 16 times as large.
        rest = np.abs(
            scipy.interpolate.CubicSpline(ts[::2], places[::2])(ts[1:-1:2]) - places[1:-1:2]
        )
        warn_if_visible(rest.max() / 16 / size)
    return scipy.interpolate.CubicSpline(ts, places)(times)


class _Sketch:
    """The drawing of each frame."""

    def __init__(
        self,
        ts: np.ndarray,
        places: np.ndarray,
        lines: Sequence[Sequence[int]],
        trails: dict[int, Any],
    ):
        from .._pictures import color_of, Drawing, PlaneSymbols, SpaceSymbols

        size = float(np.ptp(places[0], axis=0).max()) or float(
            np.ptp(places.reshape(-1, places.shape[-1]), axis=0).max()
        )
        kind = PlaneSymbols if places.shape[-1] == 2 else SpaceSymbols
        self._symbols, self._nothing = kind(size if size > 0 else 1.0), Drawing()
        self._ts, self._places, self._lines, self._trails = ts, places, lines, trails
        moving = [k for k in range(places.shape[1]) if np.ptp(places[:, k], axis=0).any()]
        self._colors = {k: color_of(f"C{n % 10}") for n, k in enumerate(moving)}
        self._fixed = color_of("0.4")

    def __call__(self, k: int) -> Any:
        drawing, here = self._nothing, self._places[k]
        color = lambda point: self._colors.get(point, self._fixed)
        for point, trail in self._trails.items():
            path = trail.until(self._ts[k], here[point])
            drawing += self._symbols.trail(path, color(point))
        for line in self._lines:
            drawing += self._symbols.bar(here[[*line]])
        for point, place in enumerate(here):
            drawing += self._symbols.mark(place, color(point))
        return drawing
