"""Checks that the start of a run satisfies the constraints, and so do its derivatives."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from .._operators import AbstractModel
from .._programs import compiled_for_once, is_known, jacobian_pattern, values_of
from .._results import RESULTS
from .._system import AbstractSystem, direction_without_symmetry, State
from .._types import Args, Scalar
from ..schemes import AbstractScheme
from .model import model_for


def check_start(
    scheme: AbstractScheme, model: AbstractModel, start: State, h: Scalar
) -> RESULTS:
    """Whether the start satisfies the constraints of the scheme, to half the digits."""
    # NaN compares false: such a start fails in its first step.
    errors = _errors(scheme, model, start, h)
    bad = jnp.any(jnp.abs(errors) > 1)
    return RESULTS.where(bad, RESULTS.inconsistent_start, RESULTS.successful)


def _errors(
    scheme: AbstractScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    *,
    of_rates: bool = True,
) -> Float[Array, " rows"]:
    """The errors of a start in the constraints of the scheme, relative to what is allowed.

    An error would stay in the energy balance of the first step. The displacement or
    velocity that would repair it is compared with that of a step, so the position of the
    origin does not matter.
    """
    scales, eps = model.scales, jnp.finfo(h.dtype).eps
    tolerance = 1e2 * jnp.sqrt(eps * model.energy_scale(start, h))
    unit, terms = map(model.holonomic, (scales.constraint, scales.constraint_size))
    allowed = jax.lax.stop_gradient(h * tolerance * unit + 1e3 * eps * terms)
    errors = model.constraint(start.q, start.t) / allowed
    if scheme.stage.formulation != "ggl" or not of_rates:
        return errors
    rate = model.joint_rate(start.q, start.v, start.t)
    allowed = jax.lax.stop_gradient(tolerance * scales.constraint[: rate.size])
    return jnp.concatenate([errors, rate / allowed])


def with_checked_rates(
    system: AbstractSystem, scheme: AbstractScheme, start: State, args: Args, h: Scalar
) -> tuple[AbstractSystem, Args]:
    """The system and `args`, without derivatives that a run does not have.

    The constraints may depend on a number with respect to which a derivative is taken, such
    as a length. If the start does not move, the run with another length would be refused.
    The derivatives by such numbers are infinite or NaN, and if there are no others, this is
    an error. (Where values are traced, as in `jit`, there is no error.) A start that moves
    with any number is not checked.
    """
    everything = system, args, scheme, start, h
    is_traced = lambda x: eqx.is_array(x) and not is_known(x)
    traced, known = eqx.partition(everything, is_traced)
    if not jax.tree.leaves(traced[:2]):
        return system, args

    @jax.custom_jvp
    def checked(traced: PyTree[Array]) -> PyTree[Array]:
        return traced[:2]

    def rule(primals: Any, tangents: Any) -> tuple[PyTree[Array], PyTree[Array]]:
        (traced,), (rates,) = primals, tangents
        numbers, motion = rates[:2], rates[3]
        if _is_moving(motion.q):
            return traced[:2], numbers
        each = functools.partial(jax.tree.map, is_leaf=_is_zero)
        moving, still = eqx.partition(traced[:2], each(_is_moving, numbers))
        others = eqx.combine(still, known[:2])
        _, _, scheme, start, h = eqx.combine(traced, known)
        factors = _factors(scheme, moving, others, start, h, not _is_moving(motion.v))
        # Two such products make a rate infinite, and leave a rate that is zero as it is.
        times = lambda rate, factor: rate if factor is None else rate * factor * factor
        return traced[:2], each(times, numbers, factors)

    checked.defjvp(rule, symbolic_zeros=True)
    return eqx.combine(checked(traced), known[:2])


def _is_zero(rate: Any) -> bool:
    return isinstance(rate, SymbolicZero)


def _is_moving(rate: Any) -> bool:
    return rate is not None and not _is_zero(rate)


def _factors(
    scheme: AbstractScheme,
    moving: PyTree[Array],
    others: PyTree[Any],
    start: State,
    h: Scalar,
    of_rates: bool,
) -> PyTree[Array]:
    """For each moving number in the constraints 1, or a large factor if the start must move
    with it.

    - `moving`, `others`: the numbers with a rate, and all else, of a system and `args`.
    - `of_rates`: whether the velocities do not move either.
    """
    if not jax.tree.leaves(moving):
        return moving
    inside, free = eqx.partition(moving, _occur_in_constraints(moving, others, start))
    if not jax.tree.leaves(inside):
        return inside
    scheme, inside, others, start, h = values_of(
        (scheme, inside, eqx.combine(free, others), start, h)
    )
    are_wrong = _violate(scheme, inside, others, start, h, of_rates)
    wrong = jax.tree_util.tree_leaves_with_path(are_wrong)
    if not jax.tree.leaves(free) and all(is_known(x) and x.all() for _, x in wrong):
        raise ValueError(_message(wrong[0][0]))
    large = jnp.finfo(h.dtype).max
    return jax.tree.map(lambda wrong: jnp.where(wrong, large, 1).astype(h.dtype), are_wrong)


def _occur_in_constraints(
    moving: PyTree[Array], others: PyTree[Any], start: State
) -> PyTree[bool]:
    """Which of the numbers occur in constraints."""
    # Coordinates and time are variables too: where they vanish, so may their factors.
    variables, unravel = ravel_pytree((moving, start.q, start.t))

    def rows(variables: Array) -> Array:
        moving, q, t = unravel(variables)
        system, args = eqx.combine(moving, others)
        functions = (
            (system.constraint, (q,)),
            (system.driven, (q, t)),
            (system.nonholonomic, (q,)),
        )
        of_each = [fn(*inputs, args) for fn, inputs in functions if fn is not None]
        return jnp.concatenate([jnp.zeros((0,), q.dtype), *map(jnp.ravel, of_each)])

    pattern = jacobian_pattern(rows, variables)
    occur = np.ones(variables.size, bool) if pattern is None else pattern.sum(axis=0) > 0
    leaves, structure = jax.tree.flatten(moving)
    ends = np.cumsum([x.size for x in leaves])
    of_leaves = [bool(np.any(x)) for x in np.split(occur, ends)[: len(leaves)]]
    return jax.tree.unflatten(structure, of_leaves)


@compiled_for_once
def _violate(
    scheme: AbstractScheme,
    moving: PyTree[Array],
    others: PyTree[Any],
    start: State,
    h: Scalar,
    of_rates: bool,
) -> PyTree[Bool[Array, "..."]]:
    """Whether another value of the numbers makes the start violate the constraints."""

    def errors(moving: PyTree[Array]) -> Array:
        system, args = eqx.combine(moving, others)
        model = model_for(scheme, system, start, args)
        return _errors(scheme, model, model.to_internal(start), h, of_rates=of_rates)

    value, pull_back = jax.vjp(errors, moving)
    (slopes,) = pull_back(direction_without_symmetry(value))
    # A number is changed by its own size, or by one if it is smaller.
    violates = lambda x, slope: jnp.maximum(jnp.abs(x), 1) * jnp.abs(slope) > 1
    return jax.tree.map(violates, moving, slopes)


def _message(path: Any) -> str:
    """The error for a number of `(system, args)` at this place."""
    (root, *rest) = path
    name = "args" if root.idx else "system"
    # The tables of a scene have rows for all parts of a kind.
    is_table = root.idx and str(rest[0]) == ".tables"
    name += f"[...]{rest[-1]}" if is_table else jax.tree_util.keystr(tuple(rest))
    return (
        f"This run has no derivative with respect to `{name}`: the constraints depend on "
        "it, and the start does not, so a run with another value would be refused. Create "
        "the start inside the differentiated function, with `initial_state(system, q, v, "
        "args)`, or `scene.start(args)`."
    )
