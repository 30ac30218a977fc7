import jax.numpy as jnp
from jaxtyping import Array

from ..._types import Scalar


def largest(x: Array) -> Scalar:
    """The largest absolute value; infinite if an entry is NaN.

    A plain maximum is not sufficient, because on CPUs reductions of large arrays ignore NaN
    (jaxlib 0.10), and a failed solve would be reported as successful.
    """
    sizes = jnp.abs(x)
    return jnp.max(jnp.where(jnp.isnan(sizes), jnp.inf, sizes), initial=0.0)
