"""Columns of Jacobians, side by side.

Under `jax.vmap` the columns are the first axis of every array, and the innermost loops of
the machine go over the two or three entries of a vector. Here they are the last axis, and
vector instructions take several columns at a time. Every array has only those columns that
can differ from zero in it: the derivatives of a tension with respect to coordinates are
not computed with respect to multipliers too.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._one_function import LARGEST_SUM
from .._tracing import evaluate, interpret
from .moves import MOVES


def columns_along(
    fn: Callable[[Array], Array], x: Float[Array, " n"], seeds: Float[np.ndarray, "n k"]
) -> Float[Array, "... k"]:
    """The derivatives of `fn` at `x` along the columns of `seeds`."""
    program = jax.make_jaxpr(jax.linearize(fn, x)[1])(x)
    seeds = seeds.astype(x.dtype)
    rule = functools.partial(_equation, count=seeds.shape[1])
    (out,) = interpret(program.jaxpr, program.consts, [_trimmed(seeds)], rule)
    return _in_columns(out, range(seeds.shape[1]))


def jacobian_columns(
    fn: Callable[[Array], Array], x: Float[Array, " n"]
) -> Float[Array, "m n"]:
    """The Jacobian of `fn` at `x`."""
    return columns_along(fn, x, np.eye(x.size))


class _Columns:
    """An array with an axis more, the last one, in which its columns follow each other.

    `numbers` are those of the columns that it has; in the others it is zero. An array of
    NumPy is known while the program is traced.
    """

    def __init__(self, array: Array | np.ndarray, numbers: range):
        self.array = array
        self.numbers = numbers


def _trimmed(array: np.ndarray, first: int = 0) -> _Columns:
    """Without zero columns at both ends."""
    filled = np.flatnonzero(np.any(array != 0, axis=tuple(range(array.ndim - 1))))
    if filled.size == 0:
        return _Columns(array[..., :0], range(0))
    start, stop = int(filled[0]), int(filled[-1]) + 1
    return _Columns(array[..., start:stop], range(first + start, first + stop))


def _in_columns(value: "Array | _Columns", numbers: range) -> Array:
    """With the columns of these numbers, also where it does not depend on the seeds."""
    if not isinstance(value, _Columns):
        value = jnp.asarray(value)
        return jnp.broadcast_to(value[..., None], (*value.shape, len(numbers)))
    array, own = jnp.asarray(value.array), value.numbers
    if own == numbers:
        return array
    if not own:
        return jnp.zeros((*array.shape[:-1], len(numbers)), array.dtype)
    before, after = own.start - numbers.start, numbers.stop - own.stop
    config = (*((0, 0, 0) for _ in array.shape[:-1]), (before, after, 0))
    return lax.pad(array, jnp.zeros((), array.dtype), config)


def _hull(values: list[Any]) -> range:
    """From the first to the last column that some of the values have."""
    numbers = [x.numbers for x in values if isinstance(x, _Columns) and x.numbers]
    if not numbers:
        return range(0)
    return range(min(x.start for x in numbers), max(x.stop for x in numbers))


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


def _equation(equation: Any, values: list[Any], count: int) -> list[Any]:
    primitive, params, name = equation.primitive, equation.params, equation.primitive.name
    if not any(isinstance(x, _Columns) for x in values):
        return evaluate(primitive, values, params)
    if name in ("jit", "pjit"):
        inner = params["jaxpr"]
        rule = functools.partial(_equation, count=count)
        return interpret(inner.jaxpr, inner.consts, values, rule)
    first = values[0]
    if name in MOVES and len(values) == 1 and isinstance(first.array, np.ndarray):
        return _known_move(first, MOVES[name], params)
    # All is linear, unless a rule asks whether a tangent is zero.
    is_linear = all(jnp.issubdtype(x.aval.dtype, jnp.inexact) for x in equation.outvars)
    numbers = _hull(values) if is_linear else range(count)
    if name in _ELEMENTWISE:
        arrays = [_in_columns(x, numbers) for x in values]
        shape = jnp.broadcast_shapes(*(x.shape for x in arrays))
        out = evaluate(primitive, [jnp.broadcast_to(x, shape) for x in arrays], params)
    elif name in _MOVES and len(values) == 1:
        out = _MOVES[name](_in_columns(first, numbers), len(numbers), **params)
        out = out if primitive.multiple_results else [out]
    elif name == "concatenate":
        arrays = [_in_columns(x, numbers) for x in values]
        out = [lax.concatenate(arrays, params["dimension"])]
    elif name == "pad" and not isinstance(values[1], _Columns):
        config = (*params["padding_config"], (0, 0, 0))
        out = [lax.pad(_in_columns(first, numbers), jnp.asarray(values[1]), config)]
    else:
        out = _by_vmap(primitive, values, params, numbers)
    return [_Columns(x, numbers) for x in out]


def _known_move(value: _Columns, move: Callable, params: dict[str, Any]) -> list[_Columns]:
    """Of the seeds, before the arithmetic begins: they show which columns are zero."""
    shape = value.array.shape[:-1]
    places = np.arange(math.prod(shape))
    rows = np.reshape(value.array, (places.size, len(value.numbers)))
    outs = move(places.reshape(shape), **params)
    return [_trimmed(rows[out], value.numbers.start) for out in outs]


def _by_vmap(
    primitive: Any, values: list[Any], params: dict[str, Any], numbers: range
) -> list[Array]:
    """Of any other primitive."""
    moved = [isinstance(x, _Columns) for x in values]
    arrays = [_in_columns(x, numbers) if isinstance(x, _Columns) else x for x in values]
    axes = [x.ndim - 1 if on else None for x, on in zip(arrays, moved, strict=True)]
    apply = lambda *arrays: evaluate(primitive, list(arrays), params)
    return jax.vmap(apply, in_axes=axes, out_axes=-1)(*arrays)
