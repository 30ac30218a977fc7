"""Whole runs."""

import dataclasses
import os
import sys
from collections.abc import Sequence
from typing import NamedTuple

from .._programs import at_top_level, compiled, in_one_function, values_of
from .._progress import Progress
from .._results import may_need_newton, RESULTS
from .._solvers import Newton, RootFinder
from .._system import AbstractSystem, State
from .._types import Args, Flag, Real, Scalar
from ..schemes import AbstractScheme
from .events import AbstractEvent
from .experience import Experience
from .failure import explained_memory_error, raise_failure
from .inputs import check_halvings, prepare
from .long_run import checked_options, run_long
from .loop import run_loop
from .saving import check_saveat, RecordedRun, SaveAt, saving_of, with_events
from .solution import first_rows, Solution
from .stage import is_chord_alone
from .step_sizes import AbstractController, EqualSteps, find_end
from .task import Task
from .watcher import watcher_of
from .without_jacobian import chord_alone


def simulate(
    system: AbstractSystem,
    scheme: AbstractScheme,
    start: State,
    args: Args = None,
    *,
    h: Real,
    num_steps: int | None = None,
    t1: Real | None = None,
    t0: Real = 0.0,
    saveat: SaveAt = SaveAt(),
    controller: AbstractController = EqualSteps(),
    max_steps: int | None = None,
    root_finder: RootFinder = Newton(),
    max_halvings: int | None = None,
    events: AbstractEvent | Sequence[AbstractEvent] = (),
    max_events: int = 64,
    progress: Progress = False,
    checkpoint: str | os.PathLike | None = None,
    checkpoint_seconds: Real = 60.0,
    resume: Solution | None = None,
    throw: bool = True,
) -> Solution:
    """Integrate `num_steps` steps of length `h` from `start`, or until the time `t1`.

    `h`, the numbers of the scheme (`alpha`), `start` and all inexact leaves of `args` are
    traced: new values never recompile, and `vmap`, `grad`, `jvp` and `jit` work over each.
    Write a number that you want to change as `1.0`, not `1`: Python integers are part
    of the program. For derivatives with respect to the start, or to numbers in the
    constraints, such as lengths, create the start inside the differentiated function with
    `initial_state`, so that it stays on the constraints. With respect to a number in the
    constraints there is no derivative if the start does not move at all: it is infinite or
    NaN, and an error if it is the only one and outside of `jit` and `vmap`.

    **Arguments:**

    - `system`: the mechanical system; see `System`.
    - `scheme`: the integration scheme, such as `EnergyConsistent(0.5)`. There is no
      default, because the choice is part of the model.
    - `start`: a `State` that satisfies the constraints, such as that of `initial_state`.
    - `args`: any pytree, which is passed to the functions of the system.
    - `h`: length of a step (time), positive.
    - `num_steps`: the number of steps.
    - `t1`: the time of the end, in place of `num_steps`; traced. The number of steps is
      `(t1 - t0)/h`, rounded up except for round-off, and `h` is shortened to fit: lanes
      with different `h` end at the same time, in one program.
    - `t0`: the time of the start; step `k` begins at `t0 + k h`. Traced.
    - `saveat`: which states become the rows of the solution; see `SaveAt`. In reverse mode
      the solved unknowns of each step are stored too, up to 10^4 steps. Beyond, memory
      grows like the square root of the number of steps, at the cost of one more run.
    - `controller`: `EqualSteps()`, or with `t1` a `StepController(rtol, atol)` that varies
      the length of the steps, of which `h` is the first. Derivatives treat the chosen
      lengths as constant fractions of `t1 - t0`.
    - `max_steps`: with `t1`, a bound on the number of steps, including rejected ones; a run
      that needs more fails. The default is the number of steps if that is known, and 4096
      with a controller. Unused steps cost nothing; a batch ends with its last lane.
    - `root_finder`: solves the step equations, which are scaled to order one, so that
      tolerances are relative. Root finders and least-squares solvers of optimistix can be
      used too.
    - `max_halvings`: a failed step is repeated as 2, 4, up to `2 ** max_halvings` equal
      steps, for which the energy identity holds as well; 0 disables this. The default is 3
      for systems with many unknowns, else 0, because it lengthens the compilation. In
      derivatives, whose compilation it doubles, the default is 0: there a step that would
      be divided fails, unless you give a number. `stats.halvings` shows where steps were
      divided.
    - `events`: an `Event`, an `Impact`, or a list of them: zeros of functions of the state,
      at which a step ends exactly, and after which the state may be another one. They are
      listed in `Solution.events`, after those of the system. Every zero is found at
      which a function changes its sign between the ends of a step, and two zeros within a
      step if the function is as smooth as the motion: if between the zeros it exceeds the
      error of a cubic interpolation of the step.
    - `max_events`: the number of times at which events may happen; a run that needs more
      fails.
    - `progress`: `True` for a line on stderr that shows how far the run is, or a function
      that is called with the time that has passed in the motion and its duration.
    - `checkpoint`: a file in which the run so far is kept. If it exists, the run continues
      from there: after an interruption make the same call again. `load` reads it at any
      time.
    - `checkpoint_seconds`: how often the file is written (seconds of the clock). It is also
      written at the end, and rarer if writing takes long.
    - `resume`: a solution of the same run to an earlier end, whose steps are not repeated.
      The result is the same to the last bit as without `resume`. The other arguments must
      be the same, but for the end (`num_steps`, which counts all steps, or `t1` with equal
      steps) and `max_steps`.
    - `throw`: raise an error at the end of a failed run, which names the step, the time and
      the cause (under `jit`, `vmap` and `grad` only the cause, and for all lanes at once).
      With `False` check `result`: rows after the failure are NaN.

    A run with equal steps outside of `jit` and `vmap` is first made without Newton's
    method, whose program compiles for longer, and so are its derivatives. If a step needs
    it, the run is made again from its start, and `saveat.fn` is evaluated again. Later runs
    of the system then have Newton's method from the beginning; they agree to round-off.

    With `progress`, `checkpoint` or `resume` a run is made piece by piece. Its program is
    another one than that of a plain run, with which it agrees to round-off; among such runs
    equal steps are equal to the last bit. Ctrl-C then ends it after the current piece, in
    about half a second. These three are for single runs outside of `jit`, `vmap` and
    derivatives.

    **Returns:** a `Solution`.

    **Raises:** `ValueError` or `TypeError` for bad input, before any step;
    `equinox.EquinoxRuntimeError` for a failed run if `throw`. `KeyboardInterrupt` for an
    interrupted run that is made piece by piece, with the run so far as its attribute
    `solution`; without `throw` this is returned. `ValueError` for a file or solution of
    another run.
    """
    check_saveat(saveat)
    check_halvings(max_halvings)
    options = checked_options(progress, checkpoint, checkpoint_seconds, resume)
    prepared = prepare(system, scheme, start, args, h, t0, root_finder)
    system, start, args, step, begin, experience, is_checked = prepared
    end = find_end(num_steps, t1, max_steps, controller, h, t0, step.dtype)
    plan = controller.plan(scheme, step, begin, end)
    longest = plan.max_attempts if options is None else sys.maxsize
    saving = saving_of(saveat, plan, controller, longest)
    watcher = watcher_of(system, events, max_events, scheme, options is not None)
    if watcher is not None:
        saving = with_events(saving, plan)
        plan = plan.with_events(watcher.max_attempts)
    task = Task(
        system=system,
        scheme=scheme,
        start=start,
        args=args,
        plan=plan,
        saving=saving,
        fn=saveat.fn,
        root_finder=root_finder,
        max_halvings=max_halvings,
        watcher=watcher,
        is_checked=is_checked,
    )
    with explained_memory_error(plan.max_attempts):
        if options is None:
            solution, outcome = _whole(task, experience)
            reached, failed = outcome.reached, outcome.failed
        else:
            solution, reached = run_long(task, saving.num_rows(plan), options)
            failed = solution.result != RESULTS.successful
    if not throw:
        return solution
    equal = plan.unit if isinstance(controller, EqualSteps) else None
    return raise_failure(solution, failed, system, args, reached, equal)


