"""A map of the limits of each scheme, and of what happens beyond them.

    python benchmarks/extremes.py [--quick] [--long] [--only AXIS] [--out FOLDER]

Each row is one scheme for one value on an axis: the parameters, the outcome, the error
against an independent reference (a closed form, an ODE solver in minimal coordinates, the
same run at unit scale), the energy that the balance does not explain, both levels of the
constraints, the iterations, and a verdict. The verdict is `right`, `law holds` if only the
energy balance can be judged, `reported failure`, or `WRONG` for a success whose error
exceeds truncation and round-off. Writes extremes.csv and extremes.png.
"""

import argparse
import time
from itertools import chain, groupby
from pathlib import Path

import harness
import jax
import numpy as np
from matplotlib.figure import Figure


def axes(quick: bool, long: bool) -> dict:
    import extremes_bodies as bodies
    import extremes_numbers as numbers

    return {
        "step": lambda: chain(numbers.step_rows(quick), numbers.mechanism_step_rows(quick)),
        "stiffness": lambda: numbers.stiffness_rows(quick),
        "alpha": lambda: numbers.alpha_rows(quick),
        "settled": lambda: numbers.settling_rows(quick),
        "rest": lambda: bodies.rest_rows(quick),
        "mass": lambda: bodies.mass_rows(quick),
        "size": lambda: bodies.size_rows(quick),
        "whip": lambda: bodies.whip_rows(quick),
        "singular": lambda: bodies.singular_rows(quick),
        "length": lambda: bodies.length_rows(quick, long),
    }


def show(rows: list) -> None:
    line = "{:32} {:30} {:24} {:>9} {:>9} {:>9} {:>9} {:>7}  {:17} {}"
    head = ("case", "asked", "scheme", "error", "leak", "|Phi|", "|psi|", "Newton")
    for axis, group in groupby(rows, lambda row: row.axis):
        print(f"\n{axis}\n" + line.format(*head, "verdict", "what happened"))
        for r in group:
            small = (r.error, r.leak, r.constraint, r.constraint_rate)
            figures = [f"{x:.1e}" for x in small]
            print(
                line.format(
                    r.case, r.asked, r.scheme, *figures, f"{r.newton:.2f}", r.verdict,
                    r.happened,
                )
            )  # fmt: skip


COLOURS = {"right": "C2", "law holds": "C0", "reported failure": "C1", "WRONG": "C3"}


def draw(rows: list, path: Path) -> None:
    """A panel for each axis: the error (without a reference, the leak) of each scheme."""
    groups = [(axis, list(group)) for axis, group in groupby(rows, lambda r: r.axis)]
    columns = min(3, len(groups))
    lines = -(-len(groups) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.2 * lines), layout="constrained")
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, (axis, group) in zip(panels, groups, strict=False):
        for verdict, colour in COLOURS.items():
            some = [r for r in group if r.verdict == verdict]
            if not some:
                continue
            x = np.array([r.x for r in some])
            y = np.array([r.leak if np.isnan(r.error) else r.error for r in some])
            axes.plot(np.maximum(x, 1e-16), np.maximum(y, 1e-17), "o", ms=3, color=colour,
                      label=f"{verdict} ({len(some)})")  # fmt: skip
        axes.set(xscale="log", yscale="log", title=axis)
        axes.grid(which="major", linewidth=0.3)
        axes.legend(fontsize="xx-small")
    for axes in panels[len(groups) :]:
        axes.axis("off")
    panels[0].set_ylabel("error, or energy leak")
    figure.savefig(path, dpi=130)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--quick", action="store_true", help="fewer places on each axis")
    parser.add_argument("--long", action="store_true", help="runs of 1e7 steps")
    parser.add_argument("--only", help="one axis")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    rows = []
    chosen = axes(options.quick, options.long)
    if options.only not in (None, *chosen):
        parser.error(f"--only must be one of {', '.join(chosen)}")
    for name, rows_of in chosen.items():
        if options.only not in (None, name):
            continue
        begin = time.perf_counter()
        found = list(rows_of())
        show(found)
        print(f"{len(found)} rows in {time.perf_counter() - begin:.0f} s.", flush=True)
        rows += found
        jax.clear_caches()
    rows.sort(key=lambda row: row.axis)
    harness.write_csv(rows, options.out / "extremes.csv")
    draw(rows, options.out / "extremes.png")
    for verdict in COLOURS:
        print(f"{verdict}: {sum(row.verdict == verdict for row in rows)}")


if __name__ == "__main__":
    main()
