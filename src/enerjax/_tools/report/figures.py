"""Counterparts of the figures of the paper, with the same numbers."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..._pictures import legend_above
from .runs import Lookup, Run


PRESERVING = "preserving index3"
DECAYING = "decaying index3"
KAPPA = "decaying kappa"

_LEGEND = 18  # the height of a legend below the title, in points of the printer


def _cartesian(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities in the plane; those of case a follow from its angle."""
    q, v = np.asarray(run.solution.ys.q), np.asarray(run.solution.ys.v)
    if run.case.name != "a":
        return q, v
    sine, cosine = np.sin(q), np.cos(q)
    return np.hstack([sine, cosine]), np.hstack([cosine, -sine]) * v


def displacements(axes: Axes, runs: Iterable[Run]) -> None:
    for run in runs:
        _components(axes, run, _cartesian(run)[0], "xy")
    axes.set_ylabel("position [m]")


def velocities(axes: Axes, runs: Iterable[Run]) -> None:
    for run in runs:
        _components(axes, run, _cartesian(run)[1], ("vx", "vy"))
    axes.set_ylabel("velocity [m/s]")


def _components(axes: Axes, run: Run, values: np.ndarray, names: Iterable[str]) -> None:
    first, second = names
    bodies = values.shape[1] // 2
    for k, column in enumerate(values.T):
        number = str(k // 2 + 1) if bodies > 1 else ""
        label = (first, second)[k % 2] + number
        axes.plot(run.solution.ts, column, linewidth=0.9, label=label)


def energies(axes: Axes, runs: Iterable[Run]) -> None:
    for run in runs:
        run.solution.plot_energy(axes, units={"time": "s", "energy": "J"})


def energy_changes(axes: Axes, runs: Iterable[Run]) -> None:
    for run in runs:
        energy = np.asarray(run.solution.audit.energy)
        label = f"alpha = {run.method.alpha:g}"
        axes.plot(run.solution.ts, energy - energy[0], linewidth=0.9, label=label)
    axes.set_ylabel("change of total energy [J]")


def kappas(axes: Axes, runs: Iterable[Run]) -> None:
    for run in runs:
        axes.plot(run.solution.ts[1:], np.asarray(run.solution.details) - 1, linewidth=0.9)
    axes.set_ylabel("kappa - 1")


Panel = tuple[str, Callable[[Axes, Iterable[Run]], None], list[Run]]


def figures(find: Lookup) -> dict[int, tuple[str, list[Panel]]]:
    """Number, title and panels of every figure."""

    def both(draw: Callable, name: str, *alphas: float | None) -> list[Panel]:
        return [
            ("case a (angle)", draw, list(find("a", 0.02, name, *alphas))),
            ("case b (constrained)", draw, list(find("b", 0.02, name, *alphas))),
        ]

    def one(
        draws: Iterable[Callable], case: str, h: float, name: str, *alphas: float | None
    ) -> list[Panel]:
        runs = list(find(case, h, name, *alphas))
        return [(f"case {case}", draw, runs) for draw in draws]

    preserving, decaying = "energy preserving", "energy decaying"
    return {
        4: (f"{preserving}, h = 0.02", both(displacements, PRESERVING)),
        5: (f"{preserving}, h = 0.02", both(velocities, PRESERVING)),
        6: (f"{preserving}, h = 0.02", both(energies, PRESERVING)),
        7: (f"{preserving}, h = 0.01", one((velocities, energies), "c", 0.01, PRESERVING)),
        8: (f"{preserving}, h = 0.001", one((velocities, energies), "d", 1e-3, PRESERVING)),
        10: (
            f"{decaying}, alpha = 1, h = 0.01",
            one((displacements, velocities), "d", 0.01, DECAYING, 1.0),
        ),
        11: (
            f"{decaying}, alpha = 1, h = 0.01",
            one((energies,), "d", 0.01, DECAYING, 1.0),
        ),
        12: (f"{decaying}, alpha = 1, h = 0.02", both(displacements, DECAYING, 1.0)),
        13: (f"{decaying}, alpha = 1, h = 0.02", both(energies, DECAYING, 1.0)),
        14: (f"{decaying}, alpha = 0, h = 0.02", both(displacements, DECAYING, 0.0)),
        15: (f"{decaying}, alpha = 0, h = 0.02", both(velocities, DECAYING, 0.0)),
        16: (f"{decaying}, alpha = 0, h = 0.02", both(energies, DECAYING, 0.0)),
        17: (f"{decaying}, h = 0.02", both(energy_changes, DECAYING, 0.0, 0.1, 0.5, 1.0)),
        18: (
            f"{decaying} with kappa, alpha = 0, h = 0.02",
            one((velocities, energies), "b", 0.02, KAPPA, 0.0),
        ),
        19: (
            f"{decaying} with kappa, h = 0.02",
            one((energy_changes,), "b", 0.02, KAPPA, 0.0, 0.5, 1.0),
        ),
        20: (
            f"{decaying} with kappa, alpha = 0 (left) and 1 (right)",
            one((kappas,), "b", 0.02, KAPPA, 0.0) + one((kappas,), "b", 0.02, KAPPA, 1.0),
        ),
    }


def write_figures(find: Lookup, folder: Path) -> list[Path]:
    """Draws every figure into `folder`, and returns the files."""
    out = []
    for number, (title, panels) in figures(find).items():
        figure = Figure(figsize=(5 * len(panels), 3.6), layout="constrained")
        figure.suptitle(f"Figure {number}: {title}")
        for axes, (name, draw, runs) in zip(
            figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
        ):
            draw(axes, runs)
            ends = [
                f"fails at t = {r.solution.ts[r.rows][-1]:.3g}" for r in runs if r.failed
            ]
            title = ", ".join([name, *ends])
            if axes.get_legend_handles_labels()[0]:
                legend_above(axes, 4)
            axes.set_title(title, fontsize="medium", pad=_LEGEND)
            axes.set_xlabel("time [s]")
        out.append(folder / f"figure-{number:02d}.png")
        figure.savefig(out[-1], dpi=120)
    return out
