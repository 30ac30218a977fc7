import dataclasses
import functools
import os
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from .._programs import is_known
from .._results import RESULTS, tally
from .._system import Names, State
from .._types import Count, Scalar
from .audit import Audit
from .events import Events


class Statistics(eqx.Module):
    """The costs of a run, for the steps between each row and the row before it.

    The shape is `(times - 1,)`: one entry for each step if every step is saved. At
    requested times it is `(times,)`, because the first of these need not be the start.

    - `newton_iterations`: the sum over these steps, including all stages of a step
      (`Composed`) and rejected steps; 0 after a failure.
    - `residual`: the largest entry of the scaled step equations before the last correction;
      of a failed step the one that was reached.
    - `halvings`: the largest number of halvings of one of these steps; see `simulate`.
    - `local_error`: an estimate of the summed errors of the velocities in these steps, as
      the square root of an energy: each is weighted by the root of its inertia. It follows
      from the change of the velocities from step to step and the order of the scheme, and
      is not a bound. See `Solution.phase_error`.
    - `completed_steps`: the number of steps before the first failure.
    - `rejected_steps`: of a run with a `StepController`, the number of steps that were
      repeated with another length, including the last one of a failed run; else `None`.
    """

    newton_iterations: Int[Array, " rows"]
    residual: Float[Array, " rows"]
    halvings: Int[Array, " rows"]
    local_error: Float[Array, " rows"]
    completed_steps: Count
    rejected_steps: Count | None = None


class Continuation(eqx.Module):
    """What a run needs to be continued to the last bit: see `resume` of `simulate`.

    - `numbers`: the start of the run, its groups of steps, the unfinished group, and the
      memories of predictor, Newton's method and step controller.
    - `run`: one word for each property of the run that must not change.
    """

    numbers: tuple[Array | np.ndarray, ...]
    run: tuple[tuple[str, str], ...] = eqx.field(static=True)


class Solution(eqx.Module):
    """A run. Every array has a leading axis of saved times.

    Row 0 is the start, unless other times were requested.

    - `ts`: shape `(times,)`, from `t0` on (time).
    - `ys`: a `State` with `q` of shape `(times, nq)` and `v` of shape `(times, nv)`, or
      what `SaveAt(fn=...)` made of the states.
    - `multipliers`: shape `(times, nc)`, `lambda` of the step that ends at each row: of
      joints, driven constraints, nonholonomic constraints and relations between
      coordinates, in this order. They are means over the step: of order 2 in its middle
      and of order 1 at the row, in schemes of higher order too. Those of row 0 belong to
      the consistent start. The force on the coordinates is `-B^T lambda`.
    - `details`: what only this scheme reports, for the steps that end at the rows after
      the start (`KappaDecaying`: kappa, shape `(times - 1,)`), or `None`.
    - `audit`: energies and constraint residuals.
    - `stats`: the costs of the run; see `Statistics`.
    - `end`: the last state that was reached, after `stats.completed_steps` steps: the last
      row, or the state in which a failed step began. A further run can start from it.
    - `result`: `RESULTS.successful`, or the first failure.
    - `events`: the times of events, and the states on both sides; `None` in a run without.
    - `names`: those of the system, for tables.
    - `continuation`: what the next step needs, of a run with `progress`, `checkpoint` or
      `resume`; else `None`.

    Rows after a failed step are NaN; the rows before it are not affected.

    At requested times (`saveat=SaveAt(ts=...)`) multipliers and details are those of the
    step in which a row lies, or which ends there. The energies of the audit are those of
    the row's state; dissipation and work are those of the steps that have ended since the
    row before (for the first row, since the start). The balance of the audit is therefore
    exact only between rows at the ends of steps, such as all rows of `SaveAt(every=...)`.

    `print` shows the outcome, the number of steps and iterations, and the audit; for a
    batch, all lanes together. `to_csv`, `to_pandas` and `to_xarray` make tables, and
    `enerjax.save` writes everything to a file.
    """

    ts: Float[Array, " times"]
    ys: PyTree[Any]
    multipliers: Float[Array, "times nc"]
    details: PyTree[Any]
    audit: Audit
    stats: Statistics
    end: State
    result: RESULTS
    events: Events | None = None
    names: Names | None = None
    continuation: Continuation | None = None

    @property
    def phase_error(self) -> Scalar:
        """An estimate of the relative error of the motion at the end of the run.

        It is the sum of the local errors of all steps over the largest velocity. Energy and
        constraints hold for steps of any length; this tells whether the steps resolve the
        motion.
        """
        kinetic, potential = self.audit.kinetic, self.audit.potential
        # A kinetic energy below the round-off of the potential energy counts as rest.
        rest = jnp.finfo(kinetic.dtype).eps * jnp.nanmax(jnp.abs(potential), axis=-1)
        # `H(q, p) - H(q, 0)` may be negative, if there is a vector potential.
        largest = jnp.maximum(jnp.nanmax(jnp.abs(kinetic), axis=-1), rest)
        total = jnp.sum(self.stats.local_error, axis=-1)
        return total / jnp.sqrt(2 * jnp.where(largest > 0, largest, jnp.inf))

    def to_csv(
        self, path: str | os.PathLike, columns: Mapping[str, ArrayLike] | None = None
    ) -> None:
        """Write the rows to a file of comma-separated values, with 17 digits.

        The columns are those of `to_pandas`; pandas is not needed.

        **Arguments:**

        - `path`: the name of the file.
        - `columns`: see `to_pandas`.

        **Raises:** `ValueError` for a batch of runs, a run without rows, and columns of
        another length.
        """
        from .tables import table, write_csv

        write_csv(path, table(self, columns))

    def to_pandas(self, columns: Mapping[str, ArrayLike] | None = None) -> Any:
        """A `pandas.DataFrame` with one line for each row, and the time `t` as index.

        The columns are the coordinates and velocities by name (or the values of
        `SaveAt(fn=...)`), `multiplier.NAME` of each constraint, the entries of the audit,
        and those of the statistics and of `details`, which belong to the steps since the
        row before. Rows that the run has not reached are left out.

        **Arguments:**

        - `columns`: arrays of shape `(times, ...)` by name, in place of coordinates,
          velocities and multipliers. Those of a scene are `scene.columns(solution)`: poses
          of bodies, lengths and angles of parts, forces and reactions.

        **Raises:** `ImportError` without pandas (the extra `tables`); `ValueError` for a
        batch of runs, and for columns of another length.
        """
        from .tables import data_frame, table

        return data_frame(table(self, columns))

    def to_xarray(self) -> Any:
        """An `xarray.Dataset` with the dimensions `t`, `coordinate`, `velocity`,
        `multiplier`, `joint` and `symmetry`, and names as their coordinates.

        Its variables are `q`, `v`, `multipliers`, the entries of the audit, `details` and
        the statistics. The outcome of the run is among its `attrs`. Rows that the run has
        not reached are left out.

        **Raises:** `ImportError` without xarray (the extra `tables`); `ValueError` for a
        batch of runs.
        """
        from .tables import dataset

        return dataset(self)

    def plot(self, axes: Any = None, *, units: dict[str, str] | None = None) -> Any:
        """Four plots of the run: energies, what changed their sum since the start, the
        largest residuals of constraints, and the iterations of the steps.

        **Arguments:**

        - `axes`: four axes of matplotlib to draw into; new ones by default.
        - `units`: names for the labels, such as `{"time": "s", "energy": "J"}`.

        **Returns:** the axes, an array of shape `(4,)`. A run that failed is shown as far
        as it came.

        **Raises:** `ValueError` for a batch of runs, and for a run without rows.
        """
        from .plots import plot_run

        return plot_run(self, axes, units)

    def plot_energy(self, ax: Any = None, *, units: dict[str, str] | None = None) -> Any:
        """The energies over time, in one axes object, which is returned; see `plot`."""
        from .plots import plot_energy

        return plot_energy(self, ax, units)

    def __str__(self) -> str:
        return _report(self) if is_known(self) else repr(self)


