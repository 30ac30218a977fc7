"""Decisions that all lanes of a batch take together."""

import jax
import jax.numpy as jnp

from .._types import Flag


@jax.custom_batching.custom_vmap
def in_any_lane(flag: Flag) -> Flag:
    """Whether a flag holds in at least one lane of the `vmap`s around the call.

    The answer is the same for all lanes. A `lax.cond` on it therefore stays a branch under
    `vmap`, where a `lax.cond` on the flag itself would run both of its sides.
    """
    return flag


@in_any_lane.def_vmap
def _union_of_lanes(axis_size, in_batched, flags):
    del axis_size
    (is_batched,) = in_batched
    return in_any_lane(jnp.any(flags, axis=0) if is_batched else flags), False
