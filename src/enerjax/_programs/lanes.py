"""What the lanes of a batch decide together."""

import jax
import jax.numpy as jnp

from .._types import Flag


@jax.custom_batching.custom_vmap
def anywhere(flag: Flag) -> Flag:
    """Whether a flag holds in any lane of the `vmap`s around: the same for all of them.

    A branch that hangs on it stays a branch under `vmap`, where otherwise both of its
    sides would run.
    """
    return flag


@anywhere.def_vmap
def _over_lanes(axis_size, in_batched, flags):
    del axis_size
    (is_batched,) = in_batched
    return anywhere(jnp.any(flags, axis=0) if is_batched else flags), False
