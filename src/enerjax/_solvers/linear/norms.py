import jax.numpy as jnp
from jaxtyping import Array

from ..._types import Scalar


def largest(x: Array) -> Scalar:
    """The largest entry in size, infinite if one is not a number.

    A plain maximum would not do: reductions of large arrays on CPUs overlook what is not a
    number (jaxlib 0.10), and a failure would pass for a success.
    """
    sizes = jnp.abs(x)
    return jnp.max(jnp.where(jnp.isnan(sizes), jnp.inf, sizes), initial=0.0)
