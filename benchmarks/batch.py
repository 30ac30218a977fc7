"""Batches of runs with different parameters, compared with single runs and with diffrax.

    python benchmarks/batch.py [--out FOLDER] [--quick] [--only WORK]

Four works: double pendulums, heavy tops, two hinged bodies in space, and car axes with a
driven mount. A parameter and the length of the step differ in each lane. Ours,
`EnergyPreserving()`, runs as a `vmap` over all lanes, and alone; diffrax (the extra
`peers`; Tsit5 with the same fixed steps, on the same model with the constraints
differentiated twice) as a `vmap`, and as a `lax.map` over chunks of lanes, of which the
fastest counts. Forward runs and their gradients by the parameter. A lane is compared with
its run alone, the energy with its balance, and the end with that of diffrax; a wrong answer
is reported and not timed. Times are medians over interleaved repeats on one core with XLA's
default settings, or on the GPU that JAX finds. At last a sweep of double pendulums runs on
one and on all cores of the machine, by the wall clock.
Writes batch.json and batch.png.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import harness
import jax
import jax.numpy as jnp
import numpy as np
import space_mechanisms

import enerjax as ej


H = 1e-3
# The largest differences of a correct result: of a lane from its run alone, of the energy
# from its balance relative to the largest kinetic or potential energy, of both from diffrax
# (truncation of the second order), and of gradients, relative to the largest.
LANE_BOUND, ENERGY_BOUND, ERROR_BOUND, GRADIENT_BOUND = 1e-11, 1e-11, 1e-3, 1e-8
CHUNKS = (16, 64, 256)
G = 9.81
# Asks a child process for the time of a sweep on so many cores.
_SWEEP = "--time-of-a-sweep"


class Work(NamedTuple):
    """Runs of a model whose `args` depend on a number of each lane."""

    mechanism: Callable[[], tuple[ej.AbstractSystem, ej.State, Any]]
    changed: Callable[[Any, Any], Any]
    h: float
    lanes: int
    steps: int


def problem() -> ej.problems.Problem:
    return ej.problems.chain(2, length=2.0, mass=2.0, g=G)


def two_bodies() -> tuple[ej.AbstractSystem, ej.State, Any]:
    return space_mechanisms.chain(2).scene().build()


def scaled(key: str) -> Callable[[Any, Any], Any]:
    return lambda args, x: args | {key: args[key] * x}


WORKS = {
    "double pendulum": Work(problem, scaled("m"), H, 2080, 200),
    "heavy top": Work(ej.problems.heavy_top, scaled("m"), 0.2 * H, 416, 200),
    "two bodies": Work(
        two_bodies,
        lambda args, x: args.set(gravity=jnp.stack([0.0 * x, 0.0 * x, -G * x])),
        H,
        416,
        100,
    ),
    "car axis": Work(ej.problems.car_axis, scaled("k"), H, 1040, 200),
}


def lanes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Masses of double pendulums, and steps."""
    rng = np.random.default_rng(0)
    return rng.uniform(0.5, 2.0, (count, 2)), H * rng.uniform(0.5, 1.5, count)


def ours(steps: int) -> Callable:
    """The end of a double pendulum: positions, velocities and corrections of a step."""
    system, start, args = problem()
    many_steps = harness.run_of(system, ej.EnergyPreserving(), steps)

    def run(m, h):
        solution = many_steps(start, args | dict(m=m), h)
        end = solution.ys
        return end.q[-1], end.v[-1], jnp.sum(solution.stats.newton_iterations) / steps

    return run


def our_lane(work: Work) -> Callable:
    """The end of a lane: positions, energy errors and corrections of a step."""
    system, start, args = work.mechanism()
    many_steps = harness.run_of(system, ej.EnergyPreserving(), work.steps)

    def run(x, h):
        solution = many_steps(start, work.changed(args, x), h)
        audit, stats = solution.audit, solution.stats
        size = jnp.max(jnp.maximum(jnp.abs(audit.kinetic), jnp.abs(audit.potential)))
        error = jnp.max(jnp.abs(audit.leak)) / size
        return solution.ys.q[-1], error, jnp.sum(stats.newton_iterations) / work.steps

    return run


