"""Primitives that only move entries, for NumPy arrays.

With JAX itself every new shape would compile a program.
"""

from collections.abc import Callable

import numpy as np


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
    spread = np.full(lengths, filling, dtype=float)
    spread[tuple(slice(None, None, inner + 1) for _, _, inner in padding_config)] = x
    added = [(max(low, 0), max(high, 0)) for low, high, _ in padding_config]
    spread = np.pad(spread, added, constant_values=filling)
    taken = [(max(-low, 0), max(-high, 0)) for low, high, _ in padding_config]
    ends = zip(taken, spread.shape, strict=True)
    return [spread[tuple(slice(low, n - high) for (low, high), n in ends)]]


def _split(x, *, sizes, axis, **_):
    return np.split(x, np.cumsum(sizes)[:-1], axis)


MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda *xs, dimension, **_: [np.concatenate(xs, dimension)],
    "copy": lambda x, **_: [x],
    "pad": _pad,
    "reshape": _reshape,
    "rev": lambda x, *, dimensions, **_: [np.flip(x, dimensions)],
    "slice": _slice,
    "split": _split,
    "squeeze": lambda x, *, dimensions, **_: [np.squeeze(x, dimensions)],
    "transpose": lambda x, *, permutation, **_: [np.transpose(x, permutation)],
}
