"""The events of a run: their functions, what they change, and what is known of them."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._operators import AbstractModel
from .._programs import in_any_lane, values_of
from .._results import RESULTS
from .._system import AbstractSystem, State
from .._types import Args, Coordinates, Flag, Scalar
from ..schemes import AbstractScheme, AbstractSchemeWithMemory
from .event_search import (
    find,
    Found,
    MAX_TRIES,
    no_search,
    round_off,
    USUAL_TRIES,
    Watch,
    ZERO,
)
from .events import AbstractEvent, checked_events, Event, Impact
from .impacts import Impacts, is_resting_number, Rest, resting_of, with_resting


class Happening(eqx.Module):
    """Which events happen at the end of a step, the states before and after them, and
    which gaps stay closed then."""

    happens: Bool[Array, " events"]
    before: State
    after: State
    closed: Bool[Array, " events"]


class Changed(eqx.Module):
    """What events have made of a state and a model, the forces of closed gaps, the energy
    that was removed, and a failure."""

    state: State
    varying: PyTree[Any]
    forces: Float[Array, " events"]
    lost: Scalar
    result: RESULTS


class Watcher(eqx.Module):
    """The events of a run.

    The part of the model that events change is called `varying`: its inexact arrays if an
    event changes `args`, or the numbers of the gaps that stay closed.
    """

    events: tuple[AbstractEvent, ...]
    max_events: int = eqx.field(static=True)

    @property
    def max_attempts(self) -> int:
        """A bound on the attempts that the searches of a run add to its steps."""
        return (USUAL_TRIES + 1) * self.max_events + MAX_TRIES

    @property
    def impacts(self) -> Impacts:
        return Impacts(tuple(x for x in self.events if isinstance(x, Impact)))

    @property
    def can_rest(self) -> bool:
        return len(self.impacts.impacts) > 0 and self.impacts.can_rest

    @property
    def changes_args(self) -> bool:
        return any(isinstance(x, Event) and x.reset_args for x in self.events)

    @property
    def changes_model(self) -> bool:
        return self.can_rest or self.changes_args

    @property
    def changes_state(self) -> np.ndarray:
        """Which events may change the state or the model."""
        changes = [
            x.reset is not None or x.reset_args is not None
            if isinstance(x, Event)
            else True
            for x in self.events
        ]
        return np.asarray(changes)

    @property
    def _is_impact(self) -> np.ndarray:
        return np.asarray([isinstance(x, Impact) for x in self.events])

    def system(self, system: AbstractSystem, dtype: Any) -> AbstractSystem:
        """The system of the run, with a constraint for each gap that may stay closed."""
        return self.impacts.constrained(system, dtype) if self.can_rest else system

    @property
    def resets(self) -> np.ndarray:
        """Which events have resets."""
        return self.changes_state & ~self._is_impact

    def rest(self, watch: Watch, time: Scalar, least_hop: Scalar) -> Rest:
        """When gaps stay closed; `least_hop` is a part of the largest gaps so far."""
        return Rest(time, least_hop * watch.largest[np.flatnonzero(self._is_impact)])

    def varying(self, model: AbstractModel) -> PyTree[Any]:
        """The part of a model that events change."""
        if self.changes_args:
            return eqx.filter(model, eqx.is_inexact_array)
        return eqx.filter(model, is_resting_number(model))

    def _of_events(self, of_gaps: Array) -> Array:
        """Entries for all events, from those of the gaps; zeros for the others."""
        out = jnp.zeros((len(self.events),), of_gaps.dtype)
        return out.at[np.flatnonzero(self._is_impact)].set(of_gaps)

    def closed(self, model: AbstractModel) -> Bool[Array, " events"]:
        """Which events are impacts whose gaps stay closed."""
        if not self.can_rest:
            return jnp.zeros((len(self.events),), bool)
        return self._of_events(resting_of(model) > 0)

    def of_closed(self, model: AbstractModel, q: Coordinates, multipliers: Array) -> Array:
        """The multipliers of a step, with zeros for the gaps that are open."""
        if not self.can_rest:
            return multipliers
        return self.impacts.of_closed(model, q, multipliers)

    def contact_forces(
        self, model: AbstractModel, q: Coordinates, multipliers: Array
    ) -> Float[Array, " events"]:
        """The forces of closed gaps, from multipliers that are zero where gaps are open."""
        if not self.can_rest:
            return jnp.zeros((len(self.events),), multipliers.dtype)
        all_closed = with_resting(model, jnp.ones_like(resting_of(model)))
        forces = self.impacts.forces(all_closed, q, multipliers)
        return self._of_events(forces)

    def values(
        self, model: AbstractModel, state: State, t: Scalar
    ) -> Float[Array, " events"]:
        """The functions of all events; of a gap that stays closed this is its force."""
        values = self._of_user(model, state, t)
        if not self.can_rest:
            return values

        def with_forces(values: Array) -> Array:
            _, multipliers = model.accelerations(_timed(model, state, t))
            forces = self.impacts.forces(model, state.q, multipliers)
            forces = self._of_events(forces).astype(values.dtype)
            return jnp.where(self.closed(model), forces, values)

        any_closed = in_any_lane(jnp.any(self.closed(model)))
        return jax.lax.cond(any_closed, with_forces, lambda values: values, values)

    def _of_user(
        self, model: AbstractModel, state: State, t: Scalar
    ) -> Float[Array, " events"]:
        """The functions of all events, also where gaps are closed."""
        return self._evaluated(model.to_user(state), t, model.args)

    def _evaluated(self, user: State, t: Scalar, args: Args) -> Float[Array, " events"]:
        values = [event.value(user, t, args) for event in self.events]
        return jnp.stack(values).astype(user.q.dtype)

    def begin(
        self, model: AbstractModel, state: State, t: Scalar, h: Scalar
    ) -> tuple[Watch, PyTree[Any], RESULTS]:
        """What is known at the start of a run, what varies of the model there, and a
        failure if a gap is not open."""
        model, forces, opens = self._first_model(model, state, t)
        # What is watched has no derivative.
        still, state, t = values_of((model, state, t))
        closed = self.closed(still)
        values = jnp.where(closed, forces, self._of_user(still, state, t))
        slope = self._slopes(still, state, t)
        none = jnp.zeros((2, values.size), values.dtype)
        eps = jnp.finfo(values.dtype).eps
        size = jnp.abs(h * slope) + self._term_sizes(still, state, t)
        at_zero = ~closed & (jnp.abs(values) <= ZERO * eps * size)
        watch = Watch(
            side=_sign(jnp.where(at_zero, slope, values)),
            values=values,
            sizes=none,
            largest=jnp.where(closed, 0.0, jnp.abs(values)),
            is_force=closed,
            starts=at_zero & (slope != 0),
            search=no_search(values.dtype),
            count=jnp.array(0),
            ended=jnp.array(False),
        )
        watch = eqx.tree_at(lambda w: w.sizes, watch, watch.sizes_with(values, closed))
        # Forces push, and gaps are open or open now.
        shut = (watch.side < 0) | (at_zero & (slope <= 0))
        opens = opens & ~jnp.any(jnp.asarray(self._is_impact) & ~closed & shut)
        result = RESULTS.where(opens, RESULTS.successful, RESULTS.gap_closed_at_start)
        return watch, self.varying(model) if self.changes_model else None, result

    def _term_sizes(
        self, model: AbstractModel, state: State, t: Scalar
    ) -> Float[Array, " events"]:
        """The changes of all functions if each coordinate and velocity changed by its own
        size, to first order: the sizes of terms that may cancel."""
        of_state = lambda q, v: self._of_user(model, State(q, v, state.t), t)
        at, sizes = (state.q, state.v), (jnp.abs(state.q), jnp.abs(state.v))
        change = jax.jvp(of_state, at, sizes)[1]
        return jnp.where(jnp.isfinite(change), jnp.abs(change), 0)

    def _first_model(
        self, model: AbstractModel, state: State, t: Scalar
    ) -> tuple[AbstractModel, Float[Array, " events"], Flag]:
        """The model at the start, in which gaps that are closed and at rest stay closed,
        their forces, and whether they could be found."""
        if not self.can_rest:
            forces = jnp.zeros((len(self.events),), state.q.dtype)
            return model, forces, jnp.array(True)
        impacts, start = self.impacts, inner_state(model, state, t)
        q, qdot = start.q, model.in_rates.lift(start.q, start.v)
        gaps = lambda q: impacts.gaps(q, model.args)
        # The sizes of the terms of the gaps and of their rates.
        value, size = jax.jvp(gaps, (q,), (jnp.abs(q),))
        rate, speed = (jax.jvp(gaps, (q,), (x,))[1] for x in (qdot, jnp.abs(qdot)))
        rounding = 1e3 * jnp.finfo(q.dtype).eps
        touching = jnp.abs(value) <= rounding * jnp.maximum(jnp.abs(size), 1e-3)
        still = jnp.abs(rate) <= rounding * jnp.abs(speed)
        none, instant = jnp.zeros_like(value), jnp.asarray(rounding, value.dtype)
        rest = Rest(instant, none)
        resting, forces, ended = impacts.consistent(
            model.in_rates, start, none, touching & still, rest
        )
        return with_resting(model, resting), self._of_events(forces), ended

    def _slopes(
        self, model: AbstractModel, state: State, t: Scalar
    ) -> Float[Array, " events"]:
        """The derivatives of all functions by the time, in a motion through this state.

        They are those of the functions of the user, also where gaps are closed.
        """
        in_rates, inner = model.to_rates(state), model.in_rates
        qdot, vdot = inner.lift(in_rates.q, in_rates.v), jnp.zeros_like(in_rates.v)
        if not self._is_impact.all():
            vdot = inner.accelerations(in_rates)[0]

        def values(q, v, t):
            timed = None if state.t is None else t
            return self._evaluated(inner.to_user(State(q, v, timed)), t, model.args)

        at, along = (in_rates.q, in_rates.v, t), (qdot, vdot, jnp.ones_like(t))
        return jax.jvp(values, at, along)[1]

    def extremum(
        self,
        model: AbstractModel,
        ends: tuple[State, State],
        times: tuple[Scalar, Scalar],
        watch: Watch,
        values: Array,
    ) -> tuple[Scalar, Flag]:
        """The fraction of a step at the first extremum of a function that has passed zero
        before it and passes zero again after it, and whether there is one.

        `ends` are the states of a step, without derivatives. Functions that have one sign
        at both ends are evaluated along a motion between them, first in the middle and then
        at the vertex of the parabola through three values.
        """
        between = _motion_between(model, ends, times)
        middle, side = self._evaluated(*between(0.5), model.args), _sign(watch.values)
        first, half, last = side * watch.values, side * middle, side * values
        bend, slope = 2 * (first - 2 * half + last), 4 * half - 3 * first - last
        vertex = -slope / (2 * jnp.where(bend > 0, bend, 1.0))
        inside = (bend > 0) & (vertex > 0) & (vertex < 1)
        vertex = jnp.where(inside, vertex, 0.5)
        zero = round_off(watch.sizes_with(values, watch.is_force), watch.is_force)
        same_sign = (first > zero) & (last > zero) & ~watch.is_force
        depth = jnp.where(inside, first - bend * vertex**2, half)

        def lowest() -> Float[Array, " events"]:
            found = [
                event.value(*between(vertex[k]), model.args).astype(values.dtype)
                for k, event in enumerate(self.events)
            ]
            return side * jnp.stack(found)

        # The parabola is far from zero in most steps.
        is_near = jnp.any(same_sign & (depth < 0.5 * jnp.minimum(first, last)))
        least = jax.lax.cond(in_any_lane(is_near), lowest, lambda: first)
        passes = same_sign & (least < -zero)
        part = jnp.min(jnp.where(passes, vertex, 1.0))
        return part, jnp.any(passes)

    def found(
        self, watch: Watch, values: Array, length: Scalar, extremum: tuple[Scalar, Flag]
    ) -> Found:
        """What happens in a step of this length."""
        directions = [event.direction for event in self.events]
        direction = jnp.asarray(directions, watch.side.dtype)
        # Only from one side a zero is an event, and only after a function was not zero.
        armed = (direction == 0) | (watch.side == -direction)
        is_flat = jnp.abs(watch.values) <= round_off(watch.sizes, watch.is_force)
        armed = armed & (watch.starts | ~is_flat)
        found = find(watch, armed, values, length, extremum)
        closes = jnp.any(jnp.asarray(self._is_impact) & (watch.side < 0))
        result = RESULTS.where(closes, RESULTS.impacts_unresolved, found.result)
        finite = jnp.all(jnp.isfinite(values))
        result = RESULTS.where(finite, result, RESULTS.nonfinite)
        return eqx.tree_at(lambda found: found.result, found, result)

    def after(
        self,
        model: AbstractModel,
        state: State,
        t: Scalar,
        happens: Array,
        rest: Rest,
        remade: Callable[[State, Args], AbstractModel],
    ) -> Changed:
        """What all events that happen have made of a state and a model.

        Resets come first, in their order, then impacts. `remade(state, args)` is the model
        with other `args`, and `rest` tells which gaps stay closed.
        """
        varying = self.varying(model) if self.changes_model else None
        zero, good = jnp.zeros((), state.q.dtype), RESULTS.successful
        no_forces = jnp.zeros((len(self.events),), state.q.dtype)
        if not self.changes_state.any():
            return Changed(state, varying, no_forces, zero, good)

        def change(state: State) -> Changed:
            before = inner_state(model, state, t)
            changed, after = self._reset(model, before, t, happens, remade)
            after, changed, forces, result = self._hit(changed, after, happens, rest)
            energy = lambda model, x: (
                model.in_rates.kinetic(x) + model.in_rates.potential(x)
            )
            user = changed.in_rates.to_user(after)
            new = changed.to_internal(State(user.q, user.v, state.t))
            same = ~jnp.any(happens)
            keep = lambda x, y: jnp.where(same, x, y)
            lost = energy(model, before) - energy(changed, after)
            new_varying = self.varying(changed) if self.changes_model else None
            return Changed(
                jax.tree.map(keep, state, new),
                jax.tree.map(keep, varying, new_varying),
                forces,
                keep(zero, lost),
                RESULTS.where(same, good, result),
            )

        none = lambda state: Changed(state, varying, no_forces, zero, good)
        changed = jnp.any(happens & jnp.asarray(self.changes_state))
        # The reverse pass computes an event again. What it would keep of the event would be
        # kept in every step, also in those without one.
        change = jax.checkpoint(change, prevent_cse=False)
        return jax.lax.cond(in_any_lane(changed), change, none, state)

    def _reset(
        self,
        model: AbstractModel,
        state: State,
        t: Scalar,
        happens: Array,
        remade: Callable[[State, Args], AbstractModel],
    ) -> tuple[AbstractModel, State]:
        """The model and its state, in rates, after the resets of all `Event`s."""
        user, args = model.in_rates.to_user(state), model.args
        choose = lambda k: lambda x, y: jnp.where(happens[k], x, y)
        for k, event in enumerate(self.events):
            if isinstance(event, Event):
                new_args = event.args_after(user, t, args)
                new = event.state_after(user, t, args)
                user = jax.tree.map(choose(k), new, user)
                args = jax.tree.map(choose(k), new_args, args)
        if self.changes_args:
            varying = eqx.filter(remade(user, args), eqx.is_inexact_array)
            model = eqx.combine(varying, model)
        after = inner_state(model, model.to_internal(State(user.q, user.v, state.t)), t)
        return model, after

    def _hit(
        self, model: AbstractModel, state: State, happens: Array, rest: Rest
    ) -> tuple[State, AbstractModel, Float[Array, " events"], RESULTS]:
        """The state, in rates, and the model after all impacts, and the forces of gaps."""
        if not self._is_impact.any():
            none = jnp.zeros((len(self.events),), state.q.dtype)
            return state, model, none, RESULTS.successful
        numbers = np.flatnonzero(self._is_impact)
        hits = self.impacts.after(model.in_rates, state, happens[numbers], rest)
        if hits.resting is not None:
            model = with_resting(model, hits.resting)
        return hits.state, model, self._of_events(hits.forces), hits.result

    def watch_after(
        self,
        watch: Watch,
        model: AbstractModel,
        changed: Changed,
        t: Scalar,
        found: Found,
        happens: Array,
    ) -> Watch:
        """What is known at the start of the next step, after an accepted one, and after the
        events that happen at its end."""
        # What is watched has no derivative.
        model, changed, found, t = values_of((model, changed, found, t))
        state, values = _timed(model, changed.state, t), found.values
        if self.changes_state.any():

            def after() -> Float[Array, " events"]:
                values = self._of_user(model, state, t)
                return jnp.where(self.closed(model), changed.forces, values)

            happened = jnp.any(happens)
            new = jax.lax.cond(in_any_lane(happened), after, lambda: values)
            values = jnp.where(happened, new, values)
        closed = self.closed(model)
        sizes = watch.faded().sizes_with(values, closed)
        is_zero = ~closed & (happens | (jnp.abs(values) <= round_off(sizes, closed)))
        # From a zero a function moves to the side of its slope.
        of_motion = lambda: self._slopes(model, state, t)
        slopes = jax.lax.cond(
            in_any_lane(jnp.any(is_zero)), of_motion, lambda: jnp.zeros_like(values)
        )
        starts = is_zero & (slopes != 0)
        side = jnp.where(starts, _sign(slopes), _sign(values))
        # A gap that has been released opens, though it may have no rate yet.
        released = watch.is_force & ~closed
        starts = starts | (released & is_zero)
        side = jnp.where(released | closed, 1.0, side)
        terminal = jnp.asarray([event.terminal for event in self.events])
        return Watch(
            side=side,
            values=values,
            sizes=sizes,
            largest=jnp.where(
                closed, watch.largest, jnp.fmax(watch.largest, jnp.abs(values))
            ),
            is_force=closed,
            starts=starts,
            search=no_search(values.dtype),
            count=watch.count + jnp.any(happens).astype(watch.count.dtype),
            ended=watch.ended | jnp.any(happens & terminal),
        )


def inner_state(model: AbstractModel, state: State, t: Scalar) -> State:
    """The state in rates, with its time if the system depends on it."""
    return model.to_rates(_timed(model, state, t))


def _timed(model: AbstractModel, state: State, t: Scalar) -> State:
    """The state with its time, if the system depends on it."""
    return State(state.q, state.v, t if model.system.is_timed else None)


def _motion_between(
    model: AbstractModel, ends: tuple[State, State], times: tuple[Scalar, Scalar]
) -> Callable[[Any], tuple[State, Scalar]]:
    """The user's state and the time at a fraction of a step: cubic in the coordinates,
    linear in the velocities."""
    inner, (t0, t1) = model.in_rates, times
    a, b = (model.to_rates(State(x.q, x.v)) for x in ends)
    h = t1 - t0
    of_a, of_b = (h * inner.lift(x.q, x.v) for x in (a, b))
    step = b.q - a.q

    def at(part: Any) -> tuple[State, Scalar]:
        rest = 1 - part
        bow = rest * (of_a - step) - part * (of_b - step)
        q = a.q + part * step + part * rest * bow
        v = a.v + part * (b.v - a.v)
        return inner.to_user(State(q, v)), t0 + part * h

    return at


def _sign(x: Array) -> Array:
    """The sign, 1 for zero."""
    return jnp.where(x < 0, -1.0, 1.0).astype(x.dtype)


def watcher_of(
    system: AbstractSystem,
    events: Any,
    max_events: Any,
    scheme: AbstractScheme,
    is_long: bool,
) -> Watcher | None:
    """The checked events of a run, those of the system first; `None` if there are none."""
    of_system, _ = checked_events(system.events, max_events)
    of_run, bound = checked_events(events, max_events)
    checked = (*of_system, *of_run)
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
