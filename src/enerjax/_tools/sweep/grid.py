"""The parameters of a sweep: which values there are, and those of each lane."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Grid:
    """Lanes in row-major order: the last axis changes from each lane to the next.

    - `axes`: the names of the parameters that change together along each axis.
    - `shape`: the number of values along each axis.
    - `values`: of each parameter, a pytree of arrays with the values in front.
    """

    axes: tuple[tuple[str, ...], ...]
    shape: tuple[int, ...]
    values: dict[str, Any]

    @property
    def size(self) -> int:
        return int(np.prod(self.shape))

    def lanes(self, numbers: np.ndarray) -> dict[str, Any]:
        """The parameters of some lanes, in front."""
        places = np.unravel_index(numbers, self.shape)
        return {
            name: jax.tree.map(lambda x, place=place: x[place], self.values[name])
            for names, place in zip(self.axes, places, strict=True)
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
    """Checked parameters."""
    if not isinstance(over, Mapping) or not over:
        raise TypeError(
            "`over` must be a dictionary of the names of parameters and their values, such "
            f'as {{"alpha": [0.0, 0.5], "h": [1e-3, 2e-3]}}; got {over!r}.'
        )
    axes, shape, values = [], [], {}
    for key, given in over.items():
        names = key if isinstance(key, tuple) else (key,)
        if not names or not all(isinstance(name, str) for name in names):
            raise TypeError(
                f"`over`: {key!r} is neither the name of a parameter nor a tuple of names."
            )
        taken = [name for name in names if name in values or names.count(name) > 1]
        if taken:
            raise ValueError(f"`over` has the parameter `{taken[0]}` twice.")
        columns = (
            _columns(names, given) if isinstance(key, tuple) else (_arrays(key, given),)
        )
        axes.append(names)
        shape.append(len(jax.tree.leaves(columns)[0]))
        values.update(zip(names, columns, strict=True))
    return Grid(tuple(axes), tuple(shape), values)


def _columns(names: tuple[str, ...], given: Any) -> tuple[np.ndarray, ...]:
    """Of points `(points, len(names))`, one column for each name."""
    points = _numbers(", ".join(names), given)
    if points.ndim != 2 or points.shape[1] != len(names) or len(points) == 0:
        raise ValueError(
            f"`over`: the points of ({', '.join(names)}) have shape {points.shape}; give "
            f"a row of {len(names)} numbers for each, shape (points, {len(names)})."
        )
    return tuple(points.T)


def _arrays(name: str, given: Any) -> Any:
    """A pytree of arrays with the values in front; a list or a tuple is one array."""
    if isinstance(given, list | tuple | range):
        given = np.asarray(given)
    tree = jax.tree.map(lambda x: _numbers(name, x), given)
    leaves = jax.tree.leaves(tree)
    counts = {len(x) if x.ndim > 0 else 0 for x in leaves}
    if len(counts) != 1 or counts == {0}:
        shapes = ", ".join(str(x.shape) for x in leaves) or "none"
        raise ValueError(
            f"`over`: the values of `{name}` need one leading axis, in which there is at "
            f"least one; the shapes of their arrays: {shapes}. A single value is a list "
            "of one."
        )
    return tree


def _numbers(name: str, given: Any) -> np.ndarray:
    array = np.asarray(given)
    if not np.issubdtype(array.dtype, np.number) and array.dtype != bool:
        raise TypeError(
            f"`over`: the values of `{name}` must be numbers, got {array.dtype}. Go "
            "through schemes and other objects in a Python loop, with a sweep for each."
        )
    return array.astype(jax.dtypes.canonicalize_dtype(array.dtype))
