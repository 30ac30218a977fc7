"""The cost of a derivative: time and memory of the reverse pass and the forward run.

    python benchmarks/gradient.py [--out FOLDER] [--quick]

The derivative of a coordinate at the end of a thousand steps with respect to everything:
the start (along the constraints), the arguments (masses among them), the length of
the step, and alpha of the decaying scheme. It must agree with forward mode and with
central differences along a random direction, or it is not timed. Memory is what XLA sets
aside for the program, per unknown of the step equations and step; of a long run too, which
is compiled but not run. Times are medians over interleaved repeats on one core. Writes
gradient.json and gradient.png.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import harness
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import enerjax as ej


H = 1e-3
# Largest errors of a right answer, relative: both modes solve the same linear systems;
# a difference quotient has half the digits.
FORWARD_BOUND, DIFFERENCE_BOUND = 1e-8, 1e-5
# Name, problem, scheme of alpha, unknowns of its step equations: for the end (and the
# jump of a decaying scheme) a rate, and a multiplier for each position and velocity row.
CASES = [
    ("double pendulum", lambda: ej.problems.chain(2, 2.0, 2.0), "preserving", 8),
    ("double pendulum", lambda: ej.problems.chain(2, 2.0, 2.0), "decaying", 16),
    ("heavy top", ej.problems.heavy_top, "preserving", 14),
    ("chain of 64", lambda: ej.problems.chain(64), "preserving", 256),
]


def scheme_of(kind: str, p: Any) -> ej.AbstractScheme:
    return ej.EnergyPreserving() if kind == "preserving" else ej.EnergyDecaying(p["alpha"])


def case_of(make: Callable, kind: str, steps: int) -> tuple[Callable, Callable, Any]:
    """A scalar of the end as a function of all numbers of the run.

    And what makes consistent numbers of any, and these numbers.
    """
    system, start, args = make()
    alpha = {} if kind == "preserving" else dict(alpha=0.5)
    numbers = dict(start=start, args=args, h=H) | alpha

    def end(p):
        solution = ej.simulate(
            system,
            scheme_of(kind, p),
            p["start"],
            p["args"],
            h=p["h"],
            num_steps=steps,
            saveat=ej.SaveAt(every=steps),
            throw=False,
        )
        # NaN if the run failed, which no check below lets pass.
        return jnp.sum(jnp.sin(solution.ys.q[-1]))

    def consistent(p):
        start = ej.initial_state(system, p["start"].q, p["start"].v, p["args"])
        return p | dict(start=start)

    return end, consistent, jax.tree.map(jnp.asarray, numbers)


def disagreement(
    end: Callable, value: Callable, consistent: Callable, numbers: Any, gradient: Any
) -> tuple[float, float]:
    """Errors of the gradient against forward mode and differences along a direction.

    `value` is the compiled `end`. The start moves along the constraints.
    """
    flat, unravel = ravel_pytree(numbers)
    towards = np.random.default_rng(0).normal(size=flat.size) * (0.1 + np.abs(flat))
    _, direction = jax.jvp(consistent, (numbers,), (unravel(jnp.asarray(towards)),))
    slope = float(ravel_pytree(direction)[0] @ ravel_pytree(gradient)[0])
    forward = float(jax.jit(lambda p: jax.jvp(end, (p,), (direction,))[1])(numbers))
    to = lambda eps: value(consistent(unravel(flat + eps * towards)))
    at = lambda eps: float(to(eps) - to(-eps))
    # Two quotients take out the error of second order.
    eps = 1e-5
    difference = (8 * at(eps) - at(2 * eps)) / (12 * eps)
    return abs(forward / slope - 1), abs(difference / slope - 1)


def our_rows(quick: bool) -> list[harness.Row]:
    most, long = (200, 10_000) if quick else (1000, 1_000_000)
    rows, programs = [], []
    for name, make, kind, unknowns in CASES:
        steps = most if unknowns < 100 else most // 10
        end, consistent, numbers = case_of(make, kind, steps)
        forward, _ = harness.compiled(end, numbers)
        reverse, seconds = harness.compiled(jax.value_and_grad(end), numbers)
        gradient = reverse(numbers)[1]
        off = disagreement(end, forward, consistent, numbers, gradient)
        row: harness.Row = dict(case=name, scheme=kind, steps=steps, unknowns=unknowns)
        row |= dict(off_forward=off[0], off_difference=off[1]) | harness.device()
        rows.append(row)
        if not (off[0] <= FORWARD_BOUND and off[1] <= DIFFERENCE_BOUND):
            print(f"{name}, {kind}: the gradient is off by {off}: not timed")
            continue
        memory = reverse.memory_analysis().temp_size_in_bytes
        row |= dict(memory=memory, compile_s=seconds)
        row["bytes_per_unknown_step"] = memory / (unknowns * steps)
        programs += [lambda p=p, x=numbers: p(x) for p in (forward, reverse)]
    times = harness.medians(programs, 3 if quick else 7)
    good = [row for row in rows if "memory" in row]
    for row, forward, reverse in zip(good, times[::2], times[1::2], strict=True):
        row |= dict(forward_us=1e6 * forward / row["steps"], ratio=reverse / forward)
    end, _, numbers = case_of(CASES[0][1], CASES[0][2], long)
    reverse, seconds = harness.compiled(jax.value_and_grad(end), numbers)
    memory = reverse.memory_analysis().temp_size_in_bytes
    row = dict(case="long double pendulum", scheme=CASES[0][2], steps=long, memory=memory)
    row |= dict(unknowns=CASES[0][3], compile_s=seconds) | harness.device()
    row["bytes_per_unknown_step"] = memory / (CASES[0][3] * long)
    return [*rows, row]


def _or_nan(row: harness.Row, key: str) -> float:
    return row.get(key, np.nan)


def show(rows: list[harness.Row]) -> None:
    for row in rows:
        get = functools.partial(_or_nan, row)
        print(
            f"{row['case']:20s} {row['scheme']:10s} {row['mode']:7s} {row['steps']:7d} "
            f"forward {get('forward_us'):8.2f} us/step, gradient x {get('ratio'):5.2f}, "
            f"{get('memory') / 1e6:8.3f} MB = {get('bytes_per_unknown_step'):8.2f} B"
            f"/unknown/step, off {get('off_forward'):.0e} {get('off_difference'):.0e}, "
            f"compile {get('compile_s'):5.1f} s"
        )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    timed = [row for row in rows if "ratio" in row]
    for axis, key, label in zip(
        axes,
        ("ratio", "bytes_per_unknown_step"),
        ("time, gradient / forward", "bytes per unknown and step"),
        strict=True,
    ):
        names = [f"{row['case']}\n{row['scheme']}" for row in timed]
        axis.bar(names, [row[key] for row in timed])
        axis.tick_params(axis="x", labelsize=7)
        axis.set(ylabel=label)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw)
