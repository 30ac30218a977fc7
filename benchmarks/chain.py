"""The cost of a step against the number of bodies: chains, compared with EXUDYN.

    python benchmarks/chain.py [--out FOLDER] [--quick]

Chains of `N` equal rods, one metre long together, fall from the horizontal with steps of
1 ms, by `EnergyPreserving()` written with plain functions: the structure of the equations
is found from the program. The energy, both levels of the constraints and, up to 512 links,
the positions (against an explicit Runge-Kutta run of the same points with their tensions
solved for) are checked first; a wrong answer is not timed. EXUDYN (the extra `peers`) runs
the generalized-alpha method with its sparse solver, rho 0.5, over the same time. Times are
medians over interleaved repeats, on one core, with XLA's default settings and with
`enable_fast_loops()` (two processes). Writes chain.json and chain.png.
"""

from pathlib import Path

import harness
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solveh_banded

import enerjax as ej


H = 1e-3
# The numbers of links and steps, and the largest errors of a correct result: of the energy
# relative to that of the fall, of the rods relative to their length (and of its rate
# relative to the length times the speed of the fall), and of positions.
STEPS = {8: 100, 64: 100, 512: 100, 2000: 30, 10000: 10}
ENERGY_BOUND, LEVEL_BOUND, ERROR_BOUND = 1e-11, 1e-9, 1e-3
WITH_REFERENCE = 512


def reference(num_links: int, end: float) -> np.ndarray:
    """Positions at the end, of points that are held by the tensions of the rods."""
    length, mass, g = 1 / num_links, 1 / num_links, 9.81

    def rates(_, y):
        q, v = y.reshape(2, num_links, 2)
        links = np.diff(q, axis=0, prepend=np.zeros((1, 2)))
        spins = np.diff(v, axis=0, prepend=np.zeros((1, 2)))
        # d/dt^2 |link|^2 = 0, with gravity on all points but the support.
        right = np.sum(spins**2, axis=1)
        right[0] += g * links[0, 1]
        diagonal = 2 * np.sum(links**2, axis=1) / mass
        diagonal[0] /= 2
        side = np.append(0.0, -np.sum(links[1:] * links[:-1], axis=1) / mass)
        tension = solveh_banded(np.stack([side, diagonal]), right)
        pull = -tension[:, None] * links
        pull[:-1] -= pull[1:]
        return np.concatenate([v.ravel(), (pull / mass + [0.0, g]).ravel()])

    start = np.zeros((2, num_links, 2))
    start[0, :, 0] = length * np.arange(1, num_links + 1)
    run = solve_ivp(rates, (0, end), start.ravel(), method="DOP853", rtol=1e-9, atol=1e-11)
    return run.y[: 2 * num_links, -1]


def sizes(quick: bool) -> tuple[int, ...]:
    return (8, 64) if quick else tuple(STEPS)


def our_rows(quick: bool) -> list[harness.Row]:
    rows, right_runs = [], []
    for num_links in sizes(quick):
        problem = ej.problems.chain(num_links)
        steps = STEPS[num_links]
        run = harness.compiled_run(problem, ej.EnergyPreserving(), H, steps)
        args = problem.args
        turnover = float(jnp.sum(args["m"] * args["g"] * jnp.cumsum(args["l"])))
        length = 1 / num_links
        energy, level, rate = run.residuals()
        row: harness.Row = dict(
            work=num_links,
            method="EnergyPreserving()",
            steps=steps,
            compile_s=run.compile_s,
            corrections=run.corrections(),
            energy=energy / turnover,
            level=level / length**2,
            rate=rate / (length * 9.81 * steps * H),
        )
        error = np.nan
        if num_links <= WITH_REFERENCE:
            exact = reference(num_links, steps * H)
            error = float(np.max(np.abs(run.solution.ys.q[-1] - exact)))
        row["error"] = error
        right = row["energy"] <= ENERGY_BOUND and not error > ERROR_BOUND
        right = right and max(row["level"], row["rate"]) <= LEVEL_BOUND
        if right:
            memory = run.program.memory_analysis()
            row["bytes_per_link"] = memory.temp_size_in_bytes / num_links
            right_runs.append((row, run))
        else:
            print(f"N = {num_links} is wrong: {row}; not timed")
        row["timed"] = right
        rows.append(row)
    harness.add_step_times(right_runs, 5)
    for row, _ in right_runs:
        row["us_per_correction"] = row["us_per_step"] / row["corrections"]
    return [row | harness.device() for row in rows]


def exudyn_rows(quick: bool) -> list[harness.Row]:
    exudyn = harness.peer("chain_exudyn", "EXUDYN")
    if exudyn is None:
        return []
    return [
        dict(
            work=n,
            method="EXUDYN generalized-alpha, rho 0.5",
            mode="exudyn",
            steps=STEPS[n],
            us_per_step=exudyn.us_per_step(n, H, STEPS[n]),
        )
        for n in sizes(quick)
        if n <= 2000
    ]


def show(rows: list[harness.Row]) -> None:
    anchors = {r["work"]: r["us_per_step"] for r in rows if r["mode"] == "exudyn"}
    for row in rows:
        if "us_per_step" not in row:
            continue
        anchor = anchors.get(row["work"])
        ratio = f"x {row['us_per_step'] / anchor:5.2f}" if anchor else ""
        name = f"N {row['work']:6d} {row['mode']:8s}"
        line = f"{name} {row['us_per_step']:9.1f} us/step {ratio:8s}"
        if "corrections" in row:
            line += (
                f" {row['corrections']:5.1f} corrections, energy {row['energy']:.0e}, "
                f"levels {row['level']:.0e} {row['rate']:.0e}, error {row['error']:.0e}, "
                f"{row['bytes_per_link']:.0f} B/link, compile {row['compile_s']:.1f} s"
            )
        print(line)
    for mode in ("default", "fast"):
        ours = [r for r in rows if r["mode"] == mode and "us_per_correction" in r]
        for one, other in zip(ours, ours[1:], strict=False):
            growth = np.log(other["us_per_correction"] / one["us_per_correction"])
            growth /= np.log(other["work"] / one["work"])
            print(f"{mode}: N^{growth:.2f} a correction, {one['work']} to {other['work']}")


def draw(rows: list[harness.Row], path: Path) -> None:
    harness.draw_costs(rows, path, "links", "chains, h = 1 ms")


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, exudyn_rows)
