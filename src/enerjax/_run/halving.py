"""A solve, and where it fails the same step in 2, 4, 8 parts.

In the whip of a chain, or past a singular pose, the equations of a few steps have no
solution that Newton could find; those of shorter steps have. The laws of the energy hold
for steps of any length, so nothing is lost but the uniform step.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._operators import AbstractModel
from .._programs import in_any_lane
from .._results import RESULTS
from .._solvers import RootFinder, SMALL
from .._system import State
from .._types import Count, Flag, Scalar
from ..schemes import AbstractOneSolveScheme, StepEnd
from .stage import first_memory, Memory, num_unknowns, solve, Solved


# Of large systems, whose single steps cost far more than what a second program does.
_HALVINGS_OF_LARGE_SYSTEMS = 3


def solve_or_divide(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    memory: Memory,
    root_finder: RootFinder,
    skip: Flag,
    max_halvings: int | None,
) -> tuple[Solved, Count]:
    """A step, whole if it can be, and how often it was halved.

    `None` allows three halvings of a large system, none of a small one.
    """
    whole = solve(scheme, model, start, h, memory, root_finder, skip)
    if max_halvings is None:
        is_large = num_unknowns(memory) > SMALL
        max_halvings = _HALVINGS_OF_LARGE_SYSTEMS if is_large else 0
    none = jnp.array(0)
    if max_halvings == 0:
        return whole, none

    def halve(carry: tuple[Solved, Count], times: Count):
        before, halvings = carry
        failed = (before.result != RESULTS.successful) & ~skip

        def again():
            parts, most = (2**times).astype(h.dtype), 2**max_halvings
            new = _in_parts(scheme, model, start, h, root_finder, before, parts, most)
            return _select(failed, (new, times), carry)

        return jax.lax.cond(in_any_lane(failed), again, lambda: carry), None

    def divided():
        return jax.lax.scan(halve, (whole, none), jnp.arange(1, max_halvings + 1))[0]

    # Not stored for the reverse pass, but done again there: it is rare.
    forget = jax.checkpoint_policies.nothing_saveable
    failed = (whole.result != RESULTS.successful) & ~skip
    # Lanes that take their steps together share the program: it runs if one needs it.
    return jax.lax.cond(
        in_any_lane(failed), jax.checkpoint(divided, policy=forget), lambda: (whole, none)
    )


def _in_parts(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    root_finder: RootFinder,
    before: Solved,
    parts: Scalar,
    most: int,
) -> Solved:
    """A step that has failed `before`, in `parts` steps, which are at `most` so many."""
    length = h / parts

    def begin(state: State, length: Scalar, may_chord: bool) -> Memory:
        rates = model.accelerations(state)
        return first_memory(scheme, model, state, length, *rates, may_chord=may_chord)

    def part(sofar: Solved, k: Scalar):
        unused = (sofar.result != RESULTS.successful) | (k >= parts)
        state = _timed(sofar.end.state, start, k * length)
        new = solve(scheme, model, state, length, sofar.memory, root_finder, unused)
        return _select(unused, sofar, _joined(sofar, new, parts)), None

    none = jax.tree.map(jnp.zeros_like, before.end)
    nothing = StepEnd(
        state=State(start.q, start.v, before.end.state.t),
        displacement=none.displacement,
        multipliers=none.multipliers,
        energies=none.energies,
        details=before.end.details,
        carried=before.end.carried,
    )
    first = Solved(
        end=nothing,
        iterations=before.iterations,
        residual=before.residual,
        result=RESULTS.successful,
        roughness=before.roughness,
        # By Newton's method alone: a second program for rare steps would compile for long.
        memory=begin(start, length, may_chord=False),
    )
    done, _ = jax.lax.scan(part, first, jnp.arange(most, dtype=h.dtype))
    state = _timed(done.end.state, start, h)
    return eqx.tree_at(lambda done: done.memory, done, begin(state, h, may_chord=True))


def _timed(state: State, start: State, passed: Scalar) -> State:
    t = None if start.t is None else start.t + passed
    return State(state.q, state.v, t)


def _joined(a: Solved, b: Solved, parts: Scalar) -> Solved:
    """What one part adds to those before it."""
    end = StepEnd(
        state=b.end.state,
        displacement=a.end.displacement + b.end.displacement,
        # The mean force over the step.
        multipliers=a.end.multipliers + b.end.multipliers / parts,
        energies=jax.tree.map(jnp.add, a.end.energies, b.end.energies),
        details=b.end.details,
        result=b.end.result,
        carried=b.end.carried,
    )
    return Solved(
        end=end,
        iterations=a.iterations + b.iterations,
        residual=b.residual,
        result=b.result,
        roughness=b.roughness,
        memory=b.memory,
    )


def _select(choice: Flag, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(choice, a, b), yes, no)
