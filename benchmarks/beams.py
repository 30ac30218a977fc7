"""Flexible beams: cost of a step, error against time, and gradients, beside EXUDYN.

    python benchmarks/beams.py [--out FOLDER] [--quick]

A soft pendulum falls from the horizontal for 0.2 s, in the plane and in space, with steps
of 1 ms, by `EnergyPreserving()`. In the plane EXUDYN (the extra `peers`) has the same
elements (`ObjectBeamGeometricallyExact2D`), and runs the generalized-alpha method, rho 0.9.
The energy and the levels of constraints are checked first, and the place of the tip against
EXUDYN's. Times are medians on one core.

The errors of the place of the tip after 0.5 s, with 8 elements in the plane, are those of
the step alone: each program is compared with its own run with steps of 25 us. Times of our
runs are those of a step times their number.

The gradient of the height of a tip is that by the bending stiffness, the load and the mass
of a weight at the tip, of a cantilever that falls. It must agree with central differences,
or it is not timed.
Writes beams.json and beams.png.
"""

import functools
from collections.abc import Callable
from pathlib import Path

import harness
import jax
import jax.numpy as jnp
import numpy as np

import enerjax as ej


H, STEPS, LENGTH = 1e-3, 200, 0.5
SECTION = ej.Section.rectangle(0.002, 0.01, E=1e8, nu=0.3, rho=1000.0)
# The largest errors of a correct result: of the energy relative to that of the fall, of
# the pin, and of the tip relative to the length, for the meshes of both programs.
ENERGY_BOUND, LEVEL_BOUND, TIP_BOUND = 1e-10, 1e-10, 0.02
# The duration of the runs whose errors are compared, their elements, the numbers of their
# steps, and that of the converged run.
DURATION, COMPARED, STEP_COUNTS, CONVERGED = 0.5, 8, (250, 500, 1000, 2000, 4000), 20_000
# The largest error of a right gradient, relative: a difference has half of the digits.
DIFFERENCE_BOUND = 1e-6
# The works of the rows: the cost of a step at this number of elements, and these.
ACCURACY, GRADIENT = "accuracy", "gradient"


def pendulum(elements: int, dimension: int) -> ej.Scene:
    none = [0.0] * (dimension - 2)
    axis = [[0.0, 0.0, *none], [LENGTH, 0.0, *none]]
    beam = ej.bodies.Beam("beam", axis, SECTION, elements)
    pin = [0.0, 0.0, 1.0] if dimension == 3 else None
    joint = ej.joints.Revolute("pin", "ground", beam.start, axis[0], axis=pin)
    return ej.Scene([beam, joint], gravity=[0.0, -9.81, *none])


def sizes(quick: bool) -> list[tuple[int, int]]:
    in_plane, in_space = ((8, 32, 512), (8,)) if quick else ((8, 32, 128, 512), (8, 32))
    return [(2, n) for n in in_plane] + [(3, n) for n in in_space]


def our_rows(quick: bool) -> list[harness.Row]:
    rows, right_runs = [], []
    for dimension, elements in sizes(quick):
        scene = pendulum(elements, dimension)
        system, start, args = scene.build()
        begin = harness.clock()
        program = ej.problems.Problem(system, start, args)
        run = harness.compiled_run(program, ej.EnergyPreserving(), H, STEPS)
        jax.block_until_ready(run.solution.ys.q)
        row: harness.Row = dict(
            work=elements,
            dimension=dimension,
            method="EnergyPreserving()",
            steps=STEPS,
            first_call_s=harness.clock() - begin,
        )
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
    rows += accuracy_rows() + gradient_rows(quick)
    return [row | harness.device() for row in rows]


def accuracy_rows() -> list[harness.Row]:
    """Errors and times of runs with steps of several lengths, by one program."""
    scene = pendulum(COMPARED, 2)
    system, start, args = scene.build()

    @jax.jit
    def places(h):
        scheme, steps = ej.EnergyPreserving(), CONVERGED
        sol = ej.simulate(system, scheme, start, args, h=h, num_steps=steps, throw=False)
        return scene.position(sol.ys, "beam:end")

    exact = np.asarray(places(DURATION / CONVERGED)[-1])
    lengths = [DURATION / count for count in STEP_COUNTS]
    programs = [lambda h=h: places(h) for h in lengths]
    rows = []
    times = harness.medians(programs, 3)
    for count, h, seconds in zip(STEP_COUNTS, lengths, times, strict=True):
        tip = np.asarray(places(h)[count])
        time = 1e6 * seconds / CONVERGED
        rows.append(_accuracy_row("EnergyPreserving()", count, tip, exact, time))
    return rows


def _accuracy_row(
    method: str, steps: int, tip: np.ndarray, exact: np.ndarray, us_per_step: float
) -> harness.Row:
    row: harness.Row = dict(work=ACCURACY, dimension=2, method=method, steps=steps)
    row |= dict(us_per_step=us_per_step, converged_tip=exact.tolist())
    return row | dict(error=float(np.abs(tip - exact).max()) / LENGTH)


def _milliseconds(row: harness.Row) -> float:
    """The time of a whole run."""
    return 1e-3 * row["us_per_step"] * row["steps"]


