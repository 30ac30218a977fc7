import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from .reference import Reals
from .runs import measure, Problem, ReferenceMotion, Runs, Schemes
from .text import number, with_uncertainty


_NAMES = ("q", "v", "multipliers")
# Errors below this are round-off, which accumulates over many steps.
_ROUND_OFF = 1e-12


@dataclasses.dataclass(frozen=True)
class OrderTable:
    """Measured orders of accuracy. Errors have the shape `(schemes, steps)`.

    - `schemes`: their names; `expected`: their theoretical orders, `(schemes,)`.
    - `steps`, `h`: numbers of steps and their lengths, shape `(steps,)`, longest first.
    - `q`, `v`, `multipliers`: the largest errors over entries and times.
    - `order_q`, `order_v`, `order_multipliers`: slopes from each length to the next, shape
      `(schemes, steps - 1)`; NaN if a run failed, or if an error is below round-off or the
      uncertainty of the reference.
    - `failures`, `uncertainty`: as in `WorkPrecision`.

    `print` shows a table.
    """

    schemes: tuple[str, ...]
    expected: tuple[int, ...]
    steps: tuple[int, ...]
    h: Reals
    q: Reals
    v: Reals
    multipliers: Reals
    order_q: Reals
    order_v: Reals
    order_multipliers: Reals
    failures: tuple[tuple[str, ...], ...]
    uncertainty: dict[str, float]

    def __str__(self) -> str:
        header = ["scheme", "promised", "h"]
        for name in ("q", "v", "lambda"):
            header += [f"error {name}", "order"]
        rows = [[*header, "outcome"]]
        for i, scheme in enumerate(self.schemes):
            for j, h in enumerate(self.h):
                cells = [scheme, str(self.expected[i]), f"{h:.4g}"]
                for name in _NAMES:
                    cells.append(number(getattr(self, name)[i, j]))
                    order = getattr(self, f"order_{name}")[i, j - 1] if j > 0 else np.nan
                    cells.append("" if np.isnan(order) else f"{order:.2f}")
                rows.append([*cells, self.failures[i][j]])
        return with_uncertainty(rows, self.uncertainty)

    def plot(self, axes: Any = None) -> Any:
        """Errors of positions and velocities against the step.

        `axes` are two axes of matplotlib, by default new ones. **Returns:** the axes.
        """
        from ..._pictures import grid_of

        axes = grid_of(axes, 1, (10.0, 4.0))
        for axis, name in zip(axes, ("q", "v"), strict=True):
            for scheme, error in zip(self.schemes, getattr(self, name), strict=True):
                axis.loglog(self.h, error, "o-", label=scheme)
            axis.set(xlabel="h", ylabel=f"largest error in {name}")
        axes[1].legend()
        return axes


def order_table(
    problem: Problem,
    schemes: Schemes,
    steps: Sequence[int],
    reference: ReferenceMotion = None,
    *,
    duration: float,
    t0: float = 0.0,
) -> OrderTable:
    """Measures the orders of schemes on a problem of yours.

    Arguments, reference, errors and failures are those of `work_precision`, without times.

    **Returns:** an `OrderTable`.
    """
    runs = measure(problem, schemes, steps, reference, duration, t0, repeats=0)
    errors = {name: runs.table(name) for name in _NAMES}
    slopes = {f"order_{name}": _slopes(runs, name) for name in _NAMES}
    return OrderTable(
        schemes=tuple(runs.schemes),
        expected=tuple(scheme.order for scheme in runs.schemes.values()),
        steps=runs.steps,
        h=runs.h,
        **errors,
        **slopes,
        failures=runs.failures,
        uncertainty=runs.uncertainty,
    )


def _slopes(runs: Runs, name: str) -> Reals:
    floor = max(2 * runs.uncertainty[name], _ROUND_OFF)
    errors = runs.table(name)
    errors = np.where(errors > floor, errors, np.nan)
    return np.diff(np.log(errors), axis=1) / np.diff(np.log(runs.h))
