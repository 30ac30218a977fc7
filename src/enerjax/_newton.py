"""The one nonlinear driver: every step equation of the package is solved here.

It knows no mechanics. It takes a function whose arguments and values are scaled to
order one, and finds its root with an optimistix root finder, by default `Newton`.
Derivatives of the root follow from the implicit function theorem, in forward and in
reverse mode.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ._types import Count, Flag, Scalar


class _Iterate(eqx.Module):
    """What Newton carries from one iteration to the next."""

    correction: Scalar  # size of the last correction
    count: Count
    done: Flag


def max_norm(x: PyTree[Array]) -> Scalar:
    """The largest entry; for all residuals and corrections here are of order one."""
    return jnp.max(jnp.abs(ravel_pytree(x)[0]), initial=0.0)


# Iterations after which a first guess is given up, if there is a second one. Where
# quadratic convergence sets in at all, it does so before.
_PATIENCE = 12


class Newton(optx.AbstractRootFinder):
    """Newton's method on a problem scaled to order one, down to round-off.

    Stops after a small correction that was computed from a residual of round-off size, or
    after one whose error, predicted from the quadratic convergence of the corrections
    `c_k`, is: the next one would be about `c_k (c_k / c_{k-1})^2`. Every residual is
    evaluated together with its Jacobian, none only to find that it is small, and the
    second test does not ask for a residual below what `fn` can resolve.

    An iteration that breaks down, or has not converged after 12 corrections, begins
    again from `options["second_guess"]` if that is given.

    **Arguments:**

    - `rtol`: bound on the predicted error, in units of round-off of the dtype.
    - `atol`: bound on the residual, in the same units.
    - `norm`: the norm of both.
    """

    rtol: float = 8.0
    atol: float = 8.0
    norm: Callable[[PyTree[Array]], Scalar] = max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        del fn, args, f_struct, aux_struct, tags
        unknown = jnp.asarray(jnp.inf, ravel_pytree(y)[0].dtype)
        skip = jnp.asarray(options.get("skip", False))
        return _Iterate(unknown, jnp.array(0), skip)

    def step(self, fn, y, args, options, state, tags):
        del tags
        flat, unravel = ravel_pytree(y)

        def flat_fn(x):
            value, aux = fn(unravel(x), args)
            value = ravel_pytree(value)[0]
            return value, (value, aux)

        jacobian, (value, aux) = jax.jacfwd(flat_fn, has_aux=True)(flat)
        correction = jnp.linalg.solve(jacobian, value)
        eps = jnp.finfo(value.dtype).eps
        # Each unknown against itself: one scale for all would hide a light, slow body
        # beside a heavy, fast one. The floor is for unknowns that pass through zero.
        own = jnp.abs(flat - correction) + eps**0.125
        size, residual = self.norm(correction / own), self.norm(value)
        contraction = size / state.correction
        # Nothing is known of the curvature before the second correction.
        known = jnp.isfinite(state.correction) & (contraction < 0.1)
        quadratic = known & (size * contraction**2 <= self.rtol * eps)
        small = (residual <= self.atol * eps) & (size <= eps**0.25)
        # A singular Jacobian leaves the correction without a value, however small the
        # residual is: that is no solution, and shows in the next iterate.
        # Coordinates far from the origin are too coarse for the rates to settle further.
        stagnated = (state.correction <= eps**0.25) & (size > 0.6 * state.correction)
        done = (quadratic | small | stagnated) & jnp.isfinite(size)
        count, flat = state.count + 1, flat - correction
        if options.get("second_guess") is not None:
            lost = ~jnp.isfinite(size) | (count == _PATIENCE)
            again = lost & ~done & (count <= _PATIENCE)
            flat = jnp.where(again, ravel_pytree(options["second_guess"])[0], flat)
            size = jnp.where(again, jnp.inf, size)
            count = jnp.where(again, _PATIENCE + 1, count)
        return unravel(flat), _Iterate(size, count, done), aux

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        del fn, args, options, tags, result
        return y, aux, {}


def _while_loop(cond_fun, body_fun, init, max_steps):
    """The loop that optimistix runs, without its own differentiation rules."""

    def cond(carry):
        count, state = carry
        return cond_fun(state) & (count < max_steps)

    def body(carry):
        count, state = carry
        return count + 1, body_fun(state)

    return jax.lax.while_loop(cond, body, (jnp.array(0), init))[1]


@eqx.filter_custom_jvp
def _root(primal_fn, rewrite_fn, inputs):
    del rewrite_fn
    root, rest = primal_fn((*inputs, _while_loop))
    return root, rest


@_root.def_jvp
def _root_jvp(primals, tangents):
    primal_fn, rewrite_fn, inputs = primals
    _, _, t_inputs = tangents
    root, rest = _root(primal_fn, rewrite_fn, inputs)
    is_none = lambda x: x is None
    unmoved = jax.tree.map(is_none, t_inputs, is_leaf=is_none)
    fixed, moved = eqx.partition(inputs, unmoved, is_leaf=is_none)
    flat, unravel = ravel_pytree(root)

    def flat_fn(x, moved):
        value = rewrite_fn(unravel(x), rest, eqx.combine(moved, fixed))
        return ravel_pytree(value)[0]

    _, rate = jax.jvp(lambda moved: flat_fn(flat, moved), (moved,), (t_inputs,))
    jacobian = jax.jacfwd(lambda x: flat_fn(x, eqx.combine(moved, fixed)))(flat)
    t_root = unravel(-jnp.linalg.solve(jacobian, rate))
    dynamic, _ = eqx.partition(rest, eqx.is_inexact_array)
    t_rest = jax.tree.map(jnp.zeros_like, dynamic)
    return (root, rest), (t_root, t_rest)


class ImplicitFunction(optx.AbstractAdjoint):
    """The implicit function theorem, with one dense linear solve for each derivative.

    Unlike `optx.ImplicitAdjoint` it raises nothing from inside the compiled program: a
    singular lane of a batch gives non-finite derivatives of its own and leaves the
    others alone.
    """

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        del tags
        return _root(primal_fn, rewrite_fn, inputs)


def find_root(
    fn: Callable[[PyTree[Array], Any], PyTree[Array]],
    root_finder: optx.AbstractRootFinder,
    guess: PyTree[Array],
    args: PyTree,
    *,
    max_iterations: int,
    second_guess: PyTree[Array] | None = None,
    skip: Flag | bool = False,
) -> tuple[PyTree[Array], Count, optx.RESULTS]:
    """The root of `fn(y, args)`, the iterations spent, and how they ended.

    Never raises. With `skip`, `Newton` returns the guess without an iteration.
    """
    solution = optx.root_find(
        fn,
        root_finder,
        guess,
        args,
        options={"skip": skip, "second_guess": second_guess},
        max_steps=max_iterations,
        adjoint=ImplicitFunction(),
        throw=False,
    )
    return solution.value, solution.stats["num_steps"], solution.result
