from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, Int, PyTree

from ._audit import Audit
from ._results import RESULTS
from ._system import State
from ._types import Count


class Statistics(eqx.Module):
    """What a run cost.

    - `newton_iterations`: of each step, shape `(num_steps,)`; 0 after a failure.
    - `completed_steps`: number of steps before the first failure, or all.
    - `rejected_steps`: of a run with a `StepController`, how many steps were repeated with
      another length, the last one of a failed run included; else `None`.

    In a run to an end time there is room for `max_steps`; with a controller rejected steps
    count and stand among the others.
    """

    newton_iterations: Int[Array, " steps"]
    completed_steps: Count
    rejected_steps: Count | None = None


class Solution(eqx.Module):
    """A run. Every array has a leading axis of saved times; row 0 is the start.

    - `ts`: shape `(times,)`, from `t0` on (time).
    - `ys`: a `State` with `q` of shape `(times, nq)` and `v` of shape `(times, nv)`.
    - `multipliers`: shape `(times, nc)`, `lambda` of the step that ends at each row:
      joints, driven constraints, relations between coordinates, in this order; row 0 those
      of the consistent start. The force on the coordinates is `-B^T lambda`.
    - `details`: what the scheme reports of its own, for the steps that end at the rows
      after the start (`KappaDecaying`: kappa, shape `(times - 1,)`), or `None`.
    - `audit`: energies and constraint residuals.
    - `stats`: `newton_iterations` and `completed_steps`.
    - `result`: `RESULTS.successful`, or the first failure.

    Rows after a failed step are NaN; those before it are what they would be without it.
    """

    ts: Float[Array, " times"]
    ys: State
    multipliers: Float[Array, "times nc"]
    details: PyTree[Any]
    audit: Audit
    stats: Statistics
    result: RESULTS
