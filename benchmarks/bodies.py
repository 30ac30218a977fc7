"""The cost of a step against the number of bodies in space, compared with EXUDYN.

    python benchmarks/bodies.py [--out FOLDER] [--quick]

Chains of `N` bodies on hinges, whose axes point along y and z in turn, fall from the
horizontal with steps of 1 ms, by `EnergyPreserving()` and bodies of the kind `RigidBody`.
The balance of the energy, the constraints and the position of the last body, against a run
with half the step, are checked first; a wrong answer is not timed. EXUDYN (the extra
`peers`) runs the generalized-alpha method, rho 0.9, on the same chains in Euler parameters;
its end must agree too. Times are medians over interleaved repeats, on one core, with XLA's
default settings and with `enable_fast_loops()` (two processes). Writes bodies.json and
bodies.png.
"""

import time
from pathlib import Path

import harness
import jax
import numpy as np

import enerjax as ej


H = 1e-3
INERTIA = np.array([0.01, 0.1, 0.1])
STEPS = {1: 2000, 2: 2000, 6: 1000, 16: 500, 64: 200}
# The largest errors: of the energy relative to that of the fall, of both constraint levels,
# and of the position.
ENERGY_BOUND, LEVEL_BOUND, ERROR_BOUND = 1e-11, 1e-10, 1e-4


def scene(num_bodies: int) -> ej.Scene:
    parts: list = []
    for k in range(num_bodies):
        parts.append(ej.bodies.RigidBody(f"body{k}", 1.0, INERTIA, [k + 0.5, 0, 0]))
        parts.append(
            ej.joints.Revolute(
                f"hinge{k}",
                "ground" if k == 0 else f"body{k - 1}",
                f"body{k}",
                axis=[0, 1, 0] if k % 2 == 0 else [0, 0, 1],
                point_b=[-0.5, 0, 0],
            )
        )
    return ej.Scene(parts, gravity=[0, 0, -9.81])


def sizes(quick: bool) -> tuple[int, ...]:
    return (2, 6) if quick else tuple(STEPS)


def last_body(q: jax.Array) -> np.ndarray:
    return np.asarray(q[-12:-9])


def our_rows(quick: bool) -> list[harness.Row]:
    rows, right_runs = [], []
    for num_bodies in sizes(quick):
        mechanism = system, start, args = scene(num_bodies).build()
        steps = STEPS[num_bodies]
        begin = time.perf_counter()
        run = harness.compiled_run(mechanism, ej.EnergyPreserving(), H, steps)
        first_call = time.perf_counter() - begin
        half = ej.simulate(
            system,
            ej.EnergyPreserving(),
            start,
            args,
            h=H / 2,
            num_steps=2 * steps,
            saveat=ej.SaveAt(t1=True),
        )
        end = last_body(run.solution.ys.q[-1])
        energy, level, rate = run.residuals()
        fall = 9.81 * num_bodies**2 / 2
        row: harness.Row = dict(
            work=num_bodies,
            method="EnergyPreserving()",
            steps=steps,
            compile_s=run.compile_s,
            first_call_s=first_call,
            corrections=run.corrections(),
            energy=energy / fall,
            level=level,
            rate=rate,
            error=float(np.max(np.abs(end - last_body(half.end.q)))) / num_bodies,
            end=end.tolist(),
        )
        right = row["energy"] <= ENERGY_BOUND and row["error"] <= ERROR_BOUND
        right = right and max(row["level"], row["rate"]) <= LEVEL_BOUND * num_bodies
        if right:
            right_runs.append((row, run))
        else:
            print(f"N = {num_bodies} is wrong: {row}; not timed")
        row["timed"] = right
        rows.append(row)
    harness.add_step_times(right_runs, 5)
    return [row | harness.device() for row in rows]


def exudyn_rows(quick: bool) -> list[harness.Row]:
    exudyn = harness.peer("bodies_exudyn", "EXUDYN")
    if exudyn is None:
        return []
    rows = []
    for n in sizes(quick):
        us_per_step, end = exudyn.run(n, INERTIA, H, STEPS[n])
        rows.append(
            dict(
                work=n,
                method="EXUDYN generalized-alpha, rho 0.9",
                mode="exudyn",
                steps=STEPS[n],
                us_per_step=us_per_step,
                end=end.tolist(),
            )
        )
    return rows


def show(rows: list[harness.Row]) -> None:
    peers = {row["work"]: row for row in rows if row["mode"] == "exudyn"}
    for row in rows:
        if "us_per_step" not in row:
            continue
        line = f"N {row['work']:4d} {row['mode']:8s} {row['us_per_step']:8.1f} us/step"
        if "corrections" in row:
            peer = peers.get(row["work"])
            if peer:
                apart = np.max(np.abs(np.subtract(row["end"], peer["end"])))
                ratio = row["us_per_step"] / peer["us_per_step"]
                line += f" x {ratio:5.2f}, ends differ by {apart:.0e};"
            line += (
                f" {row['corrections']:.1f} corrections, energy {row['energy']:.0e}, "
                f"levels {row['level']:.0e} {row['rate']:.0e}, error {row['error']:.0e}, "
                f"first call {row['first_call_s']:.1f} s"
            )
        print(line)


def draw(rows: list[harness.Row], path: Path) -> None:
    harness.draw_costs(rows, path, "bodies", "hinged bodies, h = 1 ms")


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, exudyn_rows)
