"""The one nonlinear driver: every step equation of the package is solved here.

It knows no mechanics. It takes a function whose arguments and values are scaled to
order one, and finds its root, by default with `Newton`. Derivatives of the root follow
from the implicit function theorem, in forward and in reverse mode.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.ad_checkpoint import checkpoint_name
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ._linear import (
    AbstractFactors,
    kept_factors,
    LARGE,
    Linearisable,
    linearisable,
    narrowed,
)
from ._newton import max_norm, Newton, newton_iterations, PATIENCE, Start
from ._one_function import in_one_function
from ._tracing import is_known
from ._types import Count, Flag, Scalar


# The name under which a policy of `jax.checkpoint` knows the value of a root.
ROOT = "enerjax_root"
RootFinder: TypeAlias = Newton | optx.AbstractRootFinder | optx.AbstractLeastSquaresSolver


class Root(eqx.Module):
    """A root, or the last iterate where none was found.

    - `value`: the unknowns.
    - `factors`: for the next solve.
    - `iterations`: corrections made.
    - `residual`: its largest entry; of `Newton` before the last correction.
    - `found`: whether they converged.
    - `broken`: whether they became singular or non-finite.
    - `finite`: whether the residual is.
    """

    value: PyTree[Array]
    factors: AbstractFactors | None
    iterations: Count
    residual: Scalar
    found: Flag
    broken: Flag
    finite: Flag


def _flattened(fn: Callable, value: PyTree[Array]) -> tuple[Array, Callable, Callable]:
    """A value as a vector, its inverse, and `fn` between vectors."""
    flat, unravel = ravel_pytree(value)
    return flat, unravel, lambda x, args: ravel_pytree(fn(unravel(x), args))[0]


def _flat(fill: PyTree[Array] | None) -> Array | None:
    return None if fill is None else ravel_pytree(fill)[0]


def _search(
    fn: Callable[[PyTree[Array], Any], PyTree[Array]],
    simplified: Callable[[PyTree[Array], PyTree[Array], Any], PyTree[Array]] | None,
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
        residual = max_norm(fn(solution.value, args))
        # Tolerances finer than the unknowns can be resolved end at `max_iterations`.
        found = found | (residual <= Newton().atol * jnp.finfo(residual.dtype).eps)
        return Root(
            solution.value,
            start.factors,
            steps,
            residual,
            found,
            singular | nonfinite,
            jnp.isfinite(residual),
        )
    flat, unravel, flat_fn = _flattened(fn, start.guess)
    given, fill = root_finder.linear_solver, _flat(start.fill)
    exact, near = linearisable(flat_fn, flat, args, given, fill), None
    if simplified is not None and given is None:
        flat_simplified = lambda x, inputs: ravel_pytree(
            simplified(unravel(x), unravel(inputs[0]), inputs[1])
        )[0]
        near = narrowed(exact, flat_simplified, flat, args)
    if near is None:
        return _iterated(exact, root_finder, start, max_iterations)
    alone = eqx.tree_at(lambda start: start.others, start, ())
    first = _iterated(near, root_finder, alone, PATIENCE)

    def again() -> Root:
        # (The lanes of a batch all come here.)
        left = eqx.tree_at(lambda start: start.skip, start, start.skip | first.found)
        last = _iterated(exact, root_finder, left, max_iterations)
        made = first.iterations + last.iterations
        return eqx.tree_at(lambda root: root.iterations, last, made)

    return jax.lax.cond(first.found, lambda: first, again)


def _iterated(
    residual: Linearisable, newton: Newton, start: Start, max_jacobians: int
) -> Root:
    _, unravel = ravel_pytree(start.guess)
    last = newton_iterations(residual, newton, start, max_jacobians)
    keeps = residual.keeps_factors and start.factors is not None
    factors = last.factors if keeps else start.factors
    return Root(
        unravel(last.x),
        factors,
        last.corrections,
        last.defect,
        last.done,
        last.broken,
        jnp.isfinite(last.defect),
    )


@eqx.filter_custom_jvp
def _root(fn, simplified, root_finder, args, start, max_iterations):
    return _search(fn, simplified, root_finder, args, start, max_iterations)


@_root.def_jvp
def _root_jvp(primals, tangents):
    fn, simplified, root_finder, args, start, max_iterations = primals
    t_args = tangents[3]
    # Apart: derivatives neither trace nor need how it is found.
    search = lambda: _root(fn, simplified, root_finder, args, start, max_iterations)
    root = in_one_function(search)()
    # All that the derivatives of a step need of the search for it.
    root = eqx.tree_at(
        lambda root: (root.value, root.found, root.broken, root.finite),
        root,
        replace_fn=lambda x: jax.tree.map(lambda x: checkpoint_name(x, ROOT), x),
    )
    is_none = lambda x: x is None
    unmoved = jax.tree.map(is_none, t_args, is_leaf=is_none)
    fixed, moved = eqx.partition(args, unmoved, is_leaf=is_none)
    flat, unravel, flat_fn = _flattened(fn, root.value)
    by_args = lambda moved: flat_fn(flat, eqx.combine(moved, fixed))
    _, rate = jax.jvp(by_args, (moved,), (t_args,))
    given = root_finder.linear_solver if isinstance(root_finder, Newton) else None
    linear = linearisable(flat_fn, flat, args, given, _flat(start.fill))
    change = linear.solve(flat, -rate)
    # Nothing but the root itself depends on the arguments: not how it was found.
    still = jax.tree.map(jnp.zeros_like, eqx.filter(root, eqx.is_inexact_array))
    return root, eqx.tree_at(lambda root: root.value, still, unravel(change))


def find_root(
    fn: Callable[[PyTree[Array], Any], PyTree[Array]],
    root_finder: RootFinder,
    guess: PyTree[Array],
    args: PyTree,
    *,
    max_iterations: int,
    others: Sequence[PyTree[Array]] = (),
    factors: AbstractFactors | None = None,
    skip: Flag | bool = False,
    fill: PyTree[Array] | None = None,
    least: Scalar | float = 1.0,
    simplified: Callable[[PyTree[Array], PyTree[Array], Any], PyTree[Array]] | None = None,
) -> Root:
    """The root of `fn(y, args)`. Never raises.

    The implicit function theorem gives its derivatives with respect to `args`, with one
    linear solve each; a singular lane of a batch has non-finite derivatives of its own and
    leaves the others alone. `guess`, `factors` (of a solve before) and `others`,
    guesses that
    `Newton` turns to where it fails, only say where to begin. With `skip`, `Newton`
    returns the guess without an iteration.

    `fill`, like the guess, is for equations that do not determine some of the unknowns,
    and do not ask for them either: small numbers that are added to the diagonal of the
    Jacobian, and make it regular. Such unknowns then stay what they are in the guess.
    Unknowns that turn out all smaller than one are resolved by their own size, down to
    `least`.

    `simplified(y, held, args)` equals `fn` where `held` is `y`. Where its Jacobian in `y`
    is a narrower band, `Newton` searches with that, and with the exact one only where that
    search has failed.
    """
    flat, _ = ravel_pytree(guess)
    start = Start(
        guess,
        tuple(others),
        kept_factors(flat.size, flat.dtype) if factors is None else factors,
        jnp.asarray(skip),
        fill,
        jnp.asarray(least, flat.dtype),
    )
    start = jax.lax.stop_gradient(start)
    traced, opened = _opened(fn, guess, args)
    call = lambda y, inputs: opened(inputs[0], y, inputs[1])
    near, traced_too = None, None
    if simplified is not None and flat.size > LARGE:
        traced_too, opened_too = _opened(simplified, guess, guess, args)
        near = lambda y, held, inputs: opened_too(inputs[2], y, held, inputs[1])
    inputs = traced, args, traced_too
    return _root(call, near, root_finder, inputs, start, max_iterations)


def _opened(fn: Callable, *like: Any) -> tuple[Any, Callable]:
    """What is traced of that which `fn` closes over, and `fn` as a function of it too."""
    # Functions in `args` may hold traced numbers. (The lambda has a closure, without which
    # the conversion would not look for any.)
    closed = lambda *args: fn(*args)
    converted = eqx.filter_closure_convert(closed, *like)
    # What is known stays closed over: indices tell which unknowns a row depends on.
    traced, known = eqx.partition(converted, lambda x: not is_known(x))
    return traced, lambda traced, *args: eqx.combine(traced, known)(*args)
