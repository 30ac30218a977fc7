"""Energy in long runs: 1e4 seconds of a double pendulum and of a heavy top.

    python benchmarks/long_run.py [--out FOLDER] [--quick]

Two rods of a metre from the horizontal, and the top in directors. Ours, and
diffrax in minimal coordinates, down to the smallest tolerances;
EXUDYN's generalized-alpha method (extra `peers`). Each row: seconds of the processor, and
the largest error of the energy at a thousand times of the run, which are ends of steps, in
parts of what the mechanism turns over. EXUDYN's is that at the end of its run, of the top
after 100 seconds. With `--quick` all run for 100 seconds. Writes long_run.json and .png.
"""

import time
from collections.abc import Callable
from pathlib import Path

import harness
import jax
import jax.numpy as jnp
import numpy as np
from speed_accuracy_peers import spin, swing, turned

import enerjax as ej


END, QUICK_END = 1e4, 1e2
SAVES = 1000
# What the energy is measured in: sum m g r of the pendulum, the energy of the top.
PENDULUM_ENERGY, TOP_ENERGY = 9.81 * 3, 5436.0
OURS: list[tuple[str, str, Callable[[], ej.AbstractScheme], float]] = [
    ("double pendulum", "EnergyConsistent(0)", lambda: ej.EnergyConsistent(0.0), 1e-2),
    ("double pendulum", "EnergyPreserving", lambda: ej.EnergyPreserving(), 4e-3),
    ("heavy top", "EnergyPreserving", lambda: ej.EnergyPreserving(), 4e-3),
]


EXUDYN_STEPS = [
    ("double pendulum", 4e-3),
    ("double pendulum", 1e-3),
    ("heavy top", 1e-3),
    ("heavy top", 2.5e-4),
]
TOLERANCES = {"double pendulum": (1e-6, 1e-9, 1e-12, 1e-14), "heavy top": (1e-9, 1e-12)}


def our_rows(quick: bool) -> list[harness.Row]:
    end = QUICK_END if quick else END
    rows = []
    for work, label, make, h in OURS:
        is_top = work == "heavy top"
        problem = (
            ej.problems.heavy_top_directors()
            if is_top
            else ej.problems.chain(2, length=2.0, mass=2.0)
        )
        system, start, args = problem
        steps = round(end / h)
        run = harness.run_of(system, make(), steps, every=steps // SAVES)
        program, _ = harness.compiled(run, start, args, h)
        begin = harness.clock()
        audit = jax.block_until_ready(program(start, args, h)).audit
        seconds = harness.clock() - begin
        levels = [
            float(np.max(np.abs(x))) for x in (audit.constraint, audit.constraint_rate)
        ]
        row = dict(work=work, solver=label, setting=f"h {h:g}", seconds=seconds)
        row |= dict(energy=_change(work, np.asarray(audit.energy)), levels=levels)
        rows.append(row | harness.device())
    return rows + _diffrax_rows(end)


def _diffrax_rows(end: float) -> list[harness.Row]:
    try:
        import diffrax  # pyright: ignore[reportMissingImports]
    except ImportError:
        return []
    top = ej.problems.heavy_top().args
    forms: list[tuple] = [
        ("double pendulum", swing, jnp.zeros(4), jnp.ones(2), _pendulum_energy),
        ("heavy top", spin, jnp.array(TOP_START), top, lambda y: _top_energy(y, top)),
    ]
    rows = []
    for work, rates, y0, args, energy_of in forms:

        def solve(y0, tolerance, rates=rates, args=args):
            # From one time to the next: the interpolant is less accurate than the steps.
            def go_on(y, t):
                out = diffrax.diffeqsolve(
                    diffrax.ODETerm(rates),
                    diffrax.Dopri8(),
                    t,
                    t + end / SAVES,
                    None,
                    y,
                    args,
                    saveat=diffrax.SaveAt(t1=True),
                    stepsize_controller=diffrax.PIDController(tolerance, tolerance),
                    max_steps=10**6,
                    adjoint=diffrax.ForwardMode(),
                )
                after = jnp.asarray(out.ys)[0]
                return after, after

            ts = end / SAVES * jnp.arange(SAVES)
            return jnp.concatenate([y0[None], jax.lax.scan(go_on, y0, ts)[1]])

        program, _ = harness.compiled(solve, y0, 1e-6)
        for tolerance in TOLERANCES[work]:
            begin = harness.clock()
            energy = energy_of(np.asarray(program(y0, tolerance)))
            row = dict(seconds=harness.clock() - begin, levels=[0.0, 0.0])
            row |= dict(work=work, solver="diffrax Dopri8, minimal")
            row |= dict(setting=f"rtol {tolerance:g}", energy=_change(work, energy))
            rows.append(row | harness.device())
    return rows


TOP_START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 150.0, -4.61538])