def accelerations(q: jax.Array, v: jax.Array, m: jax.Array) -> jax.Array:
    """Of the points of a double pendulum, with the multipliers that keep the rods."""
    inner, outer = q[:2], q[2:] - q[:2]
    inner_rate, outer_rate = v[:2], v[2:] - v[:2]
    # Phi'' = 0 along the motion: a linear system for the tensions per length.
    a = inner @ inner * (1 / m[0])
    b = -inner @ outer * (1 / m[0])
    c = outer @ outer * (1 / m[0] + 1 / m[1])
    d = inner_rate @ inner_rate + G * inner[1]
    e = outer_rate @ outer_rate
    determinant = a * c - b * b
    first, second = (c * d - b * e) / determinant, (a * e - b * d) / determinant
    gravity = jnp.array([0.0, G])
    return jnp.concatenate(
        [
            gravity + (second * outer - first * inner) / m[0],
            gravity - second * outer / m[1],
        ]
    )


def diffrax_lane(name: str) -> Callable | None:
    """The end of a lane by diffrax: positions."""
    diffrax = harness.peer("diffrax", "diffrax")
    if diffrax is None:
        return None
    work = WORKS[name]
    system, start, args = work.mechanism()

    def by_hand(t, y, m):
        del t
        q, v = y
        return v, accelerations(q, v, m)

    def run(x, h):
        own = work.changed(args, x)
        if name == "double pendulum":
            term, begin = diffrax.ODETerm(by_hand), (start.q, start.v)
        else:
            term, begin = ej.to_diffrax(system, start, own)
        solution = diffrax.diffeqsolve(
            term,
            diffrax.Tsit5(),
            0.0,
            h * work.steps,
            h,
            begin,
            args=own["m"] if name == "double pendulum" else None,
            saveat=diffrax.SaveAt(t1=True),
            # The last step may fall a rounding error short of the end.
            max_steps=work.steps + 2,
        )
        return solution.ys[0][-1]

    return run


def batched(run: Callable, chunk: int, count: int) -> Callable:
    if chunk >= count:
        return jax.vmap(run)
    return lambda x, h: jax.lax.map(lambda lane: run(*lane), (x, h), batch_size=chunk)


def slope(run: Callable) -> Callable:
    """The gradient, by the parameter, of a sum over the end of a run."""
    return jax.grad(lambda x, h: jnp.sum(jnp.sin(run(x, h))))


