"""The search for a root: by Newton's method, or by a root finder of optimistix."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree
from typing_extensions import TypeAliasType

from .._programs import part
from .._types import Count, Flag, Scalar
from .chord_iterations import chord_iterations, PATIENCE, PATIENCE_ALONE
from .equations import Equations
from .linear.dense import AbstractFactors, Inverse
from .linear.jacobian import Linearisable
from .newton import ChordAlone, Newton, Start
from .newton_iterations import max_norm, newton_iterations, powers_of


RootFinder = TypeAliasType(
    "RootFinder", Newton | optx.AbstractRootFinder | optx.AbstractLeastSquaresSolver
)


class Chord(NamedTuple):
    """The corrections of the chord method, whose approximate Jacobian is constant.

    - `prepare(y, args)`: factorises the approximate Jacobian at the guess `y`.
    - `correct(value, args, prepared)`: the correction for the residual `value`, where
      `prepared` is the result of `prepare`.
    - `effective(y, args, prepared)`: `y` without its part that the equations leave open;
      no correction has such a part.
    - `is_elastic`: whether the equations may contain the forces of stiff springs, whose
      round-off is large.
    """

    prepare: Callable[[PyTree[Array], Any], PyTree]
    correct: Callable[[PyTree[Array], Any, PyTree], PyTree[Array]]
    effective: Callable[[PyTree[Array], Any, PyTree], PyTree[Array]] = lambda y, *_: y
    is_elastic: bool = False


class Root(eqx.Module):
    """A root, or the last iterate where none was found.

    - `value`: the unknowns.
    - `factors`: the factors of the last Jacobian, for the next solve.
    - `iterations`: the number of corrections.
    - `residual`: the largest residual; with `Newton` the one before the last correction.
    - `found`: whether the search has converged.
    - `broken`: whether the Jacobian was singular, or an iterate became non-finite.
    - `finite`: whether the residual is finite.
    - `by_chord`: whether the chord method has found the root.
    """

    value: PyTree[Array]
    factors: AbstractFactors | None
    iterations: Count
    residual: Scalar
    found: Flag
    broken: Flag
    finite: Flag
    by_chord: Flag


def flat_of(regularisation: PyTree[Array] | None) -> Array | None:
    return None if regularisation is None else ravel_pytree(regularisation)[0]


def has_chord_search(root_finder: RootFinder | ChordAlone) -> bool:
    """Whether searches with this root finder begin with the chord method, if there is one.

    A solver of the user must see all equations.
    """
    if isinstance(root_finder, ChordAlone):
        return True
    return isinstance(root_finder, Newton) and root_finder.linear_solver is None


def search(
    equations: Equations,
    chord: Chord | None,
    root_finder: RootFinder | ChordAlone,
    args: PyTree,
    start: Start,
    max_iterations: int,
) -> Root:
    if isinstance(root_finder, ChordAlone):
        if chord is not None:
            newton = root_finder.newton
            return _by_chord(equations.fn, chord, newton, args, start, PATIENCE_ALONE)
        root_finder = root_finder.newton
    if not isinstance(root_finder, Newton):
        fn, guess = equations.fn, start.guess
        solution = optx.root_find(
            fn, root_finder, guess, args, max_steps=max_iterations, throw=False
        )
        found, singular, nonfinite = (
            solution.result == getattr(optx.RESULTS, name)
            for name in ("successful", "singular", "nonfinite")
        )
        steps = solution.stats["num_steps"]
        residual = max_norm(fn(solution.value, args))
        # A tolerance below round-off is never met, and the search ends at `max_iterations`.
        found = found | (residual <= Newton().atol * jnp.finfo(residual.dtype).eps)
        return Root(
            value=solution.value,
            factors=start.factors,
            iterations=steps,
            residual=residual,
            found=found,
            broken=singular | nonfinite,
            finite=jnp.isfinite(residual),
            by_chord=jnp.array(False),
        )
    flat, _ = ravel_pytree(start.guess)
    exact = equations.linearisable(flat, args, flat_of(start.regularisation))
    if chord is None or not has_chord_search(root_finder):
        return _iterated(exact, root_finder, start, max_iterations)
    first = _by_chord(equations.fn, chord, root_finder, args, start, PATIENCE)

    def again() -> Root:
        # Under `vmap` this is evaluated for all lanes, also for those with a root.
        left = eqx.tree_at(lambda start: start.skip, start, start.skip | first.found)
        last = _iterated(exact, root_finder, left, max_iterations)
        last = eqx.tree_at(
            lambda root: root.iterations, last, last.iterations + first.iterations
        )
        return jax.tree.map(lambda x, y: jnp.where(first.found, x, y), first, last)

    return jax.lax.cond(first.found, lambda: first, again)


def _by_chord(
    fn: Callable[[PyTree[Array], Any], PyTree[Array]],
    chord: Chord,
    newton: Newton,
    args: PyTree,
    start: Start,
    patience: int,
) -> Root:
    def begin() -> tuple[PyTree, Array]:
        prepared = chord.prepare(start.guess, args)
        return prepared, ravel_pytree(chord.effective(start.guess, args, prepared))[0]

    given, unravel = ravel_pytree(start.guess)
    prepared, guess = part(begin)()
    guess = jnp.where(start.skip, given, guess)
    leaves_of = lambda tree: tuple(jax.tree.leaves(tree))
    joined = lambda leaves: jnp.concatenate([x.ravel() for x in leaves])

    # Compiled separately: XLA would otherwise evaluate parts of the residual again for each
    # of its uses.
    def value(x: Array) -> Array:
        return joined(leaves_of(fn(unravel(x), args)))

    def solve(right: Array) -> Array:
        correct = lambda x: leaves_of(chord.correct(unravel(x), args, prepared))
        return joined(correct(right))

    search = lambda: chord_iterations(
        value, solve, newton, start, guess, patience, chord.is_elastic
    )
    last = part(search)()
    return Root(
        value=unravel(last.x),
        factors=start.factors,
        iterations=last.corrections,
        residual=last.defect,
        found=last.done,
        broken=jnp.array(False),
        finite=jnp.isfinite(last.defect),
        by_chord=last.done,
    )


def _iterated(
    residual: Linearisable, newton: Newton, start: Start, max_jacobians: int
) -> Root:
    _, unravel = ravel_pytree(start.guess)
    last = newton_iterations(residual, newton, start, max_jacobians)
    x = last.x
    if residual.regularisation is not None:
        closed = _least_norm_root(residual, last.factors, x)
        # Beside stiff forces the matrix of redundant rows is so ill-conditioned that
        # `closed` may be no root. The multipliers of `x` cause the same forces.
        left, before = (max_norm(residual.value(y)) for y in (closed, x))
        is_root = left <= jnp.maximum(before, powers_of(x).round_off)
        x = jnp.where(last.done & ~start.skip & is_root, closed, x)
    keeps = residual.keeps_factors and start.factors is not None
    factors = last.factors if keeps else start.factors
    return Root(
        value=unravel(x),
        factors=factors,
        iterations=last.corrections,
        residual=last.defect,
        found=last.done,
        broken=last.broken,
        finite=jnp.isfinite(last.defect),
        by_chord=jnp.array(False),
    )


def _least_norm_root(
    residual: Linearisable, factors: AbstractFactors, x: Float[Array, " n"]
) -> Float[Array, " n"]:
    """The root of least norm: `x` without its part in the null space of the Jacobian.

    The Jacobian must be that at the root, because errors of the Jacobian are divided by
    the regularisation, which is small.
    """
    matrix = residual.jacobian(x)
    once = factors.renewed(matrix).solve

    def solve(right: Array) -> Array:
        first = once(right)
        if not isinstance(factors, Inverse):
            return first
        # The inverse of a nearly singular matrix is inaccurate; one refinement corrects it.
        return first + once(right - matrix @ first)

    closed = x - residual.null_space_part(solve, x)
    # Where the equations are nonlinear in these unknowns, the residual has changed. One
    # more correction compensates for this.
    change = solve(residual.value(closed))
    return closed - change + residual.null_space_part(solve, change)
