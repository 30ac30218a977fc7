"""Products of small matrices as plain arithmetic."""

import functools
import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .possible import LARGEST_SUM


# Products of which the sum is written out.
_MOST = 32


def written_out(left: Array, right: Array, dimension_numbers: Any) -> Array:
    """`dot_general` as a sum of products, which XLA fuses with what is around it."""
    contracted, batch = dimension_numbers
    one, shape = _rows(left, contracted[0], batch[0])
    other, last = _rows(right, contracted[1], batch[1])
    count = one.shape[-1]
    shape = (*(left.shape[k] for k in batch[0]), *shape, *last)
    if one.size * other.shape[1] <= LARGEST_SUM or not 0 < count <= _MOST:
        out = jnp.sum(one[:, :, None] * other[:, None], axis=-1)
    else:
        terms = (one[:, :, None, k] * other[:, None, :, k] for k in range(count))
        out = functools.reduce(jnp.add, terms)
    return out.reshape(shape)


def _rows(
    x: Array, contracted: tuple[int, ...], batch: tuple[int, ...]
) -> tuple[Array, tuple[int, ...]]:
    """As (batch, free, contracted), and the shape of what is free."""
    free = [k for k in range(x.ndim) if k not in (*contracted, *batch)]
    sizes = [math.prod(x.shape[k] for k in axes) for axes in (batch, free, contracted)]
    moved = jnp.transpose(x, (*batch, *free, *contracted)).reshape(sizes)
    return moved, tuple(x.shape[k] for k in free)
