"""The order table as text, CSV, JSON and a picture."""

import csv
import dataclasses
import json
import math
import platform
from importlib.metadata import version
from itertools import groupby
from pathlib import Path

import jax
import numpy as np
from convergence import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure


HEADER = (
    "scheme",
    "theory",
    "order in q",
    "order in v",
    "finest h",
    "error q",
    "error v",
    "|dE|",
    "balance",
    "|Phi|",
    "|psi|",
    "Newton",
    "remark",
)
NOTES = """\
Orders: slopes over the halvings above the round-off plateau, from the coarsest step.
They tend to that of the theory as h falls; the highest can reach round-off before.
Errors: at the finest step, the largest entry of q, or v, at a quarter, a half, three
quarters and the end of the run, against DOP853 (rtol 1e-13) in minimal coordinates.
|dE|, balance: largest change of the energy, and of energy + dissipated, over its scale.
|Phi|, |psi|: largest residuals of the constraints and of their rates, in their units.
Newton: mean iterations of one solve. These last five are over all steps of all runs."""


def as_text(table: list[Row]) -> str:
    parts = []
    for case, rows in groupby(table, key=lambda row: row.case):
        cells = [HEADER, *map(_cells, rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = [
            "  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip()
            for line in cells
        ]
        parts.append(
            f"{case.name}, to t = {case.end_time:g} s; "
            f"energy scale {case.energy_scale:g} J ({case.energy_scale_name})"
        )
        parts += [lines[0], "-" * max(map(len, lines)), *lines[1:], ""]
    return "\n".join([*parts, NOTES])


def _cells(row: Row) -> tuple[str, ...]:
    def largest(name: str) -> float:
        return max(getattr(run, name) for run in row.runs)

    newton = np.nanmean([run.newton_iterations for run in row.runs])
    finest = row.runs[-1]
    both = (row.slopes_q, row.slopes_v)
    orders = [" ".join(f"{s:.2f}" for s in slopes) for slopes in both]
    return (
        row.method.name,
        str(row.method.expected),
        *(("none", "none") if row.outcome else orders),
        f"{finest.h:.3g}",
        "failed" if finest.failure else f"{finest.error_q:.1e}",
        "failed" if finest.failure else f"{finest.error_v:.1e}",
        f"{largest('energy_error'):.1e}",
        f"{largest('identity_error'):.1e}",
        f"{largest('constraint'):.1e}",
        f"{largest('constraint_rate'):.1e}",
        f"{newton:.2f}",
        row.outcome,
    )


def write_csv(table: list[Row], path: Path) -> None:
    """One line for each run, with the slope from the run before it."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(_records(table[0])[0]))
        writer.writeheader()
        for row in table:
            writer.writerows(_records(row))


def _records(row: Row) -> list[dict]:
    records = []
    slopes = {"order_q": row.slopes_q, "order_v": row.slopes_v}
    for k, run in enumerate(row.runs):
        has_slope = 0 < k and not row.outcome
        records.append(
            {"problem": row.case.name, "scheme": row.method.name}
            | {"theory": row.method.expected}
            | {name: _finite(x) for name, x in dataclasses.asdict(run).items()}
            | {
                name: values[k - 1] if has_slope and k <= len(values) else None
                for name, values in slopes.items()
            }
        )
    return records


def _finite(x: float | str) -> float | str | None:
    return None if isinstance(x, float) and not math.isfinite(x) else x


def write_json(table: list[Row], path: Path, seconds: float) -> None:
    packages = ("enerjax", "jax", "jaxlib", "equinox", "optimistix", "numpy", "scipy")
    content = {
        "versions": {name: version(name) for name in packages}
        | {"python": platform.python_version()},
        "device": jax.devices()[0].device_kind,
        "dtype": "float64",
        "seconds": round(seconds, 1),
        "energy_scales": {row.case.name: row.case.energy_scale for row in table},
        "runs": [record for row in table for record in _records(row)],
    }
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def write_picture(table: list[Row], path: Path) -> None:
    """Error in q against h for every problem, with a line for each theoretical order."""
    names = list(dict.fromkeys(row.method.name for row in table))
    styles = {
        name: dict(color=f"C{k % 10}", marker="os^Dv"[k // 10 % 5])
        for k, name in enumerate(names)
    }
    cases = [(case, list(rows)) for case, rows in groupby(table, lambda row: row.case)]
    columns = min(3, len(cases) + 1)
    lines = -(-(len(cases) + 1) // columns)
    figure = Figure(figsize=(5.2 * columns, 4.6 * lines), layout="constrained")
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, (case, rows) in zip(panels, cases, strict=False):
        for row in rows:
            h, error = _curve(row)
            style = dict(linewidth=0.9, markersize=3.5, **styles[row.method.name])
            axes.loglog(h, error, **style)
        _slope_lines(axes, rows)
        axes.set_title(f"{case.name}, t = {case.end_time:g} s")
        axes.set_xlabel("step h [s]")
        axes.set_ylabel("largest error in q [m or rad; quaternion: 1]")
        axes.grid(which="major", linewidth=0.3)
    for axes in panels[len(cases) :]:
        axes.axis("off")
    for name in names:
        panels[len(cases)].plot([], [], label=name, **styles[name])
    panels[len(cases)].legend(loc="center", fontsize="x-small", frameon=False)
    figure.savefig(path, dpi=130)


def _curve(row: Row) -> tuple[list[float], list[float]]:
    good = [(run.h, run.error_q) for run in row.runs if not run.failure]
    return [h for h, _ in good], [error for _, error in good]


def _slope_lines(axes: Axes, rows: list[Row]) -> None:
    """Dashed, just below the most accurate scheme of each order, marked with it."""
    best: dict[int, Row] = {}
    for row in rows:
        if row.outcome:
            continue
        other = best.setdefault(row.method.expected, row)
        if row.runs[0].error_q < other.runs[0].error_q:
            best[row.method.expected] = row
    for order, row in best.items():
        h, error = _curve(row)
        ends = np.array([h[0], h[-2]])
        line = 0.4 * error[0] * (ends / h[0]) ** order
        axes.loglog(ends, line, "k--", linewidth=0.7)
        axes.annotate(str(order), (ends[-1], line[-1]), ha="right", va="top")
