"""The parameters of a sweep: all values, and those of each lane."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Grid:
    """All combinations of parameters, one lane each, in row-major order.

    - `axes`: the names of the parameters that change together along each axis.
    - `shape`: the number of values along each axis.
    - `values`: of each parameter, a pytree of arrays with the values along the first axis.
    """

    axes: tuple[tuple[str, ...], ...]
    shape: tuple[int, ...]
    values: dict[str, Any]

    @property
    def size(self) -> int:
        return int(np.prod(self.shape))

    def lanes(self, numbers: np.ndarray) -> dict[str, Any]:
        """The parameters of some lanes, with the lanes along the first axis."""
        indices = np.unravel_index(numbers, self.shape)
        return {
            name: jax.tree.map(lambda x, index=index: x[index], self.values[name])
            for names, index in zip(self.axes, indices, strict=True)
            for name in names
        }

    def order(self, by: str | None) -> np.ndarray:
        """All lanes, sorted by the value of a parameter."""
        lanes = np.arange(self.size)
        if by is None:
            return lanes
        if by not in self.values:
            raise ValueError(
                f"`sort_by` must be a parameter of `over` ({', '.join(self.values)}), got "
                f"{by!r}."
            )
        keys = self.lanes(lanes)[by]
        if not isinstance(keys, np.ndarray) or keys.ndim != 1:
            raise ValueError(f"`sort_by`: the values of `{by}` are no numbers to sort by.")
        return np.argsort(keys, kind="stable")


def make_grid(over: Any) -> Grid:
    """The grid of checked parameters."""
    if not isinstance(over, Mapping) or not over:
        raise TypeError(
            "`over` must be a dictionary of the names of parameters and their values, such "
            f'as {{"alpha": [0.0, 0.5], "h": [1e-3, 2e-3]}}; got {over!r}.'
        )
    axes, shape, values = [], [], {}
    for key, listed in over.items():
        names = key if isinstance(key, tuple) else (key,)
        if not names or not all(isinstance(name, str) for name in names):
            raise TypeError(
                f"`over`: {key!r} is neither the name of a parameter nor a tuple of names."
            )
        taken = [name for name in names if name in values or names.count(name) > 1]
        if taken:
            raise ValueError(f"`over` has the parameter `{taken[0]}` twice.")
        columns = (
            _columns(names, listed) if isinstance(key, tuple) else (_arrays(key, listed),)
        )
        axes.append(names)
        shape.append(len(jax.tree.leaves(columns)[0]))
        values.update(zip(names, columns, strict=True))
    return Grid(tuple(axes), tuple(shape), values)


def _columns(names: tuple[str, ...], points: Any) -> tuple[np.ndarray, ...]:
    """The columns of points of shape `(points, len(names))`, one for each name."""
    points = _numbers(", ".join(names), points)
    if points.ndim != 2 or points.shape[1] != len(names) or len(points) == 0:
        raise ValueError(
            f"`over`: the points of ({', '.join(names)}) have shape {points.shape}; give "
            f"a row of {len(names)} numbers for each, shape (points, {len(names)})."
        )
    return tuple(points.T)


def _arrays(name: str, values: Any) -> Any:
    """A pytree of arrays with the values along the first axis; a list is one array."""
    if isinstance(values, list | tuple | range):
        values = np.asarray(values)
    tree = jax.tree.map(lambda x: _numbers(name, x), values)
    leaves = jax.tree.leaves(tree)
    counts = {len(x) if x.ndim > 0 else 0 for x in leaves}
    if len(counts) != 1 or counts == {0}:
        shapes = ", ".join(str(x.shape) for x in leaves) or "none"
        raise ValueError(
            f"`over`: the values of `{name}` need one leading axis with at least one "
            f"entry; the shapes of their arrays: {shapes}. A single value is a list of one."
        )
    return tree


def _numbers(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values)
    if not np.issubdtype(array.dtype, np.number) and array.dtype != bool:
        raise TypeError(
            f"`over`: the values of `{name}` must be numbers, got {array.dtype}. For "
            "schemes and other objects use a Python loop with one sweep for each."
        )
    return array.astype(jax.dtypes.canonicalize_dtype(array.dtype))
