"""Adaptive steps against equal steps: errors, steps and times.

    python benchmarks/adaptive.py [--quick] [--out FOLDER]

Kepler's problem at eccentricity 0.9, Pleiades, and the paper's double pendulum whose inner
mass is 200 times lighter (case d). Errors are the largest of positions at eight times
within steps, against explicit Runge-Kutta solutions in minimal coordinates. For each
adaptive run, the number of equal steps with the same error is interpolated between runs
with repeatedly halved steps; rejected steps count. Writes adaptive.csv, adaptive.json and
adaptive.png.
"""

import csv
import functools
from pathlib import Path
from typing import Any

import harness
import jax
import jax.numpy as jnp
import numpy as np
from references import DOUBLE_PENDULUM, Minimal, solve

import enerjax as ej


TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
COUNTS = tuple(100 * 2**k for k in range(9))
# For those that vary.
MAX_STEPS = 8192


def _planet(y: Any, args: Any) -> Any:
    return np.concatenate([y[2:], -args["mu"] * y[:2] / np.hypot(*y[:2]) ** 3])


def _stars(y: Any, args: Any) -> Any:
    x = y[:14].reshape(7, 2)
    apart = x[:, None] - x[None]
    distance = np.sqrt(np.sum(apart**2, axis=2)) + np.eye(7)
    pulls = -args["m"][None, :, None] * apart / distance[..., None] ** 3
    return np.concatenate([y[14:], pulls.sum(axis=1).ravel()])


def _from_start(problem: ej.problems.Problem, rates: Any) -> Minimal:
    begin = np.concatenate([problem.start.q, problem.start.v])
    half = begin.size // 2
    return Minimal(lambda args: begin, rates, lambda y, args: (y[:half], y[half:]))


KEPLER, PLEIADES = ej.problems.kepler, ej.problems.pleiades
CASES = {
    "Kepler 0.9": (lambda: KEPLER(0.9), lambda p: _from_start(p, _planet), 10.0),
    "Pleiades": (PLEIADES, lambda p: _from_start(p, _stars), 3.0),
    "case d": (ej.problems.stiff_double_pendulum, lambda p: DOUBLE_PENDULUM, 2.0),
}
# Made when they are used: the numbers in them start JAX.
SCHEMES = {
    "EnergyPreserving()": lambda: ej.EnergyPreserving(),
    "EnergyConsistent(0.0)": lambda: ej.EnergyConsistent(0.0),
    "EnergyConsistent(0.5)": lambda: ej.EnergyConsistent(0.5),
    "Composed(EnergyPreserving(), 4)": lambda: ej.Composed(ej.EnergyPreserving(), 4),
}


def _row(name: str, kind: str, value: float, exact: Any, program: Any) -> harness.Row:
    solution = program(value)
    stats, audit = solution.stats, solution.audit
    completed = int(stats.completed_steps)
    rejected = 0 if stats.rejected_steps is None else int(stats.rejected_steps)
    # From the first row to the last: between them the balance is that of whole steps.
    change = audit.energy[-1] - audit.energy[0]
    known = jnp.sum(audit.work + audit.drive_work - audit.dissipated)
    scale = float(jnp.max(jnp.abs(audit.kinetic)))
    row: harness.Row = dict(scheme=name, kind=kind, value=value, steps=completed + rejected)
    row |= dict(rejected=rejected, iterations=int(jnp.sum(stats.newton_iterations)))
    row["error"] = float(np.abs(np.asarray(solution.ys.q)[1:-1] - exact).max())
    row["leak"] = float(jnp.abs(change - known)) / scale
    row["failed"] = bool(solution.result != ej.RESULTS.successful)
    row["seconds"] = harness.medians([lambda: program(value)], 3)[0]
    return row


