"""A step, which is divided into 2, 4, 8 equal steps if it fails.

When a chain cracks like a whip, or near a singular pose, Newton's method finds no solution
for some steps, but it does for shorter ones. The energy identity holds for steps of any
length, so dividing a step costs nothing but its uniform length.

A run is a loop over attempts, whose body solves one step, whole or a part: one program
solves them all. Reverse mode cannot differentiate such a loop. Its derivatives are those of
a whole step, and of a scan over the parts behind a condition. This doubles the program of a
derivative, so that steps are divided in derivatives only if the user has asked for it.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._operators import AbstractModel
from .._programs import call_traced_once, in_any_lane
from .._results import RESULTS
from .._solvers import ChordAlone, RootFinder, SMALL
from .._system import State
from .._types import Count, Flag, Scalar
from ..schemes import AbstractOneSolveScheme, AbstractSchemeWithMemory, StepEnd
from .prediction import Memory
from .stage import first_memory, is_chord_alone, num_unknowns, solve, Solved, unsolved


# The default for large systems: their steps take far longer than compiling the division.
_HALVINGS_OF_LARGE_SYSTEMS = 3
# A wait for the chord method that is longer than any division.
_NO_CHORD = 2**30


class _Step(eqx.Module):
    """A step that is to be solved, with the arguments of `solve`."""

    scheme: AbstractOneSolveScheme
    model: AbstractModel
    start: State
    h: Scalar
    memory: Memory
    root_finder: RootFinder | ChordAlone
    skip: Flag

    def solve(self, rarely: bool = False) -> Solved:
        """The whole step."""
        return solve(
            self.scheme,
            self.model,
            self.start,
            self.h,
            self.memory,
            self.root_finder,
            self.skip,
            rarely=rarely,
        )

    def part(self, sofar: Solved, k: Scalar, count: Scalar, skip: Flag) -> "_Step":
        """Part `k` of `count`, after the parts in `sofar`."""
        length = self.h / count
        return _Step(
            scheme=self.scheme,
            model=self.model,
            start=_at_time(sofar.end.state, self.start, k * length),
            h=length,
            memory=sofar.memory,
            root_finder=self.root_finder,
            skip=skip,
        )


def solve_or_divide(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    memory: Memory,
    root_finder: RootFinder | ChordAlone,
    skip: Flag,
    max_halvings: int | None,
) -> tuple[Solved, Count]:
    """The solved step, and how often it was halved.

    By default a step of a large system may be halved three times, and that of a small
    system not at all. Derivatives by default do not divide steps: a step that would be
    divided fails in them. Where the chord method is alone, a step that it cannot solve
    fails.
    """
    step = _Step(scheme, model, start, h, memory, root_finder, skip)
    asked_for = max_halvings is not None
    if max_halvings is None:
        is_large = num_unknowns(memory) > SMALL
        max_halvings = _HALVINGS_OF_LARGE_SYSTEMS if is_large else 0
    if is_chord_alone(root_finder, scheme, model):
        max_halvings = 0
    if max_halvings == 0:
        return step.solve(), jnp.array(0)
    return _solve_or_divide(step, max_halvings, asked_for)


def _solved_once(step: _Step) -> Solved:
    """The step or part, solved by a program that is traced once for all of them.

    The loop over attempts contains it, and so do the derivatives.
    """
    return call_traced_once(_Step.solve, step)


class _Attempts(eqx.Module):
    """The carry of the loop over attempts.

    - `sofar`: the solved parts of the step.
    - `halvings`, `k`: there are `2**halvings` parts, and `k` of them are solved.
    """

    sofar: Solved
    halvings: Count
    k: Count

    @property
    def unfinished(self) -> Flag:
        """Whether a part is left, and none has failed for good."""
        # XLA searches the body of a loop whose condition reads a single number of the
        # carry for a count of its passes, again and again, which takes seconds.
        left = self.k < (1 << self.halvings)
        return left & (self.sofar.result == RESULTS.successful)


@eqx.filter_custom_jvp
def _solve_or_divide(
    step: _Step, max_halvings: int, asked_for: bool
) -> tuple[Solved, Count]:
    wait = None if step.memory.chord_wait is None else jnp.array(_NO_CHORD)

    def attempt(before: _Attempts) -> _Attempts:
        count = (1 << before.halvings).astype(step.h.dtype)
        k = before.k.astype(step.h.dtype)
        new = _solved_once(step.part(before.sofar, k, count, step.skip))
        sofar = _joined(before.sofar, new, count)
        failed = (new.result != RESULTS.successful) & ~step.skip
        divides = failed & (before.halvings < max_halvings)

        def again() -> Solved:
            memory = _memory_of_parts(step, 2 * count, wait)
            return select(divides, _nothing(step, sofar, memory), sofar)

        halvings = before.halvings + divides.astype(before.halvings.dtype)
        return _Attempts(
            sofar=jax.lax.cond(in_any_lane(divides), again, lambda: sofar),
            halvings=halvings,
            k=jnp.where(divides, 0, before.k + 1),
        )

    nothing = unsolved(step.scheme, step.model, step.start, step.h, step.memory)
    first = _Attempts(nothing, jnp.array(0), jnp.array(0))
    last = jax.lax.while_loop(lambda carry: carry.unfinished, attempt, first)
    divided = last.halvings > 0

    def after() -> Solved:
        count = (1 << last.halvings).astype(step.h.dtype)
        return select(divided, _with_memory_after(step, last.sofar, count), last.sofar)

    return jax.lax.cond(in_any_lane(divided), after, lambda: last.sofar), last.halvings


@_solve_or_divide.def_jvp
def _solve_or_divide_jvp(primals: Any, tangents: Any) -> Any:
    """The derivatives of a whole step. If it has failed and the user has asked for
    halvings, they are those of its parts."""
    (step, max_halvings, asked_for), (t_step, *_) = primals, tangents

    def in_parts(step: _Step) -> tuple[Solved, Count]:
        if not asked_for:
            return _solved_once(step), jnp.array(0)
        return _solve_and_divide(step, max_halvings)

    return eqx.filter_jvp(in_parts, (step,), (t_step,))


def _solve_and_divide(step: _Step, max_halvings: int) -> tuple[Solved, Count]:
    """`_solve_or_divide` as a program that can be differentiated in reverse mode."""
    whole = _solved_once(step)

    def halve(carry: tuple[Solved, Count], times: Count):
        before, halvings = carry
        failed = (before.result != RESULTS.successful) & ~step.skip

        def again():
            return select(
                failed, (_divided(step, before, times, max_halvings), times), carry
            )

        return jax.lax.cond(in_any_lane(failed), again, lambda: carry), None

    def all_halvings():
        times = jnp.arange(1, max_halvings + 1)
        return jax.lax.scan(halve, (whole, jnp.array(0)), times)[0]

    # The reverse pass repeats a divided step instead of storing it, because it is rare.
    repeated = jax.checkpoint(all_halvings, policy=jax.checkpoint_policies.nothing_saveable)
    failed = (whole.result != RESULTS.successful) & ~step.skip
    return jax.lax.cond(in_any_lane(failed), repeated, lambda: (whole, jnp.array(0)))


def _divided(step: _Step, before: Solved, times: Count, max_halvings: int) -> Solved:
    """A step in `2**times` parts; `before` is the last attempt, which failed."""
    count = (1 << times).astype(step.h.dtype)

    def one_part(sofar: Solved, k: Scalar):
        unused = (sofar.result != RESULTS.successful) | (k >= count)
        new = step.part(sofar, k, count, unused).solve(rarely=True)
        return select(unused, sofar, _joined(sofar, new, count)), None

    parts = jnp.arange(2**max_halvings, dtype=step.h.dtype)
    nothing = _nothing(step, before, _memory_of_parts(step, count, None))
    done, _ = jax.lax.scan(one_part, nothing, parts)
    return _with_memory_after(step, done, count)


def _nothing(step: _Step, before: Solved, memory: Memory) -> Solved:
    """A step of which no part is solved, after the failed attempt `before`."""
    nothing = unsolved(step.scheme, step.model, step.start, step.h, memory)
    return eqx.tree_at(
        lambda solved: (solved.iterations, solved.residual),
        nothing,
        (before.iterations, before.residual),
    )


def _memory_of_parts(step: _Step, count: Scalar, chord_wait: Count | None) -> Memory:
    """The memory of the first of `count` parts.

    The parts use Newton's method alone: the chord method has failed, or was waiting.
    """
    if isinstance(step.scheme, AbstractSchemeWithMemory):
        return _begun(step, step.start, step.h / count)
    memory = step.memory
    return Memory(
        # What a step adds to a free flight is proportional to its length.
        differences=jax.tree.map(lambda x: x / count, memory.differences),
        choice=jnp.array(0),
        factors=memory.factors,
        chord_wait=chord_wait,
        carried=memory.carried,
    )


def _with_memory_after(step: _Step, done: Solved, count: Scalar) -> Solved:
    """The solved parts, with a memory for the next whole step."""
    last = done.memory
    if isinstance(step.scheme, AbstractSchemeWithMemory):
        memory = _begun(step, _at_time(done.end.state, step.start, step.h), step.h)
    else:
        memory = Memory(
            differences=jax.tree.map(lambda x: count * x, last.differences),
            choice=jnp.array(0),
            factors=last.factors,
            chord_wait=step.memory.chord_wait,
            carried=last.carried,
        )
    return eqx.tree_at(lambda done: done.memory, done, memory)


def _begun(step: _Step, state: State, h: Scalar) -> Memory:
    """The memory of a scheme that begins at a state."""
    model = step.model
    return first_memory(step.scheme, model, state, h, *model.accelerations(state))


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
