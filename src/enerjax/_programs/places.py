"""Entries at places that are known while a program is traced."""

from collections.abc import Sequence

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
    if step := _step(flat):
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


def at_all_places(
    x: Array, all_places: Sequence[Int[np.ndarray, " places"]]
) -> list[Array]:
    """`x[places]` for several arrays of places.

    Those that are no slices are one gather: the transpose of each adds numbers to all
    entries of `x`, also where few are read.
    """
    keys = [places.astype(int).tobytes() for places in all_places]
    by_key = dict(zip(keys, all_places, strict=True))
    scattered = {key: places for key, places in by_key.items() if not _step(places)}
    if len(scattered) > 1:
        together = at_places(x, np.concatenate([*scattered.values()]))
        parts = lax.split(together, [places.size for places in scattered.values()])
        found = dict(zip(scattered, parts, strict=True))
    else:
        found = {}
    for key, places in by_key.items():
        if key not in found:
            found[key] = at_places(x, places)
    return [found[key] for key in keys]


def _step(places: Int[np.ndarray, " places"]) -> int:
    """The distance of successive places, if these are equal and positive, else zero."""
    step = int(places[1] - places[0]) if places.size > 1 else 1
    is_slice = np.array_equal(places, places[:1] + step * np.arange(places.size))
    return step if step > 0 and is_slice else 0


def with_any(places: Int[np.ndarray, "*places"], count: int) -> Int[np.ndarray, "*places"]:
    """Places of which those one past the end, `count`, are replaced by any others.

    They are spread evenly: the transpose of a gather takes as long as the place that is
    read most often.
    """
    absent = places == count
    out = np.array(places)
    out[absent] = np.arange(np.count_nonzero(absent)) % count
    return out
