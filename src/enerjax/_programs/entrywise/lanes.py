"""Programs that are evaluated for many lanes."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .emission import values_of
from .entries import array_of, Entry, Graph, objects, Region
from .evaluation import Evaluation, Stack, UnsupportedError
from .kernels import has_kernels


def in_lanes(
    jaxpr: Any, values: Sequence[np.ndarray | None]
) -> Callable[[Sequence[Array]], list[Array]] | None:
    """A program as a function of arrays whose last axis is that of the lanes.

    `jaxpr` takes its constants first. `values` are the inputs that are known; the function
    takes the others. The result is `None` if an operation is not supported.
    """
    if not has_kernels():
        return None
    region = Region()
    variables = [*jaxpr.constvars, *jaxpr.invars]
    inputs, arrays = [], []
    for variable, value in zip(variables, values, strict=True):
        if value is not None:
            arrays.append(value)
            continue
        aval = variable.aval
        entries = [Entry(aval.dtype, region) for _ in range(aval.size)]
        inputs.append(entries)
        arrays.append(array_of(entries, aval.shape, aval.dtype))
    try:
        out = Evaluation(Graph(), region).outputs(jaxpr, arrays)
    except UnsupportedError:
        return None
    numbers = [_numbers(x) for x in out]

    def program(arrays: Sequence[Array]) -> list[Array]:
        size = arrays[0].shape[-1]
        known = {
            entry: row
            for entries, array in zip(inputs, arrays, strict=True)
            for entry, row in zip(entries, array.reshape(-1, size), strict=True)
        }
        flat = [x for entries in numbers if isinstance(entries, list) for x in entries]
        found, known = values_of(region, flat, known, size)
        remaining, results = iter(found), []
        for entries, var in zip(numbers, jaxpr.outvars, strict=True):
            if isinstance(entries, Stack):
                rows = [known[x] for x in entries.entries]
                array = jnp.stack(rows, axis=1) if rows else jnp.zeros((0,))
            else:
                rows = [next(remaining) for _ in entries]
                array = jnp.stack(rows) if rows else jnp.zeros((0,))
            results.append(array.reshape(*var.aval.shape, size).astype(var.aval.dtype))
        return results

    return program


def _numbers(x: np.ndarray) -> Any:
    (first,) = x.ravel() if x.ndim == 0 else (None,)
    return first if isinstance(first, Stack) else list(objects(x).ravel())
