"""How large the terms are that forces and energies are made of.

Where springs balance each other or a weight, forces vanish and energies may; what is left
of them there is the round-off of their terms, `eps` times the sizes here.
"""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._discrete import AbstractCorrected, AbstractDerivative
from .._system import State
from .._types import Coordinates, Scalar
from .interval import Increment


if TYPE_CHECKING:
    from .base import AbstractModel


_OPERATIONS = 4.0


def force_size(model: "AbstractModel", state: State) -> Coordinates:
    """Of the terms of `dH/dq` and of the applied forces, without those of constraints."""
    return _term_size(lambda model, state: model.slope(state), model, state)


def action_size(
    model: "AbstractModel",
    derivative: AbstractDerivative,
    state: State,
    h: Scalar,
    increment: Increment,
) -> Scalar | float:
    """Of the terms of `h V + impulse . Phi`; nothing where no correction asks for it."""
    if not isinstance(derivative, AbstractCorrected):
        return 0.0
    energy = _term_size(lambda model, state: model.potential(state), model, state)
    pull = jnp.abs(increment.impulse) @ model.scales.constraint_size
    # A few operations each, with a rounding of their own.
    return _OPERATIONS * jax.lax.stop_gradient(jnp.abs(h) * energy + pull)


def _term_size(
    fn: Callable[["AbstractModel", State], Array], model: "AbstractModel", state: State
) -> Array:
    """The change of `fn` if all that it is made from were wrong by its own size.

    By unequal parts of it, so that what cancels in `fn` does not cancel here.
    """
    inputs, rest = eqx.partition((state.q, model.args), eqx.is_inexact_array)

    def of(inputs: PyTree[Array]) -> Array:
        q, args = eqx.combine(inputs, rest)
        return fn(_with_args(model, args), State(q, state.v, state.t))

    inputs = jax.lax.stop_gradient(inputs)
    flat, unravel = ravel_pytree(inputs)
    # The golden ratio leaves no two parts equal.
    parts = 0.5 + (0.618034 * jnp.arange(1, flat.size + 1, dtype=flat.dtype)) % 1
    value, change = jax.jvp(of, (inputs,), (unravel(parts * flat),))
    # Where `args` enter by a function without a derivative there is no telling.
    size = jnp.abs(value) + jnp.where(jnp.isfinite(change), jnp.abs(change), 0)
    return jax.lax.stop_gradient(size)


def _with_args(model: "AbstractModel", args: Any) -> "AbstractModel":
    is_none = lambda x: x is None
    return eqx.tree_at(lambda model: model.args, model, args, is_leaf=is_none)
