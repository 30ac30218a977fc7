"""One solve of the step equations: predict, find the root, finish.

Here the physics scales what Newton sees: rates by the inertia, multipliers by the
gradients of their constraints, and everything by an energy of the step.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._operators import AbstractModel, Increment, roughness, scales_like, shortened
from .._results import first_failure, from_root_finder, RESULTS
from .._solvers import (
    AbstractFactors,
    Chord,
    find_root,
    kept_factors,
    max_norm,
    Root,
    RootFinder,
    RowPattern,
)
from .._system import State
from .._types import Count, Flag, Multipliers, Scalar, Velocities
from ..schemes import (
    AbstractOneSolveScheme,
    AbstractSchemeWithChord,
    AbstractSchemeWithMemory,
    StepEnd,
)


# Enough for the linear convergence of a locking step; a step that needs more has failed.
MAX_ITERATIONS = 50
# Steps before a chord iteration is tried again after one that has failed. What makes it
# fail (stiff forces, fast turns) lasts for some steps, and trying costs a few residuals.
_CHORD_WAITS = 10


class Memory(eqx.Module):
    """What the last steps leave for a solve.

    - `added`: what the last three steps added to a free flight, newest first.
    - `is_smooth`: whether extrapolating from these would have met the last step better
      than repeating.
    - `factors`: of the Jacobians of the last three steps, newest first; `None` for large
      systems, and where a chord iteration has its own.
    - `chord_wait`: how many steps are solved without trying a chord iteration; `None` where
      there is none to try.
    - `carried`: what a scheme with a memory hands on; of others `None`.
    """

    added: PyTree[Any]
    is_smooth: Flag
    factors: AbstractFactors | None
    chord_wait: Count | None
    carried: PyTree[Any]


class Solved(eqx.Module):
    """A solve, done or failed.

    - `end`: what it leads to.
    - `iterations`: of Newton.
    - `residual`: largest entry of the step equations, scaled to order one, before the last
      correction.
    - `result`: whether, and how, it failed.
    - `roughness`: differences of velocities from step to step; see `_operators/scaling.py`.
    - `memory`: for the next.
    """

    end: StepEnd
    iterations: Count
    residual: Scalar
    result: RESULTS
    roughness: Array
    memory: Memory


def first_memory(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    acceleration: Velocities,
    multipliers: Multipliers,
    with_chord: bool = True,
) -> Memory:
    """The memory of a run that begins; without `with_chord` no chord iteration is made."""
    carried = None
    if isinstance(scheme, AbstractSchemeWithMemory):
        carried = scheme.begin(model, start, h, acceleration)
    problem = _problem(scheme, model, start, h, carried)
    z = scheme.predict(problem, acceleration, multipliers)
    flight = _free_flight(scheme, problem, model, start)
    added = jax.tree.map(lambda x, x0: jnp.stack([x - x0] * 3), z, flight)
    added = jax.lax.stop_gradient(added)
    is_chord_scheme = isinstance(scheme, AbstractSchemeWithChord)
    has_chord = with_chord and is_chord_scheme and model.has_constraint_matrix
    flat, _ = ravel_pytree(flight)
    factors = None if has_chord else kept_factors(flat.size, flat.dtype)
    return Memory(
        added=added,
        is_smooth=jnp.array(True),
        factors=jax.tree.map(lambda x: jnp.stack([x] * 3), factors),
        chord_wait=jnp.array(0) if has_chord else None,
        carried=carried,
    )


def _problem(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    carried: PyTree[Any],
) -> Any:
    """The data of a step."""
    problem = scheme.problem(model, start, h)
    if isinstance(scheme, AbstractSchemeWithMemory):
        return scheme.resume(problem, carried)
    return problem


def solve(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    memory: Memory,
    root_finder: RootFinder,
    skip: Flag,
) -> Solved:
    """A step of length `h` of a scheme; with `skip` it costs no iteration."""
    problem = _problem(scheme, model, start, h, memory.carried)
    flight = _free_flight(scheme, problem, model, start)
    unknown_scale, row_scale, least = scales_like(flight, model, start, h)

    def scaled(x, inputs):
        scheme, problem, unknown_scale, row_scale = inputs
        z = jax.tree.map(jnp.multiply, x, unknown_scale)
        return jax.tree.map(jnp.divide, scheme.residual(z, problem), row_scale)

    inputs = (scheme, problem, unknown_scale, row_scale)

    guess = jax.tree.map(
        lambda x0, x, s: (x0 + x) / s, flight, _predicted(memory), unknown_scale
    )
    scale_down = lambda z: jax.tree.map(jnp.divide, z, unknown_scale)
    wait = memory.chord_wait
    root = find_root(
        scaled,
        root_finder,
        guess,
        inputs,
        max_iterations=MAX_ITERATIONS,
        # What the last steps suggest can lie beyond a fold of the step equations, a flight
        # without force on the near side, or where rods turn far in it, a part of that.
        others=[scale_down(shortened(flight, part)) for part in (1.0, 0.5, 0.25)],
        factors=jax.tree.map(_next, memory.factors),
        skip=skip,
        regularisation=_regularisation(model, unknown_scale, row_scale),
        least=least,
        chord=None if wait is None else _chord(scheme),
        by_chord=True if wait is None else wait == 0,
    )
    z = jax.tree.map(jnp.multiply, root.value, unknown_scale)
    end = scheme.finish(z, problem)
    found = from_root_finder(root.found, root.broken, root.finite)
    turns = _turns(model, start, end.state)
    turned = RESULTS.where(turns, RESULTS.step_too_large, RESULTS.successful)
    added = jax.lax.stop_gradient(jax.tree.map(jnp.subtract, z, flight))
    return Solved(
        end=end,
        iterations=root.iterations,
        residual=root.residual,
        result=first_failure(first_failure(end.result, found), turned),
        roughness=roughness(model.scales.coordinate, added, memory.added, unknown_scale),
        memory=_memory_after(memory, added, unknown_scale, root, end.carried),
    )


def _chord(scheme: AbstractOneSolveScheme) -> Chord:
    """Corrections with inertia and constraints alone."""
    assert isinstance(scheme, AbstractSchemeWithChord)

    def prepare(x, inputs):
        scheme, problem, unknown_scale, _ = inputs
        z = jax.tree.map(jnp.multiply, x, unknown_scale)
        return scheme.constraint_matrix(z, problem)

    def correct(value, inputs, matrix):
        scheme, problem, unknown_scale, row_scale = inputs
        rows = jax.tree.map(jnp.multiply, value, row_scale)
        correction = scheme.chord(rows, problem, matrix)
        return jax.tree.map(jnp.divide, correction, unknown_scale)

    return Chord(prepare, correct)


def num_unknowns(memory: Memory) -> int:
    """How many unknowns a solve has."""
    return sum(x[0].size for x in jax.tree.leaves(memory.added))


def _predicted(memory: Memory) -> PyTree[Any]:
    """What a step is expected to add to a free flight.

    Smooth motion is met by extrapolation; where it changes quickly the last step is the
    better guess. What would have been better for the step before decides.
    """
    smooth, last = _candidates(memory)
    choose = lambda x, y: jnp.where(memory.is_smooth, x, y)
    return jax.tree.map(choose, smooth, last)


def _candidates(memory: Memory) -> tuple[PyTree[Any], PyTree[Any]]:
    """What a step may add to a free flight: the extrapolation, and the last step again."""
    smooth = jax.tree.map(_next, memory.added)
    return smooth, jax.tree.map(lambda x: x[0], memory.added)


def _memory_after(
    memory: Memory,
    added: PyTree[Any],
    unknown_scale: PyTree[Any],
    root: Root,
    carried: PyTree[Any],
) -> Memory:
    """The memory with a step that added `added` to a free flight."""

    def error(guess: PyTree[Any]) -> Scalar:
        difference = lambda x, y, unit: (x - y) / unit
        return max_norm(jax.tree.map(difference, added, guess, unknown_scale))

    smooth, last = _candidates(memory)
    return Memory(
        added=jax.tree.map(_pushed, added, memory.added),
        is_smooth=error(smooth) <= error(last),
        factors=jax.tree.map(_pushed, root.factors, memory.factors),
        chord_wait=_wait_after(memory.chord_wait, root),
        carried=carried,
    )


def _wait_after(wait: Count | None, root: Root) -> Count | None:
    if wait is None:
        return None
    passed = jnp.where(root.by_chord, 0, _CHORD_WAITS)
    return jnp.where(wait == 0, passed, wait - 1).astype(wait.dtype)


def _next(x: Array) -> Array:
    """What follows the last three, newest first, on a parabola."""
    return 3 * x[0] - 3 * x[1] + x[2]


def _pushed(new: Array, old: Array) -> Array:
    """The last three, one step later."""
    return jnp.stack([new, old[0], old[1]])


def _turns(model: AbstractModel, a: State, b: State) -> Flag:
    """Whether the gradient of a joint turns by more than a right angle from `a` to `b`.

    A solution of the step equations on the other side of a joint satisfies the joint too.
    """
    if model.system.constraint is None:
        return jnp.array(False)
    rows = RowPattern(model.fixed, a.q)
    unit = model.scales.coordinate[rows.columns]
    before, after = (
        rows.derivative(model.fixed, jax.lax.stop_gradient(q)) / unit for q in (a.q, b.q)
    )
    return jnp.any(jnp.sum(before * after, axis=1) < 0)


def _with_multipliers(z: PyTree[Any], values: PyTree[Any]) -> PyTree[Any]:
    """Unknowns with the multipliers of others."""
    parts = lambda x: (x.impulse, x.velocity_impulse)
    is_increment = lambda x: isinstance(x, Increment)
    change = lambda x, y: eqx.tree_at(parts, x, parts(y)) if is_increment(x) else x
    return jax.tree.map(change, z, values, is_leaf=is_increment)


def _regularisation(model: AbstractModel, unknown_scale: Any, row_scale: Any) -> Any | None:
    """What makes the step equations regular where constraints repeat each other.

    Weighed by the scales of row and unknown, so that the multipliers of least norm are
    those of least norm in the measure of their constraints.
    """
    if not model.system.redundant:
        return None

    def weigh(unit: Array, row: Array) -> Array:
        product = unit * row
        share = jnp.min(product, initial=jnp.inf) / product
        return share * jnp.asarray(model.regularisation(unit.size, unit.dtype))

    none = jax.tree.map(jnp.zeros_like, unknown_scale)
    return _with_multipliers(none, jax.tree.map(weigh, unknown_scale, row_scale))


def _free_flight(
    scheme: AbstractOneSolveScheme, problem: Any, model: AbstractModel, start: State
) -> PyTree[Any]:
    """The unknowns of a step in which no force acts."""
    num_constraints = jax.eval_shape(model.constraint, start.q, start.t).shape[0]
    no_force = jnp.zeros((num_constraints,), start.q.dtype)
    return scheme.predict(problem, jnp.zeros_like(start.v), no_force)
