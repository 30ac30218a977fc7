"""The rows that a run reached, as pictures and tables need them."""

import warnings
from typing import Any

import numpy as np

from .._programs import is_known
from .._results import tally
from .solution import Solution


# Errors of pictures above this part of their size are told.
_VISIBLE = 0.01


class ReachedRows:
    """The rows that a run reached.

    - `ts`: their times, shape `(rows,)`.
    - `outcome`: why the run ended before its time, or nothing.

    **Raises:** `TypeError` for traced values, `ValueError` for a batch of runs, and for one
    without rows.
    """

    def __init__(self, sol: Solution):
        if not isinstance(sol, Solution):
            raise TypeError(
                f"A run is needed, the `Solution` of `simulate`, got {type(sol).__name__}."
            )
        must_be_known(sol)
        energy, ts = np.asarray(sol.audit.energy), np.asarray(sol.ts)
        if energy.ndim != 1:
            raise ValueError(
                f"One run is needed, but this is a batch of {energy.shape[:-1]}: "
                "pick one, `jax.tree.map(lambda x: x[3], sol)`."
            )
        words = tally(sol.result).removeprefix("1 ")
        self.outcome = "" if words == "successful" else words
        self._reached = np.isfinite(energy) & np.isfinite(ts)
        if not self._reached.any():
            raise ValueError(
                f"The run has no rows to show: all are NaN. Its outcome: {words}."
            )
        self.ts = ts[self._reached]

    def __call__(self, values: Any) -> np.ndarray:
        """The reached rows of an array with the axis of time first."""
        return np.asarray(values)[self._reached]

    def after_start(self, values: Any) -> tuple[np.ndarray, np.ndarray]:
        """Times and values of an array that may lack the row of the start."""
        values = np.asarray(values)
        reached = self._reached[len(self._reached) - len(values) :]
        return self.ts[len(self.ts) - reached.sum() :], values[reached]


def must_be_known(values: Any) -> None:
    """Raises an error for traced values."""
    if not is_known(values):
        raise TypeError(
            "Pictures and tables need values: they cannot be made inside `jit`, `vmap` or "
            "`grad`."
        )


def must_be_close(num_rows: int) -> None:
    """Raises an error for a run with too few rows to tell the motion between them."""
    if num_rows < 3:
        raise ValueError(
            f"The run has {num_rows} rows, which do not tell the motion between them: save "
            "more, all steps with `saveat=ej.SaveAt(every=1)`, or the times that you want "
            "to see with `SaveAt(ts=...)`."
        )


def warn_if_visible(error: float) -> None:
    """Warns of an error of interpolation, relative to the size of the picture."""
    if error > _VISIBLE:
        warnings.warn(
            "The rows of the run are too far apart to draw what is between them: it may be "
            f"off by {100 * error:.0f} % of the size of the picture. Save more rows, or "
            "the times of the picture: `saveat=ej.SaveAt(ts=...)`.",
            stacklevel=2,
        )
