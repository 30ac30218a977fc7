"""One solve of the step equations: initial guess, Newton's method, end of the step.

The unknowns are scaled to order one before the solve: rates by the inertia, multipliers by
the gradients of their constraints, and all of them by a typical energy of the step. Initial
guesses are the unknowns of a free flight, which is a step without forces, plus an
extrapolation of the differences between the last steps and their free flights.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._operators import (
    AbstractModel,
    Increment,
    roughness,
    scales_like,
    shortened,
    terms_of_chord,
)
from .._programs import part, simplified
from .._results import first_failure, from_root_finder, RESULTS
from .._solvers import (
    AbstractFactors,
    Chord,
    ChordAlone,
    find_root,
    kept_factors,
    Root,
    RootFinder,
    RowPattern,
)
from .._system import AbstractStrainEnergy, State
from .._types import Count, Flag, JointMultipliers, Multipliers, Scalar, Velocities
from ..schemes import (
    AbstractOneSolveScheme,
    AbstractSchemeWithChord,
    AbstractSchemeWithMemory,
    StepEnd,
)
from .prediction import (
    differences_after,
    extrapolated,
    initial_memory,
    Memory,
    memory_after,
    predicted,
)


# Enough for the linear convergence of a step that locks. A step that needs more has failed.
MAX_ITERATIONS = 50
# Up to this number of unknowns the parts of a step are functions of machine code. In larger
# steps array operations take longer than their calls, and outside of such a function they
# are faster: a chain of 64 points takes 75 us a step, and would take 108 us.
_MANY = 128


class Solved(eqx.Module):
    """The result of a solve, which may have failed.

    - `end`: the end of the step.
    - `iterations`: the number of corrections.
    - `residual`: the largest residual of the scaled step equations before the last
      correction.
    - `result`: success, or the kind of failure.
    - `roughness`: differences of velocities from step to step; see `_operators/scaling.py`.
    - `memory`: the data for the next solve.
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
) -> Memory:
    """The memory at the start of a run."""
    carried = None
    if isinstance(scheme, AbstractSchemeWithMemory):
        carried = scheme.begin(model, start, h, acceleration)
    problem = step_problem(scheme, model, start, h, carried)
    z = scheme.predict(problem, acceleration, multipliers)
    flight = free_flight(scheme, problem, model, start)
    added = jax.tree.map(jnp.subtract, z, flight)
    flat, _ = ravel_pytree(flight)
    both = has_chord(scheme, model)
    factors = None if both else kept_factors(flat.size, flat.dtype)
    return initial_memory(added, factors, jnp.array(0) if both else None, carried)


def step_problem(
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
    root_finder: RootFinder | ChordAlone,
    skip: Flag,
    *,
    rarely: bool = False,
) -> Solved:
    """Solves a step of length `h`. With `skip` it makes no iteration; see `find_root`."""
    problem = step_problem(scheme, model, start, h, memory.carried)
    # Steps by the chord method are the longest programs.
    has_parts = memory.chord_wait is not None and num_unknowns(memory) <= _MANY
    apart = part if has_parts else lambda fn: fn
    prepare = simplified(lambda: _prepared(scheme, problem, model, start, h, memory))
    prepared = apart(prepare)()

    def scaled(x, inputs):
        scheme, problem, scales = inputs
        z = jax.tree.map(jnp.multiply, x, scales.unknown)
        return jax.tree.map(jnp.multiply, scheme.residual(z, problem), scales.per_row)

    wait = memory.chord_wait
    alone = is_chord_alone(root_finder, scheme, model)
    root = find_root(
        scaled,
        root_finder,
        prepared.guess,
        (scheme, problem, prepared.scales),
        max_iterations=MAX_ITERATIONS,
        others=prepared.others,
        factors=None if alone else prepared.factors,
        skip=skip,
        regularisation=_regularisation(model, prepared.scales),
        least=prepared.least,
        chord=_chord(scheme, model) if alone or wait is not None else None,
        by_chord=True if wait is None else wait == 0,
        owners=owners_of(prepared.guess, model.num_joints),
        rarely=rarely or wait is not None,
    )
    step = scheme, problem, model, start, memory, prepared
    return apart(simplified(lambda: _solved(*step, root, root_finder)))()


def has_chord(scheme: AbstractOneSolveScheme, model: AbstractModel) -> bool:
    """Whether the step equations have a chord method."""
    return isinstance(scheme, AbstractSchemeWithChord) and model.has_delassus_matrix


def is_chord_alone(
    root_finder: RootFinder | ChordAlone,
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
) -> bool:
    """Whether the exact Jacobian is left out, because there is a chord method."""
    return isinstance(root_finder, ChordAlone) and has_chord(scheme, model)


