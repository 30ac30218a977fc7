"""Newton's method, on functions whose arguments and values are scaled to order one."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ._linear import AbstractFactors, Linearisable
from ._types import Count, Flag, Scalar


def max_norm(x: PyTree[Array]) -> Scalar:
    """The largest entry; for all residuals and corrections here are of order one."""
    return jnp.max(jnp.abs(ravel_pytree(x)[0]), initial=0.0)


class Newton(eqx.Module):
    """Newton's method on a problem scaled to order one, down to round-off.

    One Jacobian serves several corrections, with an approximate inverse that is improved
    from that of the step before. It is renewed where the corrections `c_k` would shrink by
    less than three; such a correction is not made. Stops after a correction whose error,
    predicted to be `c_k max(c_k / c_{k-1}, c_{k-1})`, is of round-off size, or which was
    computed from a residual that is, or where corrections that did shrink no longer do:
    coordinates far from the origin are too coarse for more. An iteration that breaks
    down, or has not converged with 12 Jacobians, begins again from a second guess.

    **Arguments:**

    - `rtol`: bound on the predicted error, in units of round-off of the dtype.
    - `atol`: bound on the residual, in the same units.
    """

    rtol: float = 1.0
    atol: float = 8.0


class Start(eqx.Module):
    """Where a solve begins.

    - `guess`, `second_guess`: first values of the unknowns.
    - `factors`: of the Jacobian of the solve before, where it is kept.
    - `skip`: return the guess without an iteration.
    """

    guess: PyTree[Array]
    second_guess: PyTree[Array]
    factors: AbstractFactors | None
    skip: Flag


class _Iterate(eqx.Module):
    x: Float[Array, " n"]
    factors: AbstractFactors
    # Size of the last correction, infinite if there was none.
    size: Scalar
    # Size of the residual that it was made from.
    defect: Scalar
    corrections: Count
    jacobians: Count
    # Jacobians in a row after which the correction was small and did not shrink.
    stalls: Count
    done: Flag
    broken: Flag


# Jacobians after which a first guess is given up. Where quadratic convergence sets in at
# all, it does so before.
_PATIENCE = 12
# What a correction may leave of the one before, for its Jacobian to serve on.
_SHRINKS = 0.3
_STALLS = 4


def newton_iterations(
    residual: Linearisable, newton: Newton, start: Start, max_jacobians: int
) -> _Iterate:
    x0, _ = ravel_pytree(start.guess)
    second, _ = ravel_pytree(start.second_guess)
    eps = float(jnp.finfo(x0.dtype).eps)

    def corrected(carry: _Iterate, value: Array) -> tuple[_Iterate, Scalar]:
        """One correction, and what it leaves of the one before."""
        correction = carry.factors.solve(value)
        x = carry.x - correction
        # Each unknown against itself: one scale for all would hide a light, slow body
        # beside a heavy, fast one. The floor is for unknowns that pass through zero.
        size = jnp.max(jnp.abs(correction) / (jnp.abs(x) + eps**0.125), initial=0.0)
        defect = max_norm(value)
        done = (defect <= newton.atol * eps) & (size <= eps**0.25)
        after = _Iterate(
            x,
            carry.factors,
            size,
            defect,
            carry.corrections + 1,
            carry.jacobians,
            carry.stalls,
            done,
            carry.broken,
        )
        return after, size / carry.size

    def converging(inner: tuple[_Iterate, Scalar]) -> Flag:
        carry, contraction = inner
        return ~carry.done & (contraction < _SHRINKS)

    def chord(inner: tuple[_Iterate, Scalar]) -> tuple[_Iterate, Scalar]:
        before, rate = inner
        value = residual.value(before.x)
        after, contraction = corrected(before, value)
        # The contraction of a chord is what its Jacobian is off by: it stays. At least as
        # much as the last correction moved it, where one that shrinks more is an accident.
        shrinks = contraction < _SHRINKS
        left = after.size * jnp.maximum(contraction, before.size)
        converged = shrinks & (left <= newton.rtol * eps)
        # One that shrank and no longer does has met the round-off.
        tiny = (after.defect <= eps**0.875) & (after.size <= eps**0.25)
        stalled = ~shrinks & (rate > 0) & tiny
        kept = shrinks | after.done
        carry = jax.tree.map(lambda x, y: jnp.where(kept, x, y), after, before)
        done = after.done | converged | stalled
        return eqx.tree_at(lambda c: c.done, carry, done), contraction

    def linearise(carry: _Iterate) -> _Iterate:
        jacobian, value = residual.jacobian(carry.x)
        carry = eqx.tree_at(
            lambda c: (c.factors, c.jacobians),
            carry,
            (carry.factors.renewed(jacobian), carry.jacobians + 1),
        )
        carry, contraction = corrected(carry, value)
        # With a Jacobian of its own a small correction shrinks, unless it is round-off.
        # Where the residual is not tiny (coordinates a million lengths off) it must have
        # happened several times to be believed.
        stalled = (carry.size <= eps**0.25) & (contraction >= _SHRINKS)
        stalls = jnp.where(stalled, carry.stalls + 1, 0)
        carry = eqx.tree_at(lambda c: c.stalls, carry, stalls)
        done = carry.done | (stalled & (carry.defect <= eps**0.75)) | (stalls == _STALLS)
        carry = eqx.tree_at(lambda c: c.done, carry, done & jnp.isfinite(carry.size))
        # No contraction is known of this Jacobian yet.
        begin = jnp.where(jnp.isfinite(carry.size), 0.0, jnp.inf).astype(x0.dtype)
        carry, _ = jax.lax.while_loop(converging, chord, (carry, begin))
        broken = ~jnp.isfinite(carry.size)
        lost = broken | (carry.jacobians == _PATIENCE)
        again = lost & ~carry.done & (carry.jacobians <= _PATIENCE)
        return eqx.tree_at(
            lambda c: (c.x, c.size, c.jacobians, c.broken),
            carry,
            (
                jnp.where(again, second, carry.x),
                jnp.where(again, jnp.inf, carry.size),
                jnp.where(again, _PATIENCE + 1, carry.jacobians),
                broken & ~again,
            ),
        )

    infinite, none, no = jnp.asarray(jnp.inf, x0.dtype), jnp.array(0), jnp.array(False)
    factors = residual.no_factors(start.factors, x0)
    first = _Iterate(x0, factors, infinite, infinite, none, none, none, start.skip, no)
    unfinished = lambda c: ~(c.done | c.broken) & (c.jacobians < max_jacobians)
    return jax.lax.while_loop(unfinished, linearise, first)
