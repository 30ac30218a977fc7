"""The cost of a step of a flexible beam against its elements, compared with EXUDYN.

    python benchmarks/beams.py [--out FOLDER] [--quick]

A soft pendulum falls from the horizontal for 0.2 s, in the plane and in space, with steps
of 1 ms, by `EnergyPreserving()`. In the plane EXUDYN (the extra `peers`) has the same
elements (`ObjectBeamGeometricallyExact2D`), and runs the generalized-alpha method, rho 0.9.
The energy and the levels of constraints are checked first, and the place of the tip against
EXUDYN's. Times are medians on one core, with XLA's default settings and with
`enable_fast_loops()`.
Writes beams.json and beams.png.
"""

from pathlib import Path

import harness
import numpy as np

import enerjax as ej


H, STEPS, LENGTH = 1e-3, 200, 0.5
SECTION = ej.Section.rectangle(0.002, 0.01, E=1e8, nu=0.3, rho=1000.0)
# The largest errors of a correct result: of the energy relative to that of the fall, of
# the pin, and of the tip relative to the length, for the meshes of both programs.
ENERGY_BOUND, LEVEL_BOUND, TIP_BOUND = 1e-10, 1e-10, 0.02


def pendulum(elements: int, dimension: int) -> ej.Scene:
    none = [0.0] * (dimension - 2)
    axis = [[0.0, 0.0, *none], [LENGTH, 0.0, *none]]
    beam = ej.bodies.Beam("beam", axis, SECTION, elements)
    pin = [0.0, 0.0, 1.0] if dimension == 3 else None
    joint = ej.joints.Revolute("pin", "ground", beam.start, axis[0], axis=pin)
    return ej.Scene([beam, joint], gravity=[0.0, -9.81, *none])


def sizes(quick: bool) -> list[tuple[int, int]]:
    in_plane, in_space = ((8, 32), (8,)) if quick else ((8, 32, 128, 512), (8, 32, 128))
    return [(2, n) for n in in_plane] + [(3, n) for n in in_space]


def our_rows(quick: bool) -> list[harness.Row]:
    rows, right_runs = [], []
    for dimension, elements in sizes(quick):
        scene = pendulum(elements, dimension)
        system, start, args = scene.build()
        begin = harness.clock()
        first = ej.simulate(
            system, ej.EnergyPreserving(), start, args, h=H, num_steps=1, throw=False
        )
        first.ys.q.block_until_ready()
        row: harness.Row = dict(
            work=elements,
            dimension=dimension,
            method="EnergyPreserving()",
            steps=STEPS,
            first_call_s=harness.clock() - begin,
        )
        program = ej.problems.Problem(system, start, args)
        run = harness.compiled_run(program, ej.EnergyPreserving(), H, STEPS)
        energy, level, _ = run.residuals()
        size = float(SECTION.numbers["rhoA"]) * 9.81 * LENGTH**2
        row |= dict(corrections=run.corrections(), energy=energy / size, level=level)
        row["tip"] = np.asarray(scene.position(run.solution.ys, "beam:end")[-1]).tolist()
        row["timed"] = row["energy"] <= ENERGY_BOUND and row["level"] <= LEVEL_BOUND
        if row["timed"]:
            right_runs.append((row, run))
        else:
            print(f"{elements} elements are wrong: {row}; not timed")
        rows.append(row)
    harness.add_step_times(right_runs, 3)
    return [row | harness.device() for row in rows]


def exudyn_rows(quick: bool) -> list[harness.Row]:
    exudyn = harness.peer("beams_exudyn", "EXUDYN")
    if exudyn is None:
        return []
    numbers = {
        key: float(x) for key, x in SECTION.in_dimension("beam", 2).items()
    }  # fmt: skip
    rows = []
    for dimension, elements in sizes(quick):
        if dimension == 3:
            continue
        time, tip = exudyn.timed_pendulum(numbers, LENGTH, elements, H, STEPS)
        rows.append(
            dict(
                work=elements,
                dimension=2,
                method="EXUDYN generalized-alpha, rho 0.9",
                mode="exudyn",
                steps=STEPS,
                us_per_step=time,
                tip=tip.tolist(),
            )
        )
    return rows


def show(rows: list[harness.Row]) -> None:
    peers = {row["work"]: row for row in rows if row["mode"] == "exudyn"}
    for row in rows:
        if "us_per_step" not in row:
            continue
        name = f"{row['dimension']}d {row['work']:4d} elements {row['mode']:8s}"
        line = f"{name} {row['us_per_step']:9.1f} us/step"
        peer = peers.get(row["work"])
        if peer and row["dimension"] == 2:
            apart = np.abs(np.subtract(row["tip"], peer["tip"])).max() / LENGTH
            line += f" x {row['us_per_step'] / peer['us_per_step']:5.2f}"
            assert apart <= TIP_BOUND, (row, peer)
        if "corrections" in row:
            line += (
                f" {row['corrections']:5.1f} corrections, energy {row['energy']:.0e}, "
                f"level {row['level']:.0e}, first call {row['first_call_s']:.1f} s"
            )
        print(line)


def draw(rows: list[harness.Row], path: Path) -> None:
    in_plane = [row for row in rows if row["dimension"] == 2]
    harness.draw_costs(in_plane, path, "elements", "a beam in the plane, h = 1 ms")


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, exudyn_rows)
