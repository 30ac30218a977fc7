import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from ..._run import positive_integer
from ...schemes import AbstractScheme
from .reference import Reals
from .runs import Given, measure, Problem
from .text import number, with_uncertainty


_COLUMNS = (
    "q",
    "v",
    "multipliers",
    "energy",
    "constraint",
    "constraint_rate",
    "evaluations",
    "seconds",
)
_HEADER = (
    "scheme",
    "h",
    "error q",
    "error v",
    "error lambda",
    "energy",
    "max |Phi|",
    "max |psi|",
    "corrections",
    "ms",
    "outcome",
)


@dataclasses.dataclass(frozen=True)
class WorkPrecision:
    """What accuracy costs. Arrays have the shape `(schemes, steps)`, the longest first.

    - `schemes`: their names.
    - `steps`, `h`: numbers of steps and their lengths, shape `(steps,)`.
    - `q`, `v`, `multipliers`: the largest errors over entries and times.
    - `energy`: the largest change of the energy; with forces or drives its largest error.
    - `constraint`, `constraint_rate`: the largest residuals.
    - `evaluations`: corrections of Newton's method, of the whole run.
    - `seconds`: of the processor, for a run that is compiled; the median of the repeats.
    - `failures`: why a run has no numbers; empty for the others.
    - `uncertainty`: of the reference, for `q`, `v` and `multipliers`; errors below it
      mean nothing. 0 for given data.

    NaN stands where a run failed, where the reference says nothing, and for constraints
    and multipliers that a system does not have. `print` shows a table.
    """

    schemes: tuple[str, ...]
    steps: tuple[int, ...]
    h: Reals
    q: Reals
    v: Reals
    multipliers: Reals
    energy: Reals
    constraint: Reals
    constraint_rate: Reals
    evaluations: Reals
    seconds: Reals
    failures: tuple[tuple[str, ...], ...]
    uncertainty: dict[str, float]

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [_HEADER]
        for i, name in enumerate(self.schemes):
            for j, h in enumerate(self.h):
                errors = [number(getattr(self, x)[i, j]) for x in _COLUMNS[:-2]]
                count, seconds = self.evaluations[i, j], self.seconds[i, j]
                costs = [f"{x:.4g}" if x == x else "" for x in (count, 1e3 * seconds)]
                rows.append((name, f"{h:.4g}", *errors, *costs, self.failures[i][j]))
        return with_uncertainty(rows, self.uncertainty)

    def plot(self) -> Any:
        """Error of the positions against time and against corrections, as a figure."""
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(
            1, 2, figsize=(10, 4), layout="constrained", sharey=True
        )
        for name, error, *costs in zip(
            self.schemes, self.q, self.seconds, self.evaluations, strict=True
        ):
            for axis, cost in zip(axes, costs, strict=True):
                axis.loglog(cost, error, "o-", label=name)
        axes[0].set(xlabel="processor time [s]", ylabel="largest error in q")
        axes[1].set(xlabel="Newton corrections")
        axes[1].legend()
        return figure


def work_precision(
    problem: Problem,
    schemes: Mapping[str, AbstractScheme],
    steps: Sequence[int],
    reference: Given = None,
    *,
    duration: float,
    t0: float = 0.0,
    repeats: int = 5,
) -> WorkPrecision:
    """How accurate schemes are on a problem of yours, and what that costs.

    **Arguments:**

    - `problem`: `(system, start, args)`, as of `problems` and `Scene.build()`.
    - `schemes`: a dictionary of names and schemes.
    - `steps`: numbers of steps into which the duration is divided.
    - `reference`: data `(t, q)` or `(t, q, v)` of your own, with q of shape
      `(times, nq)`, at times that all runs pass; or a scheme, of which two runs finer than
      all others are extrapolated (Richardson). Left out, that is done with
      `Composed(EnergyPreserving(), 6)`, or `EnergyPreserving()` where the system has
      forces, at quarters of the duration (at its end where `steps` are no multiples of 4).
    - `duration`: of every run (time).
    - `t0`: the time of the start.
    - `repeats`: timed runs of each kind, after one that compiles.

    Multipliers are those that a run reports, against those of the reference at the same
    time: schemes that report the mean over a step are off by half a step there. A scheme
    that refuses the system, and a run that fails, leave a row that says so.

    **Returns:** a `WorkPrecision`.

    **Raises:** `ValueError` or `TypeError` for bad input, data between the steps, and a
    reference run that fails.

    **Reference:** E. Hairer and G. Wanner, Solving Ordinary Differential Equations II,
    section IV.10, on such diagrams; L. F. Richardson (1911), extrapolation.
    """
    repeats = positive_integer("repeats", repeats)
    runs = measure(problem, schemes, steps, reference, duration, t0, repeats)
    numbers = {name: runs.table(name) for name in _COLUMNS}
    return WorkPrecision(
        tuple(runs.schemes),
        runs.steps,
        runs.h,
        **numbers,
        failures=runs.failures,
        uncertainty=runs.uncertainty,
    )
