"""Runs that end at a time: the loop over their steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._operators import make_model
from .._results import first_failure, RESULTS
from .._solvers import RootFinder
from .._system import AbstractSystem, State
from .._types import Args, Count, Flag, Multipliers, Real, Scalar, Times
from ..schemes import AbstractScheme
from .audit import audit
from .controller import controlled, StepController
from .failure import raise_failure
from .inputs import prepare
from .pace import AbstractPace, EqualSteps, steps_that_fit
from .reverse import keep_roots, scan_until
from .rows import at_both_ends, at_steps, at_times, Run, Step
from .selection import check_start, select
from .solution import Solution, Statistics
from .step import advance, first_warm, Warm
from .times import bound_on_steps, check_times


class _Carry(eqx.Module):
    """What one attempt hands to the next; the last good state once the run has failed."""

    state: State
    warm: Warm
    # The part of the whole time that has passed.
    passed: Scalar
    memory: PyTree[Any]
    result: RESULTS
    completed: Count
    attempts: Count
    multipliers: Multipliers


# Steps that a controller may try, if nothing else is said.
MAX_STEPS = 4096


def simulate_until(
    system: AbstractSystem,
    scheme: AbstractScheme,
    start: State,
    args: Args,
    h: Real,
    times: tuple[Real, Any, Any],
    max_steps: int | None,
    controller: StepController | None,
    root_finder: RootFinder,
    max_halvings: int | None,
    throw: bool,
) -> Solution:
    """`simulate` with `times = t0, t1, ts`."""
    t0, t1, ts = times
    start, args, step, begin = prepare(system, scheme, start, args, h, t0, root_finder)
    end, rows = check_times(t0, t1, ts, step.dtype)
    if controller is None:
        needed = steps_that_fit(h, t0, t1, step.dtype)
        max_steps = bound_on_steps(max_steps, needed)
        pace = EqualSteps(jnp.asarray(needed, step.dtype))
    else:
        max_steps = bound_on_steps(max_steps, MAX_STEPS)
        pace = controlled(controller, scheme, step / (end - begin))
    solution, reached = _run(
        system,
        scheme,
        start,
        args,
        begin,
        end,
        rows,
        pace,
        root_finder,
        max_halvings,
        max_steps,
    )
    return raise_failure(solution, system, args, reached) if throw else solution


@eqx.filter_jit
def _run(
    system: AbstractSystem,
    scheme: AbstractScheme,
    start: State,
    args: Args,
    t0: Scalar,
    t1: Scalar,
    rows: Times | str | None,
    pace: AbstractPace,
    root_finder: RootFinder,
    max_halvings: int | None,
    max_steps: int,
) -> tuple[Solution, Scalar]:
    """The run, and the time that it has reached. `rows`: times, all steps or both ends."""
    model = make_model(system, start, args)
    start = model.enter(start)
    duration = t1 - t0
    first_h = duration * pace.first()
    acceleration, multipliers0 = model.accelerations(start)
    warm = first_warm(scheme, model, start, first_h, acceleration, multipliers0)

    def timed(state: State, passed: Scalar) -> State:
        """With the time, where time enters."""
        return State(state.q, state.v, t0 + duration * passed if system.is_timed else None)

    def attempt(carry: _Carry, live: Flag) -> tuple[_Carry, Step]:
        live = live & ~_done(carry)
        passed, length = pace.next(carry.memory, carry.passed, carry.completed)
        # A step that is not made has a length all the same: its derivatives are numbers.
        length = jnp.where(live, length, pace.first())
        begin, h = timed(carry.state, carry.passed), duration * length
        memory = pace.warm(carry.memory, carry.warm, length)
        out = advance(scheme, model, begin, h, memory, root_finder, ~live, max_halvings)
        verdict = pace.judge(carry.memory, model, begin, out, h, length)
        good = live & verdict.accepted
        reached = State(out.state.q, out.state.v)
        new = reached, pace.kept(out.warm, carry.warm), passed, out.multipliers
        old = carry.state, carry.warm, carry.passed, carry.multipliers
        state, left, passed, multipliers = select(good, new, old)
        result = RESULTS.where(live, verdict.result, RESULTS.successful)
        count = lambda flag: flag.astype(carry.completed.dtype)
        after = _Carry(
            state,
            left,
            passed,
            select(live, verdict.memory, carry.memory),
            first_failure(carry.result, result),
            carry.completed + count(good),
            carry.attempts + count(live),
            multipliers,
        )
        energies = jax.tree.map(lambda x: jnp.where(good, x, 0), out.energies)
        states = None if rows is None else (state, multipliers)
        costs = out.newton_iterations, out.residual, out.halvings, out.local_error
        costs = jax.tree.map(lambda x: jnp.where(live, x, 0), costs)
        return after, Step(states, out.details, energies, passed, good, costs)

    whole_start = timed(start, jnp.zeros_like(duration))
    none = jnp.array(0)
    begin = _Carry(
        State(start.q, start.v),
        warm,
        jnp.zeros_like(duration),
        pace.begin(model, whole_start),
        check_start(scheme, model, whole_start, first_h),
        none,
        none,
        multipliers0,
    )
    loop = scan_until(_done, max_steps)
    end, steps = loop(keep_roots(attempt), begin, jnp.ones((max_steps,), bool))
    missing = RESULTS.where(_done(end), RESULTS.successful, RESULTS.out_of_steps)
    result = first_failure(end.result, missing)
    run = Run(model, t0, t1, begin.state, multipliers0, steps, end.completed)
    if rows is None:
        failed = result != RESULTS.successful
        saved = at_both_ends(run, (end.state, end.multipliers), failed)
    elif isinstance(rows, str):
        saved = at_steps(run)
    else:
        saved = at_times(run, rows, scheme.order)
    ts, states, multipliers, details, energies = saved
    passed = (ts - t0) / duration
    rejected = None if isinstance(pace, EqualSteps) else end.attempts - end.completed
    solution = Solution(
        ts,
        jax.vmap(model.leave)(states),
        multipliers,
        details,
        audit(model, jax.vmap(timed)(states, passed), energies),
        Statistics(*steps.costs, completed_steps=end.completed, rejected_steps=rejected),
        model.leave(end.state),
        result,
    )
    return solution, t0 + duration * end.passed


def _done(carry: _Carry) -> Flag:
    return (carry.result != RESULTS.successful) | (carry.passed >= 1)