def rows_of(quick: bool, works: Any) -> list[harness.Row]:
    rows = []
    for name in works:
        work = WORKS[name]
        work = work._replace(lanes=work.lanes // 4) if quick else work
        rows += of_work(name, work, quick)
    return rows


def of_work(name: str, work: Work, quick: bool) -> list[harness.Row]:
    rng = np.random.default_rng(0)
    x = rng.uniform(0.8, 1.2, work.lanes)
    h = work.h * rng.uniform(0.5, 1.5, work.lanes)
    ours, other = our_lane(work), diffrax_lane(name)
    rows: list[harness.Row] = []
    programs: list[Callable] = []

    def add(kind: str, code: str, run: Callable, chunk: int) -> Any:
        """Compiles a program, and returns its result."""
        single = chunk == 1
        inputs = (x[0], h[0]) if single else (x, h)
        fn = run if single else batched(run, chunk, work.lanes)
        program, seconds = harness.compiled(fn, *inputs)
        repeats = 20 if single else 1
        again = lambda: [program(*inputs) for _ in range(repeats)][-1]
        row = dict(work=name, kind=kind, code=code, chunk=chunk, lanes=len(h))
        row |= dict(steps=work.steps, compile_s=seconds) | harness.device()
        row["of"] = work.steps * (repeats if single else work.lanes)
        rows.append(row)
        programs.append(again)
        return jax.tree.map(np.asarray, again())

    q, energy, corrections = add("forward", "enerjax", ours, work.lanes)
    alone, _, _ = add("forward", "single", ours, 1)
    rows[0] |= dict(
        lane_difference=float(np.max(np.abs(q[0] - alone))),
        energy=float(np.max(energy)),
        corrections=float(np.mean(corrections)),
    )
    of_end = lambda x, h: ours(x, h)[0]
    found = add("gradient", "enerjax", slope(of_end), work.lanes)
    alone = add("gradient", "single", slope(of_end), 1)
    rows[-2]["lane_difference"] = float(np.abs(found[0] - alone) / np.max(np.abs(found)))
    right = rows[0]["lane_difference"] <= LANE_BOUND and rows[0]["energy"] <= ENERGY_BOUND
    right &= rows[-2]["lane_difference"] <= GRADIENT_BOUND
    if other is not None:
        for chunk in (*CHUNKS[1 : 2 if quick else None], work.lanes):
            end = add("forward", "diffrax", other, chunk)
            rows[-1]["error"] = float(np.max(np.abs(end - q)))
            right &= rows[-1]["error"] <= ERROR_BOUND
        add("gradient", "diffrax", slope(other), CHUNKS[1])
    if not right:
        print(f"{name} is wrong: {rows}; not timed")
        return rows
    times = harness.medians(programs, 3)
    for row, seconds in zip(rows, times, strict=True):
        row["ns_per_lane_step"] = 1e9 * seconds / row.pop("of")
    return rows


# All cores ------------------------------------------------------------------------------


def seconds_of_a_sweep() -> float:
    """The time of a sweep by the wall clock, without its compilation."""
    run = ours(200)
    m, h = lanes(6 * 2080)
    moments: list[float] = []
    ej.sweep(
        lambda lane: run(**lane)[0],
        {"lane": dict(m=m, h=h)},
        chunk=2080,
        progress=lambda done, total: moments.append(time.perf_counter()),
    )
    return moments[-1] - moments[0]


def rows_of_cores(quick: bool, works: Any) -> list[harness.Row]:
    """A sweep on one core, and on all."""
    del quick
    if "double pendulum" not in works or jax.default_backend() != "cpu":
        return []
    rows = []
    for cores in (1, os.cpu_count() or 1):
        out = subprocess.run(
            [sys.executable, __file__, _SWEEP, str(cores)],
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        row = dict(work="double pendulum", kind="sweep", code="enerjax", mode="enerjax")
        rows.append(row | dict(cores=cores, seconds=json.loads(out.stdout)))
    return rows


def show(rows: list[harness.Row]) -> None:
    """Against single runs, and against the best of diffrax."""
    time_of = lambda row: row.get("ns_per_lane_step", np.nan)
    for row in rows:
        if row["kind"] == "sweep":
            print(f"sweep on {row['cores']} cores: {row['seconds']:.2f} s")
            continue
        same = [x for x in rows if (x["work"], x["kind"]) == (row["work"], row["kind"])]
        ratios = ""
        if row["code"] == "enerjax":
            for code in ("single", "diffrax"):
                others = [time_of(x) for x in same if x["code"] == code]
                ratios += f" {time_of(row) / min(others, default=np.nan):5.2f} {code}"
        print(
            f"{row['work']:16s} {row['kind']:8s} {row['code']:8s} chunk {row['chunk']:5d} "
            f"{time_of(row):9.1f} ns/lane-step{ratios:28s} "
            f"compile {row['compile_s']:5.1f} s"
            + "".join(
                f"  {key} {row[key]:.2g}"
                for key in ("lane_difference", "energy", "error", "corrections")
                if key in row
            )
        )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
    works = list(dict.fromkeys(row["work"] for row in rows))
    place = np.arange(len(works))
    bars = [
        (code, kind)
        for kind in ("forward", "gradient")
        for code in ("enerjax", "single", "diffrax")
    ]
    for k, (code, kind) in enumerate(bars):
        heights = [
            min(
                (
                    row.get("ns_per_lane_step", np.nan)
                    for row in rows
                    if (row["work"], row["code"], row["kind"]) == (work, code, kind)
                ),
                default=np.nan,
            )
            for work in works
        ]
        axis.bar(place + 0.13 * (k - 2.5), heights, 0.13, label=f"{code}, {kind}")
    axis.set_xticks(place, works)
    axis.set(ylabel="ns per lane and step", yscale="log")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    if _SWEEP in sys.argv:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, range(int(sys.argv[-1])))
        jax.config.update("jax_enable_x64", True)
        print(seconds_of_a_sweep())
    else:
        harness.run(
            __file__,
            rows_of,
            show,
            draw,
            peers=rows_of_cores,
            works=tuple(WORKS),
            xla_flags=harness.FAST_LOOPS,
        )
