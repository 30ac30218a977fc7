from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._programs import is_known
from .._results import RESULTS, tally
from .._system import State
from .._types import Count, Scalar
from .audit import Audit


class Statistics(eqx.Module):
    """What a run cost: for each row after the start, the steps since the row before.

    Shape `(times - 1,)`, one entry a step where every step is saved. At requested times
    the shape is `(times,)`, for the first of them need not be the start.

    - `newton_iterations`: of these steps together; 0 after a failure. Those of all stages
      count where a step has several (`Composed`), and those of rejected steps.
    - `residual`: the largest entry of the step equations, scaled to order one, before the
      last correction; of a step that failed what Newton came to.
    - `halvings`: how often one of these steps had to be halved, at most; see `simulate`.
    - `local_error`: an estimate of what these steps are off by together, as the square root
      of an energy: of the velocities, weighted by the root of the inertia. By how they
      change from step to step, and the order of the scheme; a guide, and no bound. The
      estimates of all steps, over the root of twice the largest kinetic energy, tell to
      which part of the motion its phase can be believed at most: see `phase_error`.
    - `completed_steps`: number of steps before the first failure, or all.
    - `rejected_steps`: of a run with a `StepController`, how many steps were repeated with
      another length, the last one of a failed run included; else `None`.
    """

    newton_iterations: Int[Array, " rows"]
    residual: Float[Array, " rows"]
    halvings: Int[Array, " rows"]
    local_error: Float[Array, " rows"]
    completed_steps: Count
    rejected_steps: Count | None = None


class Solution(eqx.Module):
    """A run. Every array has a leading axis of saved times.

    Row 0 is the start, unless other times were requested.

    - `ts`: shape `(times,)`, from `t0` on (time).
    - `ys`: a `State` with `q` of shape `(times, nq)` and `v` of shape `(times, nv)`, or
      what `SaveAt(fn=...)` made of the states.
    - `multipliers`: shape `(times, nc)`, `lambda` of the step that ends at each row:
      joints, driven constraints, relations between coordinates, in this order; row 0 those
      of the consistent start. The force on the coordinates is `-B^T lambda`.
    - `details`: what the scheme reports of its own, for the steps that end at the rows
      after the start (`KappaDecaying`: kappa, shape `(times - 1,)`), or `None`.
    - `audit`: energies and constraint residuals.
    - `stats`: what the run cost; see `Statistics`.
    - `end`: the last state that was reached, after `stats.completed_steps` steps: the last
      row, or where a failed step began. The start for a run that goes on from there.
    - `result`: `RESULTS.successful`, or the first failure.

    Rows after a failed step are NaN; those before it are what they would be without it.

    At times that were requested (`saveat=SaveAt(ts=...)`) multipliers and details
    are those of the step that a row lies in or ends. The energies of the audit are those of
    its state; dissipation and work are those of the steps that have ended since the row
    before (of the first row since the start). So the balance of the audit is exact between
    rows at the ends of steps: the start, the end, and all rows of `SaveAt(every=...)`.

    `print` tells the outcome, the steps and what Newton's method took for them, and the
    account of the energy; of a batch all lanes together.
    """

    ts: Float[Array, " times"]
    ys: PyTree[Any]
    multipliers: Float[Array, "times nc"]
    details: PyTree[Any]
    audit: Audit
    stats: Statistics
    end: State
    result: RESULTS

    @property
    def phase_error(self) -> Scalar:
        """What the motion may be off by at the end, in parts of itself: an estimate.

        The local errors of all steps, over the largest velocity. Energy and constraints
        hold at any step; this tells whether the motion is resolved.
        """
        kinetic, potential = self.audit.kinetic, self.audit.potential
        # Below the round-off of the potential energy nothing moves: a system at rest.
        rest = jnp.finfo(kinetic.dtype).eps * jnp.nanmax(jnp.abs(potential), axis=-1)
        largest = jnp.maximum(jnp.nanmax(kinetic, axis=-1), rest)
        total = jnp.sum(self.stats.local_error, axis=-1)
        return total / jnp.sqrt(2 * jnp.where(largest > 0, largest, jnp.inf))

    def __str__(self) -> str:
        return _report(self) if is_known(self) else repr(self)


def _report(solution: Solution) -> str:
    stats = solution.stats
    done, times = np.asarray(stats.completed_steps), np.asarray(solution.ts)
    iterations, halvings = (
        np.asarray(x) for x in (stats.newton_iterations, stats.halvings)
    )
    outcome, steps = tally(solution.result), f"{done}"
    if done.ndim == 0:
        outcome = outcome.removeprefix("1 ")
    else:
        outcome = f"{done.size} lanes: {outcome}"
        steps = f"{done.min()} to {done.max()}"
    rows = f"rows from t = {np.nanmin(times):.6g} to {np.nanmax(times):.6g}"
    lines = [outcome, f"{steps} steps, {rows}"]
    if np.sum(done) > 0:
        lines.append(f"{np.sum(iterations) / np.sum(done):.1f} iterations a step")
    if np.any(halvings > 0):
        rows = f"before {np.sum(halvings > 0)} of {halvings.size} rows"
        lines.append(f"steps divided, into up to {2 ** halvings.max()} parts, {rows}")
    if stats.rejected_steps is not None:
        lines.append(f"{np.sum(stats.rejected_steps)} steps repeated with another length")
    phase = np.nanmax(np.asarray(solution.phase_error), initial=0.0)
    lines.append(f"phase of the motion, by local errors: to about {phase:.1e}")
    return "\n".join([*lines, str(solution.audit)])
