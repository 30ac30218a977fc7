"""Plots of a run: its energies, the account of their changes, constraints and steps."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .._pictures import axes_of, grid_of, label, legend_above, tell, Units
from .audit import Audit
from .reached import ReachedRows
from .solution import Solution, Statistics


def plot_energy(sol: Solution, ax: Any, units: Units | None) -> Axes:
    """Kinetic, potential and total energy."""
    rows, ax, audit = ReachedRows(sol), axes_of(ax), sol.audit
    for name, color in (("kinetic", "C0"), ("potential", "C2"), ("energy", "k")):
        values = rows(getattr(audit, name))
        ax.plot(rows.ts, values, color, label="total" if name == "energy" else name)
    ax.set(xlabel=label("time", units), ylabel=label("energy", units))
    _say_the_end(rows, ax)
    legend_above(ax, 3)
    return ax


def plot_run(sol: Solution, axes: Any, units: Units | None) -> np.ndarray:
    """Energies, their account, constraints and steps in four axes."""
    rows = ReachedRows(sol)
    grid = grid_of(axes, 2, (9.0, 6.0))
    plot_energy(sol, grid[0], units)
    _account(rows, sol.audit, grid[1], units)
    _constraints(rows, sol.audit, grid[2])
    _steps(rows, sol.stats, grid[3])
    for ax in grid:
        ax.set_xlabel(label("time", units))
    return grid


def _account(rows: ReachedRows, audit: Audit, ax: Axes, units: Units | None) -> None:
    """What changed the energy since the start; only what is not zero throughout."""
    energy = rows(audit.energy)
    change = energy - energy[0]
    ax.plot(rows.ts, change, "k", linewidth=4, alpha=0.25, label="change of the energy")
    for name, values in (
        ("removed by the scheme", -audit.dissipated),
        ("work of forces", audit.work),
        ("of these, by dampers", -audit.damped),
        ("work of drives", audit.drive_work),
        ("unaccounted for", audit.leak),
    ):
        total = np.cumsum(rows(values))
        if np.any(total != 0):
            ax.plot(rows.ts, total, "--" if name.startswith("of") else "-", label=name)
    ax.set_ylabel(label("energy since the start", units, "energy"))
    legend_above(ax, 2)


def _constraints(rows: ReachedRows, audit: Audit, ax: Axes) -> None:
    """The largest residuals of positions and velocities, in their own units."""
    for name, values in (
        ("of positions", audit.constraint),
        ("of velocities", audit.constraint_rate),
    ):
        if values.shape[-1] > 0:
            largest = np.abs(rows(values)).max(axis=1)
            # A residual of exactly zero has no logarithm.
            ax.semilogy(rows.ts, np.where(largest > 0, largest, np.nan), label=name)
    if ax.lines:
        ax.legend(fontsize="small")
    else:
        ax.text(0.5, 0.5, "no constraints", transform=ax.transAxes, ha="center")
    ax.set_ylabel("largest residual")


def _steps(rows: ReachedRows, stats: Statistics, ax: Axes) -> None:
    """Iterations between rows, and their distance where it varies."""
    ts, iterations = rows.after_start(stats.newton_iterations)
    ax.plot(ts, iterations, ".", markersize=3, label="iterations")
    ax.set_ylabel("iterations since the row before")
    ax.set_ylim(bottom=0)
    distances = np.diff(rows.ts)
    if len(distances) > 1 and np.ptp(distances) > 1e-6 * distances.max():
        beside = ax.twinx()
        beside.semilogy(rows.ts[1:], distances, "C1", linewidth=0.8)
        beside.set_ylabel("time since the row before", color="C1")


def _say_the_end(rows: ReachedRows, ax: Axes) -> None:
    """Where and why a run ended before its time."""
    if rows.outcome:
        ax.axvline(rows.ts[-1], color="C3", linewidth=1)
        tell(ax, f"ends at t = {rows.ts[-1]:.4g}: {rows.outcome}")
