"""Pictures and films of scenes, and plots of their reactions."""

from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._pictures import (
    AbstractCanvas,
    Animation,
    axes_of,
    checked,
    clock,
    color_of,
    Drawing,
    in_space,
    label,
    Path,
    PlaneCanvas,
    SpaceCanvas,
    tell,
    Units,
)
from ._motion import Array, Motion
from ._relative_motions import Reaction
from ._sketch import Sketch


class Trace(NamedTuple):
    """A point of a body, whose path is drawn."""

    body: str
    point: Array


def traces_of(traces: Any, motion: Motion) -> list[Trace]:
    """The points that a user names: bodies, for their mass centres, or `(body, point)`.

    **Raises:** `ValueError` for a body that does not exist, and a point of another shape.
    """
    if isinstance(traces, str):
        traces = [traces]
    names = [body.name for body in motion.bodies]
    dimension, found = motion.bodies[0].position.shape[1], []
    for trace in traces:
        name, point = (trace, np.zeros(dimension)) if isinstance(trace, str) else trace
        if name not in names:
            raise ValueError(
                f"`traces` names the body {name!r}, but there is none; there are {names}. "
                "A trace is the name of a body, or a pair of the name and a point in its "
                "frame."
            )
        point = np.asarray(point, float)
        if point.shape != (dimension,):
            raise ValueError(
                f"The point of the trace of '{name}' must be of {dimension} entries, got "
                f"shape {point.shape}."
            )
        found.append(Trace(name, point))
    return found


def _paths(motion: Motion, traces: list[Trace]) -> list[tuple[Array, Array]]:
    """The path of each trace, shape `(times, d)`, and its colour."""
    bodies = {body.name: body for body in motion.bodies}
    numbers = {name: k for k, name in enumerate(x for x in bodies if x != "ground")}
    return [
        (
            bodies[name].position + bodies[name].rotation @ point,
            color_of(f"C{numbers.get(name, 0) % 10}"),
        )
        for name, point in traces
    ]


def draw(
    motion: Motion,
    whole: Motion,
    ax: Any,
    traces: Any,
    names: bool,
    units: Units | None,
) -> Axes:
    """A picture of a motion at one or several times, of which earlier ones are paler.

    `whole` is the motion along which traces are drawn.
    """
    sketch = Sketch(motion, whole)
    low, high = sketch.bounds()
    paths = _paths(whole, traces_of(traces, motion))
    for path, _ in paths:
        low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    canvas = _canvas(ax, low, high, units)
    count = len(motion.ts)
    drawing = Drawing(paths=tuple(Path(path, color, 1.0) for path, color in paths))
    for k in range(count):
        drawing += sketch.at(k).faded(0.25 + 0.75 * (k + 1) / count)
    canvas.frame(low, high)
    canvas.show(drawing)
    if names:
        _write_names(canvas, motion)
    if motion.outcome:
        tell(canvas.ax, f"the run ends at t = {whole.ts[-1]:.4g}: {motion.outcome}")
    return canvas.ax


def _canvas(ax: Any, low: Array, high: Array, units: Units | None) -> AbstractCanvas:
    """A canvas in the axes of the user, or in new ones of a shape that fits."""
    spatial = len(low) == 3
    if ax is None and spatial:
        figure = plt.figure(figsize=(6.0, 5.0), layout="constrained")
        ax = figure.add_subplot(projection="3d")
        ax.view_init(elev=22, azim=-55)
    elif ax is None:
        ax = axes_of(None, _figsize(low, high))
    elif in_space(checked(ax)) != spatial:
        raise ValueError(
            "This scene is in space: make axes with "
            "`plt.figure().add_subplot(projection='3d')`."
            if spatial
            else "This scene is in the plane, but `ax` are axes in space."
        )
    names = ("x", "y", "z")[: len(low)]
    ax.set(**{f"{name}label": label(name, units, "length") for name in names})
    return SpaceCanvas(ax) if spatial else PlaneCanvas(ax)


def _figsize(low: Array, high: Array) -> tuple[float, float]:
    ratio = float((high - low)[1] / (high - low)[0])
    return (6.4, float(np.clip(5.6 * ratio + 0.8, 1.8, 6.0)))


