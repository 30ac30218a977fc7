"""A run at an extreme, and its verdict."""

import dataclasses
from collections.abc import Callable
from typing import Any

import harness
import jax
import numpy as np
from numpy.typing import NDArray

import enerjax as ej


Vector = NDArray[np.float64]
Problem = tuple[Any, ej.State, Any]

RIGHT, REPORTED, WRONG = "right", "reported failure", "WRONG"
# Where there is nothing to compare with, and the balance of the energy holds.
LAW = "law holds"
# The largest leak: the residuals of Newton's method, summed over a long run.
LEAK = 1e-9


@dataclasses.dataclass(frozen=True)
class Row:
    """A scheme at one value on an axis; `error` is NaN without a reference.

    - `x`: the value; `asked`: the same in words.
    - `happened`: "success", or the step that failed and the cause.
    - `error`, `allowed`: the difference from the reference, and its bound by the order of
      the scheme and the round-off of the input.
    - `phase`: the run's own estimate of its phase error.
    - `leak`: the energy that the balance does not explain, relative to the largest change.
    """

    axis: str
    case: str
    scheme: str
    asked: str
    x: float
    happened: str
    error: float
    allowed: float
    leak: float
    constraint: float
    constraint_rate: float
    newton: float
    phase: float
    verdict: str


def alphas(*values: float) -> dict[str, ej.AbstractScheme]:
    """The three families, decaying ones at some values of alpha."""
    schemes: dict[str, ej.AbstractScheme] = {"EnergyPreserving()": ej.EnergyPreserving()}
    for alpha in values:
        schemes[f"EnergyDecaying({alpha:g})"] = ej.EnergyDecaying(alpha)
        schemes[f"EnergyConsistent({alpha:g})"] = ej.EnergyConsistent(alpha)
    return schemes


def run(
    problem: Problem, scheme: ej.AbstractScheme, h: float, steps: int, save_every: int = 1
) -> ej.Solution:
    system, start, args = problem
    return harness.run_of(system, scheme, steps, every=save_every)(start, args, h)


def judge(
    place: tuple[str, str, str, str, float],
    solution: ej.Solution,
    error_of: Callable[[Vector, Vector], float] | None = None,
    allowed: float = np.nan,
    leak_allowed: float = LEAK,
) -> Row:
    """The row of a run; `error_of` takes its coordinates and velocities at all times."""
    audit = jax.device_get(solution.audit)
    done = int(solution.stats.completed_steps)
    failed = bool(solution.result != ej.RESULTS.successful)
    good = np.isfinite(audit.kinetic)
    energy = (audit.kinetic + audit.potential)[good]
    explained = np.cumsum((audit.work + audit.drive_work - audit.dissipated)[good])
    moved = np.max(audit.kinetic[good]) + np.ptp(audit.potential[good])
    # Where next to nothing moves, energies are rounded by more than a part of that.
    moved += 1e-4 * np.max(np.abs(energy))
    left = np.max(np.abs(energy - energy[0] - explained))
    leak = float(left / moved) if moved > 0 else float(left)
    error = np.nan
    if error_of is not None and not failed:
        error = float(error_of(np.asarray(solution.ys.q), np.asarray(solution.ys.v)))
    # An error that is NaN is no success.
    okay = leak <= leak_allowed and (error_of is None or error <= allowed)
    good_enough = LAW if error_of is None else RIGHT
    verdict = REPORTED if failed else good_enough if okay else WRONG
    cause = ej.RESULTS[solution.result]
    iterations = np.asarray(solution.stats.newton_iterations)
    return Row(
        *place,
        happened=f"step {done + 1}: {cause.partition('.')[0]}" if failed else "success",
        error=error,
        allowed=allowed if error_of is not None else np.nan,
        leak=leak,
        constraint=_largest(audit.constraint[good]),
        constraint_rate=_largest(audit.constraint_rate[good]),
        newton=float(np.mean(iterations[: max(done, 1)])),
        phase=float(solution.phase_error),
        verdict=verdict,
    )


def _largest(x: Vector) -> float:
    return float(np.max(np.abs(x), initial=0.0))
