"""The iterations of Newton's method, for arguments and values scaled to order one."""

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


def max_norm(x: PyTree[Array]) -> Scalar:
    """The largest entry; for all residuals and corrections here are of order one."""
    return largest(ravel_pytree(x)[0])


class _Iterate(eqx.Module):
    x: Float[Array, " n"]
    factors: AbstractFactors
    # The last correction made with a Jacobian of its own, and the part of it that was.
    step: Float[Array, " n"]
    part: Scalar
    # Size of the last correction, infinite if there was none, and what it had left of the
    # one before, zero unless both were made with the same Jacobian.
    size: Scalar
    contraction: Scalar
    corrections: Count
    jacobians: Count
    # Jacobians in a row after which the correction was small and did not shrink.
    stalls: Count
    # Size of the residual that the last correction was made from.
    defect: Scalar
    # Whether the factors are of the Jacobian at `x`, and whether they should become so.
    fresh: Flag
    stale: Flag
    done: Flag
    broken: Flag


# Jacobians after which the first guess is given up. Where quadratic convergence sets in at
# all, it does so before.
PATIENCE = 12
# Without damping. Of the steps of a double pendulum with an inner mass 200 times lighter,
# at h = 0.01, that are found only so, those found with 20 Jacobians are on the branch of
# the motion, and those that take longer are mostly not.
_UNDAMPED_PATIENCE = 20
# What a correction may leave of the one before, for its Jacobian to serve on. What steps
# before have left is never used as it is, near as it can be: it is blind to what has become
# soft since, and a light body hides behind a heavy one until corrections are exact.
_SHRINKS = 0.3
_STALLS = 4
# A correction is halved until it takes no part smaller than this.
_LEAST_PART = 0.01


def newton_iterations(
    residual: Linearisable, newton: Newton, start: Start, max_jacobians: int
) -> _Iterate:
    """A search; `max_jacobians` are those of the attempts with damping, in all."""
    guesses = jnp.stack([ravel_pytree(x)[0] for x in (start.guess, *start.others)])
    factors = residual.first_factors(start.factors, guesses[0])
    first = _first(factors, guesses[0], jnp.array(0), start.skip)
    num_attempts = guesses.shape[0]
    if num_attempts == 1:
        return _attempt(residual, newton, start, first, max_jacobians, True)
    limits = [PATIENCE, max_jacobians - PATIENCE, *[_UNDAMPED_PATIENCE] * num_attempts]

    def attempt(carry: tuple[Count, _Iterate]) -> tuple[Count, _Iterate]:
        k, last = carry
        begun = _first(last.factors, guesses[k], last.corrections, start.skip)
        limit = jnp.asarray(limits[:num_attempts])[k]
        return k + 1, _attempt(residual, newton, start, begun, limit, k < 2)

    unfinished = lambda carry: ~carry[1].done & (carry[0] < num_attempts)
    return jax.lax.while_loop(unfinished, attempt, (jnp.array(0), first))[1]


