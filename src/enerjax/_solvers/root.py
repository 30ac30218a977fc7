"""The one nonlinear driver: every step equation of the package is solved here.

It knows no mechanics. It takes a function whose arguments and values are scaled to
order one, and finds its root, by default with `Newton`. Derivatives of the root follow
from the implicit function theorem, in forward and in reverse mode.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._programs import in_one_function, is_known
from .._types import Flag, Scalar
from .linear.dense import AbstractFactors
from .linear.jacobian import Linearisable, linearisable
from .newton import Newton, Start
from .search import Chord, flat_of, flattened, Root, RootFinder, search


# The name under which a policy of `jax.checkpoint` knows the value of a root.
ROOT = "enerjax_root"


@eqx.filter_custom_jvp
def _root(fn, chord, root_finder, args, start, max_iterations):
    return search(fn, chord, root_finder, args, start, max_iterations)


@_root.def_jvp
def _root_jvp(primals, tangents):
    fn, chord, root_finder, args, start, max_iterations = primals
    t_args = tangents[3]
    # Apart: derivatives neither trace nor need how it is found.
    again = lambda: _root(fn, chord, root_finder, args, start, max_iterations)
    root = in_one_function(again)()
    # All that the derivatives of a step need of the search for it.
    root = eqx.tree_at(
        lambda root: (root.value, root.found, root.broken, root.finite),
        root,
        replace_fn=lambda x: jax.tree.map(lambda x: checkpoint_name(x, ROOT), x),
    )
    is_none = lambda x: x is None
    unmoved = jax.tree.map(is_none, t_args, is_leaf=is_none)
    fixed, moved = eqx.partition(args, unmoved, is_leaf=is_none)
    flat, unravel, flat_fn = flattened(fn, root.value)
    by_args = lambda moved: flat_fn(flat, eqx.combine(moved, fixed))
    _, rate = jax.jvp(by_args, (moved,), (t_args,))
    given = root_finder.linear_solver if isinstance(root_finder, Newton) else None
    regularisation = flat_of(args[-1])
    linear = linearisable(flat_fn, flat, args, given, regularisation)
    change = linear.solve(flat, -rate)
    if regularisation is not None:
        change = change + _turned(linear, flat_fn, flat, (moved, fixed), t_args)
    # Nothing but the root itself depends on the arguments: not how it was found.
    still = jax.tree.map(jnp.zeros_like, eqx.filter(root, eqx.is_inexact_array))
    return root, eqx.tree_at(lambda root: root.value, still, unravel(change))


def _turned(
    linear: Linearisable,
    fn: Callable[[Array, PyTree], Array],
    root: Float[Array, " n"],
    parts: tuple[PyTree, PyTree],
    t_args: PyTree,
) -> Float[Array, " n"]:
    """How fast a root of least size moves into what the equations leave open.

    That part turns with the arguments, and the root stays orthogonal to it. The root is the
    limit of the roots `r` of `fn(r) + regularisation r = 0` as the regularisation vanishes.
    Their derivatives show this part at `r`, which is one correction off the root.
    """
    moved, fixed = parts

    def regularised(moved: PyTree, at: Array) -> Array:
        args = eqx.combine(moved, fixed)
        return fn(at, args) + ravel_pytree(args[-1])[0] * at

    assert linear.regularisation is not None
    solve = linear.regularised_solver(root)
    regular = root - solve(linear.regularisation * root)
    _, rate = jax.jvp(lambda moved: regularised(moved, regular), (moved,), (t_args,))
    return linear.open_part(solve, linear.regularised_solver(regular)(-rate))


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
    regularisation: PyTree[Array] | None = None,
    least: Scalar | float = 1.0,
    chord: Chord | None = None,
    by_chord: Flag | bool = True,
) -> Root:
    """The root of `fn(y, args)`. Never raises.

    The implicit function theorem gives its derivatives with respect to `args`, with one
    linear solve each. A singular lane of a batch has non-finite derivatives of its own and
    leaves the others alone. `guess`, `factors` (of a solve before) and `others` (guesses
    that `Newton` turns to if it fails) only say where to begin. With `skip`, `Newton`
    returns the guess without an iteration.

    `regularisation` is for equations that leave a combination of the unknowns open: small
    numbers that are added to the diagonal of the Jacobian and make it regular. The root is
    then the one of least size, in the norm that `regularisation` weights, and so are its
    derivatives. If all unknowns turn out smaller than one, they are resolved relative to
    their own size, down to `least`.

    With a `chord`, and if `by_chord`, `Newton` searches with its corrections first, and
    with the exact Jacobian only where that search has failed. The root and its derivatives
    are those of `fn` in any case.
    """
    flat, _ = ravel_pytree(guess)
    start = Start(
        guess=guess,
        others=tuple(others),
        factors=factors,
        skip=jnp.asarray(skip),
        by_chord=jnp.asarray(by_chord),
        regularisation=regularisation,
        least=jnp.asarray(least, flat.dtype),
    )
    start = jax.lax.stop_gradient(start)
    traced, opened = _opened(fn, guess, args)
    call = lambda y, inputs: opened(inputs[0], y, inputs[1])
    of_chord = None
    if chord is not None:
        of_chord, prepare = _opened(chord.prepare, guess, args)
        correct = chord.correct
        chord = Chord(
            lambda y, inputs: prepare(inputs[2], y, inputs[1]),
            lambda value, inputs, prepared: correct(value, inputs[1], prepared),
        )
    inputs = traced, args, of_chord, regularisation
    return _root(call, chord, root_finder, inputs, start, max_iterations)


def _opened(fn: Callable, *like: Any) -> tuple[Any, Callable]:
    """What is traced of that which `fn` closes over, and `fn` as a function of it too."""
    # Functions in `args` may hold traced numbers. (The lambda has a closure, without which
    # the conversion would not look for any.)
    closed = lambda *args: fn(*args)
    converted = eqx.filter_closure_convert(closed, *like)
    # What is known stays closed over: indices tell which unknowns a row depends on.
    traced, known = eqx.partition(converted, lambda x: not is_known(x))
    return traced, lambda traced, *args: eqx.combine(traced, known)(*args)
