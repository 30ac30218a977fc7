"""Plots of a fit: the data with the prediction, and the intervals of the parameters."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from matplotlib.axes import Axes

from ..._pictures import axes_of, label, legend_above, Units
from .estimate import Fit, student


def plot_prediction(
    fit: Fit, predict: Callable, data: Any, ts: Any, ax: Any, units: Units | None
) -> Axes:
    numbers, unravel = ravel_pytree(fit.parameters)
    of_numbers = lambda x: jnp.asarray(predict(unravel(x)))
    predicted = np.asarray(of_numbers(numbers))
    measured = np.asarray(data, float)
    if predicted.shape != measured.shape or predicted.ndim not in (1, 2):
        raise ValueError(
            "`predict` must return what was measured, shape (times,) or (times, n): it "
            f"returns shape {predicted.shape}, and the data has {measured.shape}."
        )
    slopes = np.asarray(jax.jacfwd(of_numbers)(numbers))
    variance = np.einsum("...i,ij,...j->...", slopes, np.asarray(fit.covariance), slopes)
    half = student(fit.degrees_of_freedom) * np.sqrt(np.maximum(variance, 0))
    times = np.arange(len(measured)) if ts is None else np.asarray(ts, float)
    if times.shape != measured.shape[:1]:
        raise ValueError(
            "`ts` must have one time for each row of the data, shape "
            f"{measured.shape[:1]}, got {times.shape}."
        )
    ax = axes_of(ax)
    columns = (x.reshape(len(times), -1).T for x in (measured, predicted, half))
    for k, (seen, mean, width) in enumerate(zip(*columns, strict=True)):
        color = f"C{k % 10}"
        name = "" if measured.size == len(times) else f" {k}"
        ax.plot(times, seen, ".", color=color, markersize=3, label=f"data{name}")
        ax.plot(times, mean, color=color, linewidth=1, label=f"fit{name}")
        ax.fill_between(times, mean - width, mean + width, color=color, alpha=0.25, lw=0)
    ax.set_xlabel("row of the data" if ts is None else label("time", units))
    legend_above(ax, 4)
    return ax


def plot_intervals(fit: Fit, truth: Any, names: Sequence[str] | None, ax: Any) -> Axes:
    chosen = fit.names if names is None else tuple(names)
    unknown = [name for name in chosen if name not in fit.names]
    if unknown:
        raise ValueError(
            f"The fit has no parameter `{unknown[0]}`; there are {[*fit.names]}."
        )
    rows = [fit.names.index(name) for name in chosen]
    numbers = lambda tree: np.asarray(ravel_pytree(tree)[0])
    value, low, high = map(numbers, (fit.parameters, fit.lower, fit.upper))
    reference = value if truth is None else numbers(jax.tree.map(jnp.asarray, truth))
    if reference.shape != value.shape:
        raise ValueError(
            f"`truth` must have the parameters {[*fit.names]}, {value.size} numbers; it "
            f"has {reference.size}."
        )
    value, low, high, reference = (x[rows] for x in (value, low, high, reference))
    # Relative to the reference where it is not zero.
    scale = np.where(reference == 0, 1, np.abs(reference))
    middle, down, up = (value - reference) / scale, (value - low) / scale, high - value
    up = up / scale
    known = np.isfinite(down) & np.isfinite(up)
    ax = axes_of(ax)
    ax.axhline(0, color="k", linewidth=0.5)
    places = np.arange(len(chosen))
    ax.errorbar(places[known], middle[known], [down[known], up[known]], fmt="o", capsize=3)
    for k in places[~known]:
        ax.text(k, 0, "not determined", rotation=90, ha="center", va="bottom", color="C3")
    rotation = 45 if max(map(len, chosen)) * len(chosen) > 50 else 0
    ax.set_xticks(places, chosen, rotation=rotation)
    ax.margins(x=0.5 / max(len(chosen), 1))
    against = "the estimate" if truth is None else "the truth"
    ax.set_ylabel(f"relative to {against}, 95 % intervals")
    return ax
