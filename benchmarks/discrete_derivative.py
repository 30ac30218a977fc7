"""The cost of discrete differentiation, relative to `jax.grad` and to Gonzalez.

Ten typical potentials and constraints: run time and trace + compile time of the discrete
gradient as ratios to those of the gradient. And whole steps of `EnergyPreserving`.

    python benchmarks/discrete_derivative.py [--out FOLDER]

Times are medians of interleaved repeats in one process; pin it to a core
(`taskset -c 0`). An answer whose identity fails is reported, not timed.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import enerjax as ej


jax.config.update("jax_enable_x64", True)

REPEATS, CALLS = 9, 200
MATRIX = jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)))


def _points(q):
    return q.reshape(-1, 3)


def _pairs(q):
    x = _points(q)
    return x[:, None, :] - x[None, :, :]


def _lennard_jones(q):
    square = jnp.sum(_pairs(q) ** 2, axis=-1) + jnp.eye(q.size // 3)
    return 2 * jnp.sum(square**-6 - square**-3)


def _rotation(p):
    scalar, vector = p[0], p[1:]
    cross = jnp.array(
        [[0, -vector[2], vector[1]], [vector[2], 0, -vector[0]], [-vector[1], vector[0], 0]]
    )
    return (
        (scalar**2 - vector @ vector) * jnp.eye(3)
        + 2 * jnp.outer(vector, vector)
        + 2 * scalar * cross
    )


def _bend(q):
    sides = jnp.diff(_points(q), axis=0)
    lengths = jnp.linalg.norm(sides, axis=1)
    cosines = jnp.sum(sides[1:] * sides[:-1], axis=1) / (lengths[1:] * lengths[:-1])
    return jnp.sum(jnp.arccos(cosines) ** 2)


def _springs(q):
    lengths = jnp.linalg.norm(jnp.diff(_points(q), axis=0), axis=1)
    return 50 * jnp.sum((lengths - 0.9) ** 2)


def _arm(q):
    inertia = 4 * jnp.eye(4) + jnp.cos(q[:4, None] - q[None, :4])
    return 0.5 * q[4:8] @ jnp.linalg.solve(inertia, q[4:8])


FUNCTIONS: dict[str, Callable] = {
    "gravity and rods": lambda q: (
        q[2::3].sum() + jnp.sum(jnp.diff(_points(q), axis=0) ** 2)
    ),
    "springs": _springs,
    "kepler": lambda q: -1 / jnp.linalg.norm(q[:3]),
    "lennard-jones": _lennard_jones,
    "bending by angles": _bend,
    "pendulum in angles": lambda q: -jnp.sum(jnp.cos(jnp.cumsum(q))),
    "spherical joint": lambda q: jnp.sum((q[:3] - _rotation(q[3:7]) @ q[7:10]) ** 2),
    "morse": lambda q: jnp.sum((1 - jnp.exp(-jnp.linalg.norm(_points(q), axis=1))) ** 2),
    "softplus contact": lambda q: jnp.sum(jax.nn.softplus(-20 * q[2::3]) ** 2),
    "kinetic energy of an arm": _arm,
}


def compiled(fn: Callable, *arguments) -> tuple[Callable, float]:
    """A compiled function, and the median seconds of trace + compile."""
    programs, seconds = [], []
    for _ in range(3):
        jax.clear_caches()
        begin = time.perf_counter()
        programs.append(jax.jit(lambda *x: fn(*x)).lower(*arguments).compile())
        seconds.append(time.perf_counter() - begin)
    return programs[-1], statistics.median(seconds)


def in_a_loop(fn: Callable) -> Callable:
    """Many evaluations in one program, as in an integrator, without dispatch."""

    def loop(a, b):
        body = lambda _, x: x + 1e-12 * fn(x, b + 1e-9 * x)
        return jax.lax.fori_loop(0, CALLS, body, a)

    return loop


def seconds_of(programs: list[Callable], *arguments) -> list[float]:
    """Median seconds of each, interleaved."""
    times: list[list[float]] = [[] for _ in programs]
    for _ in range(REPEATS):
        for program, record in zip(programs, times, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(program(*arguments))
            record.append(time.perf_counter() - begin)
    return [statistics.median(record[1:]) for record in times]


def functions() -> list[dict]:
    rng = np.random.default_rng(1)
    a = jnp.asarray(np.arange(12) / 3 + 0.3 * rng.normal(size=12))
    b = a + 0.01 * jnp.asarray(rng.normal(size=12))
    rows = []
    for name, fn in FUNCTIONS.items():
        discrete = ej.discrete_grad(fn)
        change = fn(b) - fn(a)
        defect = abs(float(discrete(a, b) @ (b - a) - change))
        bound = 50 * np.finfo(float).eps * (abs(float(fn(a))) + abs(float(fn(b))) + 1)
        if not defect <= bound:
            print(f"{name}: the identity fails by {defect:.1e}; not timed")
            continue
        gradient = lambda a, b, fn=fn: jax.grad(fn)(a)
        _, compile_one = compiled(gradient, a, b)
        _, compile_other = compiled(discrete, a, b)
        loops = [jax.jit(in_a_loop(f)) for f in (gradient, discrete)]
        one, other = seconds_of(loops, a, b)
        rows.append(
            dict(
                function=name,
                gradient_us=1e6 * one / CALLS,
                run_ratio=other / one,
                gradient_compile_s=compile_one,
                compile_ratio=compile_other / compile_one,
            )
        )
        row = rows[-1]
        print(
            f"{name:26s} {row['gradient_us']:7.2f} us  x {row['run_ratio']:.2f}   "
            f"{compile_one:5.2f} s  x {row['compile_ratio']:.2f}",
            flush=True,
        )
    return rows


def steps() -> list[dict]:
    rows = []
    for name in ("double_pendulum", "heavy_top"):
        system, start, args = getattr(ej.problems, name)()
        forms = (ej.ChainRule(), ej.Gonzalez(), ej.MeanValue())
        runs, compile_times = [], []
        for form in forms:
            scheme = ej.EnergyPreserving(derivative=form)

            def run(start, system=system, scheme=scheme, args=args):
                out = ej.simulate(system, scheme, start, args, h=1e-3, num_steps=200)
                return out.audit.energy

            program, seconds = compiled(run, start)
            runs.append(program)
            compile_times.append(seconds)
        times = seconds_of(runs, start)
        for form, t, c in zip(forms, times, compile_times, strict=True):
            row = dict(
                problem=name,
                derivative=type(form).__name__,
                us_per_step=1e6 * t / 200,
                run_ratio=t / times[1],
                compile_s=c,
                compile_ratio=c / compile_times[1],
            )
            rows.append(row)
            print(
                f"{name:16s} {row['derivative']:10s} {row['us_per_step']:8.2f} us a step, "
                f"x {row['run_ratio']:.2f} of Gonzalez; compiled in {c:.2f} s, "
                f"x {row['compile_ratio']:.2f}",
                flush=True,
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="What discrete differentiation costs.")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    folder = parser.parse_args().out
    print(
        "the gradient, and the discrete gradient as a multiple of it: run, trace + compile"
    )
    result = dict(functions=functions(), steps=steps())
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "discrete_derivative.json").write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
