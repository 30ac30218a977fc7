"""Random systems: the energy balance, the constraints, and the end of the motion.

The end is compared with a run sixteen times finer and with an explicit solver of high
order, which shares nothing with the schemes.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import fuzz_case as common
import jax
import jax.numpy as jnp
import numpy as np
from fuzz_case import Result
from numpy.random import Generator
from scipy.integrate import solve_ivp

import enerjax as ej


STEPS, FINER, DRAWS = 12, 16, 18
SIZES = (8, 20, 40, 80)
# Each with the order of its error, and whether it has an energy identity.
SCHEMES: dict[str, tuple[Callable[[float], ej.AbstractScheme], int, bool]] = {
    "preserving": (lambda a: ej.EnergyPreserving(), 2, True),
    "consistent": (ej.EnergyConsistent, 3, True),
    "decaying": (ej.EnergyDecaying, 2, True),
    "preserving index3": (lambda a: ej.EnergyPreserving("index3"), 2, True),
    "composed 4": (lambda a: ej.Composed(ej.EnergyPreserving(), 4), 4, True),
    "decaying index3": (lambda a: ej.EnergyDecaying(a, "index3"), 1, True),
    "consistent 6": (lambda a: ej.Composed(ej.EnergyConsistent(0.0), 6), 6, True),
    "preserving gauss": (
        lambda a: ej.EnergyPreserving(derivative=ej.MeanValue()), 2, True
    ),
    "decaying gonzalez": (
        lambda a: ej.EnergyDecaying(a, derivative=ej.Gonzalez()), 2, True
    ),
    "rattle": (lambda a: ej.Rattle(), 2, False),
    "generalized": (lambda a: ej.GeneralizedAlpha(1 - a), 2, False),
    "kappa": (ej.KappaDecaying, 2, True),
}  # fmt: skip
ORDER = list(itertools.product(SCHEMES, SIZES))
CALM = 0.3  # h times the fastest frequency, up to which a failure is a finding
FLOOR = 1e-9  # of the extent of the motion, below which errors are round-off


def cases(rng: Generator, number: int) -> Iterator[tuple[str, Callable[[], Result]]]:
    """A scheme and a size, without constraints in every fifth block."""
    # Neighbours differ in both, so that a short run sees many of each.
    name, n = ORDER[(number * 5) % len(ORDER)]
    free = number % 5 == 3
    for draw in range(DRAWS):
        alpha = (0.0, 0.3, 1.0)[draw % 3]
        label = f"{name}, n = {n}" + (", free" if free else "")
        # Drawn here, so that a case does not depend on how the one before has ended.
        own = np.random.default_rng(rng.integers(2**63))
        yield label, functools.partial(check, own, name, n, free, alpha)


def check(rng: Generator, name: str, n: int, free: bool, alpha: float) -> Result:
    convex = bool(rng.integers(2))
    system = common.FREE if free else common.CONSTRAINED
    args = common.random_args(rng, n, convex)
    start = ej.initial_state(system, *common.random_start(rng, n, args), args)
    pace = rng.choice([0.1, CALM, 0.7, 2.0])
    h = float(pace / fastest(start, args))
    make, order, accounts = SCHEMES[name]
    if name in ("kappa", "decaying index3") and alpha == 0.0:
        alpha = 0.1  # both are known to stop or to lock there
    scheme = make(alpha)
    runs = [simulate(system, scheme, start, args, h, part) for part in (1, 2, FINER)]
    about = f"alpha {alpha}, h omega {pace}, {'convex' if convex else 'bent'}"
    found, measures = [], {}
    for part, run in zip((1, 2, FINER), runs, strict=True):
        for text in laws(run, name, alpha, convex, accounts, measures):
            found.append(f"{about}, h/{part}: {text}")
    truth = reference(free, start, args, STEPS * h)
    found += [f"{about}: {x}" for x in ends(runs, truth, start, order, pace, measures)]
    return Result(found, measures)


def simulate(system, scheme, start, args, h, part):
    solution = ej.simulate(
        system,
        scheme,
        start,
        args,
        h=h / part,
        t1=STEPS * h,
        saveat=ej.SaveAt(every=1),
        max_steps=STEPS * FINER + 1,
        max_halvings=0,
        throw=False,
    )
    return jax.device_get(solution)


@jax.jit
def fastest(start: ej.State, args: Any) -> Any:
    """The fastest frequency at the start, of the potential or of the motion itself."""
    stiffness = jax.hessian(common.potential)(start.q, args)
    half = jnp.linalg.inv(jnp.linalg.cholesky(args["M"]))
    squared = jnp.abs(jnp.linalg.eigvalsh(half @ stiffness @ half.T))
    return jnp.maximum(jnp.sqrt(jnp.max(squared)), jnp.max(jnp.abs(start.v)))


def laws(run, name, alpha, convex, accounts, measures) -> Iterator[str]:
    """Properties that hold for steps of any length."""
    audit = run.audit
    good = np.isfinite(audit.kinetic)
    size = np.max(np.abs(audit.kinetic[good])) + np.max(np.abs(audit.potential[good])) + 1
    failed = bool(run.result != ej.RESULTS.successful)
    checks = {"constraint": (np.max(np.abs(audit.constraint[good]), initial=0.0), 1e-10)}
    if accounts:
        change = np.diff((audit.kinetic + audit.potential)[good])
        leak = np.abs(change + audit.dissipated[good][1:]) / size
        checks["leak"] = (np.max(leak, initial=0.0), 1e-11)
    if "index3" not in name and name not in ("kappa", "generalized"):
        rate = np.abs(audit.constraint_rate[good])
        checks["rate"] = (np.max(rate, initial=0.0), 1e-9)
    if name == "consistent" or (name.startswith("decaying") and convex):
        gain = -np.min(audit.dissipated[good]) / size
        checks["gain"] = (max(gain, 0.0), 1e-12)
    if accounts and (alpha == 0 or "preserving" in name or "composed" in name):
        checks["kept"] = (np.max(np.abs(audit.dissipated[good])) / size, 1e-12)
    for what, (value, allowed) in checks.items():
        measures[what] = max(measures.get(what, 0.0), float(value))
        if not value <= allowed:
            yield f"{what} {value:.1e} (failed: {failed})"
    if not failed and not np.isfinite(run.end.q).all():
        yield "success, but the end is not a number"


def ends(runs, truth, start, order, pace, measures) -> Iterator[str]:
    """Whether a run that reports success is correct."""
    causes = [ej.RESULTS[run.result].partition(".")[0] for run in runs]
    failed = [bool(run.result != ej.RESULTS.successful) for run in runs]
    measures["failed"] = max(measures.get("failed", 0.0), float(sum(failed)))
    # The scheme of kappa is known to fail where the kinetic energy turns.
    for part, bad, cause in zip((1, 2, FINER), failed, causes, strict=True):
        if bad and pace / part <= CALM and "kappa" not in cause:
            yield f"h/{part} failed: {cause}"
    if truth is None or failed[-1]:
        return
    extent = np.max(np.abs(truth - np.asarray(start.q))) + 1e-3
    errors = [np.max(np.abs(run.end.q - truth)) / extent for run in runs]
    text = "errors " + " ".join(f"{x:.1e}" for x in errors)
    if pace <= CALM:
        measures["error"] = float(np.max(np.where(failed, 0, errors)))
    # Otherwise a sixteenth of the step does not resolve the motion either.
    if pace < 1 and errors[2] > (0.3 if order == 1 else 0.02):
        yield f"the finer run is far from the explicit solver: {text}"
    for error, bad in zip(errors[:2], failed[:2], strict=True):
        # Half of the order that the scheme has.
        if not bad and error > FLOOR and errors[2] > error * 4.0 ** (-order / 2) + FLOOR:
            yield f"does not converge: {text}"
        if not bad and pace <= CALM and error > 0.5:
            yield f"success far from the truth: {text}"


def _rates(free: bool):
    @jax.jit
    def rates(y, args):
        n = y.size // 2
        q, v = y[:n], y[n:]
        force = -jax.grad(common.potential)(q, args)
        if free:
            return jnp.append(v, jnp.linalg.solve(args["M"], force))
        rows = jax.jacobian(common.constraint)(q, args)
        turned = lambda q: jax.jvp(lambda q: common.constraint(q, args), (q,), (v,))[1]
        bend = jax.jvp(turned, (q,), (v,))[1]
        none = jnp.zeros((rows.shape[0], rows.shape[0]))
        matrix = jnp.block([[args["M"], rows.T], [rows, none]])
        return jnp.append(v, jnp.linalg.solve(matrix, jnp.append(force, -bend))[:n])

    return rates


RATES = {free: _rates(free) for free in (False, True)}


def reference(free: bool, start: ej.State, args: Any, t1: float):
    """The coordinates at the end, by DOP853; the constraints are differentiated twice."""
    rates = lambda t, y: np.asarray(RATES[free](y, args))
    y = np.concatenate([start.q, start.v])
    solved = solve_ivp(rates, (0.0, t1), y, method="DOP853", rtol=1e-11, atol=1e-11)
    return solved.y[: y.size // 2, -1] if solved.success else None
