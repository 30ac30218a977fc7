"""Which states of a run become the rows of its `Solution`."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree
from typing_extensions import TypeAliasType

from .._operators import AbstractModel
from .._programs import is_known
from .._system import State
from .._types import Args, Count, Flag, Multipliers, Scalar, Times, Vector
from ..schemes import Energies
from .collocation import state_within
from .inputs import positive_integer
from .step_sizes import AbstractController, AbstractPlan, EqualSteps, NEAR
from .watcher import Happening


SaveFunction = TypeAliasType("SaveFunction", Callable[[Scalar, State, Args], PyTree[Any]])


class SaveAt(eqx.Module):
    """Which states of a run are saved. Pass at most one of `every`, `ts` and `t1`.

    By default a run of `num_steps` saves every step, and a run to a time `t1` saves its
    start and its end.

    **Arguments:**

    - `every`: save the start, every `every`-th step, and the end. If only a bound
      `max_steps` on the number of steps is known, there are rows for that many steps, and
      those that are not needed are NaN.
    - `ts`: save the states at these times, shape `(times,)`, ascending, within the run.
      Within a step the state is interpolated to the order of the scheme and projected onto
      the constraints. Memory grows with the number of steps.
    - `t1`: save the start and the end.
    - `fn`: a function `fn(t, state, args)` whose value, a pytree of arrays, is saved as
      `Solution.ys` in place of the state. In long runs of large systems it can keep only
      what is of interest.

    **Raises:** `ValueError` or `TypeError` for more than one choice, for an `every` that is
    not a positive integer, and for an `fn` that is not a function.
    """

    every: int | None = eqx.field(static=True, default=None)
    ts: Vector | None = None
    t1: bool = eqx.field(static=True, default=False)
    fn: SaveFunction | None = None

    def __check_init__(self):
        chosen = [name for name in ("every", "ts") if getattr(self, name) is not None]
        chosen += ["t1"] if self.t1 else []
        if len(chosen) > 1:
            raise ValueError(
                "`SaveAt` takes one of `every`, `ts` and `t1`, got "
                + " and ".join(f"`{name}`" for name in chosen)
                + ". (The rows of `every` always include the end of a run.)"
            )
        if self.every is not None:
            positive_integer("every", self.every)
        if not isinstance(self.t1, bool):
            raise TypeError(
                f"`SaveAt(t1=True)` saves the start and the end, got t1 = {self.t1!r}. "
                "Pass times as `SaveAt(ts=...)`."
            )
        if self.fn is not None and not callable(self.fn):
            raise TypeError(
                f"`fn` must be a function of (t, state, args), got {self.fn!r}."
            )


def _as_times(ts: Vector, plan: AbstractPlan) -> Times:
    """Requested times as an array, checked against the run."""
    t0, t1, dtype = plan.t0, plan.t1, plan.t0.dtype
    times = jnp.asarray(ts, dtype)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(
            f"`ts` must be a vector of times, shape (times,), got shape {times.shape}."
        )
    if is_known((t0, t1, ts)):
        first, last = float(t0), float(t1)
        room = 1e-6 * (last - first) if dtype == jnp.float32 else 1e-12 * (last - first)
        values = np.asarray(ts, float)
        inside = np.all((values >= first - room) & (values <= last + room))
        if not inside or np.any(np.diff(values) < 0):
            raise ValueError(
                f"`ts` must be ascending times from t0 = {t0} to t1 = {t1}, got {ts}."
            )
    return times


class Costs(eqx.Module):
    """The costs of steps; see `Statistics`."""

    iterations: Array
    residual: Array
    halvings: Array
    local_error: Array

    def total(self) -> "Costs":
        """The costs of all steps along the leading axis together."""
        return Costs(
            iterations=jnp.sum(self.iterations, axis=0),
            residual=jnp.max(self.residual, axis=0),
            halvings=jnp.max(self.halvings, axis=0),
            local_error=jnp.sum(self.local_error, axis=0),
        )

    def with_more(self, more: "Costs") -> "Costs":
        """The costs of these steps and of more steps together."""
        return Costs(
            iterations=self.iterations + more.iterations,
            residual=jnp.maximum(self.residual, more.residual),
            halvings=jnp.maximum(self.halvings, more.halvings),
            local_error=self.local_error + more.local_error,
        )


class Record(eqx.Module):
    """What the loop returns for each group of attempted steps, along a leading axis.

    - `kept`: what is kept of the state after the group.
    - `multipliers`: of the last step.
    - `details`: what the scheme reports of the last accepted step.
    - `energies`: sums over the accepted steps.
    - `costs`: of all attempted steps together.
    - `place`: how far the run has come, see `AbstractPlan`.
    - `reached`: whether a step of the group was accepted, and none failed.
    - `happening`: the events at the end of the group; `None` in a run without events.
    - `varying`: the part of the model that events change, after the group; `None` if they
      change none.
    """

    kept: PyTree[Any]
    multipliers: Float[Array, "groups nc"]
    details: PyTree[Any]
    energies: Energies
    costs: Costs
    place: Float[Array, " groups"]
    reached: Bool[Array, " groups"]
    happening: Happening | None = None
    varying: PyTree[Any] = None


class Begin(eqx.Module):
    """What is kept of the start of a run, the multipliers there, and the part of the model
    that events change."""

    kept: PyTree[Any]
    multipliers: Multipliers
    varying: PyTree[Any] = None


class RecordedRun(eqx.Module):
    """A run whose rows are still to be made: all that the loop has returned.

    `model` is that before events change it, for the states that are kept. `completed` steps
    were accepted; `order` is that of the scheme.
    """

    model: AbstractModel
    plan: AbstractPlan
    begin: Begin
    record: Record
    completed: Count
    order: int = eqx.field(static=True)


class Rows(eqx.Module):
    """The rows of a solution; `kept` are states, or the values of `SaveAt(fn=...)`."""

    ts: Times
    kept: PyTree[Any]
    multipliers: Float[Array, "times nc"]
    details: PyTree[Any]
    energies: Energies
    costs: Costs
    varying: PyTree[Any] = None


class Standing(eqx.Module):
    """Where a run stands between two steps; the places are those of `AbstractPlan`.

    - `completed`: the number of accepted steps.
    - `begin`: the place where the group of steps began that is not closed yet.
    - `place`: the place that is reached.
    - `next`: the place where the next step is going to end.
    """

    completed: Count
    begin: Scalar
    place: Scalar
    next: Scalar


class AbstractSaving(eqx.Module):
    """How rows are made from the states that the loop keeps.

    `keeps_rows` tells whether these states are the rows.
    """

    keeps_rows: ClassVar[bool]

    @abc.abstractmethod
    def steps_in_group(self, plan: AbstractPlan) -> int:
        """The number of attempted steps between two states that are kept."""

    @abc.abstractmethod
    def num_rows(self, plan: AbstractPlan) -> int:
        """The number of rows of a run with this plan."""

    @abc.abstractmethod
    def rows(self, run: RecordedRun) -> Rows:
        """The rows; those that the run did not reach are NaN."""

    @abc.abstractmethod
    def is_due(self, plan: AbstractPlan, standing: Standing) -> Flag:
        """Whether the open group must end here, in a run whose groups have any length."""

    @abc.abstractmethod
    def of_groups(self) -> "AbstractSaving":
        """The saving that makes the same rows of groups that ended where they were due."""


def check_saveat(saveat: Any) -> None:
    if not isinstance(saveat, SaveAt):
        raise TypeError(f"`saveat` must be a `SaveAt`, got {saveat!r}.")


def saving_of(
    saveat: SaveAt, plan: AbstractPlan, controller: AbstractController, max_every: int
) -> AbstractSaving:
    """The saving of a run; steps between rows that exceed `max_every` are not needed."""
    if saveat.ts is not None:
        return _AtTimes(_as_times(saveat.ts, plan))
    if saveat.t1 or (saveat.every is None and not plan.is_counted):
        return _AtBothEnds()
    every = 1 if saveat.every is None else positive_integer("every", saveat.every)
    if isinstance(controller, EqualSteps):
        return _EveryEqualStep(min(every, max_every))
    return _EveryAcceptedStep(min(every, max_every))


def with_events(saving: AbstractSaving, plan: AbstractPlan) -> AbstractSaving:
    """The saving of the same rows in a run whose steps may end early."""
    if isinstance(saving, _AtBothEnds | _EveryEqualStep):
        every = getattr(saving, "every", plan.max_attempts)
        return _AtGrid(every, plan.max_attempts)
    return saving


class _AtBothEnds(AbstractSaving):
    """The start and the end."""

    keeps_rows = True

    def steps_in_group(self, plan: AbstractPlan) -> int:
        return plan.max_attempts

    def num_rows(self, plan: AbstractPlan) -> int:
        return 2

    def rows(self, run: RecordedRun) -> Rows:
        plan, record = run.plan, run.record
        at_end = record.reached & (record.place >= plan.last)
        return _after_start(run.begin, record, at_end, jnp.stack([plan.t0, plan.t1]))

    def is_due(self, plan: AbstractPlan, standing: Standing) -> Flag:
        return jnp.array(False)

    def of_groups(self) -> "_AtBothEnds":
        return self


class _EveryEqualStep(AbstractSaving):
    """The start, every `every`-th of the equal steps, and the end."""

    keeps_rows = True
    every: int = eqx.field(static=True)

    def steps_in_group(self, plan: AbstractPlan) -> int:
        return self.every

    def num_rows(self, plan: AbstractPlan) -> int:
        return 1 - (-plan.max_attempts // self.every)

    def rows(self, run: RecordedRun) -> Rows:
        plan, record = run.plan, run.record
        # A run that fails still reports the times that were planned.
        numbers = self.every * jnp.arange(record.reached.size + 1, dtype=plan.last.dtype)
        is_used = numbers - self.every < plan.last
        ts = jnp.where(is_used, jax.vmap(plan.time)(numbers), jnp.nan)
        return _after_start(run.begin, record, record.reached, ts)

    def is_due(self, plan: AbstractPlan, standing: Standing) -> Flag:
        return standing.completed % self.every == 0

    def of_groups(self) -> "_EveryEqualStep":
        return self


class _AtGrid(AbstractSaving):
    """The start, the ends of every `every`-th equal step, and the end, where events end
    steps early: a row is found by its place.
    """

    keeps_rows = False
    every: int = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)

    def steps_in_group(self, plan: AbstractPlan) -> int:
        return 1

    def num_rows(self, plan: AbstractPlan) -> int:
        return 1 - (-self.num_steps // self.every)

    def rows(self, run: RecordedRun) -> Rows:
        plan, record, completed = run.plan, run.record, run.completed
        steps = _accepted_first(record)
        ends = jnp.where(jnp.arange(record.reached.size) < completed, steps.place, jnp.inf)
        count = self.num_rows(plan) - 1
        numbers = self.every * jnp.arange(count + 1, dtype=plan.last.dtype)
        is_used = numbers - self.every < plan.last
        places = jnp.minimum(numbers, plan.last)
        ends = jax.lax.stop_gradient(ends)
        last = jnp.searchsorted(ends, places[1:] - 2 * NEAR).astype(completed.dtype)
        valid = last < completed
        picked = jax.tree.map(lambda x: x[jnp.where(valid, last, 0)], steps)
        segment = jnp.minimum(jnp.searchsorted(last, _number_of_step(record)), count)
        energies, costs = _by_segment(record, segment, count)
        picked = eqx.tree_at(lambda x: (x.energies, x.costs), picked, (energies, costs))
        ts = jnp.where(is_used, jax.vmap(plan.time)(places), jnp.nan)
        return _after_start(run.begin, picked, valid & is_used[1:], ts)

    def is_due(self, plan: AbstractPlan, standing: Standing) -> Flag:
        raise NotImplementedError

    def of_groups(self) -> "_AtGrid":
        raise NotImplementedError


class _EveryAcceptedStep(AbstractSaving):
    """The start, every `every`-th accepted step, and the end."""

    keeps_rows = False
    every: int = eqx.field(static=True)

    def steps_in_group(self, plan: AbstractPlan) -> int:
        return 1

    def num_rows(self, plan: AbstractPlan) -> int:
        return 1 - (-plan.max_attempts // self.every)

    def rows(self, run: RecordedRun) -> Rows:
        plan, record, completed = run.plan, run.record, run.completed
        num_rows = -(-record.reached.size // self.every)
        last = jnp.minimum(self.every * jnp.arange(1, num_rows + 1), completed) - 1
        is_used = self.every * jnp.arange(num_rows) < completed
        picked = jax.tree.map(lambda x: x[last], _accepted_first(record))
        segment = jnp.minimum(_number_of_step(record) // self.every, num_rows - 1)
        energies, costs = _by_segment(record, segment, num_rows)
        picked = eqx.tree_at(lambda x: (x.energies, x.costs), picked, (energies, costs))
        times = jax.vmap(plan.time)(picked.place)
        ts = jnp.append(plan.t0, jnp.where(is_used, times, jnp.nan))
        return _after_start(run.begin, picked, is_used, ts)

    def is_due(self, plan: AbstractPlan, standing: Standing) -> Flag:
        return standing.completed % self.every == 0

    def of_groups(self) -> "_EveryAcceptedStep":
        return _EveryAcceptedStep(1)


class _AtTimes(AbstractSaving):
    """Requested times, which ascend. A row at the end of a step is the end of that step.

    The energies are those of the steps that have ended since the row before.
    """

    keeps_rows = False
    times: Times

    def steps_in_group(self, plan: AbstractPlan) -> int:
        return 1

    def num_rows(self, plan: AbstractPlan) -> int:
        return self.times.size

    def rows(self, run: RecordedRun) -> Rows:
        plan, record, completed, ts = run.plan, run.record, run.completed, self.times
        steps = _accepted_first(record)
        ends = jnp.where(jnp.arange(record.reached.size) < completed, steps.place, jnp.inf)
        places = (ts - plan.t0) / plan.unit
        # The round-off of the times and of their differences.
        size = plan.last + jnp.maximum(jnp.abs(plan.t0), jnp.abs(plan.t1)) / plan.unit
        near = 16 * jnp.finfo(ts.dtype).eps * size
        number = jnp.searchsorted(ends, places - near).astype(completed.dtype)
        number = jnp.where(places >= -near, number, ends.size)
        at_start = (number <= completed) & (jnp.abs(places) <= near)
        inside = number < completed
        number = jnp.where(inside, number, 0)
        first = jnp.append(0.0, ends)[number]
        last = jnp.where(inside, ends[number], plan.last)
        at_end = jnp.abs(places - last) <= near
        part = jnp.where(at_end, 1.0, (places - first) / (last - first))
        part = jnp.where(at_start | ~inside, 0.0, part)
        states = _states_within(run, steps, (number, first, last, part))
        done = jnp.where(part == 1, number + 1, number)
        segment = jnp.searchsorted(done, _number_of_step(record), side="right")
        valid = inside | at_start
        details = jax.tree.map(lambda x: x[number], steps.details)
        multipliers = _nan_unless(valid, steps.multipliers[number])
        energies, costs = _by_segment(record, segment, ts.size)
        at_start = at_start[:, None]
        return Rows(
            ts=ts,
            kept=_nan_unless(valid, states),
            multipliers=jnp.where(at_start, run.begin.multipliers[None], multipliers),
            details=jax.tree.map(lambda x: x[1:], _nan_unless(valid, details)),
            energies=_nan_unless(valid, energies),
            costs=costs,
            varying=jax.tree.map(lambda x: x[done], _with_start(run, steps.varying)),
        )

    def is_due(self, plan: AbstractPlan, standing: Standing) -> Flag:
        # A step with a time inside is a group of its own, and so are those beside it: the
        # time of a row at the end of a step is known to round-off only.
        places = (self.times - plan.t0) / plan.unit
        room = standing.next - standing.place
        first = jnp.searchsorted(places, standing.begin - room)
        return first < jnp.searchsorted(places, standing.next + room, side="right")

    def of_groups(self) -> "_AtTimes":
        return self


def _with_start(run: RecordedRun, varying: PyTree[Any]) -> PyTree[Any]:
    """What varies of the model at the start and after each of these steps."""
    join = lambda x, y: jnp.concatenate([x[None], y])
    return jax.tree.map(join, run.begin.varying, varying)


def _states_within(
    run: RecordedRun, steps: Record, rows: tuple[Count, Scalar, Scalar, Scalar]
) -> State:
    """The states at rows that lie within steps.

    A row is the number of its step, the places where this step begins and ends, and the
    fraction of the step at which the row lies. At an event it is the state after it.
    """
    plan, afters = run.plan, steps.kept
    ends = afters if steps.happening is None else steps.happening.before
    join = lambda x, y: jnp.concatenate([x[None], y])
    starts = jax.tree.map(join, run.begin.kept, afters)
    varying = _with_start(run, steps.varying)

    def state_at(row: tuple[Count, Scalar, Scalar, Scalar]) -> State:
        number, first, last, part = row
        pick = lambda tree: jax.tree.map(lambda x: x[number], tree)
        model = eqx.combine(pick(varying), run.model)
        a = pick(starts)
        # A row that is not reached has no step; its derivatives must still be finite.
        b = jax.tree.map(lambda x, y: jnp.where(part > 0, x, y), pick(ends), a)
        begin, end = with_time(model, plan, a, first), with_time(model, plan, b, last)
        h = plan.unit * (last - first)
        within = state_within(model, begin, end, h, part, run.order)
        state = State(within.q, within.v)
        if steps.happening is None:
            return state
        at_end = lambda x, y: jnp.where(part == 1, x, y)
        return jax.tree.map(at_end, pick(afters), state)

    return jax.lax.map(state_at, rows)


def with_time(
    model: AbstractModel, plan: AbstractPlan, state: State, place: Scalar
) -> State:
    """The state with its time, if the system depends on time."""
    t = plan.time(place) if model.system.is_timed else None
    return State(state.q, state.v, t)


def _accepted_first(record: Record) -> Record:
    """The accepted steps at the beginning; the entries after them are meaningless."""
    numbers = jnp.arange(record.reached.size)
    order = jnp.searchsorted(jnp.cumsum(record.reached), numbers + 1)
    order = jnp.minimum(order, numbers.size - 1)
    return jax.tree.map(lambda x: x[order], record)


def _number_of_step(record: Record) -> Int[Array, " groups"]:
    """The number of the accepted step that each attempt belongs to.

    A rejected attempt belongs to the next accepted step.
    """
    reached = record.reached.astype(int)
    return jnp.cumsum(reached) - reached


def _by_segment(
    record: Record, segment: Int[Array, " steps"], num_segments: int
) -> tuple[Energies, Costs]:
    """The energies and costs of the steps of each segment together; segments ascend."""

    def turn(before: tuple, row: tuple) -> tuple[tuple, tuple]:
        is_first, (energies, costs) = row
        before = jax.tree.map(lambda x: jnp.where(is_first, jnp.zeros_like(x), x), before)
        sums = jax.tree.map(jnp.add, before[0], energies), before[1].with_more(costs)
        return sums, sums

    rows = record.energies, record.costs
    zeros = jax.tree.map(lambda x: jnp.zeros_like(x[0]), rows)
    is_first = jnp.diff(segment, prepend=segment[:1] - 1) != 0
    sums = jax.lax.scan(turn, zeros, (is_first, rows))[1]
    numbers = jnp.arange(num_segments, dtype=segment.dtype)
    last = jnp.maximum(jnp.searchsorted(segment, numbers, side="right") - 1, 0)
    has_steps = segment[last] == numbers
    return jax.tree.map(
        lambda x: jnp.where(has_steps, x[last], jnp.zeros_like(x[last])), sums
    )


def _after_start(
    begin: Begin, record: Record, valid: Bool[Array, " groups"], ts: Times
) -> Rows:
    """The rows of the start and of the groups."""
    kept, multipliers, details, energies = _nan_unless(
        valid, (record.kept, record.multipliers, record.details, record.energies)
    )
    join = lambda x, y: jnp.concatenate([x[None], y])
    return Rows(
        ts=ts,
        kept=jax.tree.map(join, begin.kept, kept),
        multipliers=join(begin.multipliers, multipliers),
        details=details,
        energies=jax.tree.map(lambda x: jnp.append(jnp.zeros((), x.dtype), x), energies),
        costs=record.costs,
        varying=jax.tree.map(join, begin.varying, record.varying),
    )


def _nan_unless(valid: Bool[Array, " rows"], tree: PyTree[Any]) -> PyTree[Any]:
    def masked(x: Array) -> Array:
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return jnp.where(valid.reshape(-1, *[1] * (x.ndim - 1)), x, jnp.nan)

    return jax.tree.map(masked, tree)
