"""The one error of a run that failed."""

import contextlib
from collections.abc import Iterator

import equinox as eqx
import jax
import numpy as np

from .._analysis import mobility
from .._programs import is_known
from .._results import RESULTS
from .._system import AbstractSystem
from .._types import Args, Scalar
from .solution import Solution


def raise_failure(
    solution: Solution,
    system: AbstractSystem,
    args: Args,
    reached: Scalar,
    h: Scalar | None = None,
) -> Solution:
    """The solution, if it is one; else an error that names step, time, cause and remedy.

    `reached` is the time that the run has come to, `h` the length of its steps if they have
    one.
    """
    failed = solution.result != RESULTS.successful
    if not is_known((solution, args, reached, h)):
        return solution.result.error_if(solution, failed)
    if not failed:
        return solution
    done = int(solution.stats.completed_steps)
    begin = float(reached)
    when = f"at t = {begin:.6g}"
    if h is not None:
        when = f"from t = {begin:.6g} to {begin + float(h):.6g}"
    message = f"The run failed in step {done + 1}, {when}. {RESULTS[solution.result]} "
    if solution.result == RESULTS.not_converged:
        # The steps of the last row that took any iteration; the others have converged.
        tried = np.flatnonzero(np.asarray(solution.stats.newton_iterations))[-1]
        residual = float(solution.stats.residual[tried])
        message += f"It came to a residual of {residual:.1e}, scaled to order one. "
    if solution.result in (RESULTS.not_converged, RESULTS.singular, RESULTS.nonfinite):
        message += _dependent_rows(system, solution, args, begin)
    raise eqx.EquinoxRuntimeError(message + "(`throw=False` returns the run up to there.)")


@contextlib.contextmanager
def memory_told(num_steps: int) -> Iterator[None]:
    """Says of a run that does not fit into memory what takes it, and what to do."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise MemoryError(
            f"This run of {num_steps} steps does not fit into memory. Keep fewer rows: "
            "`saveat=SaveAt(every=1000)`, or `SaveAt(fn=...)`, which keeps a function of "
            "the state. A run that is longer still can go on in parts: each starts from "
            "`solution.end` of the one before."
        ) from error


def _dependent_rows(
    system: AbstractSystem, solution: Solution, args: Args, t: float
) -> str:
    """Names the constraints that follow from others where the run came to a stop."""
    found = mobility(system, solution.end, args, t=t)
    if not found.redundant:
        return ""
    rows = ", ".join(map(str, found.redundant))
    return (
        f"Where it came to a stop, row {rows} of the constraints (counted from 0, joints "
        "first) depends on the others. "
    )
