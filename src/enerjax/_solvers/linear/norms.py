import jax.numpy as jnp
from jaxtyping import Array

from ..._types import Scalar


# The number of pieces of an array that are compared entry by entry first.
_PIECES = 16


def largest(x: Array) -> Scalar:
    """The largest absolute value; infinite if an entry is NaN.

    A plain maximum is not sufficient, because on CPUs reductions of large arrays ignore NaN
    (jaxlib 0.10), and a failed solve would be reported as successful.
    """
    sizes = jnp.abs(x.ravel())
    sizes = jnp.where(jnp.isnan(sizes), jnp.inf, sizes)
    # XLA does not vectorise a reduction to a single number.
    width = -(-sizes.size // _PIECES)
    if width > 1:
        sizes = jnp.max(jnp.pad(sizes, (0, -sizes.size % width)).reshape(-1, width), axis=0)
    return jnp.max(sizes, initial=0.0)
