"""Programs that are evaluated for many lanes."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..jaxprs import has_numbers, known_numbers
from .emission import computed, value_of
from .entries import (
    array_of,
    Entry,
    Graph,
    Number,
    objects,
    Region,
    UnsupportedError,
)
from .evaluation import Evaluation
from .kernels import has_kernels
from .loops import Stack
from .planning import num_operations, plan_of


_Output: TypeAlias = list[Number] | Stack


class ProgramInLanes:
    """A program as a function of arrays whose last axis is that of the lanes.

    - `needed`: the numbers of the inputs that it takes, of those that are not known.
    - `length`: the number of its operations.
    - `same`: for each output the number of the input that it is equal to, or `None`. Such
      outputs are not computed.
    """

    def __init__(
        self,
        inputs: list[list[Entry]],
        outputs: list[_Output],
        avals: Sequence[Any],
        region: Region,
    ):
        number = {id(x[0]): k for k, x in enumerate(inputs) if x}
        of_input = lambda x: number.get(id(x[0])) if isinstance(x, list) and x else None
        found = map(of_input, outputs)
        self.same = [
            k if k is not None and _are_same(inputs[k], x) else None
            for k, x in zip(found, outputs, strict=True)
        ]
        pairs = zip(outputs, avals, self.same, strict=True)
        self._computed = [(x, aval) for x, aval, same in pairs if same is None]
        flat = (x for xs, _ in self._computed if isinstance(xs, list) for x in xs)
        self._plan = plan_of(region, flat)
        self.length = num_operations(self._plan)
        read = set(self._plan.inputs)
        self.needed = [k for k, x in enumerate(inputs) if not read.isdisjoint(x)]
        self._inputs = [inputs[k] for k in self.needed]

    def __call__(self, arrays: Sequence[Array], size: int) -> list[Array]:
        """The outputs that are not `same`, of `size` lanes, from the needed inputs."""
        known = {
            entry: row
            for entries, array in zip(self._inputs, arrays, strict=True)
            for entry, row in zip(entries, array.reshape(-1, size), strict=True)
        }
        known = computed(self._plan, known, size)
        return [_array(x, known, size, aval) for x, aval in self._computed]


def _are_same(entries: list[Entry], numbers: _Output) -> bool:
    if isinstance(numbers, Stack) or len(entries) != len(numbers):
        return False
    return all(x is y for x, y in zip(entries, numbers, strict=True))


def _array(x: _Output, known: dict[Entry, Array], size: int, aval: Any) -> Array:
    shape = *aval.shape, size
    if isinstance(x, Stack):
        rows, axis = [known[entry] for entry in x.entries], 1
    else:
        rows, axis = [value_of(number, known, size) for number in x], 0
    if not rows:
        return jnp.zeros(shape, aval.dtype)
    return jnp.stack(rows, axis=axis).reshape(shape).astype(aval.dtype)


def in_lanes(jaxpr: Any, values: Sequence[np.ndarray | None]) -> ProgramInLanes | None:
    """A program for many lanes; `None` if an operation is not supported.

    `jaxpr` takes its constants first. `values` are the inputs that are known, and `None`
    for the others.
    """
    found = _evaluated(jaxpr, values) if has_kernels() else None
    if found is None:
        return None
    region, inputs, outputs = found
    avals = [x.aval for x in jaxpr.outvars]
    return ProgramInLanes(inputs, list(map(_numbers, outputs)), avals, region)


def known_zeros(fn: Callable[[], PyTree[Array]]) -> PyTree[np.ndarray]:
    """Which entries of the arrays that `fn` returns are zero whatever it depends on."""
    closed, like = jax.make_jaxpr(fn, return_shape=True)()
    found = _evaluated(closed.jaxpr, list(map(known_numbers, closed.consts)))
    outputs = closed.out_avals if found is None else found[2]
    is_zero = lambda x: isinstance(x, np.generic) and x == 0
    masks = (np.zeros(x.shape, bool) for x in outputs)
    if found is not None:
        flat = (list(map(is_zero, objects(x).ravel())) for x in outputs)
        shapes = (x.shape for x in outputs)
        masks = map(np.reshape, (np.array(x, bool) for x in flat), shapes)
    return jax.tree.unflatten(jax.tree.structure(like), list(masks))


def _evaluated(
    jaxpr: Any, values: Sequence[np.ndarray | None]
) -> tuple[Region, list[list[Entry]], list[np.ndarray]] | None:
    """A program evaluated entry by entry, with the entries of its unknown inputs."""
    region = Region()
    inputs: list[list[Entry]] = []
    arrays = []
    variables = [*jaxpr.constvars, *jaxpr.invars]
    if not all(has_numbers(x.aval) for x in variables):
        return None
    for variable, value in zip(variables, values, strict=True):
        if value is None:
            aval = variable.aval
            inputs.append([Entry(aval.dtype, region) for _ in range(aval.size)])
            value = array_of(inputs[-1], aval.shape, aval.dtype)
        arrays.append(value)
    try:
        return region, inputs, Evaluation(Graph(), region).outputs(jaxpr, arrays)
    except UnsupportedError:
        return None


def _numbers(x: np.ndarray) -> _Output:
    first = x[()] if x.ndim == 0 else None
    return first if isinstance(first, Stack) else list(objects(x).ravel())
