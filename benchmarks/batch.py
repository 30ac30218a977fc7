"""Ten thousand double pendulums in one batch, compared with diffrax.

    python benchmarks/batch.py [--out FOLDER] [--quick]

The masses and the length of the step differ in each lane; all are released from the
horizontal. `EnergyPreserving()` and diffrax (the extra `peers`; Tsit5 with the same fixed
steps, in the same Cartesian coordinates with the multipliers solved for) run as a `vmap`
over all lanes, and as a `lax.map` over chunks of them. Some lanes are compared with
explicit Runge-Kutta runs in minimal coordinates, and one with its run alone; a wrong answer
is reported and not timed. Times are medians over interleaved repeats, with XLA's default
settings and with `enable_fast_loops()` (two processes) on one core, or on the GPU that JAX
finds. Writes batch.json and batch.png.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import harness
import jax
import jax.numpy as jnp
import numpy as np

import enerjax as ej


H = 1e-3
# The largest errors of a correct result: of positions, of the energy (about 10 J are
# exchanged between its forms), and of a lane compared with a single run.
ERROR_BOUND, ENERGY_BOUND, LANE_BOUND = 1e-4, 1e-10, 1e-10
CHUNKS = (16, 64, 256)
G = 9.81


def problem() -> ej.problems.Problem:
    return ej.problems.chain(2, length=2.0, mass=2.0, g=G)


def lanes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Masses and steps."""
    rng = np.random.default_rng(0)
    return rng.uniform(0.5, 2.0, (count, 2)), H * rng.uniform(0.5, 1.5, count)


def ours(steps: int) -> Callable:
    """The end of a lane: positions, velocities and Newton corrections of a step."""
    system, start, args = problem()
    many_steps = harness.run_of(system, ej.EnergyPreserving(), steps)

    def run(m, h):
        solution = many_steps(start, args | dict(m=m), h)
        end = solution.ys
        return end.q[-1], end.v[-1], jnp.sum(solution.stats.newton_iterations) / steps

    return run


def accelerations(q: jax.Array, v: jax.Array, m: jax.Array) -> jax.Array:
    """Of the points, with the two multipliers that keep the rods."""
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


def diffrax_run(steps: int) -> Callable | None:
    diffrax = harness.peer("diffrax", "diffrax")
    if diffrax is None:
        return None
    start = problem().start

    def rates(t, y, m):
        del t
        return jnp.concatenate([y[4:], accelerations(y[:4], y[4:], m)])

    def run(m, h):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            diffrax.Tsit5(),
            0.0,
            h * steps,
            h,
            jnp.concatenate([start.q, start.v]),
            args=m,
            saveat=diffrax.SaveAt(t1=True),
            # The last step may fall a rounding error short of the end.
            max_steps=steps + 2,
        )
        return solution.ys[-1, :4], solution.ys[-1, 4:], jnp.zeros(())

    return run


def batched(run: Callable, chunk: int, count: int) -> Callable:
    if chunk >= count:
        return jax.vmap(run)
    return lambda m, h: jax.lax.map(lambda lane: run(*lane), (m, h), batch_size=chunk)


def energies(q: np.ndarray, v: np.ndarray, m: np.ndarray) -> np.ndarray:
    kinetic = 0.5 * np.sum(m * np.sum(v.reshape(-1, 2, 2) ** 2, axis=2), axis=1)
    return kinetic - G * np.sum(m * q[:, 1::2], axis=1)


def reference(m: np.ndarray, end: float) -> np.ndarray:
    """Positions of a lane at its end."""
    from references import solve, STRETCHED_DOUBLE_PENDULUM

    args = dict(m1=m[0], m2=m[1], l1=1.0, l2=1.0, g=G)
    return solve(STRETCHED_DOUBLE_PENDULUM, args, np.array([end])).q[-1]


