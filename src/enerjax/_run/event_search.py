"""The search for events within the steps of a run.

After each attempted step the functions of all events are evaluated. If one has passed a
zero, the step is repeated with lengths that enclose the first zero, by the Illinois form of
regula falsi, until the function is round-off at the end of the step.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._operators import AbstractModel
from .._programs import in_any_lane
from .._results import RESULTS
from .._system import State
from .._types import Count, Flag, Scalar
from ..schemes import AbstractScheme, AbstractSchemeWithMemory
from .collocation import rates
from .events import AbstractEvent, checked_events


# A function counts as zero below this multiple of the round-off of its largest value.
_ZERO = 64.0
# The attempts of one search. Ten usually suffice; steps that are halved forty times, for a
# function that touches zero at their start, need more.
MAX_TRIES = 80
_USUAL_TRIES = 16
# The fraction of the interval by which a length must differ from both of its ends.
_MARGIN = 1e-3


class Watch(eqx.Module):
    """What is known of the events at the start of a step.

    - `side`: the sign that each function has before its next zero.
    - `values`: of all functions.
    - `size`: the largest absolute value of each function so far.
    - `slope`: the derivative by the time of a function that is zero; else 0.
    - `search`: the interval of lengths that encloses the first zero in the step.
    - `count`: the number of events so far.
    - `ended`: whether a terminal event has happened.
    """

    side: Float[Array, " events"]
    values: Float[Array, " events"]
    size: Float[Array, " events"]
    slope: Float[Array, " events"]
    search: "Search"
    count: Count
    ended: Flag

    @property
    def zero(self) -> Float[Array, " events"]:
        """The round-off of each function."""
        return _ZERO * jnp.finfo(self.size.dtype).eps * self.size


class Search(eqx.Module):
    """An interval of lengths of a step: steps of the upper length pass a zero.

    - `active`: whether there is a search.
    - `lower`, `upper`: the ends of the interval.
    - `at_lower`, `at_upper`: the distances to the first zero there, positive and negative;
      those of an end that has been kept are halved.
    - `moved`: 1 if the last attempt has moved the upper end, -1 the lower end, 0 none.
    - `tries`: the number of attempts.
    """

    active: Flag
    lower: Scalar
    upper: Scalar
    at_lower: Scalar
    at_upper: Scalar
    moved: Scalar
    tries: Count

    @property
    def length(self) -> Scalar:
        """The length to try next."""
        width = self.upper - self.lower
        part = self.at_lower / (self.at_lower - self.at_upper)
        # Where the function vanishes at the lower end too, the secant finds this zero.
        part = jnp.where(self.at_lower > 0, part, 0.5)
        margin = jnp.where(self.tries > MAX_TRIES // 2, 0.5, 0.0)
        return self.lower + jnp.clip(part, margin, 1 - margin) * width

    def narrowed(self, length: Scalar, distance: Scalar, beyond: Flag) -> "Search":
        """The interval after an attempt of this length, which ends beyond a zero or not."""
        distance = jnp.where(beyond, jnp.minimum(distance, 0), jnp.maximum(distance, 0))
        moved = jnp.where(beyond, 1.0, -1.0).astype(length.dtype)
        again = self.moved == moved
        at_lower = jnp.where(beyond & again, 0.5 * self.at_lower, self.at_lower)
        at_upper = jnp.where(~beyond & again, 0.5 * self.at_upper, self.at_upper)
        return Search(
            active=jnp.array(True),
            lower=jnp.where(beyond, self.lower, length),
            upper=jnp.where(beyond, length, self.upper),
            at_lower=jnp.where(beyond, at_lower, distance),
            at_upper=jnp.where(beyond, distance, at_upper),
            moved=moved,
            tries=self.tries + 1,
        )


def no_search(dtype: Any) -> Search:
    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    return Search(
        active=jnp.array(False),
        lower=zero,
        upper=one,
        at_lower=one,
        at_upper=-one,
        moved=zero,
        tries=jnp.array(0),
    )


class Found(eqx.Module):
    """What an attempted step has found.

    - `happens`: which events happen at the end of the step.
    - `searches`: whether the step must be repeated with another length.
    - `search`: for the next attempt.
    - `values`: the functions at the end.
    - `result`: a failure of the search.
    """

    happens: Bool[Array, " events"]
    searches: Flag
    search: Search
    values: Float[Array, " events"]
    result: RESULTS


class Happening(eqx.Module):
    """Which events happen at the end of a step, and the states before and after them."""

    happens: Bool[Array, " events"]
    before: State
    after: State


class Watcher(eqx.Module):
    """The events of a run."""

    events: tuple[AbstractEvent, ...]
    max_events: int = eqx.field(static=True)

    @property
    def max_attempts(self) -> int:
        """A bound on the attempts that the searches of a run add to its steps."""
        return (_USUAL_TRIES + 1) * self.max_events + MAX_TRIES

    def values(
        self, model: AbstractModel, state: State, t: Scalar
    ) -> Float[Array, " events"]:
        user = model.to_user(state)
        values = [event.value(user, t, model.args) for event in self.events]
        return jnp.stack(values).astype(state.q.dtype)

    def begin(self, model: AbstractModel, state: State, t: Scalar) -> Watch:
        values = jax.lax.stop_gradient(self.values(model, state, t))
        slope = jax.lax.stop_gradient(self._slopes(model, state, t))
        size = jnp.abs(values)
        watch = Watch(
            side=_sign(values),
            values=values,
            size=size,
            slope=jnp.zeros_like(values),
            search=no_search(values.dtype),
            count=jnp.array(0),
            ended=jnp.array(False),
        )
        at_zero = size <= _ZERO * jnp.finfo(values.dtype).eps * jnp.abs(slope)
        return eqx.tree_at(
            lambda w: (w.side, w.slope),
            watch,
            (
                jnp.where(at_zero, _sign(slope), watch.side),
                jnp.where(at_zero, slope, 0.0),
            ),
        )

    def _slopes(
        self, model: AbstractModel, state: State, t: Scalar
    ) -> Float[Array, " events"]:
        """The derivatives of all functions by the time, in a motion through this state."""
        in_rates = model.to_rates(state)
        qdot, vdot = rates(model.in_rates, in_rates)

        def values(q, v, t):
            timed = None if state.t is None else t
            user = model.in_rates.to_user(State(q, v, timed))
            values = [event.value(user, t, model.args) for event in self.events]
            return jnp.stack(values).astype(q.dtype)

        at, along = (in_rates.q, in_rates.v, t), (qdot, vdot, jnp.ones_like(t))
        return jax.jvp(values, at, along)[1]

    def find(self, watch: Watch, values: Array, length: Scalar, place: Scalar) -> Found:
        """What happens in a step of this length, from `place`."""
        values_now = jax.lax.stop_gradient(values)
        length, place = jax.lax.stop_gradient((length, place))
        search = watch.search
        sized = eqx.tree_at(lambda w: w.size, watch, self._size(watch, values_now))
        zero, left = sized.zero, watch.side * values_now
        armed = self._armed(watch)
        # A function that is zero at the start must first become positive.
        starts = watch.slope != 0
        least = jnp.where(starts & ~search.active, -zero, zero)
        distance = jnp.min(jnp.where(armed, left, jnp.inf))
        beyond = jnp.any(armed & (left <= jnp.where(starts, -zero, 0)))
        near = armed & (left <= least)
        first = jnp.all(~armed | (left >= -zero))
        narrowed = search.narrowed(length, distance, beyond)
        eps = jnp.finfo(length.dtype).eps
        is_narrow = search.active & (
            narrowed.upper - narrowed.lower <= 4 * eps * (place + length)
        )
        found = jnp.any(near) & (first | (is_narrow & beyond))
        searches = ~found & (search.active | beyond)
        start = self._first_interval(watch, length, distance, armed)
        use = lambda x, y: jnp.where(search.active, x, y)
        following = jax.tree.map(use, narrowed, start)
        following = jax.tree.map(
            lambda x, y: jnp.where(searches, x, y), following, no_search(length.dtype)
        )
        failed = searches & (following.tries > MAX_TRIES)
        return Found(
            happens=found & near,
            searches=searches,
            search=following,
            values=values,
            result=RESULTS.where(failed, RESULTS.event_not_found, RESULTS.successful),
        )

    def _armed(self, watch: Watch) -> Bool[Array, " events"]:
        """Which functions are on the side from which their next zero is an event."""
        direction = jnp.asarray(
            [event.direction for event in self.events], watch.side.dtype
        )
        return (direction == 0) | (watch.side == -direction)

    def _size(self, watch: Watch, values: Array) -> Array:
        return jnp.where(
            jnp.isfinite(values), jnp.maximum(watch.size, abs(values)), watch.size
        )

    def _first_interval(
        self, watch: Watch, length: Scalar, distance: Scalar, armed: Array
    ) -> Search:
        left = jnp.where(armed, watch.side * watch.values, jnp.inf)
        at_zero = watch.slope[jnp.argmin(left)] != 0
        return Search(
            active=jnp.array(True),
            lower=jnp.zeros_like(length),
            upper=length,
            at_lower=jnp.where(at_zero, 0.0, jnp.maximum(jnp.min(left), 0)),
            at_upper=jnp.minimum(distance, 0),
            moved=jnp.zeros_like(length),
            tries=jnp.array(1),
        )

    def after(
        self, model: AbstractModel, state: State, t: Scalar, happens: Array
    ) -> tuple[State, Scalar]:
        """The state after all events that happen, and the energy that they removed.

        The states are those of the model. Events that happen at once do so in their order.
        """

        def change(state: State) -> tuple[State, Scalar]:
            inner, before = model.in_rates, model.to_rates(state)
            after = before
            for k, event in enumerate(self.events):
                if event.changes_state:
                    new = event.after(inner, after, t)
                    after = jax.tree.map(
                        lambda x, y, k=k: jnp.where(happens[k], x, y), new, after
                    )
            energy = lambda state: inner.kinetic(state) + inner.potential(state)
            user = inner.to_user(after)
            new = model.to_internal(State(user.q, user.v, state.t))
            same = ~jnp.any(happens)
            new = jax.tree.map(lambda x, y: jnp.where(same, x, y), state, new)
            return new, jnp.where(same, 0.0, energy(before) - energy(after))

        none = lambda state: (state, jnp.zeros((), state.q.dtype))
        changes = [event.changes_state for event in self.events]
        if not any(changes):
            return none(state)
        changed = jnp.any(happens & jnp.asarray(changes))
        return jax.lax.cond(in_any_lane(changed), change, none, state)

    def watch_after(
        self, watch: Watch, model: AbstractModel, state: State, t: Scalar, happens: Array
    ) -> Watch:
        """What is known at the start of the next step, after an accepted one."""
        values = jax.lax.stop_gradient(self.values(model, state, t))
        size = self._size(watch, values)
        sized = eqx.tree_at(lambda w: w.size, watch, size)
        is_zero = jnp.abs(values) <= sized.zero
        side = jnp.where(
            is_zero, jnp.where(happens, -watch.side, watch.side), _sign(values)
        )
        slope = jnp.zeros_like(values)
        changes = np.asarray([event.changes_state for event in self.events])
        if changes.any():
            turned = happens & changes
            of_change = lambda: jax.lax.stop_gradient(self._slopes(model, state, t))
            slopes = jax.lax.cond(in_any_lane(jnp.any(turned)), of_change, lambda: slope)
            known = turned & is_zero & (slopes != 0)
            side = jnp.where(known, _sign(slopes), side)
            slope = jnp.where(known, slopes, 0.0)
        terminal = jnp.asarray([event.terminal for event in self.events])
        return Watch(
            side=side,
            values=values,
            size=size,
            slope=slope,
            search=no_search(values.dtype),
            count=watch.count + jnp.any(happens).astype(watch.count.dtype),
            ended=watch.ended | jnp.any(happens & terminal),
        )


def _sign(x: Array) -> Array:
    """The sign, 1 for zero."""
    return jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)


@eqx.filter_custom_jvp
def settle(attempt: Any) -> tuple[Any, Scalar, Found]:
    """An attempted step, its length, and what it has found.

    `attempt` is a module with the attribute `length` and a method `run` that returns the
    step and what it has found. If an event happens, the derivative of the length is such
    that the function of the event stays zero: with the derivative `slope` of the function
    by the length it is minus the change of the function, divided by `slope`.
    """
    out, found = attempt.run()
    return out, attempt.length, found


@settle.def_jvp
def _settle_jvp(primals: Any, tangents: Any) -> Any:
    (attempt,), (t_attempt,) = primals, tangents

    def result(attempt: Any) -> tuple[Any, Scalar, Found]:
        out, found = attempt.run()
        return out, attempt.length, found

    ends, change = eqx.filter_jvp(result, (attempt,), (t_attempt,))
    change = _without_none(change, ends)
    _, length, found = ends
    first = jnp.arange(found.happens.size) == jnp.argmax(found.happens)
    value_of = lambda tangent: jnp.sum(jnp.where(first, tangent[2].values, 0))

    def of_length(length: Scalar) -> Any:
        return result(eqx.tree_at(lambda attempt: attempt.length, attempt, length))

    def corrected(change: Any) -> Any:
        _, along = eqx.filter_jvp(of_length, (length,), (jnp.ones_like(length),))
        along = _without_none(along, ends)
        slope = value_of(along)
        shift = -value_of(change) / jnp.where(slope == 0, 1, slope)
        shift = jnp.where(jnp.any(found.happens), shift, 0)
        return jax.tree.map(lambda x, y: x + shift * y, change, along)

    happens = in_any_lane(jnp.any(found.happens))
    return ends, jax.lax.cond(happens, corrected, lambda change: change, change)


def _without_none(tangents: Any, values: Any) -> Any:
    """The tangents, with zeros for those of numbers that do not change."""

    def tangent(t: Any, x: Any) -> Any:
        is_number = eqx.is_inexact_array(x)
        return jnp.zeros_like(x) if t is None and is_number else t

    return jax.tree.map(tangent, tangents, values, is_leaf=lambda x: x is None)


def watcher_of(
    events: Any, max_events: Any, scheme: AbstractScheme, is_long: bool
) -> Watcher | None:
    """The checked events of a run; `None` if there are none."""
    checked, bound = checked_events(events, max_events)
    if not checked:
        return None
    if isinstance(scheme.stage, AbstractSchemeWithMemory):
        raise ValueError(
            f"`{type(scheme).__name__}` passes an acceleration from step to step that is "
            "valid for one step length only, so no event can end a step. Use a one-step "
            "scheme, such as `EnergyPreserving` or `EnergyDecaying`."
        )
    if is_long:
        raise ValueError(
            "A run with `events` cannot be made piece by piece: leave out `progress`, "
            "`checkpoint` and `resume`, or end the run at its events (`terminal=True`) and "
            "start the next run from `solution.end`."
        )
    return Watcher(checked, bound)
