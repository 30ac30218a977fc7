import functools

import jax.numpy as jnp
from jaxtyping import Array

from ..._types import Scalar


# The most rows of numbers of which `largest` compares corresponding ones first.
_ROWS = 16


def largest(x: Array) -> Scalar:
    """The largest absolute value; infinite if an entry is NaN.

    A plain maximum is not sufficient, because on CPUs reductions of large arrays ignore NaN
    (jaxlib 0.10), and a failed solve would be reported as successful.
    """
    sizes = jnp.abs(x.ravel())
    sizes = jnp.where(jnp.isnan(sizes), jnp.inf, sizes)
    # XLA's reductions of numbers of one row do not use vectors.
    width = -(-sizes.size // _ROWS)
    if width > 1:
        rows = jnp.pad(sizes, (0, -sizes.size % width)).reshape(-1, width)
        sizes = functools.reduce(jnp.maximum, rows)
    return jnp.max(sizes, initial=0.0)
