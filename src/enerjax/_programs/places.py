"""Entries at places that are known while a program is traced."""

import numpy as np
from jax import lax
from jaxtyping import Array, Int


def at_places(x: Array, places: Int[np.ndarray, "*places"]) -> Array:
    """`x[places]`, for places along the first axis that are not negative.

    Places at equal distances are a slice, which XLA merges with the operations around it
    into loops that use vectors. A gather is not; that of `jax.numpy` also adds the number
    of entries to negative indices at every call, and takes longer to trace.
    """
    flat = places.ravel()
    assert np.all((flat >= 0) & (flat < x.shape[0]))
    shape = *places.shape, *x.shape[1:]
    if flat.size == 0:
        return x[:0].reshape(shape)
    step = int(flat[1] - flat[0]) if flat.size > 1 else 1
    if step > 0 and np.array_equal(flat, flat[:1] + step * np.arange(flat.size)):
        is_whole = step == 1 and flat.size == x.shape[0]
        taken = x if is_whole else lax.slice_in_dim(x, flat[0], flat[-1] + 1, step)
        return taken.reshape(shape)
    numbers = lax.GatherDimensionNumbers(
        offset_dims=tuple(range(places.ndim, len(shape))),
        collapsed_slice_dims=(0,),
        start_index_map=(0,),
    )
    index = places.astype(np.int32)[..., None]
    sizes = 1, *x.shape[1:]
    return lax.gather(x, index, numbers, sizes, mode="promise_in_bounds")


def with_any(places: Int[np.ndarray, "*places"], count: int) -> Int[np.ndarray, "*places"]:
    """Places of which those one past the end, `count`, are replaced by any others.

    They are spread evenly: the transpose of a gather takes as long as the place that is
    read most often.
    """
    absent = places == count
    out = np.array(places)
    out[absent] = np.arange(np.count_nonzero(absent)) % count
    return out
