"""A run with its checked arguments: what its programs have in common."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._operators import AbstractModel
from .._results import first_failure, RESULTS
from .._solvers import ChordAlone, RootFinder
from .._system import AbstractSystem, has_valid_energy, State
from .._types import Args, Coordinates, Scalar
from ..schemes import AbstractScheme
from .audit import audit, Measures, measures
from .events import Events
from .loop import Progress, Stepper
from .model import model_for
from .saving import AbstractSaving, Record, Rows, SaveFunction
from .solution import Solution, Statistics
from .step_sizes import AbstractPlan
from .watcher import Watcher


# States of so many coordinates are observed one after the other: vectors are then along the
# coordinates, and the code would have a copy for every row.
_MANY = 128


class Task(NamedTuple):
    """The checked arguments of `simulate`.

    - `is_checked`: whether the values of the kinetic energy have been checked too.
    """

    system: AbstractSystem
    scheme: AbstractScheme
    start: State
    args: Args
    plan: AbstractPlan
    saving: AbstractSaving
    fn: SaveFunction | None
    root_finder: RootFinder | ChordAlone
    max_halvings: int | None
    watcher: Watcher | None = None
    is_checked: bool = True

    def stepper(self) -> Stepper:
        system, watcher = self.system, self.watcher
        if watcher is not None:
            system = watcher.system(system, self.start.q.dtype)
        return Stepper(
            scheme=self.scheme,
            model=model_for(
                self.scheme,
                system,
                self.start,
                self.args,
                omits_dampers=isinstance(self.root_finder, ChordAlone)
                and self.root_finder.omits_dampers,
            ),
            plan=self.plan,
            root_finder=self.root_finder,
            max_halvings=self.max_halvings,
            watcher=self.watcher,
            checked=self._checked(),
        )

    def _checked(self) -> RESULTS:
        """The outcome of checks in the program of a run, whose numbers may be traced."""
        unit = jax.lax.stop_gradient(self.plan.unit)
        goes_on = (unit > 0) & jnp.isfinite(unit)
        step = RESULTS.where(goes_on, RESULTS.successful, RESULTS.invalid_step)
        if self.is_checked:
            return step
        valid = has_valid_energy(self.system, self.start, self.args)
        energy = RESULTS.where(valid, RESULTS.successful, RESULTS.invalid_energy)
        return first_failure(step, energy)

    @property
    def observes_in_loop(self) -> bool:
        """Whether the loop keeps values of `fn`.

        Then states need not be stored. Otherwise they are observed together after the loop,
        which is faster.
        """
        return self.fn is not None and self.saving.keeps_rows

    def keep(self, model: AbstractModel) -> Callable[[State, Scalar], PyTree[Any]]:
        """What the loop keeps of the state at a place."""

        def keep(state: State, place: Scalar) -> PyTree[Any]:
            kept = model.to_rates(state)
            if not self.observes_in_loop:
                return kept
            return self._observe(model, kept, self.plan.time(place))

        return keep

    def _observe(
        self, model: AbstractModel, state: State, t: Scalar
    ) -> tuple[PyTree[Any], Measures]:
        """The user's form of a state, or the value of `fn`, and its part of the audit.

        The state is one of `model.in_rates`.
        """
        value: PyTree[Any] = model.in_rates.to_user(state)
        if self.fn is not None:
            value = jax.tree.map(jnp.asarray, self.fn(t, value, model.args))
        timed = State(state.q, state.v, t if self.system.is_timed else None)
        return value, self._measures(model.in_rates, timed)

    def _measures(self, model: AbstractModel, state: State) -> Measures:
        """The part of the audit of a state, without the gaps of impacts."""
        found = measures(model, state)
        rows = lambda found: (found.constraint, found.constraint_rate)
        of_user = [self._without_gaps(model, state.q, x) for x in rows(found)]
        return eqx.tree_at(rows, found, tuple(of_user))

    def _without_gaps(self, model: AbstractModel, q: Coordinates, rows: Array) -> Array:
        """Rows of constraints without those of the gaps of impacts."""
        watcher = self.watcher
        if watcher is None or not watcher.can_rest:
            return rows
        return watcher.impacts.without_gaps(model, q, rows)

    def events(
        self, model: AbstractModel, record: Record, multipliers: Float[Array, "times nc"]
    ) -> Events | None:
        """The events of a run, from the record of all its attempted steps.

        `multipliers` are those of the rows, with those of the gaps of impacts.
        """
        watcher = self.watcher
        if watcher is None:
            return None
        happening = record.happening
        assert happening is not None
        happened = jnp.any(happening.happens, axis=1)
        numbers = jnp.arange(watcher.max_events)
        at = jnp.searchsorted(jnp.cumsum(happened), numbers + 1)
        count = jnp.sum(happened)
        is_event = numbers < count
        user = jax.vmap(model.in_rates.to_user)

        def picked(x: Array) -> Array:
            x = x[jnp.minimum(at, happened.size - 1)]
            valid = is_event.reshape(-1, *[1] * (x.ndim - 1))
            return jnp.where(valid, x, False if x.dtype == bool else jnp.nan)

        forces = lambda rows: watcher.contact_forces(model, self.start.q, rows)
        return Events(
            ts=picked(jax.vmap(self.plan.time)(record.place)),
            happened=picked(happening.happens),
            closed=picked(happening.closed),
            before=jax.tree.map(picked, user(happening.before)),
            after=jax.tree.map(picked, user(happening.after)),
            count=count,
            contact_forces=jax.vmap(forces)(multipliers),
        )

    def solution(self, model: AbstractModel, rows: Rows, end: Progress) -> Solution:
        """The solution with these rows, of a run that has ended."""

        def observe(state: State, t: Scalar, varying: PyTree[Any]) -> Any:
            return self._observe(eqx.combine(varying, model), state, t)

        if self.observes_in_loop:
            ys, measured = rows.kept
        else:
            each = jax.vmap if self.start.q.size < _MANY else _one_after_the_other
            ys, measured = each(observe)(rows.kept, rows.ts, rows.varying)
        of_user = lambda x: self._without_gaps(model, self.start.q, x)
        return Solution(
            ts=rows.ts,
            ys=ys,
            multipliers=of_user(jax.vmap(model.user_multipliers)(rows.multipliers)),
            details=rows.details,
            audit=audit(measured, rows.energies),
            stats=Statistics(
                newton_iterations=rows.costs.iterations,
                residual=rows.costs.residual,
                halvings=rows.costs.halvings,
                local_error=rows.costs.local_error,
                completed_steps=end.completed,
                rejected_steps=self.plan.num_rejected(end.memory),
            ),
            end=eqx.combine(end.varying, model).to_user(end.state),
            result=end.result,
            names=self.system.names,
        )


def _one_after_the_other(fn: Callable[..., PyTree[Any]]) -> Callable[..., PyTree[Any]]:
    """Like `vmap`, by a loop, whose code does not grow with the number of rows."""
    return lambda *rows: jax.lax.map(lambda row: fn(*row), rows)
