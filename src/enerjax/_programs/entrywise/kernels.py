"""Scalar operations for many lanes, as one loop over the lanes."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..fast_loops import are_enabled
from ..jaxprs import evaluate
from ..one_function.marks import has_marks
from .entries import Entry


@functools.cache
def has_kernels() -> bool:
    """Whether XLA evaluates a window of one entry by its function, as `kernel` needs.

    Within one function its loop would not be vectorised.
    """
    if not has_marks() or are_enabled():
        return False
    fn = lambda x, y: (x + y, x * y + 2)
    like = jax.ShapeDtypeStruct((8,), np.float32)
    program = jax.jit(lambda *arrays: _each(fn, arrays)).lower(like, like).compile()
    x, y = np.arange(8.0, dtype=np.float32), np.ones(8, np.float32)
    return all(map(np.array_equal, program(x, y), fn(x, y)))


def _each(fn: Any, arrays: Sequence[Array]) -> list[Array]:
    """`fn`, from scalars to as many scalars, of each lane of some arrays.

    XLA has one operation with several results that evaluates any scalar function for all
    entries in one loop, whose body LLVM vectorises: a reduction over windows, here of one
    entry each. Elementwise operations would be merged into one loop for each result, with
    what results share computed for each of them.
    """
    start = tuple(jnp.zeros((), x.dtype) for x in arrays)
    window = lambda start, x: tuple(fn(*x))
    return list(lax.reduce_window(tuple(arrays), start, window, (1,), (1,), "VALID"))


def kernel(
    entries: Sequence[Entry], wanted: Sequence[Entry], known: dict[Entry, Array]
) -> list[Array]:
    """The wanted ones of some entries, which are sorted such that operands come first.

    `known` are the values of the entries that they depend on, one for each lane.
    """
    own = set(entries)
    operands = (x for entry in entries for x in entry.operands if isinstance(x, Entry))
    inputs = list(dict.fromkeys(x for x in operands if x not in own))
    # Each result takes the place of an input of its type. Where there are more results
    # than inputs of a type, an input is passed several times.
    slots: list[Entry] = list(inputs)
    free = {
        kind: [k for k, x in enumerate(slots) if x.dtype == kind] for kind in _kinds(slots)
    }
    places = []
    for entry in wanted:
        own_kind = free.setdefault(entry.dtype, [])
        if not own_kind:
            slots.append(entry)
            own_kind.append(len(slots) - 1)
        places.append(own_kind.pop(0))
    while len(slots) < 2:
        slots.append(slots[0])
    size = known[inputs[0]].shape[0]
    filling = functools.cache(lambda kind: jnp.zeros((size,), kind))
    arrays = [known[x] if x in known else filling(x.dtype) for x in slots]

    def scalars(*numbers: Array) -> list[Array]:
        values: dict[Entry, Any] = dict(zip(inputs, numbers, strict=False))
        read = lambda x: values[x] if isinstance(x, Entry) else _literal(x)
        for entry in entries:
            (out,) = evaluate(
                entry.primitive, list(map(read, entry.operands)), entry.params
            )
            values[entry] = out
        results = list(numbers)
        for place, entry in zip(places, wanted, strict=True):
            results[place] = values[entry]
        return results

    out = _each(scalars, arrays)
    return [out[place] for place in places]


def _kinds(entries: Sequence[Entry]) -> set[np.dtype]:
    return {x.dtype for x in entries}


def _literal(x: np.generic) -> Array:
    return jnp.asarray(x, x.dtype)


def filled(number: np.generic, size: int) -> Array:
    """A known number for each of `size` lanes."""
    return jnp.full((size,), jnp.asarray(number), number.dtype)
