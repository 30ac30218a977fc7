"""Error against time: our schemes, explicit integrators and DAE solvers, on one core.

    python benchmarks/speed_accuracy.py [--out FOLDER] [--quick] [--only PROBLEM]

Points on rods that fall from the horizontal (one, two, two with an inner mass 200 times
lighter, 8 and 64 of them) and the heavy top. Ours, and diffrax in minimal coordinates and
on the same model by `to_diffrax`, with the settings of XLA that diffrax is fastest with;
SciPy's DOP853; EXUDYN's generalized-alpha method and trapezoidal rule; IDA of SUNDIALS on
the stabilised index-2 equations (extra `peers`). The error is the largest of any point at
the end, against an explicit run at tight tolerance. Times are medians, of the processor,
without what is done once: compiling, building the model. Where a solver calls Python
(SciPy, IDA) the equations of chains are compiled with numba, those of the top are NumPy's.
Prints, for each problem and error, the cheapest run of each solver. Writes
speed_accuracy.json and .png. With `--quick` without chains; `--only` runs one problem and
keeps what is saved of others.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import harness
import numpy as np
from speed_accuracy_peers import diffrax_rows, SOLVERS
from speed_accuracy_works import BOUND, Work, WORKS

import enerjax as ej


REPEATS, QUICK_REPEATS = 5, 2
ERRORS = tuple(10.0**-k for k in range(2, 10))
SCHEMES: dict[str, Callable[[], ej.AbstractScheme]] = {
    "EnergyConsistent(0)": lambda: ej.EnergyConsistent(0.0),
    "EnergyPreserving": lambda: ej.EnergyPreserving(),
    "EnergyDecaying(0.5)": lambda: ej.EnergyDecaying(0.5),
    "Composed(EnergyPreserving, 4)": lambda: ej.Composed(ej.EnergyPreserving(), 4),
    "Composed(EnergyConsistent, 6)": lambda: ej.Composed(ej.EnergyConsistent(0.0), 6),
    "Composed(Rattle, 4)": lambda: ej.Composed(ej.Rattle(), 4),
    "Composed(Rattle, 6)": lambda: ej.Composed(ej.Rattle(), 6),
    "Composed(Rattle, 8)": lambda: ej.Composed(ej.Rattle(), 8),
}
COLOURS = dict(ours="C0", dae="C3", ode="C2")


def our_rows(quick: bool, names: Sequence[str]) -> list[harness.Row]:
    rows: list[harness.Row] = []
    programs: list[Callable] = []
    works = _chosen(quick, names)
    for name, work in works.items():
        exact = work.exact()
        for label, make in SCHEMES.items():
            for h in work.steps.get(label, ()):
                row, program = _our_run(name, work, label, make(), h, exact)
                rows.append(row)
                programs += [] if program is None else [program]
    timed = [row for row in rows if row["error"] <= BOUND]
    repeats = QUICK_REPEATS if quick else REPEATS
    times = harness.medians(programs, repeats)
    for row, seconds in zip(timed, times, strict=True):
        row["seconds"] = seconds
    # In this process: it is in JAX too.
    for name, work in works.items():
        peers = diffrax_rows(work, work.exact(), repeats)
        rows += [dict(work=name) | row for row in peers]
    return [row | harness.device() for row in rows]


def _our_run(
    name: str, work: Work, label: str, scheme: ej.AbstractScheme, h: float, exact: Any
) -> tuple[harness.Row, Callable | None]:
    run = harness.compiled_run(work.problem(), scheme, h, round(work.end / h))
    solution = run.solution
    error = work.error(work.positions(np.asarray(solution.ys.q[-1])), exact)
    error = error if np.isfinite(error) else float("inf")
    row = dict(work=name, kind="ours", solver=label, setting=f"h {h:g}", error=error)
    row["energy"] = float(abs(solution.audit.leak[-1]))
    return row, run.again if error <= BOUND else None


def _chosen(quick: bool, names: Sequence[str]) -> dict[str, Work]:
    return {n: w for n, w in WORKS.items() if n in names and not (quick and w.size > 2)}


def peer_rows(quick: bool, names: Sequence[str]) -> list[harness.Row]:
    repeats = QUICK_REPEATS if quick else 3
    rows: list[harness.Row] = []
    for name, work in _chosen(quick, names).items():
        exact = work.exact()
        for solver in SOLVERS:
            for row in solver(work, exact, repeats):
                rows.append(dict(work=name, mode="peer") | row)
    return rows


def cheapest(rows: list[harness.Row], error: float) -> dict[str, float]:
    """Milliseconds of the cheapest run of each solver that reaches this accuracy."""
    best: dict[str, float] = {}
    for row in rows:
        if row["error"] <= error and "seconds" in row:
            key = f"{row['kind']}: {row['solver']}"
            best[key] = min(best.get(key, np.inf), 1e3 * row["seconds"])
    return best


def show(rows: list[harness.Row]) -> None:
    for name in WORKS:
        here = [row for row in rows if row["work"] == name]
        if not here:
            continue
        tables = [cheapest(here, error) for error in ERRORS]
        print(f"\n{name}: ms to an error of" + "".join(f"{e:9.0e}" for e in ERRORS))
        for solver in sorted({solver for table in tables for solver in table}):
            cells = (f"{t[solver]:9.3g}" if solver in t else " " * 9 for t in tables)
            print(f"  {solver:42s}" + "".join(cells))
        for kind in ("dae", "ode"):
            print(f"  {'best ' + kind + ' / best ours':42s}" + _ratios(tables, kind))


def _ratios(tables: list[dict[str, float]], kind: str) -> str:
    """The time of the best solver of a kind, relative to that of our best scheme."""
    best = lambda table, kind: min(
        (ms for solver, ms in table.items() if solver.startswith(kind)), default=np.inf
    )
    pairs = [(best(table, kind), best(table, "ours")) for table in tables]
    return "".join(
        f"{theirs / ours:9.2g}" if np.isfinite(theirs + ours) else f"{'-':>9s}"
        for theirs, ours in pairs
    )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    names = [name for name in WORKS if any(row["work"] == name for row in rows)]
    figure, axes = plt.subplots(2, -(-len(names) // 2), figsize=(13, 8), squeeze=False)
    for axis, name in zip(axes.ravel(), names, strict=False):
        here = [r for r in rows if r["work"] == name and "seconds" in r]
        for solver in sorted({r["solver"] for r in here}):
            mine = [r for r in here if r["solver"] == solver]
            line = sorted((r["seconds"], r["error"]) for r in mine)
            seconds, errors = zip(*line, strict=True)
            axis.loglog(seconds, errors, ".-", color=COLOURS[mine[0]["kind"]])
            axis.annotate(solver, (seconds[-1], errors[-1]), fontsize=5)
        axis.set(title=name, xlabel="seconds of computation", ylabel="error at the end")
    for axis in axes.ravel()[len(names) :]:
        axis.set_visible(False)
    figure.suptitle("ours (blue), DAE solvers (red), explicit ODE (green)")
    figure.tight_layout()
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, peer_rows, tuple(WORKS), harness.FAST_LOOPS)
