"""The loop over the steps of a run."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._operators import AbstractModel
from .._results import first_failure, RESULTS
from .._solvers import RootFinder
from .._system import State
from .._types import Count, Flag, Multipliers, Scalar
from ..schemes import AbstractScheme, Energies
from .halving import select
from .reverse import keep_roots, loops
from .saving import Begin, Costs, Record, with_time
from .step import advance, first_warm, Warm
from .step_sizes import AbstractPlan


class Progress(eqx.Module):
    """The carry of the loop over the steps; after a failure, that of the last good step."""

    state: State
    warm: Warm
    place: Scalar
    memory: PyTree[Any]
    result: RESULTS
    completed: Count
    multipliers: Multipliers


class Stepper(eqx.Module):
    """What all steps of a run have in common."""

    scheme: AbstractScheme
    model: AbstractModel
    plan: AbstractPlan
    root_finder: RootFinder
    max_halvings: int | None = eqx.field(static=True)

    def begin(self, start: State) -> Progress:
        """The carry at the start of a run; `start` is a state of the model."""
        scheme, model, plan = self.scheme, self.model, self.plan
        acceleration, multipliers = model.accelerations(start)
        h = plan.unit * plan.first()
        place = jnp.zeros_like(plan.last)
        timed = with_time(model, plan, start, place)
        return Progress(
            state=State(start.q, start.v),
            warm=first_warm(scheme, model, start, h, acceleration, multipliers),
            place=place,
            memory=plan.begin(model.in_rates, model.to_rates(timed)),
            result=_check_start(scheme, model, timed, h),
            completed=jnp.array(0),
            multipliers=multipliers,
        )

    def attempt(self, before: Progress, live: Flag) -> tuple[Progress, "Attempt"]:
        """Attempts one step. If `live` is false nothing changes, at no cost."""
        model, plan = self.model, self.plan
        place, length = plan.next(before.memory, before.place)
        # A step that is not live gets a positive length, so that no derivative is NaN.
        length = jnp.where(live, length, plan.first())
        begin = with_time(model, plan, before.state, before.place)
        out = advance(
            self.scheme,
            model,
            begin,
            plan.unit * length,
            plan.warm(before.memory, before.warm, length),
            self.root_finder,
            ~live,
            self.max_halvings,
        )
        ends = model.to_rates(begin), model.to_rates(out.state)
        verdict = plan.judge(before.memory, model.in_rates, ends, out.result, length)
        good = live & verdict.accepted
        result = RESULTS.where(live, verdict.result, RESULTS.successful)
        keep = lambda new, old: select(good, new, old)
        after = Progress(
            state=keep(State(out.state.q, out.state.v), before.state),
            warm=keep(plan.kept(out.warm, before.warm), before.warm),
            place=keep(place, before.place),
            memory=select(live, verdict.memory, before.memory),
            result=first_failure(before.result, result),
            completed=before.completed + good.astype(before.completed.dtype),
            multipliers=keep(out.multipliers, before.multipliers),
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


class Attempt(eqx.Module):
    """The report of one attempted step; the energies of a rejected one are zero."""

    energies: Energies
    details: PyTree[Any]
    costs: Costs
    accepted: Flag


def run_loop(
    stepper: Stepper,
    start: State,
    steps_in_group: int,
    keep: Callable[[State, Scalar], PyTree[Any]],
) -> tuple[Begin, Progress, Record]:
    """Runs all steps, in groups of `steps_in_group` attempts.

    `keep(state, place)` is kept of the state after each group.
    """
    plan = stepper.plan
    num_groups = -(-plan.max_attempts // steps_in_group)
    is_whole = num_groups * steps_in_group == plan.max_attempts

    def is_done(progress: Progress) -> Flag:
        failed = progress.result != RESULTS.successful
        done = failed | (progress.place >= plan.last)
        return done if is_whole else done | (progress.completed >= plan.max_attempts)

    over_groups, over_steps = loops(
        num_groups, steps_in_group, None if plan.is_counted else is_done
    )

    def one_step(progress: Progress, live: Flag) -> tuple[Progress, Attempt]:
        return stepper.attempt(progress, live & ~is_done(progress))

    def one_group(before: Progress, live: Flag) -> tuple[Progress, Record]:
        after, attempts = over_steps(keep_roots(one_step), before, steps_in_group, live)
        numbers = jnp.arange(steps_in_group)
        last = jnp.max(jnp.where(attempts.accepted, numbers, 0))
        return after, Record(
            kept=keep(after.state, after.place),
            multipliers=after.multipliers,
            details=jax.tree.map(lambda x: x[last], attempts.details),
            energies=jax.tree.map(jnp.sum, attempts.energies),
            costs=attempts.costs.total(),
            place=after.place,
            reached=jnp.any(attempts.accepted) & (after.result == RESULTS.successful),
        )

    begin = stepper.begin(start)
    kept = Begin(keep(begin.state, begin.place), begin.multipliers)
    end, record = over_groups(one_group, begin, num_groups, jnp.array(True))
    arrived = RESULTS.where(
        end.place >= plan.last, RESULTS.successful, RESULTS.out_of_steps
    )
    result = first_failure(end.result, arrived)
    return kept, eqx.tree_at(lambda x: x.result, end, result), record


def _check_start(
    scheme: AbstractScheme, model: AbstractModel, start: State, h: Scalar
) -> RESULTS:
    """Whether the start satisfies the constraints of the scheme, to half the digits.

    An error would stay in the energy balance of the first step. The displacement or
    velocity that would repair it is compared with that of a step, so the position of the
    origin does not matter.
    """
    scales, eps = model.scales, jnp.finfo(h.dtype).eps
    root = jnp.sqrt(model.energy_scale(start, h))
    # NaN compares false: such a start fails in its first step.
    tolerance = 1e2 * jnp.sqrt(eps) * root
    position = jnp.abs(model.constraint(start.q, start.t))
    rounding = 1e3 * eps * scales.constraint_size
    bad = jnp.any(position > h * tolerance * scales.constraint + rounding)
    if scheme.stage.formulation == "ggl":
        rate = jnp.abs(model.joint_rate(start.q, start.v, start.t))
        bad = bad | jnp.any(rate > tolerance * scales.constraint[: rate.size])
    return RESULTS.where(bad, RESULTS.inconsistent_start, RESULTS.successful)
