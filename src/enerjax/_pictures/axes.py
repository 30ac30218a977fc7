"""Axes of pictures: those of the user or new ones, and their labels."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import matplotlib.patheffects as effects
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D


# The unit of each dimension: "time", "length", "energy", "force", "torque".
Units: TypeAlias = Mapping[str, str]
DIMENSIONS = ("time", "length", "energy", "force", "torque")


def axes_of(ax: Any, figsize: tuple[float, float] = (6.0, 4.0)) -> Axes:
    """`ax`, or new axes in a figure of its own.

    **Raises:** `TypeError` for what is no axes of matplotlib.
    """
    if ax is None:
        return plt.subplots(figsize=figsize, layout="constrained")[1]
    return checked(ax)


def checked(ax: Any) -> Axes:
    if not isinstance(ax, Axes):
        raise TypeError(
            f"`ax` must be axes of matplotlib, such as those of `plt.subplots()`, got "
            f"{type(ax).__name__}."
        )
    return ax


def grid_of(axes: Any, rows: int, figsize: tuple[float, float]) -> np.ndarray:
    """`axes` as a flat array, or new ones in this number of rows, two in each.

    **Raises:** `ValueError` for another number of axes.
    """
    count = 2 * rows
    if axes is None:
        axes = plt.subplots(rows, 2, figsize=figsize, layout="constrained")[1]
    flat = np.ravel(np.asarray(axes, object))
    if len(flat) != count:
        raise ValueError(f"This picture needs {count} axes, got {len(flat)}.")
    for ax in flat:
        checked(ax)
    return flat


def in_space(ax: Axes) -> bool:
    return isinstance(ax, Axes3D)


def label(quantity: str, units: Units | None, dimension: str | None = None) -> str:
    """`quantity [unit]`, if there is a unit for its dimension.

    **Raises:** `ValueError` for units of other dimensions.
    """
    units = {} if units is None else units
    unknown = [name for name in units if name not in DIMENSIONS]
    if unknown:
        raise ValueError(
            f"`units` has no dimension `{unknown[0]}`; there are {[*DIMENSIONS]}."
        )
    unit = units.get(quantity if dimension is None else dimension)
    return f"{quantity} [{unit}]" if unit else quantity


def legend_above(ax: Axes, columns: int, handles: Any = None) -> None:
    """A legend outside of the axes, where it hides no curve, nor a power of ten."""
    ax.legend(
        handles=handles,
        fontsize="small",
        ncols=columns,
        frameon=False,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.2,
    )


def tell(ax: Axes, text: str) -> Any:
    """A line in red at the foot of the axes."""
    return _in_corner(ax, text, 0.02, "C3")


def headline(ax: Axes, text: str) -> None:
    """A line in red above the axes, where it covers nothing."""
    ax.set_title(text, color="C3", fontsize="small")


def clock(ax: Axes, text: str) -> Any:
    """A line at the head of the axes, for the time."""
    return _in_corner(ax, text, 0.98, "0.25")


def _in_corner(ax: Axes, text: str, height: float, color: str) -> Any:
    place: Any = ax.text2D if in_space(ax) else ax.text  # pyright: ignore
    return place(
        0.02,
        height,
        text,
        transform=ax.transAxes,
        va="top" if height > 0.5 else "bottom",
        fontsize="small",
        color=color,
        zorder=7,
        path_effects=[effects.withStroke(linewidth=2, foreground="white")],
    )
