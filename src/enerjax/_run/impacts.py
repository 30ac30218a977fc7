"""Impacts: the jumps of the velocities when gaps close, and gaps that stay closed.

A gap that stays closed is a constraint until its force would pull. Each gap has a row of
its own among the constraints, multiplied by a number that is 1 while the gap stays closed
and 0 otherwise, so one program serves every combination of contacts.
"""

import copy
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._analysis import project_velocity
from .._operators import AbstractModel
from .._programs import is_known, values_of
from .._results import RESULTS
from .._system import AbstractSystem, HamiltonianSystem, State
from .._types import Args, Coordinates, Flag, Multipliers, Scalar, Velocities
from .events import Impact


# Numbers of the gaps: 1 for those that stay closed, 0 for the others.
Resting = Float[Array, " gaps"]
# How often the impacts that happen at once are applied one after another.
_SWEEPS = 16


class _WithGaps(eqx.Module):
    """The constraints of a system, followed by the gaps that stay closed."""

    constraint: Callable[[Coordinates, Args], Multipliers] | None
    impacts: "Impacts"
    resting: Resting

    def __call__(self, q: Coordinates, args: Args) -> Multipliers:
        gaps = self.resting * self.impacts.gaps(q, args)
        if self.constraint is None:
            return gaps
        return jnp.concatenate([self.constraint(q, args), gaps])

    def first_row(self, q: Coordinates, args: Args) -> int:
        """The number of the first row of the gaps."""
        rows = jax.eval_shape(lambda q: self(q, args), q)
        return rows.shape[0] - len(self.impacts.impacts)


def _is_with_gaps(x: Any) -> bool:
    return isinstance(x, _WithGaps)


def is_resting_number(model: AbstractModel) -> Any:
    """A tree like the model, which is true where the numbers of the gaps are."""
    only = lambda x: jax.tree.map(lambda _: False, x)
    mark = lambda x: eqx.tree_at(lambda x: x.resting, only(x), True)
    is_leaf = _is_with_gaps
    return jax.tree.map(lambda x: mark(x) if is_leaf(x) else False, model, is_leaf=is_leaf)


def with_resting(model: AbstractModel, resting: Resting) -> AbstractModel:
    """The model in which these gaps stay closed."""
    change = lambda x: eqx.tree_at(lambda x: x.resting, x, resting)
    is_leaf = _is_with_gaps
    return jax.tree.map(lambda x: change(x) if is_leaf(x) else x, model, is_leaf=is_leaf)


def resting_of(model: AbstractModel) -> Resting:
    assert isinstance(model.system.constraint, _WithGaps)
    return model.system.constraint.resting


class Hits(eqx.Module):
    """What impacts do: the state after them, the gaps that stay closed and their forces,
    and a failure."""

    state: State
    resting: Resting | None
    forces: Float[Array, " gaps"]
    result: RESULTS


class Rest(eqx.Module):
    """When gaps stay closed: `time` to the next hit and `heights` of the hops until then
    below which they do."""

    time: Scalar
    heights: Float[Array, " gaps"]


