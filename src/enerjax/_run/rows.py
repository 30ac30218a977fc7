"""The rows of a run to an end time: its ends, its steps, or requested times."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from .._operators import AbstractModel
from .._system import State
from .._types import Count, Flag, Multipliers, Scalar, Times
from ..schemes import Energies
from .dense_output import Bracket, state_within
from .selection import nan_unless


class Step(eqx.Module):
    """What is kept of the steps that were tried, with a leading axis.

    - `reached`: state and multipliers at the end; `None` where no rows are made of them.
    - `details`: what the scheme reports of its own.
    - `energies`: zero for a step that was rejected.
    - `costs`: iterations, residual, halvings and local error.
    - `passed`: the part of the whole time that has passed at its end.
    """

    reached: PyTree[Any]
    details: PyTree[Any]
    energies: Energies
    passed: Float[Array, " steps"]
    accepted: Bool[Array, " steps"]
    costs: tuple[Array, Array, Array, Array]


class Run(eqx.Module):
    """All that rows are made of."""

    model: AbstractModel
    t0: Scalar
    t1: Scalar
    start: State
    multipliers0: Multipliers
    steps: Step
    completed: Count

    @property
    def duration(self) -> Scalar:
        return self.t1 - self.t0


# Times, states, multipliers, details, and energies since the row before.
Rows: TypeAlias = tuple[Times, State, Array, PyTree[Any], Energies]


def _behind(first: PyTree[Any], rest: PyTree[Any]) -> PyTree[Any]:
    return jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), first, rest)


def _zeros(run: Run) -> Energies:
    return jax.tree.map(lambda x: jnp.zeros((), x.dtype), run.steps.energies)


def at_both_ends(run: Run, end: PyTree[Any], failed: Flag) -> Rows:
    """Two rows."""
    total = jax.tree.map(jnp.sum, run.steps.energies)
    steps, _ = _completed(run)
    details = jax.tree.map(lambda x: x[run.completed - 1], steps.details)
    end, details, total = nan_unless(~failed, (end, details, total))
    last = jax.tree.map(lambda x: x[None], (*end, total))
    rows = _behind((run.start, run.multipliers0, _zeros(run)), last)
    states, multipliers, energies = rows
    ts = jnp.stack([run.t0, run.t1])
    return ts, states, multipliers, jax.tree.map(lambda x: x[None], details), energies


def _completed(run: Run) -> tuple[Step, Bool[Array, " steps"]]:
    """The steps that were accepted, first, and which they are."""
    numbers = jnp.arange(run.steps.accepted.size)
    order = jnp.searchsorted(jnp.cumsum(run.steps.accepted), numbers + 1)
    order = jnp.minimum(order, numbers.size - 1)
    steps = jax.tree.map(lambda x: x[order], run.steps)
    return steps, numbers < run.completed


def _mask(valid: Bool[Array, " rows"], tree: PyTree[Any]) -> PyTree[Any]:
    return jax.vmap(nan_unless)(valid, tree)


def at_steps(run: Run) -> Rows:
    """The start and every completed step; rows that are left are no numbers."""
    steps, valid = _completed(run)
    kept = steps.passed, steps.reached, steps.details, steps.energies
    passed, (states, multipliers), details, energies = _mask(valid, kept)
    first = run.start, run.multipliers0, _zeros(run), jnp.zeros_like(run.duration)
    rest = states, multipliers, energies, passed
    states, multipliers, energies, passed = _behind(first, rest)
    return run.t0 + run.duration * passed, states, multipliers, details, energies


def at_times(run: Run, ts: Times, order: int) -> Rows:
    """Rows at times, which ascend. Those at the end of a step are its end.

    The energies are those of the steps that have ended since the row before.
    """
    steps, valid = _completed(run)
    states, multipliers = steps.reached
    ends = jnp.where(valid, steps.passed, jnp.inf)
    parts = (ts - run.t0) / run.duration
    # The round-off of the times and of their differences.
    size = 1 + jnp.maximum(jnp.abs(run.t0), jnp.abs(run.t1)) / run.duration
    near = 16 * jnp.finfo(ts.dtype).eps * size
    number = jnp.searchsorted(ends, parts - near).astype(run.completed.dtype)
    number = jnp.where(parts >= -near, number, ends.size)
    at_start = (number <= run.completed) & (jnp.abs(parts) <= near)
    inside = number < run.completed
    number = jnp.where(inside, number, 0)
    begin = jnp.append(0.0, ends)[number]
    end = jnp.where(inside, ends[number], 1.0)
    part = jnp.where(jnp.abs(parts - end) <= near, 1.0, (parts - begin) / (end - begin))
    part = jnp.where(at_start | ~inside, 0.0, part)

    before = _behind(run.start, states)
    pick = lambda tree, k: jax.tree.map(lambda x: x[k], tree)

    def state_at(k, begin, end, part):
        a = pick(before, k)
        # A row that is not reached is no step: its derivatives are numbers all the same.
        b = jax.tree.map(lambda x, y: jnp.where(part > 0, x, y), pick(states, k), a)
        timed = lambda x, s: State(x.q, x.v, _time(run, s))
        h = run.duration * (end - begin)
        bracket = Bracket(timed(a, begin), timed(b, end), h, part)
        state = state_within(run.model, bracket, order)
        return State(state.q, state.v)

    rows = jax.lax.map(lambda row: state_at(*row), (number, begin, end, part))
    within = pick((multipliers, steps.details), number)
    done = jnp.where(part == 1, number + 1, number)
    since = jnp.searchsorted(done, jnp.arange(ends.size), side="right")
    total = lambda x: jax.ops.segment_sum(jnp.where(valid, x, 0), since, ts.size)
    energies = jax.tree.map(total, steps.energies)
    reached = inside | at_start
    states, (multipliers, details), energies = _mask(reached, (rows, within, energies))
    multipliers = jnp.where(at_start[:, None], run.multipliers0[None], multipliers)
    return ts, states, multipliers, jax.tree.map(lambda x: x[1:], details), energies


def _time(run: Run, passed: Scalar) -> Scalar | None:
    return run.t0 + run.duration * passed if run.model.system.is_timed else None
