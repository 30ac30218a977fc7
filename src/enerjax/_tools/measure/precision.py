import dataclasses
from collections.abc import Sequence
from typing import Any

from ..._run import positive_integer
from .reference import Reals
from .runs import measure, Problem, ReferenceMotion, Schemes
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
    """The costs of accuracy. Arrays have the shape `(schemes, steps)`, longest step first.

    - `schemes`: their names.
    - `steps`, `h`: numbers of steps and their lengths, shape `(steps,)`.
    - `q`, `v`, `multipliers`: the largest errors over entries and times.
    - `energy`: the largest change of the energy; with forces or drives its largest error.
    - `constraint`, `constraint_rate`: the largest residuals.
    - `evaluations`: the number of Newton corrections in the whole run.
    - `seconds`: processor time of a compiled run; the median of the repeats.
    - `failures`: why a run failed; empty for all others.
    - `uncertainty`: of the reference, for `q`, `v` and `multipliers`; smaller errors are
      meaningless. 0 if the reference is data.

    Entries are NaN if a run failed, if the reference does not contain them, and for
    constraints and multipliers that a system does not have. `print` shows a table.
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

    def plot(self, axes: Any = None) -> Any:
        """Error of the positions against time and against corrections.

        `axes` are two axes of matplotlib, by default new ones. **Returns:** the axes.
        """
        from ..._pictures import grid_of

        axes = grid_of(axes, 1, (10.0, 4.0))
        for name, error, *costs in zip(
            self.schemes, self.q, self.seconds, self.evaluations, strict=True
        ):
            for axis, cost in zip(axes, costs, strict=True):
                axis.loglog(cost, error, "o-", label=name)
        axes[0].set(xlabel="processor time [s]", ylabel="largest error in q")
        axes[1].set(xlabel="Newton corrections")
        axes[1].legend()
        return axes


def work_precision(
    problem: Problem,
    schemes: Schemes,
    steps: Sequence[int],
    reference: ReferenceMotion = None,
    *,
    duration: float,
    t0: float = 0.0,
    repeats: int = 5,
) -> WorkPrecision:
    """Measures how accurate schemes are on a problem of yours, and what that costs.

    **Arguments:**

    - `problem`: `(system, start, args)`, such as those of `problems` and `Scene.build()`.
    - `schemes`: a dictionary of names and schemes.
    - `steps`: numbers of steps into which the duration is divided.
    - `reference`: either data `(t, q)` or `(t, q, v)`, with q of shape `(times, nq)`, at
      times that are ends of steps in all runs; or a scheme, of which two finer runs are
      extrapolated (Richardson). The default is `Composed(EnergyPreserving(), 6)`, or
      `EnergyPreserving()` if the system has forces. A scheme is compared at quarters of the
      duration (only at its end if some of `steps` are not multiples of 4).
    - `duration`: of every run (time).
    - `t0`: the time of the start.
    - `repeats`: the number of timed runs of each kind, after one that compiles.

    The multipliers of a run are compared with those of the reference at the same time, so
    schemes that report means over a step have an error of half a step there. The row of a
    scheme that refuses the system, or of a failed run, contains the reason.

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
        schemes=tuple(runs.schemes),
        steps=runs.steps,
        h=runs.h,
        **numbers,
        failures=runs.failures,
        uncertainty=runs.uncertainty,
    )