class Impacts(eqx.Module):
    """All impacts of a run."""

    impacts: tuple[Impact, ...]

    @property
    def can_rest(self) -> bool:
        """Whether a gap may stay closed. After elastic impacts no gap does."""
        known = [x.restitution for x in self.impacts if is_known(x.restitution)]
        elastic = [e for e in known if not callable(e) and e == 1]
        return len(elastic) < len(self.impacts)

    def gaps(self, q: Coordinates, args: Args) -> Float[Array, " gaps"]:
        return jnp.stack([impact.distance(q, args) for impact in self.impacts])

    def restitutions(self, args: Args, dtype: Any) -> Float[Array, " gaps"]:
        return jnp.stack([x.coefficient(args, dtype) for x in self.impacts])

    def constrained(self, system: AbstractSystem, dtype: Any) -> AbstractSystem:
        """The system with a constraint for each gap, none of which is closed."""
        # The constructors of systems convert their arguments, so a copy is changed.
        new = copy.copy(system)
        # Scales are those of gaps that are closed; see `Watcher.begin`.
        resting = jnp.ones((len(self.impacts),), dtype)
        constraint = _WithGaps(system.constraint, self, resting)
        object.__setattr__(new, "constraint", constraint)
        # The row of a gap that is open is zero.
        object.__setattr__(new, "redundant", True)
        return new

    def rates(self, model: AbstractModel, state: State) -> Float[Array, " gaps"]:
        """The rates of the gaps; the state is one of `model`, which is `in_rates`."""
        q, qdot = state.q, model.lift(state.q, state.v)
        return jax.jvp(lambda q: self.gaps(q, model.args), (q,), (qdot,))[1]

    def motion(
        self, model: AbstractModel, state: State
    ) -> tuple[Float[Array, " gaps"], Float[Array, " gaps"]]:
        """The accelerations of the gaps, and the forces of those that stay closed."""
        change, multipliers = model.accelerations(state)
        at, along = (
            (state.q, state.v),
            (model.lift(state.q, state.v), change),
        )
        rate = lambda q, v: self.rates(model, State(q, v, state.t))
        _, accelerations = jax.jvp(rate, at, along)
        return accelerations, self.forces(model, state.q, multipliers)

    def forces(
        self, model: AbstractModel, q: Coordinates, multipliers: Multipliers
    ) -> Float[Array, " gaps"]:
        """The forces that push the gaps open; zero of those that are open."""
        rows = model.system.constraint
        assert isinstance(rows, _WithGaps)
        first = rows.first_row(q, model.args)
        return -rows.resting * multipliers[first : first + len(self.impacts)]

    def of_closed(
        self, model: AbstractModel, q: Coordinates, multipliers: Multipliers
    ) -> Multipliers:
        """The multipliers of a step, with zeros for the gaps that are open.

        The equations of a step hold those to round-off of zero.
        """
        rows = model.system.constraint
        assert isinstance(rows, _WithGaps)
        first = rows.first_row(q, model.args)
        gaps = slice(first, first + len(self.impacts))
        return multipliers.at[gaps].set(rows.resting * multipliers[gaps])

    def without_gaps(self, model: AbstractModel, q: Coordinates, rows: Array) -> Array:
        """Rows of the constraints, without those of the gaps."""
        constraint = model.system.constraint
        if not isinstance(constraint, _WithGaps):
            return rows
        first = constraint.first_row(q, model.args)
        last = first + len(self.impacts)
        return jnp.concatenate([rows[..., :first], rows[..., last:]], axis=-1)

    def after(self, model: AbstractModel, state: State, happens: Array, rest: Rest) -> Hits:
        """The state after the impacts that happen; states are those of `model`, which is
        `in_rates`."""
        resting = resting_of(model) if self.can_rest else None
        if resting is not None:
            released = happens & (resting > 0)
            resting, happens = jnp.where(released, 0.0, resting), happens & ~released
        e = self.restitutions(model.args, state.q.dtype)
        valid = jnp.all((e >= 0) & (e <= 1))
        state, resting, closes = self._hit(model, state, happens, resting)
        if resting is None:
            forces = jnp.zeros_like(happens, state.q.dtype)
            return Hits(state, None, forces, _outcome(valid, ~jnp.any(closes)))
        before = resting
        # Where hits in turn do not end, these gaps close for good.
        resting = jnp.maximum(resting, closes.astype(resting.dtype))
        resting, forces, ended = self.consistent(
            model, state, resting, happens & (e < 1), rest
        )
        held = project_velocity(with_resting(model, resting), state, ())[0]
        v = jnp.where(jnp.any(resting > before), held, state.v)
        end = State(state.q, v, state.t)
        scale = jnp.max(jnp.abs(self.rates(model, state)))
        still = self.rates(model, end) < -(jnp.finfo(v.dtype).eps ** 0.5) * scale
        resolved = ended & ~jnp.any(happens & still)
        return Hits(end, resting, forces, _outcome(valid, resolved))

    def _hit(
        self,
        model: AbstractModel,
        state: State,
        happens: Bool[Array, " gaps"],
        resting: Resting | None,
    ) -> tuple[State, Resting | None, Bool[Array, " gaps"]]:
        """The state after the impacts, one after another until none of these gaps closes,
        and the gaps that still do.

        Derivatives are those of impacts one after another too: each happens at the zero of
        its own gap, at a time that differs by `shift`, which is zero but has derivatives.
        """
        e = self.restitutions(model.args, state.q.dtype)
        corrections = 8 if isinstance(model.system, HamiltonianSystem) else 1
        constant = jax.lax.stop_gradient

        def hit(carry: tuple, k: Array) -> tuple[tuple, None]:
            q, v, resting = carry
            at = State(q, v, state.t)
            gap, rate = self.gaps(q, model.args)[k], self.rates(model, at)[k]
            is_hit = happens[k] & (rate < 0)
            shift = (constant(gap) - gap) / constant(jnp.where(is_hit, rate, 1.0))
            q, v = self._moved(model, at, resting, shift)
            rates = lambda v: self.rates(model, State(q, v, state.t))
            rate, slope = rates(v)[k], jax.grad(lambda v: rates(v)[k])(v)
            pressed, change = self._push(model, State(q, v, state.t), slope, resting)

            def correct(impulse: Scalar, _: None) -> tuple[Scalar, None]:
                off = -e[k] * rate - rates(v + impulse * change)[k]
                return impulse + off / (slope @ change), None

            none = jnp.zeros_like(rate)
            impulse, _ = jax.lax.scan(correct, none, None, length=corrections)
            after = State(q, v + impulse * change, state.t)
            q, v = self._moved(model, after, pressed, -shift)
            choose = lambda x, y: jnp.where(is_hit, x, y)
            return jax.tree.map(choose, (q, v, pressed), carry), None

        number = len(self.impacts)
        order = jnp.tile(jnp.arange(number), 1 if number == 1 else _SWEEPS)
        (q, v, resting), _ = jax.lax.scan(hit, (state.q, state.v, resting), order)
        end = State(q, v, state.t)
        eps, speed = jnp.finfo(q.dtype).eps, jnp.max(jnp.abs(self.rates(model, state)))
        closes = happens & (self.rates(model, end) < -1e3 * eps * speed)
        return end, resting, closes

    def _moved(
        self, model: AbstractModel, state: State, held: Resting | None, shift: Scalar
    ) -> tuple[Coordinates, Velocities]:
        """Positions and velocities after the time `shift`, to first order."""
        if len(self.impacts) == 1:
            return state.q, state.v
        at: State
        inner, at = values_of((model if held is None else with_resting(model, held), state))
        qdot, vdot = inner.lift(at.q, at.v), inner.accelerations(at)[0]
        return state.q + shift * qdot, state.v + shift * vdot

    def _push(
        self, model: AbstractModel, state: State, slope: Velocities, resting: Resting | None
    ) -> tuple[Resting | None, Velocities]:
        """The gaps that stay closed in a hit, and the change of the velocities by a unit
        impulse along `slope`."""
        pushed = state.v + model.inverse_regular_metric(state) @ slope

        def change_with(held: Resting | None) -> Velocities:
            inner = model if held is None else with_resting(model, held)
            after = project_velocity(inner, State(state.q, pushed, state.t), ())[0]
            return after - state.v

        if resting is None:
            return None, change_with(None)
        rates = lambda v: self.rates(model, State(state.q, v, state.t))

        # A closed gap transmits the impact if this presses it, and opens if not.
        def press(held: Resting, _: None) -> tuple[Resting, tuple]:
            change = change_with(held)
            moves = jax.jvp(rates, (state.v,), (change,))[1]
            return jnp.where(moves < 0, resting, 0.0), (held, change)

        _, tried = jax.lax.scan(press, jnp.zeros_like(resting), None, length=2)
        return jax.tree.map(lambda x: x[-1], tried)

    def consistent(
        self,
        model: AbstractModel,
        state: State,
        resting: Resting,
        touching: Bool[Array, " gaps"],
        rest: Rest,
    ) -> tuple[Resting, Float[Array, " gaps"], Flag]:
        """The gaps that stay closed, their forces, and whether the search for them has
        ended.

        No force pulls, and every gap stays closed that is `touching` and would close again
        soon, as `rest` says. Gaps open before others close.
        """
        # Which gaps stay closed has no derivative.
        model, state, resting = values_of((model, state, resting))
        rounding = jnp.finfo(state.q.dtype).eps ** 0.5
        rate = self.rates(model, state)

        def improve(resting: Resting, _: None) -> tuple[Resting, tuple[Array, Flag]]:
            acceleration, force = self.motion(with_resting(model, resting), state)
            pulls = force < -rounding * jnp.max(jnp.abs(force))
            # The next hit is due after the time `2 rate / -acceleration`, and the gap then
            # has been `rate^2 / (2 -acceleration)` wide.
            soon = 2 * rate < -rest.time * acceleration
            low = rate * jnp.abs(rate) <= -2 * acceleration * rest.heights
            closes = touching & (acceleration < 0) & soon & low
            closes = jnp.where(closes & ~jnp.any(pulls), 1.0, resting)
            new = jnp.where(pulls, 0.0, closes).astype(state.q.dtype)
            return new, (force, jnp.all(new == resting))

        length = 2 * len(self.impacts) + 1
        resting, (forces, ended) = jax.lax.scan(improve, resting, None, length=length)
        return resting, forces[-1], ended[-1]


def _outcome(valid: Flag, resolved: Flag) -> RESULTS:
    """The outcome of impacts: whether restitutions are valid, and no gap closes."""
    result = RESULTS.where(resolved, RESULTS.successful, RESULTS.impacts_unresolved)
    return RESULTS.where(valid, result, RESULTS.restitution_out_of_range)
