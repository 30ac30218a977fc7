"""Convergence studies: a scheme on a problem, with halved steps, against the reference."""

import dataclasses
import math

import numpy as np
from catalogue import Case, CHECKPOINTS, Method
from references import Reference

import enerjax as ej


@dataclasses.dataclass(frozen=True)
class Run:
    """One run to the end time; the errors are NaN if it failed.

    Energies are relative to the scale of the case. `identity_error` is that of the energy
    identity of the scheme: the change of the energy plus the dissipated energy.
    """

    h: float
    error_q: float
    error_v: float
    energy_error: float
    identity_error: float
    constraint: float
    constraint_rate: float
    newton_iterations: float  # mean, of one solve
    failure: str


def run(
    case: Case,
    problem: ej.problems.Problem,
    method: Method,
    reference: Reference,
    blocks: int,
) -> Run:
    """The run in `blocks` times the coarsest number of steps.

    It is done in as many calls of the same number of steps. `h` and the start are
    traced, so all steps of a scheme share one compilation.
    """
    num_steps = case.coarsest[method.kind]
    h = case.end_time / (num_steps * blocks)
    system, state, args = problem
    energy0, removed, failure = float(system.energy(state, args)), 0.0, ""
    names = ("q", "v", "change", "identity", "constraint", "rate", "iterations")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for block in range(blocks):
        solution = ej.simulate(
            system, method.scheme, state, args, h=h, num_steps=num_steps, throw=False
        )
        done = int(solution.stats.completed_steps)
        audit, rows = solution.audit, slice(1, done + 1)
        change = np.asarray(audit.energy)[rows] - energy0
        dissipated = removed + np.cumsum(audit.dissipated)[rows]
        parts["q"].append(np.asarray(solution.ys.q)[rows])
        parts["v"].append(np.asarray(solution.ys.v)[rows])
        parts["change"].append(change / case.energy_scale)
        parts["identity"].append((change + dissipated) / case.energy_scale)
        parts["constraint"].append(np.asarray(audit.constraint)[rows])
        parts["rate"].append(np.asarray(audit.constraint_rate)[rows])
        parts["iterations"].append(np.asarray(solution.stats.newton_iterations)[:done])
        if done < num_steps:
            cause = ej.RESULTS[solution.result].split(".")[0].split(":")[0]
            failure = f"failed at t = {(block * num_steps + done) * h:.4g}: {cause}"
            break
        removed = dissipated[-1]
        state = ej.State(solution.ys.q[-1], solution.ys.v[-1])
    whole = {name: np.concatenate(part) for name, part in parts.items()}
    error_q = error_v = math.nan
    if not failure:
        at = np.rint(num_steps * blocks * CHECKPOINTS).astype(int) - 1
        error_q = _largest(whole["q"][at] - reference.q)
        error_v = _largest(whole["v"][at] - reference.v)
    count = whole["iterations"]
    return Run(
        h=h,
        error_q=error_q,
        error_v=error_v,
        energy_error=_largest(whole["change"]),
        identity_error=_largest(whole["identity"]),
        constraint=_largest(whole["constraint"]),
        constraint_rate=_largest(whole["rate"]),
        newton_iterations=(
            float(count.mean()) / len(method.scheme.stages) if count.size else math.nan
        ),
        failure=failure,
    )


def _largest(x: np.ndarray) -> float:
    return float(np.abs(x).max(initial=0.0))


def slopes(runs: list[Run], error: str, floor: float) -> list[float]:
    """Slopes over the halvings above `floor`, coarsest first; none if a run failed."""
    if any(run.failure for run in runs):
        return []
    errors = [getattr(run, error) for run in runs]
    pairs = zip(errors[:-1], errors[1:], strict=True)
    return [math.log2(a / b) for a, b in pairs if min(a, b) > floor]


@dataclasses.dataclass(frozen=True)
class Row:
    """A scheme on a problem: its runs, the coarsest first, and the slopes between."""

    case: Case
    method: Method
    runs: list[Run]
    slopes_q: list[float]
    slopes_v: list[float]

    @property
    def outcome(self) -> str:
        """Why there is no order, or nothing."""
        failures = [f"h = {r.h:.4g} {r.failure}" for r in self.runs if r.failure]
        if failures:
            return "; ".join(failures)
        few = min(len(self.slopes_q), len(self.slopes_v)) < 2
        return "plateau: fewer than two halvings above round-off" if few else ""


def measure(
    case: Case,
    problem: ej.problems.Problem,
    group: list[Method],
    reference: Reference,
    levels: int,
) -> list[Row]:
    """The rows of schemes that share a program."""
    rows = []
    for method in group:
        runs = [run(case, problem, method, reference, 2**k) for k in range(levels)]
        rows.append(
            Row(
                case=case,
                method=method,
                runs=runs,
                # Smaller errors are those of the reference, or round-off of the sum of all
                # steps.
                slopes_q=slopes(runs, "error_q", max(2 * reference.uncertainty_q, 1e-12)),
                slopes_v=slopes(runs, "error_v", max(2 * reference.uncertainty_v, 1e-12)),
            )
        )
    return rows
