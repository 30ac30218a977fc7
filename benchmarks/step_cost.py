"""The cost of a step: our schemes and EXUDYN, on the double pendulum and the heavy top.

    python benchmarks/step_cost.py [--out FOLDER] [--quick]

Each row is a run, whose error is measured first; a wrong answer is reported and not timed.
Times are medians over interleaved repeats, of the processor, on one core. The pendulum is
released from the horizontal, two unit rods and masses; the top is `problems.heavy_top`.
EXUDYN (the extra `peers`) runs the generalized-alpha method, rho 0.9, in the same Cartesian
coordinates. Writes step_cost.json and step_cost.png.
"""

from pathlib import Path

import harness
import numpy as np

import enerjax as ej


REPEATS, QUICK_REPEATS = 7, 2
# The time at which errors are measured.
PENDULUM_END, TOP_END = 10.0, 1.0
# Schemes, steps, and the largest error that is still a right answer.
PENDULUM = [
    ("EnergyPreserving()", 1e-3, 1e-2),
    ("EnergyDecaying(0.5)", 1e-3, 1e-2),
    ("EnergyConsistent(0.0)", 1e-3, 1e-4),
    ("EnergyConsistent(0.5)", 1e-3, 1e-3),
    ("EnergyConsistent(0.0)", 2.5e-3, 1e-5),
    ("EnergyConsistent(0.0)", 1e-2, 1e-2),
    ("EnergyConsistent(0.0)", 2.5e-2, 1e-2),
    ("EnergyConsistent(0.0)", 1 / 36, 1e-2),
    ("Composed(EnergyConsistent(0.0), 6)", 1 / 35, 1e-6),
    ("Composed(EnergyPreserving(), 4)", 4e-3, 1e-3),
    ("Composed(EnergyPreserving(), 4)", 2e-2, 1e-3),
]
TOP = [
    ("EnergyPreserving()", 1e-3, 3e-2),
    ("Composed(EnergyPreserving(), 4)", 2e-3, 1e-3),
    ("Composed(EnergyPreserving(), 4)", 3.125e-3, 1e-3),
]


def scheme_of(name: str) -> ej.AbstractScheme:
    names = {k: getattr(ej, k) for k in dir(ej) if k[0].isupper()}
    return eval(name, {"__builtins__": {}}, names)


def reference() -> dict[str, np.ndarray]:
    """Positions at the end, from explicit Runge-Kutta runs in minimal coordinates."""
    from references import HEAVY_TOP, solve, STRETCHED_DOUBLE_PENDULUM

    pendulum = dict(m1=1.0, m2=1.0, l1=1.0, l2=1.0, g=9.81)
    top = ej.problems.heavy_top().args
    ends = (
        solve(STRETCHED_DOUBLE_PENDULUM, pendulum, np.array([PENDULUM_END])),
        solve(HEAVY_TOP, top, np.array([TOP_END])),
    )
    return dict(pendulum=ends[0].q[-1], top=ends[1].q[-1][:3])


def problem_of(work: str) -> ej.problems.Problem:
    if work == "pendulum":
        return ej.problems.chain(2, length=2.0, mass=2.0)
    return ej.problems.heavy_top()


def our_rows(quick: bool) -> list[harness.Row]:
    exact = reference()
    rows, right_runs = [], []
    for work, table, end in (("pendulum", PENDULUM, PENDULUM_END), ("top", TOP, TOP_END)):
        problem = problem_of(work)
        for name, h, bound in table:
            steps = round(end / h)
            run = harness.compiled_run(problem, scheme_of(name), h, steps)
            solution = run.solution
            position = np.asarray(solution.ys.q[-1])[: len(exact[work])]
            error = float(np.max(np.abs(position - exact[work])))
            energy = solution.audit.energy
            leak = float(abs(energy[-1] - energy[0] + solution.audit.dissipated[-1]))
            row = dict(work=work, method=name, h=h, error=error, energy=leak)
            if error <= bound:
                row |= dict(steps=steps, compile_s=run.compile_s)
                row["iterations"] = run.corrections()
                right_runs.append((row, run))
            else:
                print(f"{name} on the {work} is off by {error:.1e}: not timed")
            rows.append(row)
    harness.add_step_times(right_runs, QUICK_REPEATS if quick else REPEATS)
    return [row | harness.device() for row in rows]


def exudyn_rows(quick: bool) -> list[harness.Row]:
    """The same work by EXUDYN, or no rows if it is not installed."""
    exudyn = harness.peer("step_cost_exudyn", "EXUDYN")
    if exudyn is None:
        return []
    repeats = QUICK_REPEATS if quick else REPEATS
    rows = exudyn.rows(reference(), PENDULUM_END, TOP_END, repeats)
    return [row | dict(mode="exudyn") for row in rows]


def show(rows: list[harness.Row]) -> None:
    anchors = {r["work"]: r["us_per_step"] for r in rows if r["mode"] == "exudyn"}
    for row in rows:
        anchor = anchors.get(row["work"])
        ratio = f"x {row['us_per_step'] / anchor:6.2f}" if anchor and "steps" in row else ""
        total = row.get("us_per_step", np.nan) * row.get("steps", 0) / 1e3
        print(
            f"{row['work']:9s} {row['mode']:8s} {row['method']:32s} h {row['h']:<8.3g} "
            f"{row.get('us_per_step', np.nan):8.2f} us/step {ratio:9s} {total:8.2f} ms  "
            f"error {row['error']:.1e}  energy {row['energy']:.0e}  "
            f"compile {row.get('compile_s', 0):5.1f} s"
        )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    marks = dict(exudyn="s", enerjax="o")
    for axis, work in zip(axes, ("pendulum", "top"), strict=True):
        for row in rows:
            if row["work"] == work and "steps" in row:
                seconds = row["us_per_step"] * row["steps"] / 1e6
                axis.loglog(seconds, row["error"], marks[row["mode"]], label=row["mode"])
                axis.annotate(row["method"], (seconds, row["error"]), fontsize=6)
        axis.set(title=f"double {work}" if work == "pendulum" else "heavy top")
        axis.set(xlabel="seconds of computation", ylabel="position error at the end")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, exudyn_rows)
