"""The solution of nonlinear equations; the step equations of all schemes are solved here.

The equations are those of a function whose arguments and values are scaled to order one.
Its root is found by `Newton`, or by a root finder of optimistix. The derivatives of the
root follow from the implicit function theorem, in forward and in reverse mode.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._programs import call_traced_once, in_one_function, is_known, part, simplified
from .._types import Flag, Scalar
from .equations import Equations
from .linear.dense import AbstractFactors, SMALL
from .linear.elimination_order import Owners
from .linear.jacobian import Linearisable
from .linear.krylov import jacobian_solver
from .newton import ChordAlone, Newton, Start
from .root_finding import (
    Chord,
    flat_of,
    has_chord_search,
    Root,
    RootFinder,
    search,
)


# The name by which policies of `jax.checkpoint` refer to the value of a root.
ROOT = "enerjax_root"


@eqx.filter_custom_jvp
def _root(equations, chord, root_finder, args, start, max_iterations):
    # A derivative of a loop over steps comes here several times.
    numbers = args, start, max_iterations
    return call_traced_once(search, equations, chord, root_finder, *numbers)


@_root.def_jvp
def _root_jvp(primals, tangents):
    equations, chord, root_finder, args, start, max_iterations = primals
    t_args = tangents[3]
    # The search is compiled as a function of its own, because it is not differentiated.
    again = lambda: _root(equations, chord, root_finder, args, start, max_iterations)
    root = in_one_function(again)()
    # The derivatives of a step use these results of the search, and no others: with one
    # that is not kept, the reverse pass would search again.
    root = eqx.tree_at(
        lambda root: (root.value, root.found, root.broken, root.finite, root.by_chord),
        root,
        replace_fn=lambda x: jax.tree.map(lambda x: checkpoint_name(x, ROOT), x),
    )
    is_none = lambda x: x is None
    unmoved = jax.tree.map(is_none, t_args, is_leaf=is_none)
    fixed, moved = eqx.partition(args, unmoved, is_leaf=is_none)
    # What is not a root may be infinite. Its rates do not count, and must not be NaN: the
    # reverse pass would multiply them by zero.
    value = jax.tree.map(lambda x: jnp.where(root.found, x, 0), root.value)
    flat, unravel = ravel_pytree(value)
    by_args = lambda moved: equations.flat(flat, eqx.combine(moved, fixed))
    # Programs without a chord method have no parts, and can be longer as one function.
    by_args = by_args if chord is None else part(by_args)
    _, rate = jax.jvp(by_args, (moved,), (t_args,))
    regularisation = flat_of(args[-1])
    exact = equations.linearisable(flat, args, regularisation)
    if regularisation is not None:
        solve = exact.regularised_solver(flat)
        inputs = equations.flat, flat, (moved, fixed), t_args
        turned = _null_space_rate(exact, solve, *inputs)
        change = exact.refined(solve, -rate) + turned
    elif chord is not None and has_chord_search(root_finder):
        change = _change(exact, chord, root_finder, value, args, -rate)
    else:
        change = exact.solve(flat, -rate)
    # Only the value of the root is differentiated. Its statistics have zero tangents.
    still = jax.tree.map(jnp.zeros_like, eqx.filter(root, eqx.is_inexact_array))
    return root, eqx.tree_at(lambda root: root.value, still, unravel(change))


def _change(
    exact: Linearisable,
    chord: Chord,
    root_finder: RootFinder | ChordAlone,
    value: PyTree[Array],
    args: PyTree,
    right: Float[Array, " n"],
) -> Float[Array, " n"]:
    """The rate of change of a root of equations that have a chord method.

    Where the approximate Jacobian is close to the exact one, a few products with the latter
    are cheaper than its entries.
    """
    flat, unravel = ravel_pytree(value)
    prepared = part(lambda: chord.prepare(value, args))()
    correct = lambda x: ravel_pytree(chord.correct(unravel(x), args, prepared))[0]
    if isinstance(root_finder, ChordAlone):
        return jacobian_solver(exact.value, flat, correct)(right)
    # The entries of the Jacobian are computed only where one of these is called.
    by_entries = lambda right: exact.constant_solvers(flat)[0](right)
    transposed = lambda right: exact.constant_solvers(flat)[1](right)
    return jacobian_solver(exact.value, flat, correct, by_entries, transposed)(right)


def _null_space_rate(
    linear: Linearisable,
    solve: Callable[[Array], Array],
    fn: Callable[[Array, PyTree], Array],
    root: Float[Array, " n"],
    moved_and_fixed: tuple[PyTree, PyTree],
    t_args: PyTree,
) -> Float[Array, " n"]:
    """The part of the tangent of a least-norm root in the null space of the Jacobian.

    The null space rotates as the arguments change. The least-norm root stays orthogonal to
    it, so its tangent has a part in the null space. It is found from the roots `r` of
    `fn(r) + regularisation r = 0`, which tend to the least-norm root as the regularisation
    tends to zero. `r` is one correction away from the root, where `solve` solves.
    """
    moved, fixed = moved_and_fixed

    def regularised(moved: PyTree, at: Array) -> Array:
        args = eqx.combine(moved, fixed)
        return fn(at, args) + ravel_pytree(args[-1])[0] * at

    assert linear.regularisation is not None
    regular = root - solve(linear.regularisation * root)
    _, rate = jax.jvp(lambda moved: regularised(moved, regular), (moved,), (t_args,))
    return linear.null_space_part(solve, linear.regularised_solver(regular)(-rate))


def find_root(
    fn: Callable[[PyTree[Array], Any], PyTree[Array]],
    root_finder: RootFinder | ChordAlone,
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
    owners: Owners | None = None,
    rarely: bool = False,
) -> Root:
    """A root of `fn(y, args)`. Failures are reported in the `Root`, not raised.

    The derivatives with respect to `args` follow from the implicit function theorem, with
    one linear solve each. A lane of a batch whose Jacobian is singular has non-finite
    derivatives, and does not affect those of other lanes.

    The search begins at `guess`, with the `factors` of an earlier solve if there are any.
    If it fails, `Newton` tries the guesses `others` in their order. None of these affects
    the derivatives. With `skip`, `Newton` returns the guess without an iteration.

    A `regularisation` is needed where the equations do not determine all unknowns. It is a
    set of small numbers that are added to the diagonal of the Jacobian and make it regular.
    The result is then the root of least norm, weighted by `regularisation`, with its
    derivatives; the chord method finds the one that `chord.effective` chooses. Unknowns
    that are all smaller than one are resolved relative to the largest of them, but to no
    less than `least`.

    With a `chord`, and if `by_chord` is true, `Newton` first tries the chord method, and
    uses the exact Jacobian only where that fails; `ChordAlone` finds no root there. The
    root and its derivatives are those of `fn` in either case. If Jacobians are needed
    `rarely`, their program is one that compiles quickly. `owners` tells coordinates from
    multipliers; with them large sparse Jacobians are eliminated in blocks.
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
    traced, opened = _explicit_closure(fn, guess, args)
    call = lambda y, inputs: opened(inputs[0], y, inputs[1])
    of_chord = None
    if chord is not None:
        of_chord, prepare = _explicit_closure(chord.prepare, guess, args)
        correct, effective = chord.correct, chord.effective
        chord = Chord(
            lambda y, inputs: prepare(inputs[2], y, inputs[1]),
            lambda value, inputs, prepared: correct(value, inputs[1], prepared),
            lambda y, inputs, prepared: effective(y, inputs[1], prepared),
            chord.is_elastic,
        )
    equations = Equations(
        call,
        guess,
        root_finder.linear_solver if isinstance(root_finder, Newton) else None,
        owners=owners,
        rarely=rarely,
        # With a chord even small Jacobians are searched for structure.
        small=SMALL if chord is None else 0,
    )
    inputs = traced, args, of_chord, regularisation
    return _root(equations, chord, root_finder, inputs, start, max_iterations)


def _explicit_closure(fn: Callable, *like: Any) -> tuple[Any, Callable]:
    """The traced values in the closure of `fn`, and `fn` with these as first argument."""
    # Functions in `args` may contain traced numbers. (`filter_closure_convert` skips
    # functions without a closure; `simplified(fn)` has one.)
    converted = eqx.filter_closure_convert(simplified(fn), *like)
    # Known values stay in the closure: the sparsity pattern is found from known indices.
    traced, known = eqx.partition(converted, lambda x: not is_known(x))
    return traced, lambda traced, *args: eqx.combine(traced, known)(*args)