def lane_alone(steps: int = 1000, count: int = 64, lane: int = 7) -> harness.Row:
    """The difference of a lane from a single run, and the change of its energy."""
    m, h = lanes(count)
    run = ours(steps)
    q, v, _ = jax.jit(jax.vmap(run))(m, h)
    alone, _, _ = jax.jit(run)(m[lane], h[lane])
    return dict(
        lane_difference=float(np.max(np.abs(q[lane] - alone))),
        lane_energy=float(np.max(np.abs(energies(np.asarray(q), np.asarray(v), m)))),
    )


def rows_of(quick: bool) -> list[harness.Row]:
    count, steps = (500, 50) if quick else (10_000, 50)
    m, h = lanes(count)
    some = range(0, count, count // 4)
    exact = {lane: reference(m[lane], steps * h[lane]) for lane in some}
    on_cpu = harness.device()["platform"] == "cpu"
    chunks = (*(CHUNKS[: 1 if quick else None] if on_cpu else ()), count)
    alone = lane_alone()
    rows, programs = [], []
    for name, run in (("enerjax", ours(steps)), ("diffrax", diffrax_run(steps))):
        for chunk in chunks:
            if run is None:
                continue
            program, seconds = harness.compiled(batched(run, chunk, count), m, h)
            q, v, iterations = (np.asarray(x) for x in program(m, h))
            row: harness.Row = dict(code=name, chunk=chunk, lanes=count, steps=steps)
            row["error"] = max(float(np.max(np.abs(q[k] - exact[k]))) for k in some)
            row["energy"] = float(np.max(np.abs(energies(q, v, m))))
            row |= alone if name == "enerjax" else {}
            rows.append(row | harness.device())
            right = row["error"] <= ERROR_BOUND
            if name == "enerjax":
                right &= max(row["energy"], row["lane_energy"]) <= ENERGY_BOUND
                right &= row["lane_difference"] <= LANE_BOUND
            if not right:
                print(f"{name} in chunks of {chunk} is wrong: {row}; not timed")
                continue
            rows[-1] |= dict(compile_s=seconds, iterations=float(np.mean(iterations)))
            programs.append(lambda p=program: p(m, h))
    timed = [row for row in rows if "compile_s" in row]
    times = harness.medians(programs, 3)
    for row, seconds in zip(timed, times, strict=True):
        row["ns_per_lane_step"] = 1e9 * seconds / (count * steps)
    return rows


def show(rows: list[harness.Row]) -> None:
    """Against the best of diffrax in the same process."""
    for row in rows:
        peers = [
            peer["ns_per_lane_step"]
            for peer in rows
            if peer["code"] == "diffrax"
            and peer["mode"] == row["mode"]
            and "ns_per_lane_step" in peer
        ]
        time = row.get("ns_per_lane_step", np.nan)
        ratio = f"x {time / min(peers):6.2f}" if peers else ""
        print(
            f"{row['device']:8s} {row['mode']:8s} {row['code']:8s} chunk {row['chunk']:6d} "
            f"{time:9.1f} ns/lane-step {ratio:9s} error {row['error']:.0e}  energy "
            f"{row['energy']:.0e}  alone {row.get('lane_difference', np.nan):.0e}  "
            f"iterations {row.get('iterations', np.nan):4.2f}  "
            f"compile {row.get('compile_s', np.nan):5.1f} s"
        )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    keys = sorted({(row["code"], row["mode"]) for row in rows})
    for code, mode in keys:
        line: list[Any] = [
            (row["chunk"], row["ns_per_lane_step"])
            for row in rows
            if (row["code"], row["mode"]) == (code, mode) and "ns_per_lane_step" in row
        ]
        style = "o-" if code == "enerjax" else "s--"
        axis.loglog(*np.array(line).T, style, label=f"{code}, {mode}")
    axis.set(xlabel="lanes in a chunk", ylabel="ns per lane and step")
    axis.legend()
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, rows_of, show, draw)
