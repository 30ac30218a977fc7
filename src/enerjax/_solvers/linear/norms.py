import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Scalar


# Arrays with more entries are cut into so many pieces first, which are compared entry by
# entry.
_LARGE, _PIECES = 2048, 16


def largest(x: Float[Array, "*shape"]) -> Scalar:
    """The largest absolute value; infinite if an entry is NaN. Its derivatives are zero.

    A plain maximum is not sufficient, because on CPUs reductions of large arrays ignore NaN
    (jaxlib 0.10), and a failed solve would be reported as successful. Without their signs,
    the bits of floating-point numbers, read as integers, have the order of the numbers, and
    those of NaN are the largest. The maximum of integers is a single instruction, that of
    floating-point numbers which keeps NaN is five.
    """
    integer = jnp.dtype(f"int{8 * x.dtype.itemsize}")
    bits = jax.lax.bitcast_convert_type(x.ravel(), integer)
    # Not by `abs`, which XLA leaves out where it knows that `x` is not negative. The NaN of
    # many processors has a sign.
    bits = bits & jnp.iinfo(integer).max
    # XLA does not vectorise a reduction to a single number.
    width = -(-bits.size // _PIECES)
    if bits.size > _LARGE:
        bits = jnp.max(jnp.pad(bits, (0, -bits.size % width)).reshape(-1, width), axis=0)
    found = jax.lax.bitcast_convert_type(jnp.max(bits, initial=0), x.dtype)
    return jnp.where(jnp.isnan(found), jnp.inf, found)
