"""The table of the main job: one row a run, as text and as CSV."""

import csv
from pathlib import Path

import numpy as np

from ..._results import meanings
from .runs import Run


HEADER = (
    "scheme",
    "case",
    "alpha",
    "h",
    "energy change",
    "max |Phi|",
    "max |B v|",
    "Newton mean",
    "Newton max",
    "divided",
    "us/step",
    "outcome",
)


def row(run: Run) -> tuple[str, ...]:
    """One run, over the steps that it completed."""
    audit, stats = run.solution.audit, run.solution.stats
    energy = np.asarray(audit.energy)[run.rows]
    largest = lambda x: np.abs(np.asarray(x)[run.rows]).max(initial=0.0)
    iterations = np.asarray(stats.newton_iterations)[: run.rows.stop]
    alpha = run.method.alpha
    return (
        run.method.name,
        run.case.name,
        "" if alpha is None else f"{alpha:g}",
        f"{run.case.h:g}",
        f"{energy[-1] - energy[0]:.2e}",
        f"{largest(audit.constraint):.1e}",
        f"{largest(audit.constraint_rate):.1e}",
        f"{iterations.mean():.2f}",
        f"{iterations.max()}",
        f"{np.count_nonzero(stats.halvings)}",
        f"{1e6 * run.seconds_per_step:.1f}",
        outcome(run),
    )


def outcome(run: Run) -> str:
    """How a run ended, in a few words."""
    if run.failed:
        done = int(run.solution.stats.completed_steps)
        cause = meanings(run.solution.result)
        return f"failed in step {done + 1} (t = {done * run.case.h:.4g}): {cause}"
    followed = _followed(run)
    if followed < 0.05:
        return "done, but LOCKS: at full speed the positions stand still"
    if followed < 0.5:
        return "done, but the velocities oscillate about the motion"
    return "done"


def _followed(run: Run) -> float:
    """In the last tenth of a run, the way made over that which the speeds promise."""
    q, v = np.asarray(run.solution.ys.q), np.asarray(run.solution.ys.v)
    last = max(len(q) // 10, 2)
    promised = run.case.h * np.abs(v[-last:]).sum()
    return float(np.abs(np.diff(q[-last:], axis=0)).sum() / promised)


def as_text(runs: list[Run]) -> str:
    rows = [HEADER, *(row(run) for run in runs)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    line = lambda cells: "  ".join(
        cell.ljust(w) for cell, w in zip(cells, widths, strict=True)
    ).rstrip()
    ruler = "  ".join("-" * w for w in widths)
    return "\n".join([line(rows[0]), ruler, *map(line, rows[1:])])


def write_csv(runs: list[Run], path: Path) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([HEADER, *(row(run) for run in runs)])
