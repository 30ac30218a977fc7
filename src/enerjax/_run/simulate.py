"""Whole runs."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._programs import at_top_level, compiled
from .._solvers import Newton, RootFinder
from .._system import AbstractSystem, State
from .._types import Args, Real, Scalar
from ..schemes import AbstractScheme
from .audit import audit, Measures, measures
from .failure import explained_memory_error, raise_failure
from .inputs import check_halvings, prepare
from .loop import run_loop, Stepper
from .saving import AbstractSaving, RecordedRun, SaveAt, SaveFunction, saving_of
from .solution import first_rows, Solution, Statistics
from .step import model_for
from .step_sizes import AbstractController, AbstractPlan, EqualSteps, find_end


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
    throw: bool = True,
) -> Solution:
    """Integrate `num_steps` steps of length `h` from `start`, or until the time `t1`.

    `h`, the numbers of the scheme (`alpha`), `start` and all inexact leaves of `args` are
    traced: new values never recompile, and `vmap`, `grad`, `jvp` and `jit` work over each.
    Write a number that you want to change as `1.0`, not `1`: Python integers are part
    of the program. For derivatives with respect to the start, create the start inside the
    differentiated function with `initial_state`, so that it stays on the constraints.

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
      for systems with many unknowns, else 0, because it lengthens the compilation.
      `stats.halvings` shows where steps were divided.
    - `throw`: raise an error at the end of a failed run, which names the step, the time and
      the cause (under `jit`, `vmap` and `grad` only the cause, and for all lanes at once).
      With `False` check `result`: rows after the failure are NaN.

    **Returns:** a `Solution`.

    **Raises:** `ValueError` or `TypeError` for bad input, before any step;
    `equinox.EquinoxRuntimeError` for a failed run if `throw`.
    """
    if not isinstance(saveat, SaveAt):
        raise TypeError(f"`saveat` must be a `SaveAt`, got {saveat!r}.")
    check_halvings(max_halvings)
    start, args, step, begin = prepare(system, scheme, start, args, h, t0, root_finder)
    end = find_end(num_steps, t1, max_steps, controller, h, t0, step.dtype)
    plan = controller.plan(scheme, step, begin, end)
    saving = saving_of(saveat, plan, controller)
    task = _Task(
        system=system,
        scheme=scheme,
        start=start,
        args=args,
        plan=plan,
        saving=saving,
        fn=saveat.fn,
        root_finder=root_finder,
        max_halvings=max_halvings,
    )
    if at_top_level(task):
        task = dataclasses.replace(task, plan=plan.rounded_up())
    with explained_memory_error(plan.max_attempts):
        solution, reached = _run(task)
    if solution.ts.size > saving.num_rows(plan):
        solution = first_rows(solution, saving.num_rows(plan))
    if not throw:
        return solution
    equal = plan.unit if isinstance(controller, EqualSteps) else None
    return raise_failure(solution, system, args, reached, equal)


class _Task(eqx.Module):
    """The checked arguments of `simulate`."""

    system: AbstractSystem
    scheme: AbstractScheme
    start: State
    args: Args
    plan: AbstractPlan
    saving: AbstractSaving
    fn: SaveFunction | None
    root_finder: RootFinder
    max_halvings: int | None


@compiled
def _run(task: _Task) -> tuple[Solution, Scalar]:
    """The run, and the time that it has reached."""
    plan, saving, fn = task.plan, task.saving, task.fn
    model = model_for(task.scheme, task.system, task.start, task.args)

    def observe(state: State, t: Scalar) -> tuple[PyTree[Any], Measures]:
        """The user's form of a state, or the value of `fn`, and its part of the audit.

        The state is one of `model.in_rates`.
        """
        value: PyTree[Any] = model.in_rates.to_user(state)
        if fn is not None:
            value = jax.tree.map(jnp.asarray, fn(t, value, task.args))
        timed = State(state.q, state.v, t if task.system.is_timed else None)
        return value, measures(model.in_rates, timed)

    # With `fn` states are observed in the loop, so that they need not be stored. Otherwise
    # they are observed together after the loop, which is faster.
    in_loop = fn is not None and saving.keeps_rows

    def keep(state: State, place: Scalar) -> PyTree[Any]:
        kept = model.to_rates(state)
        return observe(kept, plan.time(place)) if in_loop else kept

    stepper = Stepper(
        scheme=task.scheme,
        model=model,
        plan=plan,
        root_finder=task.root_finder,
        max_halvings=task.max_halvings,
    )
    start = model.to_internal(task.start)
    begin, end, record = run_loop(stepper, start, saving.steps_in_group(plan), keep)
    run = RecordedRun(
        model=model.in_rates,
        plan=plan,
        begin=begin,
        record=record,
        completed=end.completed,
        order=task.scheme.order,
    )
    rows = saving.rows(run)
    ys, measured = rows.kept if in_loop else jax.vmap(observe)(rows.kept, rows.ts)
    solution = Solution(
        ts=rows.ts,
        ys=ys,
        multipliers=jax.vmap(model.user_multipliers)(rows.multipliers),
        details=rows.details,
        audit=audit(measured, rows.energies),
        stats=Statistics(
            newton_iterations=rows.costs.iterations,
            residual=rows.costs.residual,
            halvings=rows.costs.halvings,
            local_error=rows.costs.local_error,
            completed_steps=end.completed,
            rejected_steps=plan.num_rejected(end.memory),
        ),
        end=model.to_user(end.state),
        result=end.result,
    )
    return solution, plan.time(end.place)
