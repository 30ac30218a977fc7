"""Pictures of what moves: one at a time in axes, or all of them as a film."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from .animation import Animation
from .axes import axes_of, checked, clock, headline, in_space, label, Units
from .canvas import AbstractCanvas, Drawing, PlaneCanvas, SpaceCanvas


Array: TypeAlias = np.ndarray

_TRAIL = 500  # points of a path: more take time, and show nothing more


def joint_bounds(
    bounds: tuple[Array, Array], clouds: Sequence[Array]
) -> tuple[Array, Array]:
    """The least and largest coordinates of a range and of further points `(n, d)`."""
    lows = [bounds[0], *(x.min(axis=0) for x in clouds)]
    highs = [bounds[1], *(x.max(axis=0) for x in clouds)]
    return np.min(lows, axis=0), np.max(highs, axis=0)


class Trail:
    """The path of a point, shape `(n, d)`, at ascending times, of which some are kept."""

    def __init__(self, ts: Array, points: Array):
        chosen = np.linspace(0, len(ts) - 1, min(len(ts), _TRAIL)).astype(int)
        self._ts, self.points = ts[chosen], points[chosen]

    def until(self, t: float, here: Array) -> Array:
        """The path up to a time, at which the point is `here`."""
        count = np.searchsorted(self._ts, t)
        return np.concatenate([self.points[:count], here[None]])


def canvas_of(ax: Any, bounds: tuple[Array, Array], units: Units | None) -> AbstractCanvas:
    """A canvas in the axes of the user, or in new ones of a shape that fits.

    **Raises:** `ValueError` for axes in the plane for a picture in space, or the reverse.
    """
    low, high = bounds
    spatial = len(low) == 3
    if ax is None and spatial:
        figure = plt.figure(figsize=_figsize(low, high), layout="constrained")
        ax = _spatial_axes(figure, 111)
    elif ax is None:
        ax = axes_of(None, _figsize(low, high))
    elif in_space(checked(ax)) != spatial:
        raise ValueError(
            "The picture is in space: make axes with "
            "`plt.figure().add_subplot(projection='3d')`."
            if spatial
            else "The picture is in the plane, but `ax` are axes in space."
        )
    names = ("x", "y", "z")[: len(low)]
    ax.set(**{f"{name}label": label(name, units, "length") for name in names})
    return SpaceCanvas(ax) if spatial else PlaneCanvas(ax)


def _figsize(low: Array, high: Array) -> tuple[float, float]:
    """The size of a figure for this range, in inches."""
    if len(low) == 3:
        return (6.0, 5.0)
    ratio = float((high - low)[1] / (high - low)[0])
    return (6.4, float(np.clip(5.6 * ratio + 0.8, 1.8, 6.0)))


def _spatial_axes(figure: Any, place: Any) -> Any:
    ax = figure.add_subplot(place, projection="3d")
    ax.view_init(elev=22, azim=-55)
    ax.locator_params(nbins=5)
    ax.tick_params(labelsize="small")  # those of two axes meet in corners
    return ax


def film(
    at: Callable[[int], Drawing],
    bounds: tuple[Array, Array],
    ts: Array,
    ax: Any,
    fps: float,
    speed: float,
    units: Units | None,
    *,
    outcome: str,
    beside: Callable[..., Any] | None,
) -> Animation:
    """A film of drawings, with the time.

    - `at`: the drawing of a frame by its number.
    - `bounds`: the range of all drawings.
    - `outcome`: why the run ended before its time, or nothing.
    - `beside`: `beside(ax, units=units)` plots over time, and the film marks the time.

    **Raises:** `ValueError` for axes that do not fit, or together with a plot.
    """
    if beside is not None and ax is not None:
        raise ValueError("With the energies a film has its own figure: leave out `ax`.")
    plot: Any = None
    if ax is None:
        ax, plot = _film_axes(bounds, beside is not None)
    canvas = canvas_of(ax, bounds, units)
    canvas.frame(*bounds)
    if outcome:
        headline(ax, f"the run ends at t = {ts[-1]:.4g}: {outcome}")
    now, text = clock(ax, ""), _time_text(ts, speed, units)
    marks = []
    if beside is not None:
        beside(plot, units=units)
        marks.append(plot.axvline(ts[0], color="0.5", linewidth=1))

    def show(k: int) -> None:
        canvas.show(at(k))
        now.set_text(text(ts[k]))
        for mark in marks:
            mark.set_xdata([ts[k]])

    return Animation(ax.figure, ts, fps, show, [*canvas.artists, now, *marks])


def _film_axes(bounds: tuple[Array, Array], with_plot: bool) -> tuple[Any, Any]:
    """Axes for a film and a plot beside it, in a figure that no window shows."""
    spatial, (width, height) = len(bounds[0]) == 3, _figsize(*bounds)
    size = (width + 4.0, max(height, 3.4)) if with_plot else (width, height)
    figure = Figure(size, layout="constrained")
    grid = figure.add_gridspec(1, 1 + with_plot, width_ratios=[width, 4.0][: 1 + with_plot])
    ax = _spatial_axes(figure, grid[0]) if spatial else figure.add_subplot(grid[0])
    return ax, figure.add_subplot(grid[1]) if with_plot else None


def _time_text(ts: Array, speed: float, units: Units | None) -> Callable[[float], str]:
    digits = max(0, int(np.ceil(-np.log10(ts[1] - ts[0]))))
    unit = (units or {}).get("time", "")
    factor = "" if speed == 1 else f"   (speed x {speed:g})"
    return lambda t: f"t = {t:.{digits}f} {unit}".rstrip() + factor
