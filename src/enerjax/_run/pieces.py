"""The compiled programs of a run that is made piece by piece.

One program makes a piece of any number of steps, so steps do not depend on where a run was
cut: each is computed by the same instructions from the same numbers. What a row adds up
over steps is added step by step, for the same reason.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._programs import compiled, in_one_function, Readable
from .._results import first_failure, RESULTS
from .._types import Count, Flag, Scalar
from ..schemes import Energies
from .halving import select
from .loop import Attempt, Progress, Stepper
from .saving import Begin, Costs, Record, RecordedRun, Standing
from .solution import Solution
from .task import Task


# The memory for the rows of one piece (bytes).
_ROOM = 2**22


class Group(eqx.Module):
    """The steps since the last row: sums as in `Record`, of a group that is still open.

    - `begin`: the place where the group begins.
    - `accepted`: the number of accepted steps.
    """

    begin: Scalar
    accepted: Count
    details: PyTree[Any]
    energies: Energies
    costs: Costs

    def after(self, attempt: Attempt) -> "Group":
        """The group with another attempted step."""
        newest = lambda new, old: jnp.where(attempt.accepted, new, old)
        return Group(
            begin=self.begin,
            accepted=self.accepted + attempt.accepted.astype(self.accepted.dtype),
            details=jax.tree.map(newest, attempt.details, self.details),
            energies=jax.tree.map(jnp.add, self.energies, attempt.energies),
            costs=self.costs.with_more(attempt.costs),
        )

    def empty(self, begin: Scalar) -> "Group":
        """The next group, without steps."""
        zeros = jax.tree.map(jnp.zeros_like, self)
        return eqx.tree_at(lambda group: group.begin, zeros, begin)


class Carry(eqx.Module):
    """What one piece passes to the next."""

    progress: Progress
    group: Group


@compiled
def begin_run(task: Task) -> tuple[Begin, Carry]:
    """The start of a run."""
    stepper = task.stepper()
    model = stepper.model
    progress = stepper.begin(model.to_internal(task.start))
    kept = task.keep(model)(progress.state, progress.place)
    _, attempt = jax.eval_shape(stepper.attempt, progress, jnp.array(True))
    group = Group(
        begin=progress.place,
        accepted=jnp.array(0),
        details=_zeros(attempt.details),
        energies=_zeros(attempt.energies),
        costs=_zeros(attempt.costs),
    )
    return Begin(kept, progress.multipliers), Carry(progress, group)


def _zeros(like: PyTree[Any]) -> PyTree[Array]:
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)


def _piece(task: Task, carry: Carry, attempts: Count) -> tuple[Carry, Record, Count]:
    """The run after some more attempts, or fewer if the memory for rows is full.

    It returns a table of closed groups, and the number of groups in it.
    """
    stepper = task.stepper()
    like = jax.eval_shape(lambda: _record(task, stepper, carry))
    size = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(like))
    capacity = max(_ROOM // size, 1)
    empty = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), like)

    def goes_on(progress: Progress, tried: Count) -> Flag:
        good = progress.result == RESULTS.successful
        return good & (progress.place < task.plan.last) & (tried < attempts)

    def one_step(state: tuple[Carry, Count]) -> tuple[Carry, Count]:
        before, tried = state
        progress, attempt = stepper.attempt(before.progress, jnp.array(True))
        return Carry(progress, before.group.after(attempt)), tried + 1

    def one_group(state: tuple[Any, ...]) -> tuple[Any, ...]:
        before, tried, table, count = state
        is_open = lambda x: ~_is_due(task, x[0]) & goes_on(x[0].progress, x[1])
        after, tried = jax.lax.while_loop(is_open, one_step, (before, tried))
        # The last group stays open: a longer run would have made another row of it.
        closed = _is_due(task, after) & (after.progress.place < task.plan.last)
        table = _with_row(table, _record(task, stepper, after), count)
        group = select(closed, after.group.empty(after.progress.place), after.group)
        count = count + closed.astype(count.dtype)
        return Carry(after.progress, group), tried, table, count

    def run(carry: Carry) -> tuple[Carry, Record, Count]:
        more = lambda x: goes_on(x[0].progress, x[1]) & (x[3] < capacity)
        first = carry, jnp.array(0), empty, jnp.array(0)
        carry, _, table, count = jax.lax.while_loop(more, one_group, first)
        return carry, table, count

    return in_one_function(run)(carry)


piece = Readable(_piece)


def _is_due(task: Task, carry: Carry) -> Flag:
    """Whether the open group is complete."""
    progress, group, plan = carry.progress, carry.group, task.plan
    end, _ = plan.next(progress.memory, progress.place)
    standing = Standing(progress.completed, group.begin, progress.place, end)
    return (group.accepted > 0) & task.saving.is_due(plan, standing)


def _record(task: Task, stepper: Stepper, carry: Carry) -> Record:
    """The record of the open group."""
    progress, group = carry.progress, carry.group
    return Record(
        kept=task.keep(stepper.model)(progress.state, progress.place),
        multipliers=progress.multipliers,
        details=group.details,
        energies=group.energies,
        costs=group.costs,
        place=progress.place,
        reached=group.accepted > 0,
    )


def _with_row(table: Record, row: Record, number: Count) -> Record:
    put = lambda rows, x: jax.lax.dynamic_update_index_in_dim(rows, x, number, 0)
    return jax.tree.map(put, table, row)


@compiled
def finish_run(
    task: Task, begin: Begin, table: Record, count: Count, carry: Carry, cause: RESULTS
) -> tuple[Solution, Scalar]:
    """The solution of a run so far, and the time that it has reached.

    The first `count` rows of the table are closed groups. `cause` tells why the run has not
    reached its end, if it has not and no step has failed.
    """
    stepper, plan = task.stepper(), task.plan
    progress, group = carry.progress, carry.group
    model, arrived = stepper.model, progress.place >= plan.last
    is_whole = (progress.result == RESULTS.successful) & (arrived | _is_due(task, carry))
    # A group of equal steps that is cut off has no row. Groups of steps of any length have.
    reached = (group.accepted > 0) & (is_whole | (not task.saving.keeps_rows))
    last = eqx.tree_at(lambda x: x.reached, _record(task, stepper, carry), reached)
    table = _with_row(table, last, count)
    saving = task.saving.of_groups()
    rows = saving.rows(
        RecordedRun(
            model=model.in_rates,
            plan=plan,
            begin=begin,
            record=table,
            completed=jnp.sum(table.reached),
            order=task.scheme.order,
        )
    )
    outcome = RESULTS.where(arrived, RESULTS.successful, cause)
    result = first_failure(progress.result, outcome)
    end = eqx.tree_at(lambda x: x.result, progress, result)
    return task.solution(model, rows, end), plan.time(progress.place)
