"""Pictures and films of scenes, and plots of their reactions."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from .._pictures import (
    AbstractCanvas,
    Animation,
    axes_of,
    canvas_of,
    color_of,
    Drawing,
    film,
    headline,
    joint_bounds,
    label,
    legend_above,
    tell,
    Trail,
    Units,
)
from .._run import ReachedRows, Solution
from ._frames import GROUND
from ._motion import Array, Motion
from ._reactions import Reaction
from ._sketch import middle_of, Sketch


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


def _trails(
    traces: list[Trace], motion: Motion, colors: dict[str, Array]
) -> list[tuple[Trail, Trace, Array]]:
    """The path of each trace along a motion, and its colour, that of the body."""
    bodies = {body.name: body for body in motion.bodies}
    found = []
    for trace in traces:
        body = bodies[trace.body]
        path = Trail(motion.ts, body.position + body.rotation @ trace.point)
        found.append((path, trace, colors[trace.body]))
    return found


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
    trails = _trails(traces_of(traces, motion), whole, sketch.colors)
    bounds = joint_bounds(sketch.bounds(), [trail.points for trail, _, _ in trails])
    canvas = canvas_of(ax, bounds, units)
    count = len(motion.ts)
    drawing = Drawing()
    for trail, _, color in trails:
        drawing += sketch.trail(trail.points, color)
    for k in range(count):
        pale = partial(canvas.pale, strength=0.25 + 0.75 * (k + 1) / count)
        drawing += sketch.at(k).recolored(pale)
    canvas.frame(*bounds)
    canvas.show(drawing)
    if names:
        _write_names(canvas, motion, sketch.colors)
    if motion.outcome:
        headline(canvas.ax, f"the run ends at t = {whole.ts[-1]:.4g}: {motion.outcome}")
    return canvas.ax


def _write_names(canvas: AbstractCanvas, motion: Motion, colors: dict[str, Array]) -> None:
    """The names of bodies and of joints, moved apart."""
    texts = [
        canvas.write(body.position[-1], body.name, colors[body.name])
        for body in motion.bodies
        if body.name != GROUND
    ]
    texts += [
        canvas.write(middle_of(link, -1), link.name, color_of("0.4"))
        for link in motion.links
    ]
    canvas.move_apart(texts)


def animate(
    motion: Motion,
    whole: Motion,
    sol: Solution,
    ax: Any,
    fps: float,
    speed: float,
    traces: Any,
    energy: bool,
    units: Units | None,
) -> Animation:
    """A film of a motion, one frame for each of its times."""
    sketch = Sketch(motion, motion)
    # Along the rows or the frames, of whichever there are more.
    finer = max(motion, whole, key=lambda x: len(x.ts))
    trails = _trails(traces_of(traces, motion), finer, sketch.colors)

    def at(k: int) -> Drawing:
        drawing, bodies = Drawing(), {body.name: body for body in motion.bodies}
        for trail, (name, point), color in trails:
            here = bodies[name].position[k] + bodies[name].rotation[k] @ point
            drawing += sketch.trail(trail.until(motion.ts[k], here), color)
        return drawing + sketch.at(k)

    bounds = joint_bounds(sketch.bounds(), [trail.points for trail, _, _ in trails])
    return film(
        at, bounds, motion.ts, ax, fps, speed, units,
        outcome=motion.outcome,
        beside=sol.plot_energy if energy else None,
    )  # fmt: skip


def plot_reaction(
    sol: Solution, found: Reaction, joint: str, ax: Any, units: Units | None
) -> Axes:
    """The components of a force and of a torque, which has an axis at the right if both
    are there."""
    rows, ax = ReachedRows(sol), axes_of(ax)
    force, torque = rows(found.force), rows(found.torque)
    largest = lambda x: float(np.max(np.abs(x)))
    arm = largest(rows(sol.ys.q))
    # Of a pin without a torque there is round-off, and of an angle without a force.
    has_torque = largest(torque) > 1e-9 * largest(force) * arm
    has_force = largest(force) * arm > 1e-9 * largest(torque) or not has_torque
    handles: list[Any] = []
    if has_force:
        for k, column in enumerate(force.T):
            handles += ax.plot(rows.ts, column, f"C{k}", label=f"force {'xyz'[k]}")
        ax.set_ylabel(f"{joint}: {label('force', units)}")
    if has_torque:
        beside: Any = ax.twinx() if has_force else ax
        names = ["torque"] if torque.shape[1] == 1 else [f"torque {x}" for x in "xyz"]
        for k, column in enumerate(torque.T):
            style = f"C{k + 3}--" if has_force else f"C{k}"
            handles += beside.plot(rows.ts, column, style, label=names[k])
        what = label("torque", units)
        beside.set_ylabel(what if has_force else f"{joint}: {what}")
    ax.set_xlabel(label("time", units))
    legend_above(ax, 3, handles)
    if rows.outcome:
        tell(ax, f"the run ends at t = {rows.ts[-1]:.4g}: {rows.outcome}")
    return ax
