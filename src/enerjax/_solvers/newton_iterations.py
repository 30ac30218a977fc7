"""The iterations of Newton's method, for arguments and values scaled to order one.

An iteration proposes a correction, classifies it by the sizes of this correction and of the
one before, and takes it, halves the one before, or asks for a new Jacobian.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._types import Count, Flag, Scalar
from .linear.dense import AbstractFactors
from .linear.jacobian import Linearisable
from .linear.norms import largest
from .newton import Newton, Start


# Thresholds of the method -----------------------------------------------------------------

# Jacobians after which the first guess is given up. Searches that reach quadratic
# convergence reach it earlier.
PATIENCE = 12
# Jacobians of an attempt without damping. For a double pendulum with a 200 times lighter
# inner mass, at h = 0.01, the steps that need such an attempt and find a root with up to 20
# Jacobians follow the branch of the motion. Those that take longer mostly do not.
_UNDAMPED_PATIENCE = 20
# A Jacobian serves on while corrections shrink at least by this factor. A weaker correction
# is not made, although the approximate inverse might improve it: that inverse cannot see
# directions that have become soft since, and a light body stays unresolved behind a heavy
# one until corrections are exact.
_SHRINKS = 0.3
# This many stalled corrections in a row end a search far from the origin.
_STALLS = 4
# The smallest part of a correction that damping tries.
_LEAST_PART = 0.01


class Powers(NamedTuple):
    """Thresholds that depend on the precision: powers of the machine epsilon.

    - `floor`: the least size, as a part of the largest unknown, by which an unknown is
      measured.
    - `small`: a correction, or a residual, below this is in the range of convergence.
    - `moderate`: a residual above this is no round-off, wherever the coordinates are.
    - `tiny`: a residual below this is round-off if a new Jacobian does not improve it.
    - `round_off`: a residual below this is round-off if the same Jacobian, which did
      improve it, no longer does.
    """

    eps: float
    floor: float
    small: float
    moderate: float
    tiny: float
    round_off: float


def powers_of(dtype: jnp.dtype) -> Powers:
    """The thresholds for a precision."""
    eps = float(jnp.finfo(dtype).eps)
    return Powers(
        eps=eps,
        floor=eps**0.125,
        small=eps**0.25,
        moderate=eps**0.5,
        tiny=eps**0.75,
        round_off=eps**0.875,
    )


# The search -------------------------------------------------------------------------------


def max_norm(x: PyTree[Array]) -> Scalar:
    """The largest entry; for residuals and corrections, which are all scaled."""
    return largest(ravel_pytree(x)[0])


def correction_size(
    step: Float[Array, " n"], x: Float[Array, " n"], least: Scalar, powers: Powers
) -> Scalar:
    """The size of a correction that leads to `x`, relative to the unknowns.

    Every unknown is compared with itself: one scale for all would hide a light, slow body
    beside a heavy, fast one. The floor is for unknowns that pass through zero. It follows
    the largest unknown, down to `least`, for where all unknowns are far smaller than their
    scales.
    """
    floor = powers.floor * jnp.clip(largest(x), least, 1.0)
    return largest(step / (jnp.abs(x) + floor))


class _Iterate(eqx.Module):
    """The state of a search.

    - `x`: the unknowns.
    - `factors`: of the Jacobian in use.
    - `step`, `part`: the last correction that was computed with a new Jacobian, and the
      part of it that was taken.
    - `size`: of the last correction, relative to the unknowns; infinite before the first.
    - `contraction`: `size` divided by that of the correction before, if both were computed
      with the same Jacobian, else zero.
    - `corrections`, `jacobians`: how many have been computed.
    - `stalls`: new Jacobians in a row whose correction was small and did not shrink.
    - `defect`: the largest residual at the iterate that was corrected last.
    - `fresh`: whether the factors are of the Jacobian at `x`.
    - `stale`: whether the Jacobian is to be renewed.
    - `done`, `broken`: whether the search has converged, or has become non-finite.
    """

    x: Float[Array, " n"]
    factors: AbstractFactors
    step: Float[Array, " n"]
    part: Scalar
    size: Scalar
    contraction: Scalar
    corrections: Count
    jacobians: Count
    stalls: Count
    defect: Scalar
    fresh: Flag
    stale: Flag
    done: Flag
    broken: Flag


def newton_iterations(
    residual: Linearisable, newton: Newton, start: Start, max_jacobians: int
) -> _Iterate:
    """A search; `max_jacobians` bounds the two attempts with damping together."""
    guesses = jnp.stack([ravel_pytree(x)[0] for x in (start.guess, *start.others)])
    factors = residual.first_factors(start.factors, guesses[0])
    first = _first_iterate(factors, guesses[0], jnp.array(0), start.skip)
    num_attempts = guesses.shape[0]
    if num_attempts == 1:
        return _attempt(residual, newton, start, first, max_jacobians, True)
    limits = [PATIENCE, max_jacobians - PATIENCE, *[_UNDAMPED_PATIENCE] * num_attempts]

    def attempt(carry: tuple[Count, _Iterate]) -> tuple[Count, _Iterate]:
        k, last = carry
        begin = _first_iterate(last.factors, guesses[k], last.corrections, start.skip)
        limit = jnp.asarray(limits[:num_attempts])[k]
        return k + 1, _attempt(residual, newton, start, begin, limit, k < 2)

    unfinished = lambda carry: ~carry[1].done & (carry[0] < num_attempts)
    return jax.lax.while_loop(unfinished, attempt, (jnp.array(0), first))[1]


def _first_iterate(
    factors: AbstractFactors, x: Float[Array, " n"], corrections: Count, done: Flag
) -> _Iterate:
    zero, one, infinite = (jnp.asarray(value, x.dtype) for value in (0.0, 1.0, jnp.inf))
    none, no, yes = jnp.array(0), jnp.array(False), jnp.array(True)
    return _Iterate(
        x=x,
        factors=factors,
        step=jnp.zeros_like(x),
        part=one,
        size=infinite,
        contraction=zero,
        corrections=corrections,
        jacobians=none,
        stalls=none,
        defect=zero,
        fresh=no,
        stale=yes,
        done=done,
        broken=no,
    )


def _attempt(
    residual: Linearisable,
    newton: Newton,
    start: Start,
    first: _Iterate,
    max_jacobians: Count | int,
    damped: Flag | bool,
) -> _Iterate:
    """A search from one guess."""
    powers = powers_of(first.x.dtype)

    def linearise(iterate: _Iterate) -> _Iterate:
        factors = iterate.factors.renewed(residual.jacobian(iterate.x))
        return eqx.tree_at(
            lambda c: (c.factors, c.jacobians, c.fresh, c.stale),
            iterate,
            (factors, iterate.jacobians + 1, jnp.array(True), jnp.array(False)),
        )

    def iteration(iterate: _Iterate) -> _Iterate:
        iterate = jax.lax.while_loop(lambda c: c.stale, linearise, iterate)
        correction = _propose(residual, iterate, start.least, powers)
        verdict = _classify(iterate, correction, newton, powers)
        return _next_iterate(iterate, correction, verdict, damped, powers)

    unfinished = lambda c: (
        ~(c.done | c.broken) & ~(c.stale & (c.jacobians >= max_jacobians))
    )
    return jax.lax.while_loop(unfinished, iteration, first)


# One iteration ----------------------------------------------------------------------------


class _Correction(NamedTuple):
    """A correction, the unknowns that it leads to, and its size, relative to these.

    `contraction` compares the size with that of the correction before; `shrinks` says
    whether that is enough. `defect` is the largest residual that is corrected.
    """

    step: Float[Array, " n"]
    x: Float[Array, " n"]
    size: Scalar
    contraction: Scalar
    shrinks: Flag
    defect: Scalar


class _Verdict(NamedTuple):
    """Whether the residual is round-off, whether the search ends, and stalls in a row."""

    is_root: Flag
    done: Flag
    stalls: Count


def _propose(
    residual: Linearisable, iterate: _Iterate, least: Scalar, powers: Powers
) -> _Correction:
    value = residual.value(iterate.x)
    step = iterate.factors.solve(value)
    x = iterate.x - step
    size = correction_size(step, x, least, powers)
    contraction = size / iterate.size
    shrinks = contraction < _SHRINKS
    return _Correction(
        step=step,
        x=x,
        size=size,
        contraction=contraction,
        shrinks=shrinks,
        defect=max_norm(value),
    )


def _classify(
    iterate: _Iterate,
    correction: _Correction,
    newton: Newton,
    powers: Powers,
) -> _Verdict:
    _, _, size, contraction, shrinks, defect = correction
    fresh, small = iterate.fresh, size <= powers.small
    # The contraction of a chord iteration measures the error of its Jacobian, and stays
    # what it is. A better one is an accident, so the bound on the next correction uses at
    # least the contraction of the correction before, and at least that correction itself,
    # by whose size the Jacobian has changed.
    rate = jnp.maximum(jnp.maximum(contraction, iterate.contraction), iterate.size)
    converged = size * rate <= newton.rtol * powers.eps
    converged = ~fresh & shrinks & converged & (defect <= powers.small)
    is_root = (defect <= newton.atol * powers.eps) & small
    # Corrections with one Jacobian that did shrink, and no longer do, have met round-off.
    met = ~fresh & ~shrinks & (iterate.contraction > 0)
    met = met & (defect <= powers.round_off) & small
    # So has a correction with a new Jacobian that does not shrink. Where the residual is
    # not tiny (coordinates a million lengths from the origin) this must happen several
    # times in a row, and the residual must not be large: a residual can have a smallest
    # value that is no root.
    stalled = fresh & small & ~shrinks
    stalls = jnp.where(fresh, jnp.where(stalled, iterate.stalls + 1, 0), iterate.stalls)
    repeatedly = (stalls == _STALLS) & (defect <= powers.moderate)
    met = met | (stalled & ((defect <= powers.tiny) | repeatedly))
    done = (is_root | converged | met) & jnp.isfinite(size)
    return _Verdict(is_root, done, stalls)


def _next_iterate(
    iterate: _Iterate,
    correction: _Correction,
    verdict: _Verdict,
    damped: Flag | bool,
    powers: Powers,
) -> _Iterate:
    """Takes the correction, or halves the one before, or asks for a new Jacobian."""
    fresh, part = iterate.fresh, iterate.part
    taken = fresh | correction.shrinks | verdict.is_root
    # The first correction after one with a new Jacobian measures how far that went wrong.
    # If it is larger than it would be after a good one, and than round-off, the one before
    # is halved (P. Deuflhard's natural monotonicity test).
    is_second = ~fresh & (iterate.contraction == 0) & (iterate.size > powers.small)
    is_monotone = correction.contraction <= 1 - 0.25 * part
    halves = damped & is_second & ~is_monotone & ~verdict.done & (part > _LEAST_PART)
    part = jnp.where(halves, 0.5 * part, jnp.ones_like(part))
    x_otherwise = jnp.where(halves, iterate.x + part * iterate.step, iterate.x)
    changes = (taken | halves).astype(iterate.corrections.dtype)
    return _Iterate(
        x=jnp.where(taken, correction.x, x_otherwise),
        factors=iterate.factors,
        step=jnp.where(fresh, correction.step, iterate.step),
        part=part,
        size=jnp.where(taken, correction.size, iterate.size),
        contraction=jnp.where(fresh | halves, 0, correction.contraction),
        corrections=iterate.corrections + changes,
        jacobians=iterate.jacobians,
        stalls=verdict.stalls,
        defect=correction.defect,
        fresh=jnp.zeros_like(fresh),
        stale=~taken & ~halves,
        done=verdict.done,
        broken=fresh & ~jnp.isfinite(correction.size),
    )
