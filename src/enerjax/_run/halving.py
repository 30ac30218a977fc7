"""A step, which is divided into 2, 4, 8 equal steps if it fails.

When a chain cracks like a whip, or near a singular pose, Newton's method finds no solution
for some steps, but it does for shorter ones. The energy identity holds for steps of any
length, so dividing a step costs nothing but its uniform length.
"""

from collections.abc import Callable
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
from ..schemes import AbstractOneSolveScheme, AbstractSchemeWithMemory, StepEnd
from .stage import first_memory, Memory, num_unknowns, solve, Solved


# The default for large systems: their steps take far longer than compiling the division.
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
    """The solved step, and how often it was halved.

    By default a step of a large system may be halved three times, and that of a small
    system not at all.
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
            count, max_count = (2**times).astype(h.dtype), 2**max_halvings
            new = _divided(
                scheme, model, start, h, memory, root_finder, before, count, max_count
            )
            return select(failed, (new, times), carry)

        return jax.lax.cond(in_any_lane(failed), again, lambda: carry), None

    def all_halvings():
        return jax.lax.scan(halve, (whole, none), jnp.arange(1, max_halvings + 1))[0]

    # The reverse pass repeats a divided step instead of storing it, because it is rare.
    repeated = jax.checkpoint(all_halvings, policy=jax.checkpoint_policies.nothing_saveable)
    failed = (whole.result != RESULTS.successful) & ~skip
    return jax.lax.cond(in_any_lane(failed), repeated, lambda: (whole, none))


def _divided(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    memory: Memory,
    root_finder: RootFinder,
    before: Solved,
    count: Scalar,
    max_count: int,
) -> Solved:
    """A step as `count` equal steps, of which there may be `max_count`.

    `before` is the last attempt, which failed.
    """
    length = h / count
    first_memory, last_memory = _memories(scheme, model, start, h, memory, count)

    def one_step(sofar: Solved, k: Scalar):
        unused = (sofar.result != RESULTS.successful) | (k >= count)
        state = _at_time(sofar.end.state, start, k * length)
        new = solve(
            scheme, model, state, length, sofar.memory, root_finder, unused, rarely=True
        )
        return select(unused, sofar, _joined(sofar, new, count)), None

    zero = jax.tree.map(jnp.zeros_like, before.end)
    nothing = StepEnd(
        state=State(start.q, start.v, before.end.state.t),
        displacement=zero.displacement,
        multipliers=zero.multipliers,
        energies=zero.energies,
        details=before.end.details,
        carried=before.end.carried,
    )
    first = Solved(
        end=nothing,
        iterations=before.iterations,
        residual=before.residual,
        result=RESULTS.successful,
        roughness=before.roughness,
        memory=first_memory,
    )
    done, _ = jax.lax.scan(one_step, first, jnp.arange(max_count, dtype=h.dtype))
    state = _at_time(done.end.state, start, h)
    return eqx.tree_at(lambda done: done.memory, done, last_memory(state, done.memory))


def _memories(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    memory: Memory,
    count: Scalar,
) -> tuple[Memory, Callable[[State, Memory], Memory]]:
    """The memory of the first of `count` equal steps, and that after the last of them.

    The second is a function of the state at the end and the memory of the last short step.
    The short steps use Newton's method alone, because a chord method for these rare steps
    would take long to compile.
    """
    if isinstance(scheme, AbstractSchemeWithMemory):

        def begin(state: State, length: Scalar) -> Memory:
            return first_memory(scheme, model, state, length, *model.accelerations(state))

        return begin(start, h / count), lambda state, last: begin(state, h)
    # What a step adds to a free flight is proportional to its length.
    scaled = lambda factor, added: jax.tree.map(lambda x: factor * x, added)
    by_newton = Memory(
        added=scaled(1 / count, memory.added),
        is_smooth=jnp.array(False),
        factors=memory.factors,
        chord_wait=None,
        carried=memory.carried,
    )

    def after(_: State, last: Memory) -> Memory:
        return Memory(
            added=scaled(count, last.added),
            is_smooth=jnp.array(False),
            factors=last.factors,
            chord_wait=memory.chord_wait,
            carried=last.carried,
        )

    return by_newton, after


def _at_time(state: State, start: State, passed: Scalar) -> State:
    t = None if start.t is None else start.t + passed
    return State(state.q, state.v, t)


def _joined(a: Solved, b: Solved, count: Scalar) -> Solved:
    """The steps in `a` followed by the step `b`, of `count` in all."""
    end = StepEnd(
        state=b.end.state,
        displacement=a.end.displacement + b.end.displacement,
        # The mean force over the whole step.
        multipliers=a.end.multipliers + b.end.multipliers / count,
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


def select(choice: Flag, yes: Any, no: Any) -> Any:
    """`jnp.where` for trees."""
    return jax.tree.map(lambda a, b: jnp.where(choice, a, b), yes, no)
