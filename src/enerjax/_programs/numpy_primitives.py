"""Primitives of JAX for NumPy arrays: moves of entries, and the arithmetic of indices.

With JAX itself every primitive would compile a program for every new shape.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from .jaxprs import evaluate, interpret
from .primitives import JIT


def as_rows(x: np.ndarray, contracted: Any, batch: Any) -> np.ndarray:
    """A factor of `dot_general` as (batch, free, contracted)."""
    free = [k for k in range(x.ndim) if k not in (*contracted, *batch)]
    sizes = [math.prod(x.shape[k] for k in axes) for axes in (batch, free, contracted)]
    return np.transpose(x, (*batch, *free, *contracted)).reshape(sizes)


def _broadcast_in_dim(x, *, shape, broadcast_dimensions, **_):
    lengths = np.ones(len(shape), int)
    lengths[list(broadcast_dimensions)] = np.shape(x)
    return [np.broadcast_to(np.reshape(x, lengths), shape)]


def _reshape(x, *, new_sizes, dimensions=None, **_):
    return [np.reshape(x if dimensions is None else np.transpose(x, dimensions), new_sizes)]


def _slice(x, *, start_indices, limit_indices, strides, **_):
    steps = strides or (1,) * np.ndim(x)
    ranges = zip(start_indices, limit_indices, steps, strict=True)
    return [x[tuple(slice(*limits) for limits in ranges)]]


def _pad(x, filling, *, padding_config, **_):
    """Negative padding removes entries."""
    lengths = [
        max(n + (n - 1) * inner, 0)
        for n, (_, _, inner) in zip(np.shape(x), padding_config, strict=True)
    ]
    # Programs can be evaluated entry by entry, with entries that are objects.
    kind = np.result_type(x.dtype, np.asarray(filling).dtype)
    spread = np.full(lengths, filling, dtype=kind)
    spread[tuple(slice(None, None, inner + 1) for _, _, inner in padding_config)] = x
    added = [(max(low, 0), max(high, 0)) for low, high, _ in padding_config]
    spread = np.pad(spread, added, constant_values=filling)
    taken = [(max(-low, 0), max(-high, 0)) for low, high, _ in padding_config]
    ends = zip(taken, spread.shape, strict=True)
    return [spread[tuple(slice(low, n - high) for (low, high), n in ends)]]


def _dynamic_slice(x, *starts, slice_sizes, **_):
    lengths = zip(starts, slice_sizes, np.shape(x), strict=True)
    places = ((int(np.clip(at, 0, n - size)), size) for at, size, n in lengths)
    return [x[tuple(slice(at, at + size) for at, size in places)]]


def _gather(x, indices, *, dimension_numbers, slice_sizes, **_):
    """Slices of `x` that begin at computed places, moved inside where they are not."""
    numbers, before = dimension_numbers, np.shape(indices)[:-1]
    joint = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    kept = [axis for axis in range(np.ndim(x)) if axis not in joint]
    places = []
    for axis, (length, size) in enumerate(zip(np.shape(x), slice_sizes, strict=True)):
        if axis in numbers.operand_batching_dims:
            own = numbers.operand_batching_dims.index(axis)
            along = numbers.start_indices_batching_dims[own]
            start = _along(np.arange(length), along, len(before))
        elif axis in numbers.start_index_map:
            start = indices[..., numbers.start_index_map.index(axis)]
            start = np.clip(start, 0, length - size)
        else:
            start = np.zeros((), int)
        start = np.broadcast_to(start, before).reshape(before + (1,) * len(kept))
        if axis in kept:
            start = start + _along(np.arange(size), kept.index(axis), len(kept))
        places.append(start)
    rank = len(before) + len(kept)
    others = [axis for axis in range(rank) if axis not in numbers.offset_dims]
    order = np.argsort([*others, *numbers.offset_dims])
    return [np.transpose(x[tuple(places)], order)]


def _along(x: np.ndarray, axis: int, rank: int) -> np.ndarray:
    """A vector as an array of this rank, along one of its axes."""
    return x.reshape([-1 if k == axis else 1 for k in range(rank)])


def is_inside(x, indices, *, dimension_numbers, slice_sizes, **_) -> bool:
    """Whether all slices of a `gather` lie within `x`, so that its mode does not matter."""
    numbers = dimension_numbers
    axes = list(numbers.start_index_map)
    last = np.array(np.shape(x))[axes] - np.array(slice_sizes)[axes]
    return bool(np.all((indices >= 0) & (indices <= last)))


def _unstack(x, *, axis, **_):
    return list(np.moveaxis(x, axis, 0))


def _split(x, *, sizes, axis, **_):
    return np.split(x, np.cumsum(sizes)[:-1], axis)


# All operands of these are moved.
MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda *xs, dimension, **_: [np.concatenate(xs, dimension)],
    "copy": lambda x, **_: [x],
    "pad": _pad,
    "reshape": _reshape,
    "rev": lambda x, *, dimensions, **_: [np.flip(x, dimensions)],
    "slice": _slice,
    "split": _split,
    "stack": lambda *xs, axis, **_: [np.stack(xs, axis)],
    "squeeze": lambda x, *, dimensions, **_: [np.squeeze(x, dimensions)],
    "tile": lambda x, *, reps, **_: [np.tile(x, reps)],
    "transpose": lambda x, *, permutation, **_: [np.transpose(x, permutation)],
    "unstack": _unstack,
}
# The first operand of these is moved, to places that the others tell.
_EVERY_MOVE = MOVES | {"dynamic_slice": _dynamic_slice, "gather": _gather}


def _iota(*, dtype, shape, dimension, **_):
    numbers = np.arange(shape[dimension], dtype=dtype)
    return [np.broadcast_to(_along(numbers, dimension, len(shape)), shape)]


def _select(which, *cases, **_):
    return [np.choose(which.astype(int), cases)]


_FUNCTIONS: dict[str, Callable] = {
    "abs": np.abs,
    "add": np.add,
    "and": np.bitwise_and,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "or": np.bitwise_or,
    "sqrt": np.sqrt,
    "sub": np.subtract,
}


# Functions of known numbers that need no call of JAX, which takes about a millisecond.
BY_NUMPY = frozenset(("convert_element_type", "select_n", *_FUNCTIONS))


def _converted(x: np.ndarray, dtype: Any) -> np.ndarray:
    """Numbers of another type; whole numbers that do not fit are the nearest that do."""
    dtype = np.dtype(dtype)
    if not (jnp.issubdtype(x.dtype, jnp.floating) and dtype.kind in "iu"):
        return x.astype(dtype)
    # Half precision does not reach the ends of the range.
    info, x = np.iinfo(dtype), x.astype(np.float64)
    whole = np.nan_to_num(np.clip(x, info.min, info.max), nan=0.0)
    inside = (whole > info.min) & (whole < info.max)
    ends = np.where(whole > 0, info.max, info.min).astype(dtype)
    return np.where(inside, np.where(inside, whole, 0).astype(dtype), ends)


_REDUCTIONS: dict[str, Callable] = {
    "reduce_and": np.all,
    "reduce_max": np.max,
    "reduce_min": np.min,
    "reduce_or": np.any,
    "reduce_prod": np.prod,
    "reduce_sum": np.sum,
}


def moved(primitive: Any, values: list[Any], params: dict[str, Any]) -> list[Any]:
    """The outputs of a primitive that moves entries, of arrays that are known."""
    values, move = list(map(np.asarray, values)), _EVERY_MOVE.get(primitive.name)
    if move is None or (move is _gather and not is_inside(*values, **params)):
        return evaluate(primitive, values, params)
    return move(*values, **params)


def _is_plain(name: str, x: np.ndarray) -> bool:
    """Whether NumPy reduces an array as JAX does: not bits, and no empty extremes."""
    is_logical = name in ("reduce_and", "reduce_or")
    return x.size > 0 and is_logical == (x.dtype.kind == "b")


def evaluated(primitive: Any, values: list[Any], params: dict[str, Any]) -> list[Any]:
    """The outputs of any primitive, of arrays that are known."""
    name = primitive.name
    if name in _EVERY_MOVE:
        return moved(primitive, values, params)
    if name == "iota":
        return _iota(**params)
    if name == "select_n":
        return _select(*map(np.asarray, values))
    if name == "convert_element_type":
        return [_converted(np.asarray(values[0]), params["new_dtype"])]
    if name in _FUNCTIONS:
        return [np.asarray(_FUNCTIONS[name](*map(np.asarray, values)))]
    if name in _REDUCTIONS and _is_plain(name, values[0]):
        out = _REDUCTIONS[name](values[0], axis=tuple(params["axes"]))
        return [np.asarray(out, values[0].dtype)]
    if name in JIT:
        program, consts = params["jaxpr"].jaxpr, params["jaxpr"].consts
        return interpret(
            program, consts, values, lambda eqn, x: evaluated(eqn.primitive, x, eqn.params)
        )
    return evaluate(primitive, values, params)
