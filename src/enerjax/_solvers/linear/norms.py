import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..._types import Scalar


_WHOLE = {4: jnp.int32, 8: jnp.int64}


def largest(x: Array) -> Scalar:
    """The largest absolute value; infinite if an entry is NaN.

    Numbers that are not negative are ordered as the whole numbers with the same bits, and
    NaN is above all of them. XLA's maximum of floating-point numbers takes them one after
    the other on CPUs, at three times the cost, and ignores NaN in large arrays (jaxlib
    0.10), so that a failed solve would be reported as successful.
    """
    bits = jax.lax.bitcast_convert_type(jnp.abs(x), _WHOLE[x.dtype.itemsize])
    found = jax.lax.bitcast_convert_type(jnp.max(bits, initial=0), x.dtype)
    return jnp.where(jnp.isnan(found), jnp.inf, found)
