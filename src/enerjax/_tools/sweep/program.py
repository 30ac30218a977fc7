"""The one program of a sweep: a chunk of lanes on all devices of this process."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec


# Measured (benchmarks/batch.py), for lanes that take their steps together: more at once
# leave the cache of a core, and all wait for the slowest. (Those of small systems run one
# after the other in any case.) Other processors take what fits.
_TOGETHER_ON_CPU = 16


def make_lane(fn: Callable, parameters: dict[str, Any]) -> tuple[Any, Any]:
    """`fn` as a function of a dictionary, compiled once, and its trace."""
    try:
        inspect.signature(fn).bind(**parameters)
    except TypeError as error:
        raise TypeError(
            f"`fn` must take the parameters of `over` by name ({', '.join(parameters)}): "
            f"{error}."
        ) from None
    except ValueError:
        pass  # No signature is known, as of some functions in C.

    def lane(parameters: dict[str, Any]) -> Any:
        values = fn(**parameters)
        if not jax.tree.leaves(values):
            raise TypeError(f"`fn` must return a pytree of arrays, got {values!r}.")
        for leaf in jax.tree.leaves(values):
            if not isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int):
                raise TypeError(
                    f"`fn` must return a pytree of arrays, and {leaf!r} in it is none. "
                    "Return the parts of a `Solution` that are wanted, as a dictionary."
                )
        return values

    compiled = jax.jit(lane)
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), parameters)
    return compiled, compiled.trace(one)


class Chunk:
    """Runs chunks of lanes, all with one program.

    Each device takes an equal part, and goes through it by `together` lanes. (Under a plain
    `jit` all devices would have to agree, in each iteration of Newton's method, whether the
    last lane of all is done, or to run all the lanes one after the other.)
    """

    def __init__(self, lane: Callable, lanes: int, together: int | None):
        devices = jax.local_devices()
        share = -(-lanes // len(devices))
        if together is None:
            together = _TOGETHER_ON_CPU if devices[0].platform == "cpu" else share
        together = min(together, share)
        self.lanes = lanes
        self.padded = len(devices) * together * -(-share // together)
        part = lambda parameters: jax.lax.map(lane, parameters, batch_size=together)
        if len(devices) > 1:
            mesh, spec = Mesh(np.array(devices), ("lanes",)), PartitionSpec("lanes")
            # Lanes know nothing of each other: there is nothing to check.
            part = jax.shard_map(
                part, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
            )
        self._program = jax.jit(part)

    def __call__(self, parameters: dict[str, Any]) -> list[np.ndarray]:
        """The leaves of the results of `lanes` lanes."""
        extra = self.padded - self.lanes
        fill = lambda x: np.concatenate([x, np.repeat(x[-1:], extra, axis=0)])
        results = self._program(jax.tree.map(fill, parameters))
        # Copied: on CPUs a view would keep the memory of the device.
        return [np.array(x)[: self.lanes] for x in jax.tree.leaves(results)]
