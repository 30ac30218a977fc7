"""The error that a failed run raises."""

import contextlib
import re
from collections.abc import Iterator

import equinox as eqx
import jax
import numpy as np

from .._analysis import mobility
from .._programs import is_known, raising, values_of
from .._results import RESULTS
from .._system import AbstractSystem
from .._types import Args, Flag, Scalar
from .solution import Solution


def raise_failure(
    solution: Solution,
    failed: Flag,
    system: AbstractSystem,
    args: Args,
    reached: Scalar,
    h: Scalar | None = None,
) -> Solution:
    """Raises an error with step, time, cause and remedy for a failed run.

    Returned is the solution. Where it is traced, a failure raises when the program runs.

    `reached` is the time that the run has reached, `h` the length of its steps if all have
    the same.
    """
    # The values are known in a call inside of `jax.grad` too.
    is_failure = values_of(failed)
    if is_known(is_failure) and not is_failure:
        return solution
    known = values_of((solution, args, reached, h))
    if not is_known((is_failure, known)):
        return raising(lambda x: solution.result.error_if(x, failed), solution)
    solution, args, reached, h = known
    num_completed = int(solution.stats.completed_steps)
    begin = float(reached)
    if solution.result == RESULTS.interrupted:
        raise Interrupted(solution, num_completed, begin)
    when = f"at t = {begin:.6g}"
    if h is not None:
        when = f"from t = {begin:.6g} to {begin + float(h):.6g}"
    message = (
        f"The run failed in step {num_completed + 1}, {when}. {RESULTS[solution.result]} "
    )
    if solution.result == RESULTS.not_converged:
        # The failed step belongs to the last row with iterations.
        failed_row = np.flatnonzero(np.asarray(solution.stats.newton_iterations))[-1]
        residual = float(solution.stats.residual[failed_row])
        message += f"The scaled residual decreased to {residual:.1e}. "
    if solution.result in (RESULTS.not_converged, RESULTS.singular, RESULTS.nonfinite):
        message += _dependent_rows(system, solution, args, begin)
    raise eqx.EquinoxRuntimeError(message + "(`throw=False` returns the run up to there.)")


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in a run that is made piece by piece; `solution` is the run so far."""

    def __init__(self, solution: Solution, num_completed: int, t: float):
        super().__init__(
            f"The run was interrupted after step {num_completed}, at t = {t:.6g}. The same "
            "call with the same `checkpoint` makes the rest. Without a checkpoint the run "
            "so far is the attribute `solution` of this error (in a notebook "
            "`sys.last_value.solution`): pass it as `resume`."
        )
        self.solution = solution


@contextlib.contextmanager
def explained_memory_error(num_steps: int) -> Iterator[None]:
    """Replaces the error of JAX for exhausted memory by one that names the remedies."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if not re.search("RESOURCE_EXHAUSTED|Out of memory", str(error)):
            raise
        raise MemoryError(
            f"This run of {num_steps} steps does not fit into memory. Save fewer rows with "
            "`saveat=SaveAt(every=1000)`, or a function of the state with "
            "`SaveAt(fn=...)`. An even longer run can be divided into runs that each start "
            "from `solution.end` of the one before."
        ) from error


def _dependent_rows(
    system: AbstractSystem, solution: Solution, args: Args, t: float
) -> str:
    """A sentence about the redundant constraints in the last state, if there are any."""
    found = mobility(system, solution.end, args, t=t)
    if not found.redundant:
        return ""
    rows = ", ".join(map(str, found.redundant))
    return (
        f"In the last state, row {rows} of the constraints (counted from 0, joints first) "
        "depends on the others. "
    )