def our_rows(quick: bool) -> list[harness.Row]:
    rows = []
    for case, (make, minimal, t1) in CASES.items():
        problem = make()
        system, start, args = problem
        # Not the ends of steps, nor times of symmetry.
        inner = t1 * (np.arange(8) + np.sqrt(0.5)) / 8
        exact = solve(minimal(problem), args, inner).q
        ts = np.concatenate([[0.0], inner, [t1]])
        for name, make_scheme in SCHEMES.items():
            scheme = make_scheme()
            if quick and name != "EnergyConsistent(0.0)":
                continue

            def run(h, controller, mechanism=(system, scheme, start, args), t1=t1, ts=ts):
                is_fixed = isinstance(controller, ej.EqualSteps)
                bound = COUNTS[-1] if is_fixed else MAX_STEPS
                run = functools.partial(ej.simulate, *mechanism, h=h, t1=t1)
                return run(
                    saveat=ej.SaveAt(ts=ts),
                    max_steps=bound,
                    controller=controller,
                    throw=False,
                )

            fixed = jax.jit(lambda h, run=run: run(h, ej.EqualSteps()))
            varied = jax.jit(lambda tol, run=run: run(1e-3, ej.StepController(tol, tol)))
            of_case = [_row(name, "adaptive", tol, exact, varied) for tol in TOLERANCES] + [
                _row(name, "fixed", t1 / count, exact, fixed) for count in COUNTS
            ]
            _compare(of_case)
            rows += [dict(case=case) | row | harness.device() for row in of_case]
    return rows


def _compare(rows: list[harness.Row]) -> None:
    """Adds the number of equal steps with the same error, if these reach it."""
    good = [row for row in rows if row["kind"] == "fixed" and not row["failed"]]
    # From the shortest steps on, as long as the error grows: the errors of long steps on
    # a chaotic motion are no measure.
    good = sorted(good, key=lambda row: -row["steps"])
    line = good[:1]
    for row in good[1:]:
        if row["error"] <= 1.2 * line[-1]["error"]:
            break
        line.append(row)
    error = np.log([row["error"] for row in line])
    for row in rows:
        if row["kind"] == "fixed" or row["failed"]:
            continue
        at = np.log(row["error"])
        for key in ("steps", "seconds"):
            of_fixed = np.log([other[key] for other in line])
            inside = error[0] <= at <= error[-1]
            same = np.exp(np.interp(at, error, of_fixed)) if inside else np.nan
            row[f"fewer_{key}"] = float(same / row[key])


def show(rows: list[harness.Row]) -> None:
    for row in rows:
        if row["kind"] == "adaptive":
            each = row["iterations"] / max(row["steps"], 1)
            print(
                f"{row['case']:11s} {row['scheme']:32s} {row['mode']:8s} "
                f"{row['value']:.0e}: error {row['error']:.1e}, {row['steps']:5d} steps "
                f"({row['rejected']:2d} rejected), {each:5.2f} "
                f"corrections, {1e3 * row['seconds']:6.1f} ms, leak {row['leak']:.0e}: "
                f"one length takes {row.get('fewer_steps', np.nan):5.1f} x the steps, "
                f"{row.get('fewer_seconds', np.nan):5.1f} x the time"
                + (" FAILED" if row["failed"] else "")
            )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    with path.with_suffix(".csv").open("w", newline="") as file:
        names = list(dict.fromkeys(name for row in rows for name in row))
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    figure, axes = plt.subplots(1, len(CASES), figsize=(14, 4.2), layout="constrained")
    rows = [row for row in rows if row["mode"] == rows[0]["mode"] and not row["failed"]]
    for axis, case in zip(axes, CASES, strict=True):
        for colour, scheme in enumerate(SCHEMES):
            for kind, style in (("adaptive", "o-"), ("fixed", "x:")):
                wanted = dict(case=case, scheme=scheme, kind=kind)
                points = [row for row in rows if wanted.items() <= row.items()]
                x = [row["steps"] for row in points]
                y = [row["error"] for row in points]
                axis.loglog(x, y, style, color=f"C{colour}", label=f"{scheme}, {kind}")
        axis.set(title=case, xlabel="steps, rejected ones included", ylabel="error in q")
    axes[0].legend(fontsize=6)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw)