def unsolved(
    scheme: AbstractOneSolveScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    memory: Memory,
) -> Solved:
    """A step of which no part is solved: it ends where it starts."""
    problem = step_problem(scheme, model, start, h, memory.carried)
    like = jax.eval_shape(lambda: scheme.finish(memory.added, problem))
    end = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    return Solved(
        end=eqx.tree_at(lambda end: end.state, end, start),
        iterations=jnp.array(0),
        residual=jnp.zeros_like(h),
        result=RESULTS.successful,
        roughness=jnp.zeros((3,), h.dtype),
        memory=memory,
    )


class _Scales(NamedTuple):
    """The scales of unknowns and rows, and their reciprocals.

    Each residual is multiplied by these, which takes less time than divisions.
    """

    unknown: PyTree[Any]
    row: PyTree[Any]
    per_unknown: PyTree[Any]
    per_row: PyTree[Any]


class _Prepared(eqx.Module):
    """The data of a search: scales, guesses and factors. `flight` is a free flight."""

    flight: PyTree[Any]
    scales: _Scales
    least: Scalar
    guess: PyTree[Any]
    others: tuple[PyTree[Any], ...]
    factors: AbstractFactors | None


def _prepared(
    scheme: AbstractOneSolveScheme,
    problem: Any,
    model: AbstractModel,
    start: State,
    h: Scalar,
    memory: Memory,
) -> _Prepared:
    flight = free_flight(scheme, problem, model, start)
    unknown, row, least = scales_like(flight, model, start, h)
    inverse = lambda scale: jax.tree.map(jnp.reciprocal, scale)
    scales = _Scales(unknown, row, inverse(unknown), inverse(row))
    scaled = lambda z: jax.tree.map(jnp.multiply, z, scales.per_unknown)
    return _Prepared(
        flight=flight,
        scales=scales,
        least=least,
        guess=scaled(jax.tree.map(jnp.add, flight, predicted(memory))),
        # The extrapolated guess can lie beyond a fold of the step equations. A free flight
        # usually does not, and a fraction of it does not if bodies rotate far in a step.
        # Stiff springs can reverse the motion, and a search must then begin at rest.
        others=tuple(scaled(shortened(flight, part)) for part in (1.0, 0.5, 0.25, 0.0)),
        factors=jax.tree.map(extrapolated, memory.factors),
    )


def _solved(
    scheme: AbstractOneSolveScheme,
    problem: Any,
    model: AbstractModel,
    start: State,
    memory: Memory,
    prepared: _Prepared,
    root: Root,
    root_finder: RootFinder | ChordAlone,
) -> Solved:
    """The result of a step whose search has ended with `root`."""
    z = jax.tree.map(jnp.multiply, root.value, prepared.scales.unknown)
    # What is not a root may be infinite. The step does not count then, but the reverse pass
    # would multiply its derivatives by zero.
    z = jax.tree.map(lambda x, y: jnp.where(root.found, x, y), z, prepared.flight)
    end = scheme.finish(z, problem)
    tests = lambda: _gradients_reverse(model, start, end.state)
    no = jnp.array(False)
    # Where the chord method converges, the gradients have hardly changed.
    if is_chord_alone(root_finder, scheme, model):
        reverses = no
    elif memory.chord_wait is None:
        reverses = tests()
    else:
        reverses = jax.lax.cond(root.by_chord, lambda: no, tests)
    branch = RESULTS.where(reverses, RESULTS.step_too_large, RESULTS.successful)
    branch = first_failure(branch, _check_angles(model, start, end.state))
    found = from_root_finder(root.found, root.broken, root.finite)
    added = jax.lax.stop_gradient(jax.tree.map(jnp.subtract, z, prepared.flight))
    differences, before = differences_after(added, memory.differences), memory.differences
    per_unknown = prepared.scales.per_unknown
    return Solved(
        end=end,
        iterations=root.iterations,
        residual=root.residual,
        result=first_failure(first_failure(end.result, found), branch),
        roughness=roughness(model.scales.step, differences, before, per_unknown),
        memory=memory_after(memory, differences, per_unknown, root, end.carried),
    )


def _chord(scheme: AbstractOneSolveScheme, model: AbstractModel) -> Chord:
    """The corrections of the chord method of a scheme, for scaled unknowns and rows."""
    assert isinstance(scheme, AbstractSchemeWithChord)

    def prepare(x, inputs):
        scheme, problem, scales = inputs
        z = jax.tree.map(jnp.multiply, x, scales.unknown)
        return scheme.delassus_matrix(z, problem)

    def correct(value, inputs, matrix):
        scheme, problem, scales = inputs
        rows = jax.tree.map(jnp.multiply, value, scales.row)
        correction = scheme.chord(rows, problem, matrix)
        return jax.tree.map(jnp.multiply, correction, scales.per_unknown)

    def effective(x, inputs, matrix):
        if matrix.regularisation is None:
            return x
        _, _, scales = inputs
        new = lambda z: tuple(map(matrix.effective, _multipliers(z)))
        z = _with_multipliers(jax.tree.map(jnp.multiply, x, scales.unknown), new)
        return jax.tree.map(jnp.multiply, z, scales.per_unknown)

    return Chord(prepare, correct, effective, "strains" in terms_of_chord(model))


