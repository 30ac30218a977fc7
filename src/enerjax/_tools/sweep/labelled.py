"""Results of a sweep, which can be selected by the values of the parameters."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from ..._results import meanings, RESULTS, tally


_Outcome = type(RESULTS.successful)


@dataclasses.dataclass(frozen=True)
class Sweep:
    """The results of a sweep.

    - `axes`: the names of the parameters along each of the leading axes of the results;
      parameters that change together share one axis.
    - `parameters`: their values along their axis, or the one value that `at` has selected.
    - `values`: the values of the function; the axes of the parameters come first.

    `print` shows the parameters, the results, and the number of failed lanes.
    """

    axes: tuple[tuple[str, ...], ...]
    parameters: dict[str, Any]
    values: Any

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of values along each axis of the parameters."""
        return tuple(
            len(jax.tree.leaves(self.parameters[names[0]])[0]) for names in self.axes
        )

    @property
    def failed(self) -> np.ndarray:
        """Which lanes returned a failure such as that in `Solution.result`; has `shape`."""
        failed = np.zeros(self.shape, bool)
        for _, leaf in self._named():
            if isinstance(leaf, _Outcome):
                failed |= meanings(leaf) != "successful"
        return failed

    def at(self, **chosen: Any) -> "Sweep":
        """The results for these values, such as `swept.at(alpha=0.5, h=1e-3)`.

        If parameters change together, pass as many as are needed to identify one point.

        **Raises:** `ValueError` for a value that was not swept, and for several points.
        """
        unknown = set(chosen) - {name for names in self.axes for name in names}
        if unknown:
            left = ", ".join(name for names in self.axes for name in names) or "none"
            raise ValueError(
                f"`{min(unknown)}` is no parameter to choose; those left are: {left}."
            )
        part = self
        for axis, names in reversed(list(enumerate(self.axes))):
            given = {name: chosen[name] for name in names if name in chosen}
            if given:
                part = part._taken(axis, self._find(names, given))
        return part

    def smallest(self, name: str) -> "Sweep":
        """The lane with the smallest value of a result, which is named as in `print`.

        Its `parameters` suit as the start of a search. Lanes with NaN are ignored.

        **Raises:** `ValueError` if there is no such result, or if all lanes are NaN.
        """
        known = dict(self._named())
        if name not in known or np.shape(known[name]) != self.shape:
            numbers = [key for key, x in known.items() if np.shape(x) == self.shape]
            raise ValueError(
                f"`{name}` is no result of one number a lane; there are: "
                f"{', '.join(numbers) or 'none'}."
            )
        if np.isnan(known[name]).all():
            raise ValueError(f"`{name}` is NaN in all lanes: all have failed.")
        place = np.unravel_index(np.nanargmin(known[name]), self.shape)
        part = self
        for axis in reversed(range(len(self.axes))):
            part = part._taken(axis, int(place[axis]))
        return part

    def results(self) -> dict[str, np.ndarray]:
        """The numbers that the lanes returned, by the names in `print`."""
        named = self._named()
        return {name: np.asarray(x) for name, x in named if not isinstance(x, _Outcome)}

    def plot_map(
        self,
        values: Any = None,
        *,
        x: str | None = None,
        log: bool = False,
        ax: Any = None,
        units: dict[str, str] | None = None,
    ) -> Any:
        """A result over two parameters, as colours. Lanes that failed are crossed.

        **Arguments:**

        - `values`: a result, which is named as in `print`, or an array of your own with the
          shape of the sweep; by default the only result.
        - `x`: the parameter along the horizontal axis, by default the last.
        - `log`: whether colours show the logarithm; values that have none are grey.
        - `ax`: axes of matplotlib, by default new ones.
        - `units`: of parameters and results, for the labels: `{"h": "s", "lost": "J"}`.

        **Returns:** the axes.

        **Raises:** `ValueError` if the sweep is not over two parameters (`at` chooses
        values for others), for an unknown name, and for a result of several numbers a lane.
        """
        from .plots import plot_map

        return plot_map(self, values, x, log, ax, units)

    def plot_lines(
        self,
        values: Any = None,
        *,
        x: str | None = None,
        log: bool = False,
        ax: Any = None,
        units: dict[str, str] | None = None,
    ) -> Any:
        """A result over one parameter as a line: one line for each value of a second
        parameter, or for each entry of a result that is a vector.

        `log` makes the vertical axis logarithmic. For the other arguments, the return value
        and the errors see `plot_map`.
        """
        from .plots import plot_lines

        return plot_lines(self, values, x, log, ax, units)

    def to_xarray(self) -> Any:
        """An `xarray.Dataset`: results with named axes, the parameters as coordinates.

        Outcomes become their messages. Further axes of a result are named after it,
        `energy_0`, `energy_1`; parameters that are pytrees have no coordinate.

        **Raises:** `ImportError` without xarray (the extra `sweep`).
        """
        try:
            import xarray  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ImportError(
                "`to_xarray` needs xarray, which is part of the extra `sweep`: "
                'python -m pip install "enerjax[sweep]"'
            ) from error
        dims = tuple("_".join(names) for names in self.axes)
        along = {
            name: dim for dim, names in zip(dims, self.axes, strict=True) for name in names
        }
        variables = {}
        for name, leaf in self._named():
            array = meanings(leaf) if isinstance(leaf, _Outcome) else np.asarray(leaf)
            own = [f"{name}_{k}" for k in range(array.ndim - len(dims))]
            variables[name] = ((*dims, *own), array)
        coordinates = {}
        for name, array in self.parameters.items():
            if isinstance(array, np.ndarray | np.generic):
                front = (along[name],) if name in along else ()
                own = [f"{name}_{k}" for k in range(array.ndim - len(front))]
                coordinates[name] = ((*front, *own), array)
        return xarray.Dataset(variables, coordinates)

    def __str__(self) -> str:
        counts = [
            f"{', '.join(names)} ({count})"
            for names, count in zip(self.axes, self.shape, strict=True)
        ]
        lines = [f"{int(np.prod(self.shape))} lanes: {' x '.join(counts) or 'one point'}"]
        for name, leaf in self._named():
            if isinstance(leaf, _Outcome):
                lines.append(f"  {name}: {tally(leaf)}")
            else:
                lines.append(f"  {name}: {leaf.dtype}{list(leaf.shape[len(self.axes) :])}")
        return "\n".join(lines)

    def _named(self) -> Iterator[tuple[str, Any]]:
        """The names and values of the results, which are outcomes or arrays."""
        flat, _ = jax.tree_util.tree_flatten_with_path(
            self.values, is_leaf=lambda x: isinstance(x, _Outcome)
        )
        for path, leaf in flat:
            yield jax.tree_util.keystr(path, simple=True, separator=".") or "value", leaf

    def _find(self, names: tuple[str, ...], given: dict[str, Any]) -> int:
        """The index of the point with these values of parameters."""
        match = np.array(True)
        for name, value in given.items():
            array = self.parameters[name]
            if not isinstance(array, np.ndarray) or array.ndim != 1:
                raise ValueError(
                    f"The values of `{name}` are not scalars: index `values` along its "
                    "axis instead."
                )
            # A value may have been rounded differently from the one in the grid.
            here = np.isclose(array, value, rtol=1e-6, atol=0, equal_nan=True)
            if not here.any():
                raise ValueError(f"`{name}` = {value} was not swept; its values: {array}.")
            match = match & here
        found = np.flatnonzero(match)
        if found.size != 1:
            choice = ", ".join(f"{name} = {value}" for name, value in given.items())
            raise ValueError(
                f"{choice}: this selects {found.size} points of ({', '.join(names)}), not "
                "one."
            )
        return int(found[0])

    def _taken(self, axis: int, index: int) -> "Sweep":
        names = self.axes[axis]
        chosen = {
            name: jax.tree.map(lambda x: x[index], self.parameters[name]) for name in names
        }
        return Sweep(
            self.axes[:axis] + self.axes[axis + 1 :],
            self.parameters | chosen,
            jax.tree.map(lambda x: np.take(x, index, axis), self.values),
        )