class _Outcome(NamedTuple):
    """How a run has ended: the time that it has reached, and whether it has failed.

    - `needs_newton`: whether it may have failed for want of Newton's method.
    """

    reached: Scalar
    failed: Flag
    needs_newton: Flag


def _whole(task: Task, experience: Experience) -> tuple[Solution, _Outcome]:
    """A run in one piece."""
    plan, finder = task.plan, task.root_finder
    values = values_of(task)
    if at_top_level(values):
        finder = chord_alone(values, experience) or finder
        if values is task and task.watcher is None:
            plan = plan.rounded_up()
    solution, outcome, alone = _run(task._replace(plan=plan, root_finder=finder))
    if alone and values_of(outcome).needs_newton:
        solution, outcome, _ = _run(task._replace(plan=plan))
        if not values_of(outcome).failed:
            # Later runs of the system have Newton's method from the beginning.
            experience.needs_newton = True
    num_rows = task.saving.num_rows(task.plan)
    if solution.ts.size > num_rows:
        solution = first_rows(solution, num_rows)
    return solution, outcome


@compiled
def _run(task: Task) -> tuple[Solution, _Outcome, bool]:
    """The program of a run in one piece; also whether it leaves out the exact Jacobian."""
    alone: list[bool] = []

    def run() -> tuple[Solution, _Outcome]:
        solution, outcome, is_alone = _computed(task)
        alone.append(is_alone)
        return solution, outcome

    solution, outcome = in_one_function(run)()
    return solution, outcome, alone[0]


def _computed(task: Task) -> tuple[Solution, _Outcome, bool]:
    plan, saving, stepper = task.plan, task.saving, task.stepper()
    model = stepper.model
    start = model.to_internal(task.start)
    begin, end, record = run_loop(stepper, start, saving.steps_in_group(plan), task.keep)
    run = RecordedRun(
        model=model.in_rates,
        plan=plan,
        begin=begin,
        record=record,
        completed=end.completed,
        order=task.scheme.order,
    )
    rows = saving.rows(run)
    happened = task.events(model, record, rows.multipliers)
    solution = dataclasses.replace(task.solution(model, rows, end), events=happened)
    outcome = _Outcome(
        reached=plan.time(end.place),
        failed=end.result != RESULTS.successful,
        needs_newton=may_need_newton(end.result),
    )
    alone = is_chord_alone(task.root_finder, task.scheme.stage, model)
    return solution, outcome, alone
