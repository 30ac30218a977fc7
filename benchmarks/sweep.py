"""A sweep of ten thousand runs, compared with a plain loop over batches.

    python benchmarks/sweep.py [--out FOLDER] [--quick]

Twice: the double pendulums of `batch.py` (`EnergyPreserving()`, two masses and the step of
each lane), and `EnergyConsistent(alpha)` over a grid of alpha, h and a mass. Each runs with
`ej.sweep`, whose lanes run side by side, and as a `lax.map` over batches of 16 lanes, which
run one after the other: one program for all, compiled before it is timed. The results must
agree. Of a sweep the time counts from its second chunk on, since the first one compiles;
its programs are counted. Writes sweep.json and sweep.png.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import batch
import harness
import jax
import numpy as np

import enerjax as ej


# Largest difference of positions between the two, which are compiled differently.
BOUND = 1e-10
STEPS, CHUNK = 50, 1000


def consistent() -> Callable:
    """The end of a run of `EnergyConsistent(alpha)`: positions."""
    system, start, args = batch.problem()

    def run(alpha, h, m):
        solution = ej.simulate(
            system,
            ej.EnergyConsistent(alpha),
            start,
            args | dict(m=args["m"] * m),
            h=h,
            num_steps=STEPS,
            saveat=ej.SaveAt(every=STEPS),
            throw=False,
        )
        return solution.ys.q[-1]

    return run


def preserving() -> Callable:
    run = batch.ours(STEPS)
    return lambda m, h: run(m, h)[0]


def cases(quick: bool) -> dict[str, tuple[Callable, dict[str, Any], dict[str, Any]]]:
    """For each name the function of a lane, the parameters, and those of each lane."""
    count = 2_000 if quick else 10_000
    m, h = batch.lanes(count)
    lanes = {"lane": {"m": m, "h": h}}
    inner = preserving()
    sizes = (5, 20, 20) if quick else (10, 40, 25)
    grid = {
        "alpha": np.linspace(0.0, 1.0, sizes[0]),
        "h": np.linspace(0.5, 1.5, sizes[1]) * batch.H,
        "m": np.geomspace(0.5, 2.0, sizes[2]),
    }
    mesh = np.meshgrid(*grid.values(), indexing="ij")
    each = {name: x.reshape(-1) for name, x in zip(grid, mesh, strict=True)}
    return {
        "preserving, points": (lambda lane: inner(**lane), lanes, lanes),
        "consistent, grid": (consistent(), grid, each),
    }


class Programs:
    """Counts what XLA compiles."""

    def __enter__(self) -> "Programs":
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def __exit__(self, *_: Any) -> None:
        jax.monitoring.clear_event_listeners()

    def _listen(self, event: str, duration_secs: float, **_: Any) -> None:
        self.count += event.endswith("backend_compile_duration")


def swept(fn: Callable, over: dict[str, Any]) -> tuple[np.ndarray, harness.Row]:
    """The results of a sweep and its costs."""
    moments: list[tuple[int, float]] = []
    watch = lambda lanes, total: moments.append((lanes, harness.clock()))
    begin = harness.clock()
    with Programs() as programs:
        found = ej.sweep(fn, over, chunk=CHUNK, progress=watch)
    end = harness.clock()
    lanes, seconds = np.subtract(moments[-1], moments[0])
    return np.asarray(found.values), dict(
        programs=programs.count,
        seconds=end - begin,
        ns_per_lane_step=1e9 * seconds / (lanes * STEPS),
    )


def compared(fn: Callable, over: dict[str, Any], each: dict[str, Any]) -> harness.Row:
    """Times of a sweep and of the loop over batches, which run in turn."""
    count = len(jax.tree.leaves(each)[0])
    loop = lambda lanes: jax.lax.map(
        lambda lane: fn(**lane), lanes, batch_size=batch.CHUNKS[0]
    )
    program, _ = harness.compiled(loop, each)
    expected = np.asarray(program(each))
    turns, row, found = [], {}, expected
    for _ in range(3):
        found, row = swept(fn, over)
        (seconds,) = harness.medians([lambda: program(each)], 1)
        turns.append((row["ns_per_lane_step"], 1e9 * seconds / (count * STEPS)))
    row["ns_per_lane_step"], row["loop_ns"] = map(float, np.median(turns, axis=0))
    difference = float(np.max(np.abs(found.reshape(expected.shape) - expected)))
    return row | dict(lanes=count, difference=difference)


def rows_of(quick: bool) -> list[harness.Row]:
    rows = []
    for name, case in cases(quick).items():
        rows.append(dict(case=name) | compared(*case) | harness.device())
        if rows[-1]["difference"] > BOUND:
            print(f"{name} is wrong, and its times mean nothing: {rows[-1]}")
    return rows


def show(rows: list[harness.Row]) -> None:
    for row in rows:
        print(
            f"{row['mode']:8s} {row['case']:20s} {row['lanes']:6d} lanes "
            f"{row['ns_per_lane_step']:7.1f} ns/lane-step, {row['loop_ns']:7.1f} in a loop "
            f"(x {row['ns_per_lane_step'] / row['loop_ns']:4.2f})  programs "
            f"{row['programs']}  {row['seconds']:5.1f} s in all  "
            f"difference {row['difference']:.0e}"
        )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    names = [f"{row['case']}\n{row['mode']}" for row in rows]
    place = np.arange(len(rows))
    axis.bar(place - 0.2, [row["ns_per_lane_step"] for row in rows], 0.4, label="sweep")
    axis.bar(place + 0.2, [row["loop_ns"] for row in rows], 0.4, label="bare loop")
    axis.set_xticks(place, names, fontsize=8)
    axis.set(ylabel="ns per lane and step")
    axis.legend()
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, rows_of, show, draw)
