"""The program of a sweep, which runs a chunk of lanes on all devices of this process."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from ..._programs import compiled


# Lanes of a batch wait for the slowest, and more would not fit into the cache, where XLA
# compiles the program. Machine code of ours takes four at a time in any case.
_BATCH_ON_CPU = 64


def make_lane(fn: Callable, parameters: dict[str, Any]) -> tuple[Any, Any]:
    """`fn` as a jitted function of a dictionary of parameters, and its trace."""
    try:
        inspect.signature(fn).bind(**parameters)
    except TypeError as error:
        raise TypeError(
            f"`fn` must take the parameters of `over` by name ({', '.join(parameters)}): "
            f"{error}."
        ) from None
    except ValueError:
        pass  # `fn` has no signature, like some functions in C.

    def lane(parameters: dict[str, Any]) -> Any:
        values = fn(**parameters)
        if not jax.tree.leaves(values):
            raise TypeError(f"`fn` must return a pytree of arrays, got {values!r}.")
        for leaf in jax.tree.leaves(values):
            if not isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int):
                raise TypeError(
                    f"`fn` must return a pytree of arrays, and {leaf!r} is no array. "
                    "Return the required arrays of a `Solution` as a dictionary."
                )
        return values

    program = jax.jit(lane)
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), parameters)
    return program, program.trace(one)


class Chunk:
    """Runs chunks of lanes, all with one program.

    Each device runs an equal share of a chunk, in batches of `batch_size` lanes. (Under a
    plain `jit` all devices would synchronise in each iteration of Newton's method.)
    """

    def __init__(self, lane: Callable, lanes: int, batch_size: int | None):
        devices = jax.local_devices()
        share = -(-lanes // len(devices))
        if batch_size is None:
            batch_size = _BATCH_ON_CPU if devices[0].platform == "cpu" else share
        batch_size = min(batch_size, share)
        self.lanes = lanes
        self.padded = len(devices) * batch_size * -(-share // batch_size)
        of_device = lambda parameters: jax.lax.map(lane, parameters, batch_size=batch_size)
        if len(devices) > 1:
            mesh, spec = Mesh(np.array(devices), ("lanes",)), PartitionSpec("lanes")
            # Lanes are independent, so there are no variations over devices to check.
            of_device = jax.shard_map(
                of_device, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
            )
        self._program = compiled(of_device)

    def __call__(self, parameters: dict[str, Any]) -> list[np.ndarray]:
        """The leaves of the results of `lanes` lanes."""
        extra = self.padded - self.lanes
        pad = lambda x: np.concatenate([x, np.repeat(x[-1:], extra, axis=0)])
        results = self._program(jax.tree.map(pad, parameters))
        # These are copies: on CPUs a view would keep the memory of the device.
        return [np.array(x)[: self.lanes] for x in jax.tree.leaves(results)]
