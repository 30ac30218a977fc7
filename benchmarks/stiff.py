"""The slow motion of a stiff double pendulum, with steps that hardly resolve the fast one.

    python benchmarks/stiff.py [--out FOLDER] [--quick]

Case d of the paper, whose inner mass is 200 times lighter: two seconds, in which it is
whipped around. The error is that of the outer mass at the end, against an explicit run in
the two angles at tight tolerance. Our schemes beside the generalized-alpha method with the
same spectral radius at infinity; with steps of varying length `EnergyConsistent(0)`, and
SciPy's Radau and BDF methods in the angles. Seconds are those of the processor;
SciPy calls Python. `--quick` leaves out the shortest steps. Writes
stiff.json and stiff.png.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import harness
import jax
import jax.numpy as jnp
import numpy as np
from references import DOUBLE_PENDULUM, solve
from scipy.integrate import solve_ivp

import enerjax as ej


END = 2.0
STEPS, QUICK_STEPS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4), (1e-2, 3e-3)
RADII = (0.9, 0.5, 0.0)
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9)
SCHEMES: dict[str, Callable[..., ej.AbstractScheme]] = {
    "EnergyConsistent": ej.EnergyConsistent.from_spectral_radius,
    "EnergyDecaying": ej.EnergyDecaying.from_spectral_radius,
    "generalized-alpha": ej.GeneralizedAlpha,
    "generalized-alpha, GGL": lambda rho: ej.GeneralizedAlpha(rho, "ggl"),
}
# Schemes without a spectral radius as parameter.
CONSERVING: dict[str, Callable[[], ej.AbstractScheme]] = {
    "EnergyPreserving": lambda: ej.EnergyPreserving(),
    "EnergyConsistent(0)": lambda: ej.EnergyConsistent(0.0),
}


def exact() -> np.ndarray:
    """Where the outer mass ends."""
    args = ej.problems.stiff_double_pendulum().args
    return solve(DOUBLE_PENDULUM, args, np.array([END])).q[-1][2:]


def our_rows(quick: bool) -> list[harness.Row]:
    makers = {name: (make, RADII) for name, make in SCHEMES.items()}
    makers |= {
        name: (lambda rho, make=make: make(), (1.0,)) for name, make in CONSERVING.items()
    }
    rows, end = [], exact()
    for name, (make, radii) in makers.items():
        run = jax.jit(lambda rho, h, make=make: _run(make(rho), h))
        for rho in radii:
            for h in QUICK_STEPS if quick else STEPS:
                row = dict(solver=name, rho=rho, h=h)
                rows.append(row | _outcome(functools.partial(run, rho, h), end))
    vary = lambda tol: _run(ej.EnergyConsistent(0.0), 1e-3, ej.StepController(tol, tol))
    run = jax.jit(vary)
    for tolerance in TOLERANCES:
        row = dict(solver="EnergyConsistent(0), adaptive", tolerance=tolerance)
        stats = run(tolerance).stats
        row["h"] = END / float(stats.completed_steps + stats.rejected_steps)
        rows.append(row | _outcome(functools.partial(run, tolerance), end))
    return [row | harness.device() for row in rows]


def _run(
    scheme: ej.AbstractScheme, h: Any, controller: ej.AbstractController = ej.EqualSteps()
) -> ej.Solution:
    system, start, args = ej.problems.stiff_double_pendulum()
    is_fixed = isinstance(controller, ej.EqualSteps)
    most = round(END / STEPS[-1]) + 1 if is_fixed else None
    run = functools.partial(ej.simulate, system, scheme, start, args, h=h, t1=END)
    return run(max_steps=most, controller=controller, throw=False)


def _outcome(run: Callable[[], ej.Solution], end: np.ndarray) -> harness.Row:
    """The error and the time, or the reason why there are none."""
    sol = run()
    if sol.result != ej.RESULTS.successful:
        return dict(failed=str(ej.RESULTS[sol.result]).partition(":")[0])
    return dict(
        error=float(np.max(np.abs(sol.ys.q[-1, 2:] - end))),
        energy=float(jnp.diff(sol.audit.energy)[0]),
        seconds=harness.medians([run], 3)[0],
    )


def scipy_rows(quick: bool) -> list[harness.Row]:
    args = {k: float(x) for k, x in ej.problems.stiff_double_pendulum().args.items()}
    rows, end = [], exact()
    for method in ("Radau", "BDF"):
        for tolerance in TOLERANCES:

            def run(method=method, tolerance=tolerance):
                return solve_ivp(
                    lambda t, y: DOUBLE_PENDULUM.rates(y, args),
                    (0, END),
                    DOUBLE_PENDULUM.start(args),
                    method=method,
                    rtol=tolerance,
                    atol=tolerance,
                )

            last = run().y[:, -1]
            position = DOUBLE_PENDULUM.as_state(last, args)[0][2:]
            row = dict(mode="peer", solver=f"{method}, in angles", tolerance=tolerance)
            row["error"] = float(np.max(np.abs(position - end)))
            row["seconds"] = harness.medians([run], 1)[0]
            # The mean step: tolerances do not compare with steps.
            row["h"] = END / (run().t.size - 1)
            rows.append(row)
    return rows


def show(rows: list[harness.Row]) -> None:
    ours = [row for row in rows if "rho" in row]
    steps = sorted({row["h"] for row in ours}, reverse=True)
    for key, title, scale, form in (
        ("error", "error of the outer mass [m]", 1.0, ".1e"),
        ("seconds", "time of the run [ms]", 1e3, ".3g"),
    ):
        print(f"\n{title:28s} h = " + "".join(f"{h:10.0e}" for h in steps))
        for name, rho in dict.fromkeys((row["solver"], row["rho"]) for row in ours):
            line = {r["h"]: r for r in ours if (r["solver"], r["rho"]) == (name, rho)}
            found = (line[h].get(key) for h in steps)
            cells = ("failed" if x is None else format(scale * x, form) for x in found)
            print(f"{name:24s} {rho:<8g}" + "".join(f"{cell:>10s}" for cell in cells))
    for row in (row for row in rows if "tolerance" in row):
        result = f"error {row['error']:.1e}" if "error" in row else row["failed"]
        print(
            f"{row['solver']:30s} tolerance {row['tolerance']:.0e}: {result}, "
            f"mean step {row['h']:.1e} s, {1e3 * row.get('seconds', np.nan):.3g} ms"
        )


def draw(rows: list[harness.Row], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(RADII), figsize=(12, 4), sharey=True)
    for axis, rho in zip(axes, RADII, strict=True):
        here = [r for r in rows if r.get("rho") in (rho, 1.0, None)]
        for name in dict.fromkeys(row["solver"] for row in here):
            line = sorted(
                (r["h"], r["error"]) for r in here if r["solver"] == name and "error" in r
            )
            style = "s:" if "angles" in name else "^--" if "alpha" in name else "o-"
            style = "D-" if "adaptive" in name else style
            axis.loglog(*zip(*line, strict=True), style, label=name, markersize=4)
        axis.set(
            title=f"spectral radius {rho:g} (where there is one)", xlabel="(mean) step [s]"
        )
    axes[0].set_ylabel("error of the outer mass at 2 s [m]")
    axes[0].legend(fontsize=6)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    harness.run(__file__, our_rows, show, draw, scipy_rows)
