"""What a step of a system computes, in words: to find out why it is slow."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from .._operators import AbstractModel, Increment, SeparableModel
from .._programs import num_operations, simplified, why_not_one_function
from .._run.events import AbstractEvent
from .._run.inputs import prepare
from .._run.loop import dispensable_newton, Stepper
from .._run.model import model_for
from .._run.stage import (
    free_flight,
    is_chord_alone,
    owners_of,
    step_problem,
)
from .._run.step_sizes import End, EqualSteps
from .._run.watcher import Watcher, watcher_of
from .._run.without_jacobian import contraction, CONTRACTS
from .._solvers import ChordAlone, form_of, Newton, regularised, RootFinder, SMALL
from .._system import AbstractSystem, State
from .._types import Args, Real, Scalar
from ..schemes import AbstractScheme


# As in a run that does not say otherwise.
_MAX_EVENTS = 64


@dataclasses.dataclass(frozen=True)
class Explanation:
    """What a step computes; `print` shows it.

    - `coordinates`: how the coordinates move.
    - `solves`: the number of solves in a step.
    - `unknowns`: the number of unknowns of a solve, by what they are.
    - `method`: how they are searched for. Beside a chord method programs have Newton's
      method from the beginning where forces are stiff, with events, with a
      `StepController`, and inside of `jit` and other transformations.
    - `chord`: how the matrix `B M^-1 B^T` of the constraints, and of strains where their
      stiffness is included, is eliminated; `None` where the chord method is not used, or
      there are no constraints.
    - `contraction`: how much of an error a correction of the chord method leaves, by the
      forces that this matrix omits, at the start and for steps of length `h`. Above 0.25
      programs have Newton's method from the beginning. `None` without an `h`.
    - `jacobian`: how the exact Jacobian is stored and eliminated.
    - `obstacles`: the operations that keep a step from being one function of machine code,
      with the places where they are called; empty if it is one function.
    - `operations`: the number of scalar operations of an evaluation of the step equations,
      of which a correction needs one.
    - `events`: what a step looks for besides; `None` without events.
    """

    coordinates: str
    solves: int
    unknowns: dict[str, int]
    method: str
    chord: str | None
    contraction: float | None
    jacobian: str
    obstacles: tuple[str, ...]
    operations: int
    events: str | None

    def __str__(self) -> str:
        parts = ", ".join(f"{count} {name}" for name, count in self.unknowns.items())
        solves = "one solve" if self.solves == 1 else f"{self.solves} solves"
        lines = [
            f"coordinates: {self.coordinates}",
            f"a step: {solves}, each of {sum(self.unknowns.values())} unknowns ({parts})",
            f"method: {self.method}",
            *([] if self.chord is None else [f"matrix of the constraints: {self.chord}"]),
            *([] if self.contraction is None else [self._omitted(self.contraction)]),
            *([] if self.events is None else [f"events: {self.events}"]),
            f"exact Jacobian: {self.jacobian}",
            f"step equations: about {self.operations} scalar operations",
        ]
        if not self.obstacles:
            lines.append("one function of machine code: yes")
        else:
            lines.append("one function of machine code: no, because of")
            lines += [f"    {obstacle}" for obstacle in self.obstacles]
        return "\n".join(lines)

    def _omitted(self, contraction: float) -> str:
        found = f"forces that it omits: a correction leaves {contraction:.2g} of an error"
        if not contraction > CONTRACTS:
            return found
        return f"{found}, so steps are solved by Newton's method"


def explain(
    system: AbstractSystem,
    scheme: AbstractScheme,
    start: State,
    args: Args = None,
    *,
    h: Real | None = None,
    root_finder: RootFinder = Newton(),
    events: AbstractEvent | Sequence[AbstractEvent] = (),
) -> Explanation:
    """What a step of a system by a scheme computes, without computing it.

    It tells which method finds the unknowns, how its matrices are eliminated, and whether
    the step is one function of machine code, or because of which operations it is not. A
    step that is not one function takes several times as long if the system is small.

    **Arguments:** as for `simulate`; events of the system count too. With the length `h` of
    a step (time) it also tells whether the forces are so stiff that the chord method is of
    no use.

    **Returns:** an `Explanation`; `print` it.

    **Raises:** `ValueError` or `TypeError` for bad input, as `simulate` does.
    """
    length = 1.0 if h is None else h
    prepared = prepare(system, scheme, start, args, length, 0.0, root_finder)
    system, start, args, step, *_ = prepared
    found: list[Explanation] = []
    watcher = watcher_of(system, events, _MAX_EVENTS, scheme, False)
    if watcher is not None:
        system = watcher.system(system, start.q.dtype)

    # Everything is found while this function is traced.
    def traced(start: State, args: Args, h: Scalar) -> Scalar:
        model = model_for(scheme, system, start, args)
        internal = model.to_internal(start)
        found.append(_explained(scheme, model, internal, h, root_finder, watcher))
        return h

    jax.eval_shape(traced, start, args, step)
    if h is None or not found[0].method.startswith(_CHORD):
        return found[0]
    left = float(contraction(scheme, system, start, args, jnp.asarray(step)))
    return dataclasses.replace(found[0], contraction=left)


def _explained(
    scheme: AbstractScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    root_finder: RootFinder,
    watcher: Watcher | None,
) -> Explanation:
    plan = EqualSteps().plan(scheme, h, jnp.zeros_like(h), End(num_steps=1))
    if watcher is not None:
        plan = plan.with_events(watcher.max_attempts)
    dispensable = dispensable_newton(root_finder, scheme, plan, watcher)
    search = root_finder
    if dispensable is not None:
        search = ChordAlone(dispensable)
    stepper = Stepper(scheme, model, plan, search, None, watcher)
    begin = stepper.begin(start)
    memory = jax.tree.map(lambda x: x[0], begin.warm.stages)
    by_chord = is_chord_alone(search, scheme.stage, model)
    step = lambda progress: stepper.attempt(progress, jnp.array(True))
    problem = step_problem(scheme.stage, model, start, h, memory.carried)
    z = free_flight(scheme.stage, problem, model, start)
    flat, unravel = ravel_pytree(z)
    equations = lambda x: ravel_pytree(scheme.stage.residual(unravel(x), problem))[0]
    jacobian = f"as {type(root_finder).__name__} chooses"
    if isinstance(root_finder, Newton):
        redundant = jnp.ones_like(flat) if model.system.redundant else None
        form = form_of(
            regularised(equations, redundant),
            flat,
            root_finder.linear_solver,
            owners=owners_of(z, model.num_joints),
            small=0 if by_chord else SMALL,
        )
        jacobian = form.description(flat.size)
    newton = "Newton's method" if isinstance(root_finder, Newton) else jacobian
    return Explanation(
        coordinates=_coordinates(model, start),
        solves=len(scheme.stages),
        unknowns=_unknowns(z),
        method=_BY_CHORD.format(newton) if by_chord else newton,
        chord=_chord(model) if by_chord else None,
        contraction=None,
        jacobian=jacobian,
        obstacles=why_not_one_function(step, begin),
        operations=num_operations(simplified(equations), flat),
        events=None if watcher is None else _events(watcher),
    )


_CHORD = "chord method"
_BY_CHORD = _CHORD + ", without the exact Jacobian; if that fails in a step, {}"


def _coordinates(model: AbstractModel, start: State) -> str:
    count = start.q.size
    if not isinstance(model, SeparableModel):
        return f"{count} coordinates with {count} momenta"
    return model.kinematics.describe(start.q, start.v)


def _chord(model: AbstractModel) -> str | None:
    if isinstance(model, SeparableModel) and model.elastic_tables is not None:
        return model.elastic_tables.description
    tables = model.constraint_tables
    return None if tables is None else tables.description


def _events(watcher: Watcher) -> str:
    count = len(watcher.events)
    told = f"{count} function{'s' * (count > 1)}, whose zeros are searched for in each step"
    rests = "; gaps that can stay closed are rows of redundant constraints"
    return told + rests * watcher.can_rest


_NAMES = {
    "rate": "increments",
    "momentum": "momenta",
    "impulse": "multipliers",
    "velocity_impulse": "multipliers of velocity constraints",
}


def _unknowns(z: Any) -> dict[str, int]:
    parts = jax.tree.leaves(z, is_leaf=lambda x: isinstance(x, Increment))
    counts: dict[str, int] = {}
    for part in parts:
        named = (
            {_NAMES[name]: getattr(part, name).size for name in _NAMES}
            if isinstance(part, Increment)
            else {"others": part.size}
        )
        for name, size in named.items():
            counts[name] = counts.get(name, 0) + size
    return {name: size for name, size in counts.items() if size > 0}