def _change(work: str, energy: np.ndarray) -> float:
    unit = TOP_ENERGY if work == "heavy top" else PENDULUM_ENERGY
    return float(np.max(np.abs(energy - energy[0])) / unit)


def _pendulum_energy(y: np.ndarray) -> np.ndarray:
    """Of two unit masses, from angles and rates."""
    a, b, da, db = y.T
    kinetic = da**2 + 0.5 * db**2 + np.cos(a - b) * da * db
    return kinetic - 9.81 * (2 * np.sin(a) + np.sin(b))


def _top_energy(y: np.ndarray, args: dict) -> np.ndarray:
    """From the quaternion and the angular velocity, about the fixed point."""
    # A solver in quaternions does not keep their length.
    p, rate = y[:, :4] / np.linalg.norm(y[:, :4], axis=1, keepdims=True), y[:, 4:]
    m, c = float(args["m"]), np.asarray(args["centre"])
    inertia = np.diag(args["J"]) + m * (c @ c * np.eye(3) - np.outer(c, c))
    height = np.asarray(jax.vmap(lambda p: turned(p, c))(p))[:, 2]
    weight = m * float(args["g"])
    return 0.5 * np.einsum("ti,ij,tj->t", rate, inertia, rate) + weight * height


def exudyn_rows(quick: bool) -> list[harness.Row]:
    try:
        import chain_exudyn
        import step_cost_exudyn
    except ImportError:
        return []
    rows = []
    for work, h in EXUDYN_STEPS:
        is_top = work == "heavy top"
        end = QUICK_END if quick or is_top else END
        if is_top:
            run = step_cost_exudyn.prepared_top(h, end)
        else:
            run = chain_exudyn.prepared((1.0, 1.0), 1.0, h, end, 0.9)
        begin = time.process_time()
        state = run()
        seconds = time.process_time() - begin
        energy, off = (_exudyn_top if is_top else _exudyn_pendulum)(*state)
        row = dict(work=work, mode="peer", solver="EXUDYN generalized-alpha")
        row |= dict(setting=f"h {h:g}, to {end:g} s", seconds=seconds, energy=energy)
        rows.append(row | dict(levels=[off, float("nan")]))
    return rows


def _exudyn_pendulum(q: np.ndarray, v: np.ndarray) -> tuple[float, float]:
    """The energy, which began at 0, and how far the rods are from their length."""
    energy = 0.5 * np.sum(v**2) - 9.81 * np.sum(q[1::2])
    links = q.reshape(2, 2) - np.stack([np.zeros(2), q[:2]])
    off = float(np.max(np.abs(np.sum(links**2, axis=1) - 1)))
    return float(abs(energy) / PENDULUM_ENERGY), off


def _exudyn_top(x: np.ndarray, v: np.ndarray, spin: np.ndarray) -> tuple[float, float]:
    """`spin` in axes of the body."""
    args = {k: np.asarray(a) for k, a in ej.problems.heavy_top().args.items()}
    energy = 0.5 * args["m"] * v @ v + 0.5 * spin @ (args["J"] * spin)
    energy += args["m"] * args["g"] * x[2]
    start = 0.5 * args["m"] * 4.61538**2 + 0.5 * TOP_START[4:] @ (args["J"] * TOP_START[4:])
    return float(abs(energy - start) / TOP_ENERGY), float(abs(x @ x - 1))


def show(rows: list[harness.Row]) -> None:
    for row in rows:
        position, rate = row["levels"]
        print(
            f"{row['work']:16s} {row['mode']:8s} {row['solver']:26s} {row['setting']:11s} "
            f"{row['seconds']:8.2f} s  energy {row['energy']:.1e}  "
            f"constraints {position:.0e} {rate:.0e}"
        )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for axis, work in zip(axes, ("double pendulum", "heavy top"), strict=True):
        for row in (row for row in rows if row["work"] == work):
            solver, at = row["solver"], (row["seconds"], row["energy"])
            kinds = dict(EXUDYN="C3", diffrax="C2")
            axis.loglog(*at, "o", color=kinds.get(solver.split()[0], "C0"))
            label = f"{solver}\n{row['setting']}"
            axis.annotate(label, at, (4, 4), textcoords="offset points", fontsize=6)
        axis.margins(0.25, 0.1)
        axis.set(title=work, xlabel="seconds of computation", ylabel="error of the energy")
    figure.suptitle("1e4 seconds: ours (blue), DAE (red), explicit in minimal coordinates")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, exudyn_rows, xla_flags=harness.FAST_LOOPS)
