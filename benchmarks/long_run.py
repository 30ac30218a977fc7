"""Energy in long runs: 1e4 seconds of a double pendulum and of a heavy top.

    python benchmarks/long_run.py [--out FOLDER] [--quick]

Two rods of a metre from the horizontal, and the top in directors. Ours with
`enable_fast_loops()` and without (two processes); diffrax in minimal coordinates (the
pendulum) with tolerances that take about as long; EXUDYN's generalized-alpha method (extra
`peers`). Each row: seconds of the processor, and the largest error of the energy at a
thousand times of the run (EXUDYN: at its end), in parts of what the mechanism turns over.
With `--quick` 100 seconds. Writes long_run.json and long_run.png.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import harness
import jax
import jax.numpy as jnp
import numpy as np

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
        scheme, unit = make(), TOP_ENERGY if is_top else PENDULUM_ENERGY

        def run(start, args, h, system=system, scheme=scheme, steps=steps):
            return ej.simulate(
                system,
                scheme,
                start,
                args,
                h=h,
                num_steps=steps,
                save_every=steps // SAVES,
            )

        program, _ = harness.compiled(run, start, args, h)
        begin = harness.clock()
        audit = jax.block_until_ready(program(start, args, h)).audit
        seconds = harness.clock() - begin
        energy = np.asarray(audit.energy)
        rows.append(
            dict(
                work=work,
                solver=label,
                setting=f"h {h:g}",
                seconds=seconds,
                energy=float(np.max(np.abs(energy - energy[0])) / unit),
                levels=[
                    float(np.max(np.abs(x)))
                    for x in (audit.constraint, audit.constraint_rate)
                ],
            )
            | harness.device()
        )
    return rows + _diffrax_rows(end)


def _diffrax_rows(end: float) -> list[harness.Row]:
    try:
        import diffrax  # pyright: ignore[reportMissingImports]
    except ImportError:
        return []
    from speed_accuracy_peers import swing

    masses = jnp.ones(2)
    rows = []
    for tolerance in (1e-6, 1e-9, 1e-12):

        @jax.jit
        def solve(y0, tolerance):
            return diffrax.diffeqsolve(
                diffrax.ODETerm(swing),
                diffrax.Dopri8(),
                0.0,
                end,
                None,
                y0,
                masses,
                saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, end, SAVES + 1)),
                stepsize_controller=diffrax.PIDController(tolerance, tolerance),
                max_steps=10**7,
                adjoint=diffrax.ForwardMode(),
            ).ys

        jax.block_until_ready(solve(jnp.zeros(4), tolerance))
        begin = harness.clock()
        y = np.asarray(solve(jnp.zeros(4), tolerance))
        seconds = harness.clock() - begin
        rows.append(
            dict(
                work="double pendulum",
                solver="diffrax Dopri8, minimal",
                setting=f"rtol {tolerance:g}",
                seconds=seconds,
                energy=float(np.max(np.abs(_energy(y) - _energy(y[:1]))) / PENDULUM_ENERGY),
                levels=[0.0, 0.0],
            )
            | harness.device()
        )
    return rows


def _energy(y: np.ndarray) -> np.ndarray:
    """Of two unit masses, from angles and rates."""
    a, b, da, db = y.T
    kinetic = da**2 + 0.5 * db**2 + np.cos(a - b) * da * db
    return kinetic - 9.81 * (2 * np.sin(a) + np.sin(b))


def exudyn_rows(quick: bool) -> list[harness.Row]:
    try:
        import chain_exudyn
    except ImportError:
        return []
    end, rows = QUICK_END if quick else END, []
    for h in (4e-3, 1e-3):
        begin = time.process_time()
        q, v = chain_exudyn.end_state((1.0, 1.0), 1.0, h, end, 0.9)
        seconds = time.process_time() - begin
        energy = 0.5 * np.sum(v**2) - 9.81 * np.sum(q[1::2])
        links = q.reshape(2, 2) - np.stack([np.zeros(2), q[:2]])
        off = float(np.max(np.abs(np.sum(links**2, axis=1) - 1)))
        rows.append(
            dict(
                work="double pendulum",
                mode="peer",
                solver="EXUDYN generalized-alpha",
                setting=f"h {h:g}",
                seconds=seconds,
                energy=float(abs(energy) / PENDULUM_ENERGY),
                levels=[off, float("nan")],
            )
        )
    return rows


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

    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    marks: dict[Any, str] = dict(peer="s", default="o", fast="^")
    for row in rows:
        axis.loglog(row["seconds"], row["energy"], marks[row["mode"]])
        label = f"{row['solver']}, {row['setting']}"
        axis.annotate(label, (row["seconds"], row["energy"]), fontsize=6)
    axis.set(xlabel="seconds of computation", ylabel="error of the energy, relative")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, exudyn_rows)
