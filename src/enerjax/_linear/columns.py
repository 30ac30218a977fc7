"""Columns of Jacobians, side by side.

Under `jax.vmap` the columns are the first axis of every array, and the innermost loops of
the machine go over the two or three entries of a vector. Here they are the last axis, and
vector instructions take several columns at a time.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._one_function import LARGEST_SUM
from .._tracing import evaluate, interpret


def columns_along(
    fn: Callable[[Array], Array], x: Float[Array, " n"], seeds: Float[Array, "n k"]
) -> Float[Array, "... k"]:
    """The derivatives of `fn` at `x` along the columns of `seeds`."""
    program = jax.make_jaxpr(lambda seed: jax.jvp(fn, (x,), (seed,))[1])(x)
    (out,) = interpret(program.jaxpr, program.consts, [_Columns(seeds)], _equation)
    return _in_columns(out, seeds.shape[1])


def jacobian_columns(
    fn: Callable[[Array], Array], x: Float[Array, " n"]
) -> Float[Array, "m n"]:
    """The Jacobian of `fn` at `x`."""
    return columns_along(fn, x, jnp.eye(x.size, dtype=x.dtype))


class _Columns:
    """An array with an axis more, the last one, in which its columns follow each other."""

    def __init__(self, array: Array):
        self.array = array


def _in_columns(value: "Array | _Columns", k: int) -> Array:
    """With that axis, also where the value does not depend on the seeds."""
    if isinstance(value, _Columns):
        return value.array
    return jnp.broadcast_to(value[..., None], (*value.shape, k))


# Parts in which a large sum is taken.
_PARTS = 8
# What is left of arithmetic in a tangent.
_ELEMENTWISE = frozenset("add add_any convert_element_type copy div mul neg sub".split())


def _broadcast(x, k, *, shape, broadcast_dimensions, **_):
    return lax.broadcast_in_dim(x, (*shape, k), (*broadcast_dimensions, len(shape)))


def _reshaped(x, k, *, new_sizes, dimensions, **_):
    dimensions = None if dimensions is None else (*dimensions, len(dimensions))
    return lax.reshape(x, (*new_sizes, k), dimensions)


def _sliced(x, k, *, start_indices, limit_indices, strides):
    strides = None if strides is None else (*strides, 1)
    return lax.slice(x, (*start_indices, 0), (*limit_indices, k), strides)


def _squeezed(x, k, *, dimensions):
    return lax.squeeze(x, dimensions)


def _transposed(x, k, *, permutation):
    return lax.transpose(x, (*permutation, len(permutation)))


def _summed(x, k, *, axes, **_):
    # In parts that are small enough for one function.
    count = max(-(-x.size // LARGEST_SUM), 1)
    if count > min(k, _PARTS):
        return jnp.sum(x, axis=axes)
    parts = (jnp.sum(part, axis=axes) for part in jnp.array_split(x, count, axis=-1))
    return jnp.concatenate([*parts], axis=-1)


def _split(x, k, *, sizes, axis):
    return lax.split(x, sizes, axis)


# Of primitives with one operand.
_MOVES = {
    "broadcast_in_dim": _broadcast,
    "reduce_sum": _summed,
    "reshape": _reshaped,
    "slice": _sliced,
    "split": _split,
    "squeeze": _squeezed,
    "transpose": _transposed,
}


def _equation(equation: Any, values: list[Any]) -> list[Any]:
    primitive, params, name = equation.primitive, equation.params, equation.primitive.name
    sizes = {x.array.shape[-1] for x in values if isinstance(x, _Columns)}
    if not sizes:
        return evaluate(primitive, values, params)
    (k,) = sizes
    if name in ("jit", "pjit"):
        inner = params["jaxpr"]
        return interpret(inner.jaxpr, inner.consts, values, _equation)
    if name in _ELEMENTWISE:
        arrays = [_in_columns(x, k) for x in values]
        shape = jnp.broadcast_shapes(*(x.shape for x in arrays))
        out = evaluate(primitive, [jnp.broadcast_to(x, shape) for x in arrays], params)
    elif name in _MOVES and len(values) == 1:
        out = _MOVES[name](values[0].array, k, **params)
        out = out if primitive.multiple_results else [out]
    elif name == "concatenate":
        arrays = [_in_columns(x, k) for x in values]
        out = [lax.concatenate(arrays, params["dimension"])]
    elif name == "pad" and not isinstance(values[1], _Columns):
        config = (*params["padding_config"], (0, 0, 0))
        out = [lax.pad(values[0].array, values[1], config)]
    else:
        out = _by_vmap(primitive, values, params)
    return [_Columns(x) for x in out]


def _by_vmap(primitive: Any, values: list[Any], params: dict[str, Any]) -> list[Array]:
    """Of any other primitive."""
    arrays = [x.array if isinstance(x, _Columns) else x for x in values]
    axes = [x.array.ndim - 1 if isinstance(x, _Columns) else None for x in values]
    apply = lambda *arrays: evaluate(primitive, list(arrays), params)
    return jax.vmap(apply, in_axes=axes, out_axes=-1)(*arrays)