def _first(
    factors: AbstractFactors, x: Float[Array, " n"], corrections: Count, done: Flag
) -> _Iterate:
    """Where an attempt begins."""
    zero, one, infinite = (jnp.asarray(value, x.dtype) for value in (0.0, 1.0, jnp.inf))
    none, no, yes = jnp.array(0), jnp.array(False), jnp.array(True)
    return _Iterate(
        x,
        factors,
        jnp.zeros_like(x),
        one,
        infinite,
        zero,
        corrections,
        none,
        none,
        zero,
        no,
        yes,
        done,
        no,
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
    eps = float(jnp.finfo(first.x.dtype).eps)

    def linearise(carry: _Iterate) -> _Iterate:
        factors = carry.factors.renewed(residual.jacobian(carry.x))
        return eqx.tree_at(
            lambda c: (c.factors, c.jacobians, c.fresh, c.stale),
            carry,
            (factors, carry.jacobians + 1, jnp.array(True), jnp.array(False)),
        )

    def correct(before: _Iterate) -> _Iterate:
        before = jax.lax.while_loop(lambda c: c.stale, linearise, before)
        fresh = before.fresh
        value = residual.value(before.x)
        correction = before.factors.solve(value)
        x = before.x - correction
        # Each unknown against itself: one scale for all would hide a light, slow body
        # beside a heavy, fast one. The floor is for unknowns that pass through zero; where
        # all of them are small, they had been taken for larger than they are.
        floor = eps**0.125 * jnp.clip(largest(x), start.least, 1.0)
        size = largest(correction / (jnp.abs(x) + floor))
        defect, contraction = max_norm(value), size / before.size
        shrinks = contraction < _SHRINKS
        new = _Size(size, contraction, defect, shrinks)
        is_root, ends, stalls = _ends(before, new, newton, residual.is_exact, eps)
        done = (is_root | ends) & jnp.isfinite(size)
        kept = fresh | shrinks | is_root
        # The first correction after one with a Jacobian of its own is what that has left
        # over: it went too far where that is more than there was, and more than round-off.
        second = ~fresh & (before.contraction == 0) & (before.size > eps**0.25)
        less = contraction <= 1 - 0.25 * before.part
        back = damped & second & ~less & ~done & (before.part > _LEAST_PART)
        part = jnp.where(back, 0.5 * before.part, jnp.ones_like(before.part))
        broken = fresh & ~jnp.isfinite(size)
        stays = jnp.where(back, before.x + part * before.step, before.x)
        return _Iterate(
            jnp.where(kept, x, stays),
            before.factors,
            jnp.where(fresh, correction, before.step),
            part,
            jnp.where(kept, size, before.size),
            jnp.where(fresh | back, 0, contraction),
            before.corrections + (kept | back).astype(before.corrections.dtype),
            before.jacobians,
            stalls,
            defect,
            jnp.zeros_like(fresh),
            ~kept & ~back,
            done,
            broken,
        )

    unfinished = lambda c: (
        ~(c.done | c.broken) & ~(c.stale & (c.jacobians >= max_jacobians))
    )
    return jax.lax.while_loop(unfinished, correct, first)


class _Size(NamedTuple):
    """The size of a correction, in parts of the one before too, and of its residual."""

    size: Scalar
    contraction: Scalar
    defect: Scalar
    shrinks: Flag


def _ends(
    before: _Iterate, new: _Size, newton: Newton, is_exact: bool, eps: float
) -> tuple[Flag, Flag, Count]:
    """Whether the residual is round-off, whether a correction ends the search for another
    reason, and how many in a row have stalled."""
    size, contraction, defect, shrinks = new
    fresh, small = before.fresh, size <= eps**0.25
    # The contraction of a chord is what its Jacobian is off by: it stays. At least as
    # much as the last correction moved it, and as it was: where one shrinks more, it
    # is an accident.
    rate = jnp.maximum(jnp.maximum(contraction, before.contraction), before.size)
    converged = (size * rate <= newton.rtol * eps) & (defect <= eps**0.25)
    converged = ~fresh & shrinks & converged
    is_root = (defect <= newton.atol * eps) & small
    # One that shrank, with this Jacobian, and no longer does has met the round-off.
    met = ~fresh & ~shrinks & (before.contraction > 0)
    met = met & (defect <= eps**0.875) & small
    # So has one with a Jacobian of its own; but where the residual is not tiny
    # (coordinates a million lengths off) only if it happens again and again, and never
    # where it is not small: a residual can have a smallest value that is no root. With
    # one that is not exact corrections can shrink slowly, and go on.
    stalled = fresh & small & (~shrinks if is_exact else contraction >= 1)
    stalls = jnp.where(fresh, jnp.where(stalled, before.stalls + 1, 0), before.stalls)
    again_and_again = (stalls == _STALLS) & (defect <= eps**0.5) & is_exact
    met = met | (stalled & ((defect <= eps**0.75) | again_and_again))
    return is_root, converged | met, stalls
