"""Whole runs."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._operators import make_model
from .._solvers import Newton, RootFinder
from .._system import AbstractSystem, State
from .._types import Args, Real, Scalar
from ..schemes import AbstractScheme
from .audit import audit, Measures, measures
from .failure import memory_told, raise_failure
from .inputs import check_halvings, prepare
from .loop import run_loop, Stepper
from .saving import AbstractSaving, SaveAt, SaveFunction, saving_of
from .solution import Solution, Statistics
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
    of the program. For derivatives with respect to the start, make the start inside the
    differentiated function with `initial_state`, so that it stays on the constraints.

    **Arguments:**

    - `system`: what moves; see `System`.
    - `scheme`: how; see the schemes. There is no default: it is part of the model.
    - `start`: a `State` that satisfies the constraints, as `initial_state` makes it.
    - `args`: any pytree, handed to the functions of the system.
    - `h`: length of a step (time), positive.
    - `num_steps`: how many steps of the length `h` the run has.
    - `t1`: instead of this, the time of the end, traced. The number of steps is
      `(t1 - t0)/h`, rounded up but for round-off, and `h` is shortened to fit: lanes of
      different `h` end at the same time, in one program.
    - `t0`: the time of the start; step `k` begins at `t0 + k h`. Traced.
    - `saveat`: which states become the rows of the solution; see `SaveAt`. In reverse mode
      the solved unknowns of each step are stored too, up to 10^4 steps; beyond, memory
      grows like the square root of the steps, at the cost of one more run.
    - `controller`: `EqualSteps()`, or with `t1` a `StepController(rtol, atol)` that varies
      the steps; `h` is the first. Derivatives are those of the steps as they were chosen,
      as parts of `t1 - t0`.
    - `max_steps`: with `t1`, a bound on the steps, rejected ones included; a run that
      needs more fails. Without it the number of steps where it is known, and with a
      controller 4096. Steps that are left cost nothing; of a batch those after its last
      lane.
    - `root_finder`: for the step equations, which are scaled to order one (so tolerances
      are relative); one of optimistix can be given, or a solver of its for least squares.
    - `max_halvings`: a step that fails is tried again in 2, 4, up to `2 ** max_halvings`
      equal parts, in which the laws of the energy hold as in a whole one; 0 for never.
      Where it is not given: 3 for systems of many unknowns, else 0, for it makes the
      program longer. `stats.halvings` tells where it was needed.
    - `throw`: raise an error at the end of a run that failed, which names the step, the
      time and the cause (under `jit`, `vmap` and `grad` the cause alone, and for all
      lanes together). With `False` look at `result`: rows after the failure are NaN.

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
    task = _Task(
        system=system,
        scheme=scheme,
        start=start,
        args=args,
        plan=plan,
        saving=saving_of(saveat, plan, controller),
        fn=saveat.fn,
        root_finder=root_finder,
        max_halvings=max_halvings,
    )
    with memory_told(plan.max_attempts):
        solution, reached = _run(task)
    if not throw:
        return solution
    equal = plan.unit if isinstance(controller, EqualSteps) else None
    return raise_failure(solution, system, args, reached, equal)


class _Task(eqx.Module):
    """A run, checked: the arguments of `simulate`."""

    system: AbstractSystem
    scheme: AbstractScheme
    start: State
    args: Args
    plan: AbstractPlan
    saving: AbstractSaving
    fn: SaveFunction | None
    root_finder: RootFinder
    max_halvings: int | None


@eqx.filter_jit
def _run(task: _Task) -> tuple[Solution, Scalar]:
    """The run, and the time that it has reached."""
    plan, saving, fn = task.plan, task.saving, task.fn
    model = make_model(task.system, task.start, task.args)

    def observe(state: State, t: Scalar) -> tuple[PyTree[Any], Measures]:
        """What users are given of a state, and what the audit tells of it."""
        told: PyTree[Any] = model.to_user(state)
        if fn is not None:
            told = jax.tree.map(jnp.asarray, fn(t, told, task.args))
        timed = State(state.q, state.v, t if task.system.is_timed else None)
        return told, measures(model, timed)

    # A function of the state is evaluated in the loop, so that no states are stored;
    # without one all rows are judged together after the loop, which is faster.
    at_once = fn is not None and saving.keeps_rows

    def keep(state: State, place: Scalar) -> PyTree[Any]:
        return observe(state, plan.time(place)) if at_once else state

    stepper = Stepper(
        scheme=task.scheme,
        model=model,
        plan=plan,
        root_finder=task.root_finder,
        max_halvings=task.max_halvings,
    )
    start = model.to_internal(task.start)
    begin, end, record = run_loop(stepper, start, saving.steps_in_group(plan), keep)
    rows = saving.rows(model, plan, begin, record, end.completed, task.scheme.order)
    ys, told = rows.kept if at_once else jax.vmap(observe)(rows.kept, rows.ts)
    solution = Solution(
        ts=rows.ts,
        ys=ys,
        multipliers=rows.multipliers,
        details=rows.details,
        audit=audit(told, rows.energies),
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
