"""A hundred fits of a double pendulum to noisy data, and a search without derivatives.

    python benchmarks/identification.py [--out FOLDER] [--quick]

Both angles of the start, a damper, gravity, both lengths and the outer mass: seven
parameters, from the points of both masses in one second, 20 times, with a noise of a
centimetre. The data comes from a run with steps ten times finer. Tells how often the 95 %
interval of each parameter holds the truth, and how many simulations `ej.fit`
(Levenberg-Marquardt) needed, each derivative by a parameter counted as one, beside SciPy's
Nelder-Mead from the same guess, until its cost is within a thousandth of the least (a
change of the parameters by some tenths of their errors). Writes identification.json and
identification.png.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import harness
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import enerjax as ej


NOISE, H, STEPS, EVERY = 0.01, 5e-3, 200, 10
# In the order of the fit: of their names.
TRUE = {"a": 0.0, "b": 1.5, "c": 0.5, "g": 9.81, "l1": 1.0, "l2": 0.7, "m2": 2.0}
GUESS = {"a": 0.1, "b": 1.3, "c": 1.0, "g": 9.0, "l1": 0.9, "l2": 0.8, "m2": 1.5}
POSITIVE = {name: name not in ("a", "b") for name in TRUE}


def damped(q: jax.Array, v: jax.Array, t: jax.Array, args: Any) -> jax.Array:
    del q, t
    return -args["c"] * v


def points(parameters: dict[str, Any], finer: int = 1) -> jax.Array:
    """Of both masses, released at rest; angles from the level, downwards."""
    plain, _, args = ej.problems.double_pendulum()
    assert isinstance(plain, ej.System)
    system = ej.System(plain.kinetic, plain.potential, plain.constraint, force=damped)
    p = jax.tree.map(jnp.asarray, parameters)
    rod = lambda length, angle: length * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    inner = rod(p["l1"], p["a"])
    solution = ej.simulate(
        system,
        ej.EnergyPreserving(),
        ej.State(jnp.concatenate([inner, inner + rod(p["l2"], p["b"])]), jnp.zeros(4)),
        args | p,
        h=H / finer,
        num_steps=STEPS * finer,
        saveat=ej.SaveAt(every=EVERY * finer),
        throw=False,
    )
    return solution.ys.q[1:]


def residuals(parameters: dict[str, Any], data: jax.Array) -> jax.Array:
    return (points(parameters) - data) / NOISE


def named(x: Any) -> dict[str, Any]:
    """The parameters, from unknowns that are logarithms of positive ones."""
    pairs = zip(POSITIVE.items(), x, strict=True)
    return {name: jnp.exp(y) if positive else y for (name, positive), y in pairs}


def nelder_mead(cost: Callable, enough: float) -> int:
    """Simulations until the cost is small enough, in the same logarithms."""
    count, reached = 0, 0

    def counted(x: np.ndarray) -> float:
        nonlocal count, reached
        count += 1
        value = float(cost(x))
        if value <= enough and not reached:
            reached = count
        return value if np.isfinite(value) else 1e30

    scipy.optimize.minimize(
        counted,
        [np.log(x) if POSITIVE[name] else x for name, x in GUESS.items()],
        method="Nelder-Mead",
        callback=lambda x: reached > 0,
        options=dict(maxfev=20_000, maxiter=20_000, xatol=1e-12, fatol=1e-12),
    )
    return reached


def rows_of(quick: bool) -> list[harness.Row]:
    repetitions, searches = (10, 1) if quick else (100, 10)
    exact = np.asarray(points(TRUE, finer=10))
    rng = np.random.default_rng(0)
    samples = exact + NOISE * rng.normal(size=(repetitions, *exact.shape))
    fits, seconds = [], []
    for data in samples:
        begin = harness.clock()
        fits.append(jax.device_get(ej.fit(residuals, GUESS, data, positive=POSITIVE)))
        seconds.append(harness.clock() - begin)
    cost = jax.jit(lambda x, data: jnp.sum(residuals(named(x), data) ** 2))
    needed = [
        nelder_mead(lambda x, data=data: cost(x, data), 1.001 * float(fit.cost))
        for fit, data in zip(fits[:searches], samples, strict=False)
    ]
    held = {
        name: sum(bool(f.lower[name] < true < f.upper[name]) for f in fits)
        for name, true in TRUE.items()
    }
    row: harness.Row = dict(
        repetitions=repetitions,
        held=held,
        noise=float(np.mean([f.noise for f in fits])),
        simulations=float(np.mean([f.simulations for f in fits])),
        iterations=float(np.mean([f.iterations for f in fits])),
        nelder_mead=float(np.mean(needed)),
        failed=int(np.sum(np.array(needed) == 0)),
        first_s=seconds[0],
        fit_ms=1e3 * float(np.median(seconds[1:])),
        estimates={name: [float(f.parameters[name]) for f in fits] for name in TRUE},
        errors={name: [float(f.standard_errors[name]) for f in fits] for name in TRUE},
    )
    return [row | harness.device()]


def show(rows: list[harness.Row]) -> None:
    for row in rows:
        held = ", ".join(f"{name} {count}" for name, count in row["held"].items())
        print(
            f"{row['mode']:8s} of {row['repetitions']} intervals hold the truth: {held}; "
            f"noise {row['noise']:.3f}\n"
            f"         {row['simulations']:.0f} simulations ({row['iterations']:.1f} "
            f"iterations), Nelder-Mead {row['nelder_mead']:.0f} "
            f"(x {row['nelder_mead'] / row['simulations']:.1f}; {row['failed']} failed)\n"
            f"         {row['fit_ms']:.0f} ms a fit, the first {row['first_s']:.1f} s"
        )


def draw(rows: list[harness.Row], path: Path) -> None:
    """Estimates in units of their standard errors."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(TRUE), figsize=(14, 3), layout="constrained")
    for axis, (name, true) in zip(axes, TRUE.items(), strict=True):
        estimates, errors = (np.array(rows[0][x][name]) for x in ("estimates", "errors"))
        axis.errorbar(range(len(errors)), estimates, 2 * errors, fmt=".", linewidth=0.5)
        axis.axhline(true, color="k", linewidth=0.8)
        axis.set(title=name, xlabel="repetition")
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, rows_of, show, draw)
