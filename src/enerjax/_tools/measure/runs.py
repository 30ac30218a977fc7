"""Runs of several schemes with several step lengths: errors, evaluations and times."""

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike
from typing_extensions import TypeAliasType

from ..._results import meanings, RESULTS
from ..._run import positive_integer, Solution
from ..._system import AbstractSystem, check_system, State
from ..._types import Args
from ...schemes import AbstractScheme
from .reference import extrapolated, from_data, Reals, Reference, Task, Values


Problem = TypeAliasType("Problem", tuple[AbstractSystem, State, Args])
Schemes = TypeAliasType("Schemes", Mapping[str, AbstractScheme])
ReferenceMotion = TypeAliasType(
    "ReferenceMotion", AbstractScheme | Sequence[ArrayLike] | None
)


@dataclasses.dataclass(frozen=True)
class Run:
    """The measurements of one run; those that are not known are NaN."""

    q: float = math.nan
    v: float = math.nan
    multipliers: float = math.nan
    energy: float = math.nan
    constraint: float = math.nan
    constraint_rate: float = math.nan
    evaluations: float = math.nan
    seconds: float = math.nan
    failure: str = ""


@dataclasses.dataclass(frozen=True)
class Runs:
    """All runs of a comparison, by scheme, the longest step first."""

    schemes: dict[str, AbstractScheme]
    steps: tuple[int, ...]
    h: Reals
    runs: dict[str, list[Run]]
    uncertainty: dict[str, float]

    def table(self, name: str) -> Reals:
        """One measurement of all runs, shape `(schemes, steps)`."""
        return np.array([[getattr(r, name) for r in runs] for runs in self.runs.values()])

    @property
    def failures(self) -> tuple[tuple[str, ...], ...]:
        return tuple(tuple(r.failure for r in runs) for runs in self.runs.values())


def measure(
    problem: Problem,
    schemes: Schemes,
    steps: Sequence[int],
    reference: ReferenceMotion,
    duration: float,
    t0: float,
    repeats: int,
) -> Runs:
    system, start, args = problem
    start, args, _ = check_system(system, start, args, t0)
    _check(schemes, duration)
    counts = tuple(sorted({positive_integer("steps", n) for n in steps}))
    if not counts:
        raise ValueError("`steps` is empty: give numbers of steps, such as [100, 200].")
    times, data = _times(reference, counts, float(duration), float(t0))
    task = Task(
        system=system,
        start=start,
        args=args,
        t0=float(t0),
        duration=float(duration),
        times=times,
    )
    for count in counts:
        task.rows(count)
    exact = _reference(task, reference, data, counts[-1])
    runs = {
        name: [_run(task, exact.values, scheme, n, repeats) for n in counts]
        for name, scheme in schemes.items()
    }
    h = duration / np.array(counts)
    return Runs(
        schemes=dict(schemes), steps=counts, h=h, runs=runs, uncertainty=exact.uncertainty
    )


def _check(schemes: Any, duration: float) -> None:
    good = isinstance(schemes, Mapping) and len(schemes) > 0
    if not good or not all(isinstance(s, AbstractScheme) for s in schemes.values()):
        raise TypeError(
            "`schemes` must be a dictionary of names and schemes, such as "
            f'{{"RATTLE": Rattle()}}; got {schemes!r}.'
        )
    if not 0 < duration < math.inf:
        raise ValueError(f"`duration` must be positive and finite, got {duration}.")


def _times(
    reference: ReferenceMotion, counts: tuple[int, ...], duration: float, t0: float
) -> tuple[Reals, list[Reals]]:
    """The times at which errors are measured, and the user's data at these times."""
    if reference is None or isinstance(reference, AbstractScheme):
        # If possible there are four times: at a single one an error may vanish by chance.
        parts = math.gcd(4, *counts)
        return t0 + duration * np.arange(1, parts + 1) / parts, []
    data = [np.asarray(x, float) for x in reference]
    if len(data) not in (2, 3) or data[0].ndim > 1:
        raise ValueError(
            "`reference` must be a scheme, or data (t, q) or (t, q, v) with the times t, "
            "q of shape (times, nq) and v of shape (times, nv)."
        )
    times = np.atleast_1d(data[0])
    return times, [np.atleast_2d(x) for x in data[1:]]


def _reference(
    task: Task, reference: ReferenceMotion, data: list[Reals], finest: int
) -> Reference:
    if not data:
        scheme = reference if isinstance(reference, AbstractScheme) else None
        return extrapolated(task, finest, scheme)
    for name, values, like in zip("qv", data, (task.start.q, task.start.v), strict=False):
        if values.shape != (task.times.size, like.size):
            raise ValueError(
                f"`{name}` of `reference` has shape {values.shape}; {task.times.size} "
                f"times and {like.size} entries of `{name}` in the start need "
                f"({task.times.size}, {like.size})."
            )
    return from_data(task, data[0], data[1] if len(data) == 2 else None)


def _run(
    task: Task, exact: Values, scheme: AbstractScheme, num_steps: int, repeats: int
) -> Run:
    # The first call compiles. A `ValueError` means that the scheme refuses the system: the
    # system itself has passed its checks.
    try:
        solution = task.run(scheme, num_steps)
    except ValueError as error:
        return Run(failure=f"refused: {_first_sentence(str(error))}")
    if solution.result != RESULTS.successful:
        at = task.t0 + int(solution.stats.completed_steps) * task.duration / num_steps
        return Run(failure=f"failed at t = {at:.4g}: {meanings(solution.result)}")
    seconds = [_timed(task, scheme, num_steps) for _ in range(repeats)]
    errors = _errors(task, exact, solution, num_steps)
    return Run(
        *map(_largest, errors),
        evaluations=float(np.sum(np.asarray(solution.stats.newton_iterations))),
        seconds=float(np.median(seconds)) if seconds else math.nan,
    )


def _errors(
    task: Task, exact: Values, solution: Solution, num_steps: int
) -> tuple[Reals, ...]:
    _, rows = task.rows(num_steps)
    at = lambda x: np.asarray(x)[rows]
    audit, energy = solution.audit, np.asarray(solution.audit.energy)
    return (
        at(solution.ys.q) - exact.q,
        at(solution.ys.v) - exact.v,
        at(solution.multipliers) - exact.multipliers,
        # A conserved energy is known better than that of any reference.
        at(energy) - exact.energy if task.system.is_timed else energy - energy[0],
        np.asarray(audit.constraint),
        np.asarray(audit.constraint_rate),
    )


def _timed(task: Task, scheme: AbstractScheme, num_steps: int) -> float:
    begin = time.process_time()
    task.run(scheme, num_steps)
    return time.process_time() - begin


def _largest(x: Reals) -> float:
    return float(np.max(np.abs(x))) if x.size > 0 else math.nan


def _first_sentence(message: str) -> str:
    return message.split(". ")[0].rstrip(".")
