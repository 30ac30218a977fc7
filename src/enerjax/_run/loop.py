"""The loop over the steps of a run."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._operators import AbstractModel
from .._programs import in_any_lane
from .._results import first_failure, RESULTS
from .._solvers import ChordAlone, Newton, RootFinder
from .._system import State
from .._types import Count, Flag, Multipliers, Scalar
from ..schemes import AbstractScheme, AbstractSchemeWithChord, Energies
from .event_search import Found, no_search, settle, Watch
from .halving import select
from .model import model_for
from .reverse import keep_roots, loops, moving
from .saving import Begin, Costs, Record, with_time
from .start_check import check_start
from .step import advance, first_warm, StepOutput, Warm
from .step_sizes import AbstractPlan, EqualPlan, Verdict
from .watcher import Happening, Watcher


class Progress(eqx.Module):
    """The carry of the loop over the steps; after a failure, that of the last good step.

    `watch` is `None` in a run without events, and `varying`, the part of the model that
    events change, in a run in which no event changes the model.
    """

    state: State
    warm: Warm
    place: Scalar
    memory: PyTree[Any]
    result: RESULTS
    completed: Count
    multipliers: Multipliers
    watch: Watch | None = None
    varying: PyTree[Any] = None


class Stepper(eqx.Module):
    """What all steps of a run have in common.

    `checked` is the outcome of checks before the first step.
    """

    scheme: AbstractScheme
    model: AbstractModel
    plan: AbstractPlan
    root_finder: RootFinder | ChordAlone
    max_halvings: int | None = eqx.field(static=True)
    watcher: Watcher | None = None
    checked: RESULTS = eqx.field(default_factory=lambda: RESULTS.successful)

    def model_at(self, progress: Progress) -> AbstractModel:
        """The model that events have left."""
        return eqx.combine(progress.varying, self.model)

    def begin(self, start: State) -> Progress:
        """The carry at the start of a run; `start` is a state of the model."""
        scheme, model, plan = self.scheme, self.model, self.plan
        h = plan.unit * plan.first()
        place = jnp.zeros_like(plan.last)
        timed = with_time(model, plan, start, place)
        watch = varying = opens = None
        if self.watcher is not None:
            t = plan.time(place)
            watch, varying, opens = self.watcher.begin(model, timed, t, h)
            model = eqx.combine(varying, model)
        result = first_failure(self.checked, check_start(scheme, model, timed, h))
        result = result if opens is None else first_failure(result, opens)
        acceleration, multipliers = model.accelerations(start)
        return Progress(
            state=State(start.q, start.v),
            warm=first_warm(scheme, model, start, h, acceleration, multipliers),
            place=place,
            memory=plan.begin(model.in_rates, model.to_rates(timed)),
            result=result,
            completed=jnp.array(0),
            multipliers=multipliers,
            watch=watch,
            varying=varying,
        )

    def attempt(self, before: Progress, live: Flag) -> tuple[Progress, "Attempt"]:
        """Attempts one step. If `live` is false nothing changes, at no cost."""
        model, plan = self.model, self.plan
        if self.watcher is not None:
            now = eqx.tree_at(lambda x: x.model, self, self.model_at(before))
            return attempt_with_events(now, self.watcher, before, live)
        place, length = plan.next(before.memory, before.place)
        # A step that is not live gets a positive length, so that no derivative is NaN.
        length = jnp.where(live, length, plan.first())
        begin = with_time(model, plan, before.state, before.place)
        out = self.advance(before, begin, length, live)
        ends = model.to_rates(begin), model.to_rates(out.state)
        verdict = plan.judge(before.memory, model.in_rates, ends, out.result, length)
        return _advanced(self, before, live, place, out, verdict)

    def advance(
        self, before: Progress, begin: State, length: Scalar, live: Flag
    ) -> StepOutput:
        """The step of a length, in units of the plan, from the state `begin`."""
        plan = self.plan
        return advance(
            self.scheme,
            self.model,
            begin,
            plan.unit * length,
            plan.warm(before.memory, before.warm, length),
            self.root_finder,
            ~live,
            self.max_halvings,
        )


class Attempt(eqx.Module):
    """The report of one attempted step; the energies of a rejected one are zero."""

    energies: Energies
    details: PyTree[Any]
    costs: Costs
    accepted: Flag
    happening: Happening | None = None


def _advanced(
    stepper: Stepper,
    before: Progress,
    live: Flag,
    place: Scalar,
    out: StepOutput,
    verdict: Verdict,
) -> tuple[Progress, Attempt]:
    """The run after an attempted step on which the plan has decided, and its report."""
    good = live & verdict.accepted
    result = RESULTS.where(live, verdict.result, RESULTS.successful)
    keep = lambda new, old: select(good, new, old)
    after = Progress(
        state=keep(State(out.state.q, out.state.v), before.state),
        warm=keep(stepper.plan.kept(out.warm, before.warm), before.warm),
        place=keep(place, before.place),
        memory=select(live, verdict.memory, before.memory),
        result=first_failure(before.result, result),
        completed=before.completed + good.astype(before.completed.dtype),
        multipliers=keep(out.multipliers, before.multipliers),
        watch=before.watch,
        varying=before.varying,
    )
    zero_unless = lambda flag, x: jnp.where(flag, x, jnp.zeros_like(x))
    return after, Attempt(
        energies=jax.tree.map(lambda x: zero_unless(good, x), out.energies),
        details=out.details,
        costs=Costs(
            iterations=zero_unless(live, out.newton_iterations),
            residual=zero_unless(live, out.residual),
            halvings=zero_unless(live, out.halvings),
            local_error=zero_unless(good, out.local_error),
        ),
        accepted=good,
    )


class _AttemptWithEvents(eqx.Module):
    """An attempted step and the search for events in it; see `settle`."""

    stepper: Stepper
    watcher: Watcher
    before: Progress
    length: Scalar
    live: Flag

    def run(self) -> tuple[StepOutput, Found]:
        before, plan, model = self.before, self.stepper.plan, self.stepper.model
        begin = with_time(model, plan, before.state, before.place)
        out = self.stepper.advance(before, begin, self.length, self.live)
        watch = before.watch
        assert watch is not None
        times = plan.time(before.place), plan.t0 + plan.unit * (before.place + self.length)
        values = self.watcher.values(model, out.state, times[1])
        constant = jax.lax.stop_gradient((begin, out.state)), jax.lax.stop_gradient(times)
        now = jax.lax.stop_gradient(values)
        extremum = self.watcher.extremum(model, *constant, watch, now)
        found = self.watcher.found(watch, values, self.length, extremum)
        return out, found


def attempt_with_events(
    stepper: Stepper, watcher: Watcher, before: Progress, live: Flag
) -> tuple[Progress, Attempt]:
    """Attempts one step, which is repeated with another length if it passes an event."""
    model, plan, watch = stepper.model, stepper.plan, before.watch
    assert watch is not None
    place, length = plan.next(before.memory, before.place)
    searching = watch.search.active
    length = jnp.where(searching, watch.search.length, length)
    length = jnp.where(live, length, plan.first())
    out, length, found = settle(_AttemptWithEvents(stepper, watcher, before, length, live))
    place = jnp.where(searching | jnp.any(found.happens), before.place + length, place)
    verdict = _judged(stepper, watcher, before, out, length, found)
    happens = found.happens & live & verdict.accepted
    t = plan.time(place)
    rest = watcher.rest(watch, plan.unit * plan.usual(before.memory), plan.least_hop)
    remade = lambda user, args: model_for(stepper.scheme, model.system, user, args)
    changed = watcher.after(model, out.state, t, happens, rest, remade)
    later = eqx.combine(changed.varying, model)
    failure = RESULTS.where(verdict.accepted, changed.result, RESULTS.successful)
    failure = first_failure(
        failure, _check_resets(stepper, watcher, later, changed.state, place, happens)
    )
    verdict = Verdict(
        accepted=verdict.accepted & (failure == RESULTS.successful),
        result=first_failure(verdict.result, failure),
        memory=_after_event(stepper, later, before, verdict, changed.state, place, happens),
    )
    without_time = lambda state: State(state.q, state.v)
    happening = Happening(
        happens=happens,
        before=without_time(model.to_rates(out.state)),
        after=without_time(later.to_rates(changed.state)),
        closed=watcher.closed(later),
    )
    energies = eqx.tree_at(
        lambda x: x.impact, out.energies, changed.lost, is_leaf=lambda x: x is None
    )
    multipliers = watcher.of_closed(model, before.state.q, out.multipliers)
    out = eqx.tree_at(
        lambda x: (x.state, x.energies, x.multipliers),
        out,
        (changed.state, energies, multipliers),
    )
    after, attempt = _advanced(stepper, before, live, place, out, verdict)
    search = select(found.searches & live, found.search, no_search(length.dtype))
    waiting = eqx.tree_at(lambda x: x.search, watch, search)
    moved = watcher.watch_after(watch, later, changed, t, found, happens)
    good = live & verdict.accepted
    after = eqx.tree_at(
        lambda x: (x.watch, x.varying),
        after,
        (
            select(good, moved, select(live, waiting, watch)),
            select(good, changed.varying, before.varying),
        ),
        is_leaf=lambda x: x is None,
    )
    return after, eqx.tree_at(
        lambda x: x.happening, attempt, happening, is_leaf=lambda x: x is None
    )


def _check_resets(
    stepper: Stepper,
    watcher: Watcher,
    model: AbstractModel,
    state: State,
    place: Scalar,
    happens: Array,
) -> RESULTS:
    """Whether the state after resets satisfies the constraints, as a start must."""
    if not watcher.resets.any():
        return RESULTS.successful
    plan = stepper.plan
    timed = with_time(model, plan, state, place)

    def is_bad() -> Flag:
        found = check_start(stepper.scheme, model, timed, plan.unit * plan.first())
        return found != RESULTS.successful

    was_reset = jnp.any(happens & watcher.resets)
    bad = jax.lax.cond(in_any_lane(was_reset), is_bad, lambda: jnp.array(False))
    bad = bad & was_reset
    return RESULTS.where(bad, RESULTS.inconsistent_reset, RESULTS.successful)


def _judged(
    stepper: Stepper,
    watcher: Watcher,
    before: Progress,
    out: StepOutput,
    length: Scalar,
    found: Found,
) -> Verdict:
    """The decision about an attempted step, which is repeated if a zero lies within."""
    model, plan, watch = stepper.model, stepper.plan, before.watch
    assert watch is not None
    begin = with_time(model, plan, before.state, before.place)
    ends = model.to_rates(begin), model.to_rates(out.state)
    verdict = plan.judge(before.memory, model.in_rates, ends, out.result, length)
    too_many = jnp.any(found.happens) & (watch.count >= watcher.max_events)
    result = RESULTS.where(too_many, RESULTS.too_many_events, found.result)
    result = RESULTS.where(verdict.accepted, result, RESULTS.successful)
    searches = verdict.accepted & found.searches
    return Verdict(
        accepted=verdict.accepted & ~found.searches & ~too_many,
        result=first_failure(verdict.result, result),
        memory=select(searches, before.memory, verdict.memory),
    )


def _after_event(
    stepper: Stepper,
    model: AbstractModel,
    before: Progress,
    verdict: Verdict,
    state: State,
    place: Scalar,
    happens: Array,
) -> PyTree[Any]:
    """The memory of the plan after a step, which an event may have ended."""
    plan = stepper.plan
    user = model.to_rates(with_time(model, plan, state, place))
    return plan.after_event(
        before.memory, verdict.memory, model.in_rates, user, jnp.any(happens)
    )


def run_loop(
    stepper: Stepper,
    start: State,
    steps_in_group: int,
    keep: Callable[[AbstractModel], Callable[[State, Scalar], PyTree[Any]]],
) -> tuple[Begin, Progress, Record]:
    """Runs all steps, in groups of `steps_in_group` attempts.

    `keep(model)(state, place)` is kept of the state after each group.
    """
    plan = stepper.plan
    num_groups = -(-plan.max_attempts // steps_in_group)
    is_whole = num_groups * steps_in_group == plan.max_attempts

    def is_done(progress: Progress) -> Flag:
        failed = progress.result != RESULTS.successful
        done = failed | (progress.place >= plan.last)
        if progress.watch is not None:
            done = done | progress.watch.ended
        return done if is_whole else done | (progress.completed >= plan.max_attempts)

    over_groups, over_steps = loops(
        num_groups, steps_in_group, None if plan.is_counted else is_done
    )

    def one_step(stepper: Stepper, progress: Progress, live: Flag):
        attempt = lambda progress, live: stepper.attempt(
            progress, live & ~is_done(progress)
        )
        return keep_roots(attempt)(progress, live)

    def one_group(stepper: Stepper, before: Progress, live: Flag):
        step = functools.partial(one_step, stepper)
        after, attempts = over_steps(step, before, steps_in_group, live)
        kept = keep(stepper.model_at(after))(after.state, after.place)
        return after, _record_of(after, attempts, kept)

    begin = stepper.begin(start)
    kept = Begin(
        kept=keep(stepper.model_at(begin))(begin.state, begin.place),
        multipliers=begin.multipliers,
        varying=begin.varying,
    )
    # Each step replaces the multipliers in the carry: the first ones need no derivatives.
    # JAX would compute these in every gradient, because the carry as a whole has some.
    first = begin.state, jax.lax.stop_gradient(begin.multipliers)
    found = lambda x: (x.state, x.multipliers)
    begin = eqx.tree_at(found, begin, moving(first, (stepper, begin)))
    group = functools.partial(one_group, stepper)
    end, record = over_groups(group, begin, num_groups, jnp.array(True))
    is_whole_run = end.place >= plan.last
    if end.watch is not None:
        is_whole_run = is_whole_run | end.watch.ended
    arrived = RESULTS.where(is_whole_run, RESULTS.successful, RESULTS.out_of_steps)
    result = first_failure(end.result, arrived)
    return kept, eqx.tree_at(lambda x: x.result, end, result), record


def _record_of(after: Progress, attempts: Attempt, kept: PyTree[Any]) -> Record:
    """The record of a group of attempted steps."""
    numbers = jnp.arange(attempts.accepted.size)
    last = jnp.max(jnp.where(attempts.accepted, numbers, 0))
    return Record(
        kept=kept,
        multipliers=after.multipliers,
        details=jax.tree.map(lambda x: x[last], attempts.details),
        energies=jax.tree.map(jnp.sum, attempts.energies),
        costs=attempts.costs.total(),
        place=after.place,
        reached=jnp.any(attempts.accepted) & (after.result == RESULTS.successful),
        happening=jax.tree.map(lambda x: x[last], attempts.happening),
        varying=after.varying,
    )


def dispensable_newton(
    root_finder: RootFinder | ChordAlone,
    scheme: AbstractScheme,
    plan: AbstractPlan,
    watcher: Watcher | None,
) -> Newton | None:
    """Newton's method of a run whose steps may be tried by the chord method alone, else
    `None`."""
    if (
        not (isinstance(root_finder, Newton) and root_finder.linear_solver is None)
        or not isinstance(scheme.stage, AbstractSchemeWithChord)
        or not isinstance(plan, EqualPlan)
        or watcher is not None
    ):
        return None
    return root_finder
