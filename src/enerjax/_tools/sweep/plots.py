"""Plots of sweeps: maps over two parameters, and lines over one."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from ..._pictures import axes_of
from .labelled import Sweep


Units = Mapping[str, str] | None


def plot_map(
    swept: Sweep, values: Any, x: str | None, log: bool, ax: Any, units: Units
) -> Axes:
    across = _axis(swept, x, default=-1)
    if len(swept.axes) != 2:
        raise ValueError(
            f"A map is over two parameters, but this sweep has {len(swept.axes)}: "
            f"{_names(swept)}. Choose values for the others with `at`, or plot lines."
        )
    name, array = _result(swept, values)
    if array.shape != swept.shape:
        raise ValueError(
            f"A map needs one number a lane, but `{name}` has the shape "
            f"{array.shape[2:]} in each."
        )
    along = 1 - across
    columns, rows = _coordinates(swept, across), _coordinates(swept, along)
    table = array if across == 1 else array.T
    failed = swept.failed if across == 1 else swept.failed.T
    ax = axes_of(ax)
    if log:
        table = np.where(table > 0, table, np.nan)
        if not np.isfinite(table).any():
            raise ValueError(f"`{name}` is nowhere positive: it has no logarithm.")
    norm = LogNorm() if log else None
    image = ax.pcolormesh(columns, rows, table, shading="nearest", norm=norm)
    ax.figure.colorbar(image, ax=ax, label=_label(name, units))
    ax.set_facecolor("0.9")  # of lanes without a number
    place, row = np.meshgrid(columns, rows)
    ax.plot(place[failed], row[failed], "x", color="C3", markersize=4)
    _scale(ax, "x", columns)
    _scale(ax, "y", rows)
    ax.set(
        xlabel=_axis_label(swept, across, units), ylabel=_axis_label(swept, along, units)
    )
    if failed.any():
        ax.set_title(f"x: {failed.sum()} of {failed.size} failed", fontsize="small")
    return ax


def plot_lines(
    swept: Sweep, values: Any, x: str | None, log: bool, ax: Any, units: Units
) -> Axes:
    along = _axis(swept, x, default=-1)
    if len(swept.axes) > 2:
        raise ValueError(
            f"Lines are over one parameter, for the values of one more, but this sweep has "
            f"{len(swept.axes)}: {_names(swept)}. Choose values for the others with `at`."
        )
    name, array = _result(swept, values)
    if array.ndim > 2:
        raise ValueError(
            f"There are too many lines: `{name}` has the shape "
            f"{array.shape[len(swept.axes) :]} in each lane of a sweep over "
            f"{_names(swept)}."
        )
    places = _coordinates(swept, along)
    columns = np.moveaxis(array, along, 0).reshape(len(places), -1)
    failed = np.moveaxis(swept.failed, along, 0).reshape(len(places), -1)
    ax = axes_of(ax)
    for k, column in enumerate(columns.T):
        (line,) = ax.plot(places, column, ".-", label=_line_label(swept, along, k, array))
        bad = failed[:, k if failed.shape[1] > 1 else 0]
        ax.plot(places[bad], column[bad], "x", color=line.get_color(), markersize=8)
    _scale(ax, "x", places)
    ax.set_yscale("log" if log else "linear")
    ax.set(xlabel=_axis_label(swept, along, units), ylabel=_label(name, units))
    if columns.shape[1] > 1:
        ax.legend(fontsize="small")
    if failed.any():
        ax.set_title(f"{failed.sum()} of {failed.size} failed", fontsize="small")
    return ax


def _names(swept: Sweep) -> list[str]:
    return [", ".join(names) for names in swept.axes]


def _label(name: str, units: Units) -> str:
    unit = (units or {}).get(name)
    return f"{name} [{unit}]" if unit else name


def _axis_label(swept: Sweep, axis: int, units: Units) -> str:
    return ", ".join(_label(name, units) for name in swept.axes[axis])


def _line_label(swept: Sweep, along: int, number: int, array: np.ndarray) -> str:
    """What tells a line from others: the value of the other parameter, or its number."""
    if len(swept.axes) == 2:
        other = 1 - along % 2
        value = _coordinates(swept, other)[number]
        return f"{swept.axes[other][0]} = {value:.4g}"
    return str(number) if array.ndim > 1 else ""


def _axis(swept: Sweep, x: str | None, default: int) -> int:
    """The number of the axis of a parameter."""
    if not swept.axes:
        raise ValueError("There is one lane, whose results are in `values`: no plot.")
    if x is None:
        return default % len(swept.axes)
    for number, names in enumerate(swept.axes):
        if x in names:
            return number
    raise ValueError(
        f"`x` is no parameter that was swept, got {x!r}; there are {_names(swept)}."
    )


def _result(swept: Sweep, values: Any) -> tuple[str, np.ndarray]:
    """The name and the numbers of a result, or of an array like one."""
    found = swept.results()
    if not isinstance(values, str) and values is not None:
        array = np.asarray(values, float)
        if array.shape[: len(swept.axes)] != swept.shape:
            raise ValueError(
                f"An array to plot has the shape of the sweep, {swept.shape}, first; got "
                f"{array.shape}."
            )
        return "", array
    if values is None and len(found) == 1:
        return next(iter(found.items()))
    if values not in found:
        raise ValueError(
            f"There is no number `{values}` among the results; there are {[*found]}."
        )
    return values, found[values]


def _coordinates(swept: Sweep, axis: int) -> np.ndarray:
    """The values of the first parameter of an axis, or its indices if they are none."""
    (first, *_), count = swept.axes[axis], swept.shape[axis]
    leaves = jax.tree.leaves(swept.parameters[first])
    array = np.asarray(leaves[0]) if len(leaves) == 1 else np.zeros((0, 0))
    is_number = array.ndim == 1 and array.dtype.kind in "iuf"
    return array.astype(float) if is_number else np.arange(count)


def _scale(ax: Axes, which: str, values: np.ndarray) -> None:
    """A logarithmic axis for values that a logarithm spaces more evenly."""
    if len(values) < 3 or np.any(values <= 0):
        return
    uneven = lambda x: np.ptp(np.diff(x)) / np.abs(np.diff(x)).max()
    if uneven(np.log(values)) < 0.5 * uneven(values):
        ax.set(**{f"{which}scale": "log"})