def gradient_rows(quick: bool) -> list[harness.Row]:
    rows = []
    for dimension, elements in ((2, 8),) if quick else ((2, 8), (3, 4)):
        tip = falling_tip(dimension, elements)
        at = jnp.array([2.0, -1.0, 0.3])
        forward, seconds = harness.compiled(tip, at)
        reverse, gradient_seconds = harness.compiled(jax.value_and_grad(tip), at)
        slopes = np.asarray(reverse(at)[1])
        off = max(
            abs(_difference(forward, at, k) / slope - 1) for k, slope in enumerate(slopes)
        )
        row: harness.Row = dict(work=GRADIENT, dimension=dimension, elements=elements)
        row |= dict(off_difference=off, compile_s=gradient_seconds, compile_run_s=seconds)
        rows.append(row)
        if not off <= DIFFERENCE_BOUND:
            print(f"the gradient in {dimension}d is off by {off}: not timed")
            continue
        programs = [functools.partial(program, at) for program in (forward, reverse)]
        run, gradient = harness.medians(programs, 5)
        row |= dict(run_us=1e6 * run / STEPS, ratio=gradient / run)
    return rows


def falling_tip(dimension: int, elements: int) -> Callable[[jax.Array], jax.Array]:
    """The height of the tip of a cantilever as a function of EI, a load and a weight."""
    up, tip_at = np.eye(dimension)[1], np.eye(dimension)[0]
    section = ej.Section(EA=1e3, GA=1e3, EI=2.0, GJ=1.5, rhoA=1.0, rhoI=1e-2)
    beam = ej.bodies.Beam("beam", [0 * tip_at, tip_at], section, elements)
    scene = ej.Scene(
        [
            beam,
            ej.joints.Fixed("clamp", "ground", beam.start),
            ej.bodies.PointMass("weight", 0.3, tip_at),
            ej.joints.Spherical("screw", beam.end, "weight"),
            ej.forces.ConstantForce("load", beam.end, 0 * up),
        ],
        gravity=-5.0 * up,
    )
    system, start, args = scene.build()

    def tip(x):
        EI, load, mass = x
        of_beam = EI if dimension == 2 else jnp.stack([EI, EI])
        changed = args.set("load", force=load * up).set("beam", EI=of_beam)
        program = harness.run_of(system, ej.EnergyPreserving(), STEPS)
        sol = program(start, changed.set("weight", mass=mass), 0.02)
        return scene.position(sol.ys, beam.end)[-1, 1]

    return tip


def _difference(value: Callable, at: jax.Array, k: int) -> float:
    """The derivative of two quotients, without the error of second order."""
    step = 1e-4 * jnp.abs(at[k]) * jnp.eye(at.size)[k]
    by = lambda step: float(value(at + step) - value(at - step))
    return (8 * by(step) - by(2 * step)) / (12 * float(step[k]))


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
    run = lambda count: exudyn.timed_pendulum(
        numbers, LENGTH, COMPARED, DURATION / count, count
    )
    exact = run(CONVERGED)[1]
    for count in STEP_COUNTS:
        time, tip = run(count)
        method = "EXUDYN generalized-alpha, rho 0.9"
        row = _accuracy_row(method, count, tip, exact, time)
        rows.append(row | dict(mode="exudyn"))
    return rows


def show(rows: list[harness.Row]) -> None:
    peers = {row["work"]: row for row in rows if row["mode"] == "exudyn"}
    for row in rows:
        if row["work"] == ACCURACY:
            print(
                f"{row['mode']:8s} {row['steps']:5d} steps: error {row['error']:.1e} of "
                f"the length, {_milliseconds(row):.1f} ms"
            )
        elif row["work"] == GRADIENT:
            print(
                f"{row['mode']:8s} gradient in {row['dimension']}d: off "
                f"{row['off_difference']:.0e}, x {row.get('ratio', np.nan):.2f} of a run, "
                f"compiled in {row['compile_s']:.1f} s, the run {row['compile_run_s']:.1f}"
            )
        elif "us_per_step" in row:
            _show_cost(row, peers.get(row["work"]))


def _show_cost(row: harness.Row, peer: harness.Row | None) -> None:
    name = f"{row['dimension']}d {row['work']:4d} elements {row['mode']:8s}"
    line = f"{name} {row['us_per_step']:9.1f} us/step"
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
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for mode, mark in (("exudyn", "s-"), ("enerjax", "o-")):
        own = [row for row in rows if row["mode"] == mode and row["dimension"] == 2]
        costs = [row for row in own if "us_per_step" in row and "error" not in row]
        sizes, times = ([row[key] for row in costs] for key in ("work", "us_per_step"))
        left.loglog(sizes, times, mark, label=mode)
        compared = [row for row in own if row["work"] == ACCURACY]
        errors = [row["error"] for row in compared]
        right.loglog([_milliseconds(row) for row in compared], errors, mark, label=mode)
    title = "a beam in the plane, h = 1 ms"
    left.set(xlabel="elements", ylabel="microseconds a step", title=title)
    title = f"{COMPARED} elements, steps of {_length(-1)} to {_length(0)} ms"
    right.set(xlabel="milliseconds", ylabel="error of the tip / length", title=title)
    left.legend()
    figure.savefig(path, dpi=130)


def _length(k: int) -> float:
    return 1e3 * DURATION / STEP_COUNTS[k]


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, exudyn_rows)
