"""Columns of Jacobians, side by side or one after the other.

`columns_along` computes them side by side. Under `jax.vmap` the columns are the first axis
of every array, and the innermost loops of the machine go over the two or three entries of a
vector. There they are the last axis, and vector instructions take several columns at a
time. Every array has only those columns that can differ from zero in it: the derivatives of
a tension with respect to coordinates are not computed with respect to multipliers too.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..jaxprs import evaluate, interpret
from ..numpy_primitives import MOVES
from ..primitives import ARITHMETIC, JIT


# Tables of nonzero entries with more truth values than this are not computed.
_LARGEST_TABLE = 2**15
# Primitives that are applied to columns as they are applied to the array itself.
_IN_COLUMNS = ARITHMETIC | {"copy"}


def columns_along(
    fn: Callable[[Array], Array], x: Float[Array, " n"], seeds: Float[np.ndarray, "n k"]
) -> Float[Array, "... k"]:
    """The derivatives of `fn` at `x` along the columns of `seeds`."""
    # Through `jvp` the program is traced faster, but derivatives of the columns were wrong.
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


def columns_in_turn(
    fn: Callable[[Array], Array], x: Float[Array, " n"], seeds: Float[np.ndarray, "n k"]
) -> Float[Array, "... k"]:
    """The same derivatives as `columns_along`, one column after the other.

    The program has a single product, and is compiled several times as fast as all columns
    beside one another. It computes entries that are zero, but its code stays in the cache
    of the processor: a step of 6 or more bodies in space by Newton's method takes as long.
    """
    _, push = jax.linearize(fn, x)
    rows = jnp.asarray(seeds.T, x.dtype)
    if jax.default_backend() == "cpu":
        return jnp.moveaxis(jax.lax.map(push, rows), 0, -1)
    # Other processors take all columns at the same time.
    return jax.vmap(push, out_axes=-1)(rows)


class _Columns:
    """An array of the program with one more axis, the last one, along its columns.

    - `array`: a NumPy array where the values are known while the program is traced.
    - `numbers`: which columns the array has; it is zero in all others.
    - `nonzero`: which entries can differ from zero, over all columns; `None` if there are
      too many entries to keep such a table.
    """

    def __init__(
        self, array: Array | np.ndarray, numbers: range, nonzero: np.ndarray | None
    ):
        self.array = array
        self.numbers = numbers
        self.nonzero = nonzero


def _trimmed(
    array: Array | np.ndarray, numbers: range, nonzero: np.ndarray | None
) -> _Columns:
    """Removes the columns of zeros at both ends."""
    if nonzero is None:
        return _Columns(array, numbers, None)
    own = _nonzero_range(nonzero)
    if own != numbers:
        start = own.start - numbers.start
        array = array[..., start : start + len(own)] if own else array[..., :0]
    return _Columns(array, own, nonzero)


def _known(array: np.ndarray, numbers: range, count: int) -> _Columns:
    nonzero = np.zeros((*array.shape[:-1], count), bool)
    nonzero[..., numbers.start : numbers.stop] = array != 0
    return _trimmed(array, numbers, nonzero)


def _in_columns(value: "Array | _Columns", numbers: range) -> Array:
    """The array of a value with just these columns, of a constant too."""
    if not isinstance(value, _Columns):
        value = jnp.asarray(value)
        return jnp.broadcast_to(value[..., None], (*value.shape, len(numbers)))
    array, own = jnp.asarray(value.array), value.numbers
    if own == numbers:
        return array
    if not range(max(own.start, numbers.start), min(own.stop, numbers.stop)):
        return jnp.zeros((*array.shape[:-1], len(numbers)), array.dtype)
    # Negative padding removes columns.
    before, after = own.start - numbers.start, numbers.stop - own.stop
    config = (*((0, 0, 0) for _ in array.shape[:-1]), (before, after, 0))
    return lax.pad(array, jnp.zeros((), array.dtype), config)


def _hull(values: list[Any]) -> range:
    """The range from the first to the last column that any of the values has."""
    numbers = [x.numbers for x in values if isinstance(x, _Columns) and x.numbers]
    if not numbers:
        return range(0)
    return range(min(x.start for x in numbers), max(x.stop for x in numbers))


# The largest number of parts into which a sum is divided.
_MAX_PARTS = 8


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
    return jnp.sum(x, axis=axes)


def _split(x, k, *, sizes, axis):
    return lax.split(x, sizes, axis)


# Primitives with one operand, applied to an array with columns.
_WITH_COLUMNS = {
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
    if name in JIT:
        inner = params["jaxpr"]
        rule = functools.partial(_equation, count=count)
        return interpret(inner.jaxpr, inner.consts, values, rule)
    # Everything is linear but rules that compare a tangent with zero.
    is_linear = all(jnp.issubdtype(x.aval.dtype, jnp.inexact) for x in equation.outvars)
    numbers = _hull(values) if is_linear else range(count)
    masks = [x.nonzero if isinstance(x, _Columns) else False for x in values]
    nonzero = _nonzero_after(equation, masks, count) if is_linear else None
    first = values[0]
    if name in MOVES and len(values) == 1 and isinstance(first.array, np.ndarray):
        # The seeds are moved while their values are known, before the arithmetic begins.
        out = _moved_rows(MOVES[name], [first.array], params)
        return [_known(x, first.numbers, count) for x in out]
    if nonzero is not None and len(nonzero) == 1:
        numbers = _nonzero_range(nonzero[0])
    if not numbers:
        out = [jnp.zeros((*x.aval.shape, 0), x.aval.dtype) for x in equation.outvars]
    elif name in _IN_COLUMNS:
        arrays = [_in_columns(x, numbers) for x in values]
        shape = jnp.broadcast_shapes(*(x.shape for x in arrays))
        out = evaluate(primitive, [jnp.broadcast_to(x, shape) for x in arrays], params)
    elif name in _WITH_COLUMNS and len(values) == 1:
        out = _WITH_COLUMNS[name](_in_columns(first, numbers), len(numbers), **params)
        out = out if primitive.multiple_results else [out]
    elif name == "concatenate":
        arrays = [_in_columns(x, numbers) for x in values]
        out = [lax.concatenate(arrays, params["dimension"])]
    elif name == "pad" and not isinstance(values[1], _Columns):
        config = (*params["padding_config"], (0, 0, 0))
        out = [lax.pad(_in_columns(first, numbers), jnp.asarray(values[1]), config)]
    else:
        out = _by_vmap(primitive, values, params, numbers)
    nonzero = [None] * len(out) if nonzero is None else nonzero
    return [_trimmed(x, numbers, own) for x, own in zip(out, nonzero, strict=True)]


def _by_vmap(
    primitive: Any, values: list[Any], params: dict[str, Any], numbers: range
) -> list[Array]:
    """The outputs of any other primitive, by `jax.vmap` over the columns."""
    has_columns = [isinstance(x, _Columns) for x in values]
    arrays = [_in_columns(x, numbers) if isinstance(x, _Columns) else x for x in values]
    axes = [x.ndim - 1 if on else None for x, on in zip(arrays, has_columns, strict=True)]
    apply = lambda *arrays: evaluate(primitive, list(arrays), params)
    return jax.vmap(apply, in_axes=axes, out_axes=-1)(*arrays)


# Which entries of tangents can differ from zero in which columns --------------------------

# The tables are computed while the program is traced, before any entry has a value. They
# hold truth values; their last axis are the columns.


def _nonzero_after(
    equation: Any, masks: Sequence[Any], count: int
) -> list[np.ndarray] | None:
    """The tables of the outputs of an equation.

    `masks` are the tables of its inputs, `False` for constants. `None` is returned where an
    input has no table, or where the tables would be too large.
    """
    name, params = equation.primitive.name, equation.params
    shapes = [(*x.aval.shape, count) for x in equation.outvars]
    if max(map(math.prod, shapes)) > _LARGEST_TABLE or any(mask is None for mask in masks):
        return None
    pairs = zip(equation.invars, masks, strict=True)
    tables = [np.broadcast_to(mask, (*x.aval.shape, count)) for x, mask in pairs]
    if name in _IN_COLUMNS:
        return [np.broadcast_to(functools.reduce(np.logical_or, tables), shapes[0])]
    if name == "reduce_sum":
        return [np.asarray(np.any(tables[0], axis=params["axes"]))]
    if name in MOVES:
        return _moved_rows(MOVES[name], tables, params)
    columns = [np.any(x, axis=tuple(range(x.ndim - 1))) for x in tables]
    union = functools.reduce(np.logical_or, columns)
    return [np.broadcast_to(union, shape) for shape in shapes]


def _moved_rows(
    move: Callable, tables: Sequence[np.ndarray], params: dict[str, Any]
) -> list[np.ndarray]:
    """Tables with a row for each entry, after a primitive has moved the entries."""
    places, rows, first = [], [], 0
    for table in tables:
        *shape, width = table.shape
        rows.append(np.reshape(table, (math.prod(shape), width)))
        places.append(np.arange(first, first + len(rows[-1])).reshape(shape))
        first += len(rows[-1])
    joined = np.concatenate(rows)
    return [joined[out.astype(int)] for out in move(*places, **params)]


def _nonzero_range(nonzero: np.ndarray) -> range:
    """The range from the first to the last column with a nonzero entry."""
    some = np.flatnonzero(np.any(nonzero, axis=tuple(range(nonzero.ndim - 1))))
    return range(int(some[0]), int(some[-1]) + 1) if some.size else range(0)
