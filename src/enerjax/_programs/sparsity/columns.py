"""Columns of Jacobians, side by side.

Under `jax.vmap` the columns are the first axis of every array, and the innermost loops of
the machine go over the two or three entries of a vector. Here they are the last axis, and
vector instructions take several columns at a time. Every array has only those columns that
can differ from zero in it: the derivatives of a tension with respect to coordinates are
not computed with respect to multipliers too.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..one_function.possible import LARGEST_SUM
from ..tracing import evaluate, interpret
from .data_movement import MOVES
from .nonzero_ranges import ELEMENTWISE, ends, filled_after, moved


def columns_along(
    fn: Callable[[Array], Array], x: Float[Array, " n"], seeds: Float[np.ndarray, "n k"]
) -> Float[Array, "... k"]:
    """The derivatives of `fn` at `x` along the columns of `seeds`."""
    program = jax.make_jaxpr(jax.linearize(fn, x)[1])(x)
    seeds = seeds.astype(x.dtype)
    rule = functools.partial(_equation, count=seeds.shape[1])
    first = _known(seeds, range(seeds.shape[1]), seeds.shape[1])
    (out,) = interpret(program.jaxpr, program.consts, [first], rule)
    return _in_columns(out, range(seeds.shape[1]))


def jacobian_columns(
    fn: Callable[[Array], Array], x: Float[Array, " n"]
) -> Float[Array, "m n"]:
    """The Jacobian of `fn` at `x`."""
    return columns_along(fn, x, np.eye(x.size))


class _Columns:
    """An array with an axis more, the last one, in which its columns follow each other.

    - `numbers`: of the columns that it has; in the others it is zero. An array of NumPy is
      known while the program is traced.
    - `filled`: which entries can differ from zero in which of all columns; `None` where
      there are too many to ask.
    """

    def __init__(
        self, array: Array | np.ndarray, numbers: range, filled: np.ndarray | None
    ):
        self.array = array
        self.numbers = numbers
        self.filled = filled


def _trimmed(
    array: Array | np.ndarray, numbers: range, filled: np.ndarray | None
) -> _Columns:
    """Without columns at both ends that are zero."""
    if filled is None:
        return _Columns(array, numbers, None)
    own = ends(filled)
    if own != numbers:
        start = own.start - numbers.start
        array = array[..., start : start + len(own)] if own else array[..., :0]
    return _Columns(array, own, filled)


def _known(array: np.ndarray, numbers: range, count: int) -> _Columns:
    filled = np.zeros((*array.shape[:-1], count), bool)
    filled[..., numbers.start : numbers.stop] = array != 0
    return _trimmed(array, numbers, filled)


def _in_columns(value: "Array | _Columns", numbers: range) -> Array:
    """With the columns of these numbers, also where it does not depend on the seeds."""
    if not isinstance(value, _Columns):
        value = jnp.asarray(value)
        return jnp.broadcast_to(value[..., None], (*value.shape, len(numbers)))
    array, own = jnp.asarray(value.array), value.numbers
    if own == numbers:
        return array
    if not range(max(own.start, numbers.start), min(own.stop, numbers.stop)):
        return jnp.zeros((*array.shape[:-1], len(numbers)), array.dtype)
    # (Padding below zero takes columns away.)
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
    # All is linear, unless a rule asks whether a tangent is zero.
    is_linear = all(jnp.issubdtype(x.aval.dtype, jnp.inexact) for x in equation.outvars)
    numbers = _hull(values) if is_linear else range(count)
    masks = [x.filled if isinstance(x, _Columns) else False for x in values]
    filled = filled_after(equation, masks, count) if is_linear else None
    first = values[0]
    if name in MOVES and len(values) == 1 and isinstance(first.array, np.ndarray):
        # Of the seeds, before the arithmetic begins.
        out = moved(MOVES[name], [first.array], params)
        return [_known(x, first.numbers, count) for x in out]
    if filled is not None and len(filled) == 1:
        numbers = ends(filled[0])
    if not numbers:
        out = [jnp.zeros((*x.aval.shape, 0), x.aval.dtype) for x in equation.outvars]
    elif name in ELEMENTWISE:
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
    filled = [None] * len(out) if filled is None else filled
    return [_trimmed(x, numbers, own) for x, own in zip(out, filled, strict=True)]


def _by_vmap(
    primitive: Any, values: list[Any], params: dict[str, Any], numbers: range
) -> list[Array]:
    """Of any other primitive."""
    moved = [isinstance(x, _Columns) for x in values]
    arrays = [_in_columns(x, numbers) if isinstance(x, _Columns) else x for x in values]
    axes = [x.ndim - 1 if on else None for x, on in zip(arrays, moved, strict=True)]
    apply = lambda *arrays: evaluate(primitive, list(arrays), params)
    return jax.vmap(apply, in_axes=axes, out_axes=-1)(*arrays)
