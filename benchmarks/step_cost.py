"""What a step costs: our schemes beside EXUDYN, on the double pendulum and the heavy top.

    python benchmarks/step_cost.py [--out FOLDER]

Each row is a run, whose error is measured first; a wrong answer is reported and not timed.
Times are medians over interleaved repeats, of the processor (so that other processes do
not count) on one core (the process pins itself), with XLA's default settings and with
`enable_fast_loops()` (two processes). The pendulum is released from the horizontal, two
unit rods and masses; the top is `problems.heavy_top`.
EXUDYN (the extra `peers`) runs the generalized-alpha method, rho 0.9, in the same Cartesian
coordinates. Writes step_cost.json and step_cost.png.
"""

import argparse
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import enerjax as ej


REPEATS = 7
# When the errors are taken.
PENDULUM_END, TOP_END = 10.0, 1.0
# Schemes, steps, and the largest error that is still a right answer.
PENDULUM = [
    ("EnergyPreserving()", 1e-3, 1e-2),
    ("EnergyDecaying(0.5)", 1e-3, 1e-2),
    ("EnergyConsistent(0.0)", 1e-3, 1e-4),
    ("EnergyConsistent(0.5)", 1e-3, 1e-3),
    ("EnergyConsistent(0.0)", 1e-2, 1e-2),
    ("Composed(EnergyPreserving(), 4)", 4e-3, 1e-3),
]
TOP = [
    ("EnergyPreserving()", 1e-3, 3e-2),
    ("Composed(EnergyPreserving(), 4)", 2e-3, 1e-3),
]


def scheme_of(name: str) -> ej.AbstractScheme:
    names = {k: getattr(ej, k) for k in dir(ej) if k[0].isupper()}
    return eval(name, {"__builtins__": {}}, names)


def reference() -> dict[str, np.ndarray]:
    """Positions at the end, from explicit Runge-Kutta runs in minimal coordinates."""
    from references import DOUBLE_PENDULUM, HEAVY_TOP, solve

    stretched = dataclasses.replace(
        DOUBLE_PENDULUM, start=lambda args: np.array([np.pi / 2, np.pi / 2, 0, 0])
    )
    pendulum = dict(m1=1.0, m2=1.0, l1=1.0, l2=1.0, g=9.81)
    top = ej.problems.heavy_top().args
    ends = (
        solve(stretched, pendulum, np.array([PENDULUM_END])),
        solve(HEAVY_TOP, top, np.array([TOP_END])),
    )
    return dict(pendulum=ends[0].q[-1], top=ends[1].q[-1][:3])


def problem_of(work: str) -> ej.problems.Problem:
    if work == "pendulum":
        return ej.problems.chain(2, length=2.0, mass=2.0)
    return ej.problems.heavy_top()


def our_runs(exact: dict[str, list[float]]) -> list[dict]:
    """Rows of this process, timed in turn."""
    rows: list[dict] = []
    programs: list[Callable] = []
    for work, table, end in (("pendulum", PENDULUM, PENDULUM_END), ("top", TOP, TOP_END)):
        system, start, args = problem_of(work)
        for name, h, bound in table:
            steps = round(end / h)
            scheme = scheme_of(name)

            def run(
                start, args, h, *, system=system, scheme=scheme, steps=steps
            ) -> ej.Solution:
                return ej.simulate(
                    system, scheme, start, args, h=h, num_steps=steps, save_every=steps
                )

            begin = time.process_time()
            program = jax.jit(run).lower(start, args, h).compile()
            seconds = time.process_time() - begin
            solution = program(start, args, h)
            position = np.asarray(solution.ys.q[-1])[: len(exact[work])]
            error = float(np.max(np.abs(position - exact[work])))
            energy = solution.audit.energy
            leak = float(abs(energy[-1] - energy[0] + solution.audit.dissipated[-1]))
            row = dict(work=work, method=name, h=h, error=error, energy=leak)
            if error <= bound:
                row |= dict(steps=steps, compile_s=seconds)
                iterations = solution.stats.newton_iterations
                row["iterations"] = float(np.mean(iterations))
                programs.append(lambda p=program, x=(start, args, h): p(*x))
            else:
                print(f"{name} on the {work} is off by {error:.1e}: not timed")
            rows.append(row)
    timed = [row for row in rows if "steps" in row]
    times: list[list[float]] = [[] for _ in timed]
    for _ in range(REPEATS):
        for program, record in zip(programs, times, strict=True):
            begin = time.process_time()
            jax.block_until_ready(program())
            record.append(time.process_time() - begin)
    for row, record in zip(timed, times, strict=True):
        row["us_per_step"] = 1e6 * statistics.median(record) / row["steps"]
    return rows


def exudyn_runs(exact: dict[str, list[float]]) -> list[dict]:
    """The same work by EXUDYN, or no rows where it is not installed."""
    try:
        import step_cost_exudyn
    except ImportError:
        print("EXUDYN is not installed (extra `peers`): no rows to compare with")
        return []
    return step_cost_exudyn.rows(exact, PENDULUM_END, TOP_END, REPEATS)


def child(mode: str, exact: dict) -> list[dict]:
    """Rows of a process of its own."""
    command = [sys.executable, __file__, "--mode", mode]
    out = subprocess.run(
        command, input=json.dumps(exact), capture_output=True, text=True, check=True
    )
    *messages, data = out.stdout.splitlines()
    print("\n".join(messages)) if messages else None
    return [row | dict(mode=mode) for row in json.loads(data)]


def show(rows: list[dict]) -> None:
    anchors = {r["work"]: r["us_per_step"] for r in rows if r["mode"] == "exudyn"}
    for row in rows:
        anchor = anchors.get(row["work"])
        ratio = f"x {row['us_per_step'] / anchor:6.2f}" if anchor and "steps" in row else ""
        total = row.get("us_per_step", np.nan) * row.get("steps", 0) / 1e3
        print(
            f"{row['work']:9s} {row['mode']:8s} {row['method']:32s} h {row['h']:.0e} "
            f"{row.get('us_per_step', np.nan):8.2f} us/step {ratio:9s} {total:8.2f} ms  "
            f"error {row['error']:.1e}  energy {row['energy']:.0e}  "
            f"compile {row.get('compile_s', 0):5.1f} s"
        )


def draw(rows: list[dict], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    marks = dict(exudyn="s", default="o", fast="^")
    for axis, work in zip(axes, ("pendulum", "top"), strict=True):
        for row in rows:
            if row["work"] == work and "steps" in row:
                seconds = row["us_per_step"] * row["steps"] / 1e6
                axis.loglog(seconds, row["error"], marks[row["mode"]], label=row["mode"])
                axis.annotate(row["method"], (seconds, row["error"]), fontsize=6)
        axis.set(title=f"double {work}" if work == "pendulum" else "heavy top")
        axis.set(xlabel="seconds of computation", ylabel="position error at the end")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description="What a step costs.")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--mode", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if options.mode == "exudyn":
        print(json.dumps(exudyn_runs(json.load(sys.stdin))))
        return
    if options.mode is not None:
        if options.mode == "fast":
            ej.enable_fast_loops()
        jax.config.update("jax_enable_x64", True)
        print(json.dumps(our_runs(json.load(sys.stdin))))
        return
    jax.config.update("jax_enable_x64", True)
    exact = {work: x.tolist() for work, x in reference().items()}
    rows = [row for mode in ("exudyn", "default", "fast") for row in child(mode, exact)]
    show(rows)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "step_cost.json").write_text(json.dumps(rows, indent=1))
    draw(rows, options.out / "step_cost.png")


if __name__ == "__main__":
    main()
