"""Checks that the start of a run satisfies the constraints, and so do its derivatives."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._operators import AbstractModel
from .._programs import compiled_for_once, is_known, jacobian_pattern, values_of
from .._results import RESULTS
from .._system import AbstractSystem, direction_without_symmetry, State
from .._types import Args, Flag, Scalar
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
    """The system and `args`, with an error for derivatives that a run does not have.

    The constraints may depend on a number with respect to which a derivative is taken, such
    as a length. If the start does not move with it, the run with another length would be
    refused. Where values are traced, as in `jit`, the derivative is NaN in place of the
    error.
    """
    is_traced = lambda x: eqx.is_inexact_array(x) and not is_known(x)
    numbers, rest = eqx.partition((system, args), is_traced)
    if not jax.tree.leaves(numbers):
        return system, args

    @jax.custom_jvp
    def checked(numbers: PyTree[Array], start: State, h: Scalar) -> PyTree[Array]:
        del start, h
        return numbers

    def rule(primals: Any, tangents: Any) -> tuple[PyTree[Array], PyTree[Array]]:
        (numbers, start, h), (rates, motion, _) = primals, tangents
        if not _is_zero(motion.q):
            return numbers, rates
        each = functools.partial(jax.tree.map, is_leaf=_is_zero)
        moving, still = eqx.partition(numbers, each(lambda r: not _is_zero(r), rates))
        others = eqx.combine(still, rest)
        factors = _factors(scheme, moving, others, start, h, _is_zero(motion.v))
        times = lambda rate, factor: rate if factor is None else rate * factor
        return numbers, each(times, rates, factors)

    checked.defjvp(rule, symbolic_zeros=True)
    return eqx.combine(checked(numbers, start, h), rest)


def _is_zero(rate: Any) -> bool:
    return isinstance(rate, SymbolicZero)


def _factors(
    scheme: AbstractScheme,
    moving: PyTree[Array],
    others: PyTree[Any],
    start: State,
    h: Scalar,
    of_rates: bool,
) -> PyTree[Scalar]:
    """For each moving number in the constraints NaN if the start must move with it, else 1.

    - `moving`, `others`: the numbers with a rate, and all else, of a system and `args`.
    - `of_rates`: whether the velocities do not move either.
    """
    if not jax.tree.leaves(moving):
        return moving
    moving, still = eqx.partition(moving, _occur_in_constraints(moving, others, start))
    if not jax.tree.leaves(moving):
        return moving
    numbers = (scheme, moving, eqx.combine(still, others), start, h)
    scheme, moving, others, start, h = values_of(numbers)
    are_wrong = _violate(scheme, moving, others, start, h, of_rates)
    for path, wrong in jax.tree_util.tree_leaves_with_path(are_wrong):
        if is_known(wrong) and wrong:
            raise ValueError(_message(path))
    return jax.tree.map(lambda wrong: jnp.where(wrong, jnp.nan, 1), are_wrong)


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
) -> PyTree[Flag]:
    """Whether another value of the numbers makes the start violate the constraints."""

    def errors(moving: PyTree[Array]) -> Array:
        system, args = eqx.combine(moving, others)
        model = model_for(scheme, system, start, args)
        return _errors(scheme, model, model.to_internal(start), h, of_rates=of_rates)

    value, pull_back = jax.vjp(errors, moving)
    (slopes,) = pull_back(direction_without_symmetry(value))
    # The change of the errors if the number doubles.
    change = lambda x, slope: jnp.where(x == 0, 1, x) * slope
    return jax.tree.map(lambda x, s: jnp.any(jnp.abs(change(x, s)) > 1), moving, slopes)


def _message(path: Any) -> str:
    """The error for a number of `(system, args)` at this place."""
    (root, *rest) = path
    name = "args" if root.idx else "system"
    name += jax.tree_util.keystr(tuple(rest))
    return (
        f"This run has no derivative with respect to `{name}`: the constraints depend on "
        "it, and the start does not, so a run with another value would be refused. Create "
        "the start inside the differentiated function, with `initial_state(system, q, v, "
        "args)`. If you do not need this derivative, pass "
        f"`jax.lax.stop_gradient({name})`."
    )