def first_rows(solution: Solution, count: int) -> Solution:
    """The solution without the rows after the first `count` rows.

    Of every array with one entry for each row, or for each step, as many last ones go.
    """
    names = "ts", "ys", "multipliers", "details", "audit", "stats"
    rows = {name: getattr(solution, name) for name in names}
    excess = solution.ts.size - count
    cut = lambda x: x[: len(x) - excess] if x.ndim > 0 else x
    if not is_known(rows):  # the functions of the system close over tracers
        return dataclasses.replace(solution, **jax.tree.map(cut, rows))
    # By NumPy: the program by which XLA cuts rows takes 54 ms to compile for each `count`.
    rows = jax.tree.map(lambda x: cut(np.asarray(x)), rows)
    return dataclasses.replace(solution, **_moved(rows, solution.ts))


def _moved(tree: PyTree[np.ndarray], like: Array) -> PyTree[Array]:
    """NumPy arrays as arrays of JAX on the device of the array `like`."""
    if like.committed or len(like.devices()) > 1:
        return jax.device_put(tree, like.sharding)
    with jax.default_device(*like.devices()):
        # JAX takes 20 us for each array. A program takes 100 us for all, but 14 ms to
        # compile, which pays for shapes that come again.
        types = tuple((x.shape, x.dtype) for x in jax.tree.leaves(tree))
        is_first = not _has_moved(types)[0]
        _has_moved(types)[0] = True
        return jax.device_put(tree) if is_first else _first_rows_moved(tree)


@functools.lru_cache(maxsize=256)
def _has_moved(types: tuple[Any, ...]) -> list[bool]:
    """Whether arrays of these types have been moved before, which the caller writes."""
    return [False]


@jax.jit
def _first_rows_moved(tree: PyTree[Array]) -> PyTree[Array]:
    return tree


def _report_of_end(solution: Solution) -> list[str]:
    """A line about a run that an event has ended before its last row."""
    kinetic, events = np.asarray(solution.audit.kinetic), solution.events
    if events is None or kinetic.ndim > 1 or solution.result != RESULTS.successful:
        return []
    if events.count == 0 or not kinetic.size or np.isfinite(kinetic[-1]):
        return []
    t = np.asarray(events.ts)[int(events.count) - 1]
    return [f"an event ended the run at t = {t:.6g}, behind the last row that was reached"]


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
    lines = [outcome, f"{steps} steps, {rows}", *_report_of_end(solution)]
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