def num_unknowns(memory: Memory) -> int:
    """The number of unknowns of a solve."""
    return sum(x[0].size for x in jax.tree.leaves(memory.differences))


def _gradients_reverse(model: AbstractModel, a: State, b: State) -> Flag:
    """Whether a constraint gradient rotates by more than a right angle from `a` to `b`.

    The step equations can have a solution in another configuration of a joint, such as the
    mirrored one. It satisfies the constraint too, but does not continue the motion.
    """
    if model.system.constraint is None:
        return jnp.array(False)
    rows = RowPattern(model.fixed, a.q)
    unit = model.scales.coordinate[rows.columns]
    before, after = (
        rows.derivative(model.fixed, jax.lax.stop_gradient(q)) / unit for q in (a.q, b.q)
    )
    return jnp.any(jnp.sum(before * after, axis=1) < 0)


def _check_angles(model: AbstractModel, a: State, b: State) -> RESULTS:
    """Whether an angle of the potential has jumped by a turn: it has passed half a turn."""
    potential = getattr(model.system, "potential", None)
    if not isinstance(potential, AbstractStrainEnergy):
        return RESULTS.successful
    before, after = (
        potential.angles(jax.lax.stop_gradient(x.q), model.args) for x in (a, b)
    )
    if before.size == 0:
        return RESULTS.successful
    jumps = jnp.any(jnp.abs(after - before) > jnp.pi)
    return RESULTS.where(jumps, RESULTS.angle_jumped, RESULTS.successful)


def _with_multipliers(
    z: PyTree[Any], new: Callable[..., tuple[Array, ...]], *others: PyTree[Any]
) -> PyTree[Any]:
    """The tree `z` with the multipliers `new(x, *y)` for each increment `x` in it.

    `y` are those at the same place of the trees `others`.
    """

    def change(x: Any, *y: Any) -> Any:
        return eqx.tree_at(_multipliers, x, new(x, *y)) if _is_increment(x) else x

    return jax.tree.map(change, z, *others, is_leaf=_is_increment)


def owners_of(z: PyTree[Any], num_joints: int) -> tuple[int | None, ...]:
    """The number of the coordinate that each unknown belongs to, or `-1 - k` for a
    multiplier of row `k`. Those of relations between coordinates, the rows behind those of
    joints, have none: without its relation the inertia of a quaternion is singular, and
    they go with the coordinates that they relate.

    Unknowns outside of increments, the impulses of strains, have numbers of their own, as
    coordinates have: the row of each contains the impulse itself, so its pivot is regular.
    """
    owners: list[int | None] = []
    # Behind the numbers of all coordinates and momenta.
    following = itertools.count(2 * sum(x.size for x in jax.tree.leaves(z)))
    for x in jax.tree.leaves(z, is_leaf=_is_increment):
        if not _is_increment(x):
            owners += itertools.islice(following, x.size)
            continue
        size, num_momenta = x.rate.size, x.momentum.size
        first = 0 if num_momenta == size else size
        owners += (-1 - k if k < num_joints else None for k in range(x.impulse.size))
        owners += [*range(size), *range(first, first + num_momenta)]
        owners += (-1 - k for k in range(x.velocity_impulse.size))
    return tuple(owners)


def _is_increment(x: Any) -> bool:
    return isinstance(x, Increment)


def _multipliers(x: Increment) -> tuple[Multipliers, JointMultipliers]:
    return x.impulse, x.velocity_impulse


def _regularisation(model: AbstractModel, scales: _Scales) -> Any | None:
    """The regularisation of the step equations of systems with redundant constraints.

    It is weighted by the scales of rows and unknowns, so that the multipliers have the
    least norm of `impulse * constraint`; see `Scales`.
    """
    if not model.system.redundant:
        return None

    # Joints alone can be redundant: relations between coordinates are independent.
    def weighted(unit: Array, row: Array) -> Array:
        product = (unit * row)[: model.num_joints]
        share = jnp.min(product, initial=jnp.inf) / product
        added = share * jnp.asarray(model.regularisation(product.size, unit.dtype))
        return jnp.pad(added, (0, unit.size - added.size))

    none = jax.tree.map(jnp.zeros_like, scales.unknown)
    weights = jax.tree.map(weighted, scales.unknown, scales.row)
    return _with_multipliers(none, lambda _, of: _multipliers(of), weights)


def free_flight(
    scheme: AbstractOneSolveScheme, problem: Any, model: AbstractModel, start: State
) -> PyTree[Any]:
    """The unknowns of a step without forces and multipliers."""
    no_force = jnp.zeros((model.scales.constraint.size,), start.q.dtype)
    return scheme.predict(problem, jnp.zeros_like(start.v), no_force)