def _write_names(canvas: AbstractCanvas, motion: Motion) -> None:
    """The names of bodies and of joints, moved apart."""
    texts = []
    for k, body in enumerate(x for x in motion.bodies if x.name != "ground"):
        texts.append(canvas.write(body.position[-1], body.name, color_of(f"C{k % 10}")))
    texts += [
        canvas.write((link.start[-1] + link.end[-1]) / 2, link.name, color_of("0.4"))
        for link in motion.links
    ]
    canvas.move_apart(texts)


def animate(
    motion: Motion,
    sol: Any,
    ax: Any,
    fps: float,
    speed: float,
    traces: Any,
    energy: bool,
    units: Units | None,
) -> Animation:
    """A film of a motion, one frame for each of its times."""
    sketch, ts = Sketch(motion, motion), motion.ts
    low, high = sketch.bounds()
    paths = _paths(motion, traces_of(traces, motion))
    for path, _ in paths:
        low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    spatial, beside = len(low) == 3, None
    if ax is None:
        width, height = (6.0, 5.0) if spatial else _figsize(low, high)
        ax, beside = _film_axes(spatial, (width, height), energy)
    elif energy:
        raise ValueError("`energy=True` makes a figure of its own: leave out `ax`.")
    canvas = _canvas(ax, low, high, units)
    canvas.frame(low, high)
    if motion.outcome:
        tell(ax, f"the run ends at t = {ts[-1]:.4g}: {motion.outcome}")
    now = clock(ax, "")
    marker = None
    if beside is not None:
        sol.plot_energy(beside, units=units)
        marker = beside.axvline(ts[0], color="0.5", linewidth=1)
    text = _time_text(ts, speed, units)

    def show(k: int) -> None:
        trails = tuple(Path(path[: k + 1], color, 1.2) for path, color in paths)
        canvas.show(Drawing(paths=trails if k > 0 else ()) + sketch.at(k))
        now.set_text(text(ts[k]))
        if marker is not None:
            marker.set_xdata([ts[k]])

    moving = [*canvas.artists, now, *([] if marker is None else [marker])]
    return Animation(ax.figure, ts, fps, show, moving)


def _film_axes(
    spatial: bool, size: tuple[float, float], energy: bool
) -> tuple[Any, Axes | None]:
    """Axes for a film, with some beside them for energies; no window shows the figure."""
    width, height = size
    projection = "3d" if spatial else None
    if not energy:
        figure = Figure(size, layout="constrained")
        ax: Any = figure.add_subplot(projection=projection)
        beside = None
    else:
        figure = Figure((width + 4.0, max(height, 3.4)), layout="constrained")
        grid = figure.add_gridspec(1, 2, width_ratios=[width, 4.0])
        ax = figure.add_subplot(grid[0], projection=projection)
        beside = figure.add_subplot(grid[1])
    if spatial:
        ax.view_init(elev=22, azim=-55)
    return ax, beside


def _time_text(ts: Array, speed: float, units: Units | None) -> Any:
    step = float(ts[1] - ts[0])
    digits = max(0, int(np.ceil(-np.log10(step))))
    unit = (units or {}).get("time", "")
    factor = "" if speed == 1 else f"   (speed x {speed:g})"
    return lambda t: f"t = {t:.{digits}f} {unit}".rstrip() + factor


def plot_reaction(
    sol: Any, found: Reaction, joint: str, ax: Any, units: Units | None
) -> Axes:
    """The components of a force and, on an axis at the right, of a torque."""
    ax = axes_of(ax)
    ts, force, torque = (np.asarray(x) for x in (sol.ts, found.force, found.torque))
    for k, column in enumerate(force.T):
        ax.plot(ts, column, f"C{k}", label=f"force {'xyz'[k]}")
    ax.set(xlabel=label("time", units), ylabel=f"{joint}: {label('force', units)}")
    names = ["torque"] if torque.shape[1] == 1 else [f"torque {x}" for x in "xyz"]
    largest = lambda x: float(np.nanmax(np.abs(x), initial=0.0))
    # Of a pin without a torque there is round-off.
    if largest(torque) > 1e-9 * largest(force) * largest(sol.ys.q):
        beside: Any = ax.twinx()
        for k, column in enumerate(torque.T):
            beside.plot(ts, column, f"C{k + 3}--", label=names[k])
        beside.set_ylabel(label("torque", units))
        handles = ax.get_lines() + beside.get_lines()
        ax.legend(handles, [x.get_label() for x in handles], fontsize="small")
    else:
        ax.legend(fontsize="small")
    return ax
