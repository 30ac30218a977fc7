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

    One Jacobian serves several corrections, with an approximate inverse that is improved
    from that of the step before. It is renewed where the corrections `c_k` shrink by less
    than three. Stops after a correction whose error, predicted from their linear
    convergence to be `c_k (c_k / c_{k-1})`, is of round-off size, or which was computed
    from a residual that is. An iteration that breaks down, or has not converged with
    25 Jacobians, begins again from a second guess.

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
    # Size of the last correction, infinite if there was none.
    size: Scalar
    corrections: Count
    jacobians: Count
    done: Flag
    broken: Flag


# Jacobians after which a first guess is given up. Where quadratic convergence sets in at
# all, it does so before.
_PATIENCE = 25
# Corrections with one Jacobian.
_CORRECTIONS = 8


def newton_iterations(
    residual: Callable[[Array], Array], newton: Newton, start: Start, max_jacobians: int
) -> _Iterate:
    x0, _ = ravel_pytree(start.guess)
    second, _ = ravel_pytree(start.second_guess)
    eps = float(jnp.finfo(x0.dtype).eps)

    def with_value(x):
        value = residual(x)
        return value, value

    def corrected(carry: _Iterate, value: Array) -> tuple[_Iterate, Scalar, Flag]:
        """One correction, its contraction, and whether the residual was round-off."""
        correction = carry.factors.solve(value)
        x = carry.x - correction
        # Each unknown against itself: one scale for all would hide a light, slow body
        # beside a heavy, fast one. The floor is for unknowns that pass through zero.
        size = jnp.max(jnp.abs(correction) / (jnp.abs(x) + eps**0.125), initial=0.0)
        small = (max_norm(value) <= newton.atol * eps) & (size <= eps**0.25)
        contraction = size / carry.size
        carry = eqx.tree_at(
            lambda c: (c.x, c.size, c.corrections), carry, (x, size, carry.corrections + 1)
        )
        return carry, contraction, small

    def converging(inner: tuple[_Iterate, Flag]) -> Flag:
        carry, slow = inner
        return ~carry.done & ~slow

    def chord(inner: tuple[_Iterate, Flag]) -> tuple[_Iterate, Flag]:
        before = inner[0]
        carry, contraction, small = corrected(before, residual(before.x))
        # The contraction of a chord is what its Jacobian is off by: it stays.
        done = small | (
            (contraction < 0.3) & (carry.size * contraction <= newton.rtol * eps)
        )
        slow = ~(contraction < 0.3)
        return eqx.tree_at(lambda c: c.done, carry, done), slow

    def linearise(carry: _Iterate) -> _Iterate:
        jacobian, value = jax.jacfwd(with_value, has_aux=True)(carry.x)
        last, factors = carry.size, carry.factors.renewed(jacobian)
        carry = eqx.tree_at(
            lambda c: (c.factors, c.jacobians), carry, (factors, carry.jacobians + 1)
        )
        carry, contraction, small = corrected(carry, value)
        # With a Jacobian of its own, a correction that does not shrink is round-off:
        # coordinates far from the origin are too coarse for the rates to settle further.
        done = small | ((last <= eps**0.25) & (contraction > 0.6))
        done = done & jnp.isfinite(carry.size)
        carry = eqx.tree_at(lambda c: c.done, carry, done)
        carry, _ = jax.lax.while_loop(converging, chord, (carry, ~jnp.isfinite(carry.size)))
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
    first = _Iterate(x0, start.factors, infinite, none, none, start.skip, no)
    unfinished = lambda c: ~(c.done | c.broken) & (c.jacobians < max_jacobians)
    return jax.lax.while_loop(unfinished, linearise, first)
