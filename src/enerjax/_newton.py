"""The one nonlinear driver: every step equation of the package is solved here.

It knows no mechanics. It takes a function whose arguments and values are scaled to
order one, and finds its root, by default with `Newton`. Derivatives of the root follow
from the implicit function theorem, in forward and in reverse mode.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ._linear import AbstractFactors, empty_factors, plain_products, solve
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
    twelve Jacobians, begins again from a second guess.

    **Arguments:**

    - `rtol`: bound on the predicted error, in units of round-off of the dtype.
    - `atol`: bound on the residual, in the same units.
    """

    rtol: float = 8.0
    atol: float = 8.0


RootFinder: TypeAlias = Newton | optx.AbstractRootFinder


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
_PATIENCE = 12
# Corrections with one Jacobian.
_CORRECTIONS = 8


def _newton(
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
        carry, contraction, small = corrected(inner[0], residual(inner[0].x))
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


class Root(eqx.Module):
    """A root, or the last iterate where none was found.

    - `value`: the unknowns.
    - `factors`: for the next solve.
    - `iterations`: corrections made.
    - `found`: whether they converged.
    - `broken`: whether they became singular or non-finite.
    """

    value: PyTree[Array]
    factors: AbstractFactors
    iterations: Count
    found: Flag
    broken: Flag


def _search(
    fn: Callable[[PyTree[Array], Any], PyTree[Array]],
    root_finder: RootFinder,
    args: PyTree,
    start: Start,
    max_iterations: int,
) -> Root:
    if not isinstance(root_finder, Newton):
        solution = optx.root_find(
            fn, root_finder, start.guess, args, max_steps=max_iterations, throw=False
        )
        found, singular, nonfinite = (
            solution.result == getattr(optx.RESULTS, name)
            for name in ("successful", "singular", "nonfinite")
        )
        steps = solution.stats["num_steps"]
        return Root(solution.value, start.factors, steps, found, singular | nonfinite)
    flat, unravel = ravel_pytree(start.guess)
    flat_fn = lambda x, args: ravel_pytree(fn(unravel(x), args))[0]
    residual = plain_products(flat_fn, flat, args)
    last = _newton(residual, root_finder, start, max_iterations)
    return Root(unravel(last.x), last.factors, last.corrections, last.done, last.broken)


@eqx.filter_custom_jvp
def _root(fn, root_finder, args, start, max_iterations):
    return _search(fn, root_finder, args, start, max_iterations)


@_root.def_jvp
def _root_jvp(primals, tangents):
    fn, root_finder, args, start, max_iterations = primals
    t_args = tangents[2]
    root = _root(fn, root_finder, args, start, max_iterations)
    is_none = lambda x: x is None
    unmoved = jax.tree.map(is_none, t_args, is_leaf=is_none)
    fixed, moved = eqx.partition(args, unmoved, is_leaf=is_none)
    flat, unravel = ravel_pytree(root.value)

    flat_fn = lambda x, args: ravel_pytree(fn(unravel(x), args))[0]
    by_args = lambda moved: flat_fn(flat, eqx.combine(moved, fixed))
    _, rate = jax.jvp(by_args, (moved,), (t_args,))
    jacobian = jax.jacfwd(plain_products(flat_fn, flat, args))(flat)
    # Nothing but the root itself depends on the arguments: not how it was found.
    still = jax.tree.map(jnp.zeros_like, eqx.filter(root, eqx.is_inexact_array))
    t_value = unravel(-solve(jacobian, rate))
    return root, eqx.tree_at(lambda root: root.value, still, t_value)


def find_root(
    fn: Callable[[PyTree[Array], Any], PyTree[Array]],
    root_finder: RootFinder,
    guess: PyTree[Array],
    args: PyTree,
    *,
    max_iterations: int,
    second_guess: PyTree[Array] | None = None,
    factors: AbstractFactors | None = None,
    skip: Flag | bool = False,
) -> Root:
    """The root of `fn(y, args)`. Never raises.


    The implicit function theorem gives its derivatives with respect to `args`, with one
    linear solve each; a singular lane of a batch has non-finite derivatives of its own and
    leaves the others alone. `guess`, `factors` (of a solve before) and `second_guess` only
    say where to begin. With `skip`, `Newton` returns the guess without an iteration.
    """
    flat, _ = ravel_pytree(guess)
    start = Start(
        guess,
        guess if second_guess is None else second_guess,
        empty_factors(flat.size, flat.dtype) if factors is None else factors,
        jnp.asarray(skip),
    )
    start = jax.lax.stop_gradient(start)
    # What is closed over becomes an input: functions in `args` may hold traced numbers.
    # (The lambda has a closure, without which the conversion would not look for any.)
    closed = lambda y, args: fn(y, args)
    converted = eqx.filter_closure_convert(closed, guess, args)
    return _root(_call, root_finder, (converted, args), start, max_iterations)


def _call(y: PyTree[Array], inputs: PyTree) -> PyTree[Array]:
    fn, args = inputs
    return fn(y, args)
