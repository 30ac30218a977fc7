"""Runs that are watched, interrupted, written to a file and continued.

They are made piece by piece, and are on the host between two pieces.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._programs import at_top_level, checksum, digest, is_known
from .._progress import check_progress, Line, Progress
from .._results import RESULTS
from .._types import Scalar
from .pieces import begin_run, Carry, finish_run, piece
from .saving import Begin, Record
from .solution import Continuation, first_rows, Solution
from .solution_file import load, save
from .task import Task


# A piece takes about so long (seconds): short enough to be watched and interrupted, and
# long beside the millisecond between two pieces.
_SECONDS_OF_A_PIECE = 0.5
_FIRST_ATTEMPTS = 64
# Writing takes at most this part of the time.
_PART_FOR_WRITING = 0.05


class _RunSoFar(NamedTuple):
    """A run so far: its start, tables of closed groups, and what the next step needs."""

    begin: Begin
    closed: tuple[Record, ...]
    carry: Carry


class _LongRun:
    """A run with its programs, which are compiled here.

    `num_rows` is the number of rows of the whole run.
    """

    def __init__(self, task: Task, num_rows: int):
        self._task = task._replace(plan=task.plan.unlimited())
        self._max_attempts = task.plan.max_attempts
        self._num_rows = num_rows
        task = self._task
        _check_alone(at_top_level(task))
        begin, carry = begin_run(task)
        # A number in the closure of a function of the system can be traced too.
        _check_alone(is_known((begin, carry)))
        begin, carry = jax.device_get((begin, carry))
        program = piece.program(task, carry, np.array(0))
        self._fingerprint = _fingerprint(task, digest(program))
        carry, table = self._made(carry, 0)
        self.first = _RunSoFar(begin, (table,), carry)

    def continued(self, solution: Solution, name: str) -> _RunSoFar:
        """The run so far, from the solution that `name` stands for."""
        known = solution.continuation
        if known is None:
            raise ValueError(
                f"{name} is a solution without what the next step needs. Only runs with "
                "`progress`, `checkpoint` or `resume` keep it: repeat the run with one of "
                "these, or start a new run from `solution.end`."
            )
        other = [key for key, word in self._fingerprint if dict(known.run).get(key) != word]
        if other:
            raise ValueError(
                f"{name} is part of another run (different: {', '.join(other)}). Only the "
                "end can be another: pass the same arguments to `simulate`, and use the "
                "same versions of the libraries. (`program` stands for the functions of "
                "the system, the scheme, `saveat`, `root_finder` and `max_halvings`.)"
            )
        structure = jax.tree.structure((self.first.begin, *self.first[1], self.first.carry))
        begin, table, carry = jax.tree.unflatten(structure, map(np.asarray, known.numbers))
        sofar = _RunSoFar(begin, (table,), carry)
        if carry.progress.place > self._task.plan.last:
            raise ValueError(
                f"{name} is longer than this run: it has made {_completed(sofar)} steps. "
                "`num_steps` and `t1` tell where the whole run ends, from its start on."
            )
        return sofar

    def is_finished(self, sofar: _RunSoFar) -> bool:
        progress = sofar.carry.progress
        failed = bool(progress.result != RESULTS.successful)
        arrived = bool(progress.place >= self._task.plan.last)
        return failed or arrived or self.attempts(sofar) >= self._max_attempts

    def attempts(self, sofar: _RunSoFar) -> int:
        """The number of attempted steps."""
        rejected = self._task.plan.num_rejected(sofar.carry.progress.memory)
        return _completed(sofar) + int(0 if rejected is None else rejected)

    def go_on(self, sofar: _RunSoFar, attempts: int) -> _RunSoFar:
        """The run after so many more attempts, or fewer."""
        attempts = min(attempts, self._max_attempts - self.attempts(sofar))
        carry, table = self._made(sofar.carry, attempts)
        return _RunSoFar(sofar.begin, (*sofar.closed, table), carry)

    def _made(self, carry: Carry, attempts: int) -> tuple[Carry, Record]:
        carry, table, count = jax.device_get(piece(self._task, carry, np.array(attempts)))
        # Copies: on CPUs a view would keep the memory of the whole table.
        return carry, jax.tree.map(lambda x: np.array(x[:count]), table)

    def times(self, sofar: _RunSoFar) -> tuple[float, float]:
        """The time since the start that is reached, and that of the end."""
        plan = self._task.plan
        unit = float(plan.unit)
        return unit * float(sofar.carry.progress.place), unit * float(plan.last)

    def solution(self, sofar: _RunSoFar) -> tuple[Solution, Scalar]:
        """The solution so far, and the time that is reached; later rows are NaN."""
        table = jax.tree.map(lambda *x: np.concatenate(x), *sofar.closed)
        count = table.place.size
        # Runs of other lengths share the program.
        size = 1 << max(self._num_rows - 2, count).bit_length()
        padded = jax.tree.map(
            lambda x: np.concatenate([x, np.zeros((size - count, *x.shape[1:]), x.dtype)]),
            table,
        )
        used_up = self.attempts(sofar) >= self._max_attempts
        cause = RESULTS.out_of_steps if used_up else RESULTS.interrupted
        solution, reached = finish_run(
            self._task, sofar.begin, padded, jnp.array(count), sofar.carry, cause
        )
        if solution.ts.size > self._num_rows:
            solution = first_rows(solution, self._num_rows)
        numbers = jax.tree.leaves((sofar.begin, table, sofar.carry))
        continuation = Continuation(tuple(numbers), self._fingerprint)
        none = lambda solution: solution.continuation
        kept = eqx.tree_at(none, solution, continuation, is_leaf=lambda x: x is None)
        return kept, reached


def _check_alone(is_alone: bool) -> None:
    if not is_alone:
        raise ValueError(
            "`progress`, `checkpoint` and `resume` are for single runs: between two pieces "
            "the run is in Python, where `jit`, `vmap`, `grad` and `jvp` cannot follow. "
            "Leave them out inside of these. (`ej.sweep` reports and resumes many runs.)"
        )


def _completed(sofar: _RunSoFar) -> int:
    return int(sofar.carry.progress.completed)


def _fingerprint(task: Task, program: str) -> tuple[tuple[str, str], ...]:
    """One word for each property of a run that must not change when it is continued."""
    parts = dict(
        system=task.system,
        scheme=task.scheme,
        start=task.start,
        args=task.args,
        steps=task.plan.numbers,
        saveat=(task.saving, task.fn),
        root_finder=task.root_finder,
    )
    words = [("program", program)]
    for name, part in parts.items():
        arrays = filter(eqx.is_array_like, jax.tree.leaves(part))
        words.append((name, checksum(map(np.asarray, arrays))))
    return tuple(words)


class LongRunOptions(NamedTuple):
    """The checked arguments of `simulate` by which a run is made piece by piece."""

    progress: Progress
    checkpoint: "_Checkpoint | None"
    resume: Solution | None


class _Checkpoint:
    """A file with the run so far, and how often it is written (seconds)."""

    def __init__(self, path: Path, pause: float):
        self.path = path
        self._pause = pause
        self._next = -float("inf")

    @property
    def is_due(self) -> bool:
        return time.monotonic() >= self._next

    def write(self, solution: Solution) -> None:
        begin = time.monotonic()
        save(self.path, solution)
        now = time.monotonic()
        self._next = now + max(self._pause, (now - begin) / _PART_FOR_WRITING)


def checked_options(
    progress: Any, checkpoint: Any, checkpoint_seconds: Any, resume: Any
) -> LongRunOptions | None:
    """The checked arguments, or `None` for a run in one piece."""
    check_progress(progress)
    if not (resume is None or isinstance(resume, Solution)):
        raise TypeError(
            f"`resume` must be a `Solution`, got {type(resume).__name__}. `enerjax.load` "
            "reads one from a file."
        )
    seconds = np.asarray(checkpoint_seconds)
    if seconds.shape != () or seconds.dtype.kind not in "iuf" or not seconds >= 0:
        raise ValueError(
            "`checkpoint_seconds` must be a number of seconds, not negative, got "
            f"{checkpoint_seconds!r}."
        )
    file = None
    if checkpoint is not None:
        path = Path(checkpoint)
        if path.is_dir() or not path.absolute().parent.is_dir():
            raise ValueError(
                f"`checkpoint` must be a file name in an existing folder, got {path}."
            )
        file = _Checkpoint(path, float(seconds))
    if progress is False and file is None and resume is None:
        return None
    return LongRunOptions(progress, file, resume)


def run_long(task: Task, num_rows: int, options: LongRunOptions) -> tuple[Solution, Scalar]:
    """The solution and the time that it has reached; partial if the run was interrupted."""
    run, file = _LongRun(task, num_rows), options.checkpoint
    sofar, in_file = run.first, None
    if file is not None and file.path.exists():
        # The file may be further than the solution that this run was continued from.
        sofar = in_file = run.continued(load(file.path), f"The file {file.path}")
    elif options.resume is not None:
        sofar = run.continued(options.resume, "`resume`")
    report, attempts = _reporter(run, options.progress), _FIRST_ATTEMPTS
    try:
        while not run.is_finished(sofar):
            if file is not None and file.is_due and sofar is not in_file:
                file.write(run.solution(sofar)[0])
                in_file = sofar
            begin, before = time.perf_counter(), run.attempts(sofar)
            sofar = run.go_on(sofar, attempts)
            speed = (run.attempts(sofar) - before) / (time.perf_counter() - begin)
            attempts = min(max(int(speed * _SECONDS_OF_A_PIECE), 1), 4 * attempts)
            report(sofar)
    except KeyboardInterrupt:
        # The result of the solution tells.
        if isinstance(report, _Bar):
            report.end(sofar)
    solution, reached = run.solution(sofar)
    if file is not None and sofar is not in_file:
        file.write(solution)
    return solution, reached


def _reporter(run: _LongRun, progress: Progress) -> Callable[[_RunSoFar], None]:
    if callable(progress):
        return lambda sofar: progress(*run.times(sofar))
    return _Bar(run) if progress else lambda sofar: None


class _Bar:
    """How far a run is, and how long it may still take, on one line."""

    def __init__(self, run: _LongRun):
        self._run = run
        self._line = Line(pause=10.0)
        self._begin: tuple[float, float] | None = None

    def __call__(self, sofar: _RunSoFar) -> None:
        self._show(sofar, self._run.is_finished(sofar))

    def end(self, sofar: _RunSoFar) -> None:
        """Ends the line of an interrupted run."""
        self._show(sofar, is_last=True)

    def _show(self, sofar: _RunSoFar, is_last: bool) -> None:
        (done, whole), now = self._run.times(sofar), time.monotonic()
        if self._begin is None:
            # Speed is measured from here: a run that is continued did not start now.
            self._begin = now, done
        begin, before = self._begin
        text = (
            f"{100 * done / whole:3.0f} % [{'#' * int(20 * done / whole):20}] "
            f"time {done:.5g} of {whole:.5g}, {_completed(sofar):,} steps"
        )
        if is_last:
            text += f", {_clock(now - begin)} passed"
        elif done > before:
            left = (now - begin) * (whole - done) / (done - before)
            text += f", {_clock(left)} left"
        self._line.show(text, is_last)


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(min(seconds, 1e9)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
