"""Newton's method, on functions whose arguments and values are scaled to order one."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ._linear import AbstractFactors
from ._types import Count, Flag, Scalar


def max_norm(x: PyTree[Array]) -> Scalar:
    """The largest entry; for all residuals and corrections here are of order one."""
    return jnp.max(jnp.abs(ravel_pytree(x)[0]), initial=0.0)


class Newton(eqx.Module):
    """Newton's method on a problem scaled to order one, down to round-off.

    One Jacobian serves several corrections and steps, with an approximate inverse that is
    improved from the one before. It is renewed where the corrections `c_k` would shrink by
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
    - `factors`: of the Jacobian of the solve before, or empty.
    - `skip`: return the guess without an iteration.
    """

    guess: PyTree[Array]
    second_guess: PyTree[Array]
    factors: AbstractFactors
    skip: Flag


class _Iterate(eqx.Module):
    x: Float[Array, " n"]
    factors: AbstractFactors
    # Size of the last correction, infinite if there was none, and what it had left of the
    # one before, with the same Jacobian.
    size: Scalar
    contraction: Scalar
    corrections: Count
    jacobians: Count
    # Whether the factors are of the Jacobian at `x`, and whether they should become so.
    fresh: Flag
    stale: Flag
    done: Flag
    broken: Flag


# Jacobians after which a first guess is given up. Where quadratic convergence sets in at
# all, it does so before.
_PATIENCE = 12
# What a correction may leave of the one before, for its Jacobian to serve on.
_SHRINKS = 0.3


def newton_iterations(
    residual: Callable[[Array], Array], newton: Newton, start: Start, max_jacobians: int
) -> _Iterate:
    x0, _ = ravel_pytree(start.guess)
    second, _ = ravel_pytree(start.second_guess)
    eps = float(jnp.finfo(x0.dtype).eps)

    def linearise(carry: _Iterate) -> _Iterate:
        factors = carry.factors.renewed(jax.jacfwd(residual)(carry.x))
        return eqx.tree_at(
            lambda c: (c.factors, c.jacobians, c.fresh, c.stale),
            carry,
            (factors, carry.jacobians + 1, jnp.array(True), jnp.array(False)),
        )

    def correct(before: _Iterate) -> _Iterate:
        before = jax.lax.while_loop(lambda c: c.stale, linearise, before)
        fresh = before.fresh
        value = residual(before.x)
        correction = before.factors.solve(value)
        x = before.x - correction
        # Each unknown against itself: one scale for all would hide a light, slow body
        # beside a heavy, fast one. The floor is for unknowns that pass through zero.
        size = jnp.max(jnp.abs(correction) / (jnp.abs(x) + eps**0.125), initial=0.0)
        contraction = size / before.size
        shrinks = contraction < _SHRINKS
        # The contraction of a chord is what its Jacobian is off by: it stays. At least as
        # much as the last correction moved it, and as it was: where one shrinks more, it
        # is an accident.
        rate = jnp.maximum(jnp.maximum(contraction, before.contraction), before.size)
        converged = ~fresh & shrinks & (size * rate <= newton.rtol * eps)
        largest = max_norm(value)
        is_root = (largest <= newton.atol * eps) & (size <= eps**0.25)
        # With a Jacobian of its own a small correction shrinks, unless it is round-off.
        stalled = fresh & ~shrinks & (largest <= eps**0.75) & (size <= eps**0.25)
        done = (converged | is_root | stalled) & jnp.isfinite(size)
        kept = fresh | shrinks | done
        broken = fresh & ~jnp.isfinite(size)
        lost = broken | (~kept & (before.jacobians == _PATIENCE))
        again = lost & (before.jacobians <= _PATIENCE)
        return _Iterate(
            jnp.where(again, second, jnp.where(kept, x, before.x)),
            before.factors,
            jnp.where(again, jnp.inf, jnp.where(kept, size, before.size)),
            jnp.where(fresh | again, 0, contraction),
            before.corrections + kept.astype(before.corrections.dtype),
            jnp.where(again, _PATIENCE + 1, before.jacobians),
            jnp.zeros_like(fresh),
            ~kept | again,
            done,
            broken & ~again,
        )

    infinite, zero = jnp.asarray(jnp.inf, x0.dtype), jnp.zeros((), x0.dtype)
    none, no = jnp.array(0), jnp.array(False)
    # The Jacobian of the solve before serves as long as it does.
    first = _Iterate(x0, start.factors, infinite, zero, none, none, no, no, start.skip, no)
    unfinished = lambda c: (
        ~(c.done | c.broken) & ~(c.stale & (c.jacobians >= max_jacobians))
    )
    return jax.lax.while_loop(unfinished, correct, first)
