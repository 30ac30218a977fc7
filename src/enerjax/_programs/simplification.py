"""Programs without operations that are repeated, or whose results are not used.

XLA leaves both out of the code that it generates. Before that they are traced, derived and
translated as often as their program occurs in another one. Half of the operations of a
residual are of this kind.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr_consts
from jaxtyping import Array, PyTree

from .jaxprs import evaluate, interpret


def simplified(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """`fn`, which returns a pytree of arrays, with every operation once."""

    def call(*args: Any) -> PyTree[Array]:
        numbers, rest = eqx.partition(args, eqx.is_array)
        leaves, structure = jax.tree.flatten(numbers)
        whole = lambda *leaves: fn(*eqx.combine(structure.unflatten(leaves), rest))
        closed, like = jax.make_jaxpr(whole, return_shape=True)(*leaves)
        jaxpr, of_consts, of_inputs = dce_jaxpr_consts(
            closed.jaxpr, [True] * len(closed.out_avals)
        )
        consts = [x for x, used in zip(closed.consts, of_consts, strict=True) if used]
        inputs = [x for x, used in zip(leaves, of_inputs, strict=True) if used]
        out = interpret(jaxpr, consts, inputs, _Once())
        return jax.tree.unflatten(jax.tree.structure(like), map(jnp.asarray, out))

    return call


class _Once:
    """Evaluates an equation, unless an equal one has been evaluated before."""

    def __init__(self):
        # The values are kept, because the identity of one that is gone can be used again.
        self._found: dict[Any, tuple[list[Any], list[Any]]] = {}

    def __call__(self, equation: Any, values: list[Any]) -> list[Any]:
        primitive, params = equation.primitive, equation.params
        key = primitive, tuple(params.items()), tuple(map(_identity, values))
        if equation.effects or not _is_hashable(key):
            return evaluate(primitive, values, params)
        if key not in self._found:
            self._found[key] = evaluate(primitive, values, params), values
        return self._found[key][0]


def _identity(value: Any) -> Any:
    """Equal for a value and itself, and for equal literals."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return value.tobytes(), value.dtype
    return id(value)


def _is_hashable(x: Any) -> bool:
    try:
        hash(x)
    except TypeError:
        return False
    return True
