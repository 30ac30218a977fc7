"""The table of the main job, with one row for each run, as text and as CSV."""

import csv
from pathlib import Path

import numpy as np

from ..._results import meanings
from ..measure.text import aligned
from .runs import Run


# A run locks if its positions move by less than the first fraction of the way that the
# velocities promise; its velocities oscillate if they move by less than the second.
_LOCKED = 0.05
_OSCILLATING = 0.5


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
    """The row of a run, for the steps that it completed."""
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
    fraction = _distance_over_promised(run)
    if fraction < _LOCKED:
        return "done, but LOCKS: at full speed the positions stand still"
    if fraction < _OSCILLATING:
        return "done, but the velocities oscillate about the motion"
    return "done"


def _distance_over_promised(run: Run) -> float:
    """The distance travelled in the last tenth of a run, over that by the velocities."""
    q, v = np.asarray(run.solution.ys.q), np.asarray(run.solution.ys.v)
    last = max(len(q) // 10, 2)
    promised = run.case.h * np.abs(v[-last:]).sum()
    return float(np.abs(np.diff(q[-last:], axis=0)).sum() / promised)


def as_text(runs: list[Run]) -> str:
    return aligned([HEADER, *(row(run) for run in runs)])


def write_csv(runs: list[Run], path: Path) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([HEADER, *(row(run) for run in runs)])
