"""Oscillators whose motion a step resolves, and others whose motion it does not."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from extremes_runs import alphas, judge, Row, run
from scipy.integrate import solve_ivp

import enerjax as ej


STEPS = 64
# The tolerance of slow motion beside a stiff spring, whose forces have a round-off far
# above the other forces.
DIGITS = 1e-6


def _kinetic(v, args):
    return 0.5 * v @ v


def _linear(q, args):
    return 0.5 * args["k"] * q @ q


def _quartic(q, args):
    return 0.25 * args["k"] * (q @ q) ** 2


def _two_springs(q, args):
    return 0.5 * q @ q + 0.5 * args["k"] * (q[0] - q[1]) ** 2


def _torsion(q, args):
    bent = 0.5 * args["k"] * (q[0] - args["rest"]) ** 2
    return bent + args["weight"] * jnp.sin(q[0])


LINEAR = ej.System(_kinetic, _linear)
QUARTIC = ej.System(_kinetic, _quartic)
PAIR = ej.System(_kinetic, _two_springs)
SETTLING = ej.System(_kinetic, _torsion, force=lambda q, v, t, args: -args["c"] * v)


def alpha_of(scheme) -> float | None:
    return None if isinstance(scheme, ej.EnergyPreserving) else float(scheme.alpha)


def growth(z: complex, alpha: float | None) -> complex:
    """The factor of one step for `y' = lambda y`, with `z = lambda h`.

    The Cayley transform of the energy-preserving scheme; of both decaying families, the
    Pade approximation (2, 2) of the exponential at alpha = 0, (1, 2) at alpha = 1.
    """
    if alpha is None:
        return (1 + z / 2) / (1 - z / 2)
    lag = 1 - alpha * z / 6
    return 1 + z * lag / ((1 - z / 2) * lag + z**2 / 12)


def step_rows(quick: bool) -> Iterator[Row]:
    schemes = alphas(0.0, 0.5, 1.0)
    places = [1e-6, 1e-2, 1.0, 1e2, 1e4] if quick else 10.0 ** np.arange(-6, 5)
    for name, scheme in schemes.items():
        for x in map(float, places):
            start = ej.State([1.0], [0.0])
            place = ("step", "linear spring", name, f"h omega = {x:g}", x)
            solution = run((LINEAR, start, dict(k=x**2)), scheme, 1.0, STEPS)
            z = growth(1j * x, alpha_of(scheme))
            expected = (z ** np.arange(STEPS + 1)).real
            error_of = lambda q, v, e=expected: np.max(np.abs(q[:, 0] - e))
            # Round-off of the phase, some in each step.
            yield judge(place, solution, error_of, 1e-10)
            if x >= 1e4:
                place = ("step", "amplification", name, f"h omega = {x:g}", x)
                alpha = alpha_of(scheme) or 0.0
                rho = (1 - alpha) / (1 + alpha)
                size = lambda q, v, x=x: np.hypot(q[:, 0], v[:, 0] / x)
                error_of = lambda q, v, rho=rho, size=size: abs(size(q, v)[1] - rho)
                # Truncation in 1/(h omega).
                yield judge(place, solution, error_of, 20 / x)
            yield _quartic_row(name, scheme, x)


def mechanism_step_rows(quick: bool) -> Iterator[Row]:
    """Steps from far below to far above the period of the fastest motion."""
    cases = {
        # Spins with 150 rad/s.
        "heavy top": (ej.problems.heavy_top_directors(), 150.0),
        # The transverse waves of a taut chain: about twice the square root of its length
        # in links over the length of one, times g.
        "chain, 8 links": (ej.problems.chain(8), 2.0 * np.sqrt(9.81 * 64)),
    }
    places = [1e-4, 1e-1] if quick else 10.0 ** np.arange(-6, 5)
    for case, (problem, omega) in cases.items():
        for name, scheme in alphas(0.0, 0.5).items():
            for x in map(float, places):
                place = ("step", case, name, f"h omega = {x:g}", x)
                yield judge(place, run(problem, scheme, x / omega, STEPS))


def _quartic_row(name: str, scheme: ej.AbstractScheme, x: float) -> Row:
    place = ("step", "quartic spring", name, f"h omega = {x:g}", x)
    problem = QUARTIC, ej.State([1.0], [0.0]), dict(k=x**2)
    solution = run(problem, scheme, 1.0, STEPS)
    if x > 0.1:  # nothing to compare with but the law
        return judge(place, solution)
    rates = lambda t, y: [y[1], -(x**2) * y[0] ** 3]
    exact = solve_ivp(
        rates, (0, STEPS), [1.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-14
    )
    error_of = lambda q, v: abs(q[-1, 0] - exact.y[0, -1])
    # Truncation of a scheme of order 2: none has less here.
    return judge(place, solution, error_of, STEPS * x**3 + 1e-10)


def stiffness_rows(quick: bool) -> Iterator[Row]:
    """Two bodies on unit springs, coupled by a stiff one: slow and fast motion apart."""
    h, early = 0.05, 4
    for name, scheme in alphas(0.1, 0.5, 1.0).items():
        for power in (0, 6, 14) if quick else range(0, 15, 2):
            k = 10.0**power
            problem = PAIR, ej.State([1.0, 1.0], [1.0, -1.0]), dict(k=k)
            solution = run(problem, scheme, h, 4 * STEPS)
            alpha, fast = alpha_of(scheme), np.sqrt(1 + 2 * k)
            slow = (growth(1j * h, alpha) ** np.arange(4 * STEPS + 1)).real
            place = ("stiffness", "slow motion", name, f"stiffness {k:.0e}", k)
            error_of = lambda q, v, e=slow: np.max(np.abs(q.mean(axis=1) - e))
            yield judge(place, solution, error_of, DIGITS, DIGITS)
            left = abs(growth(1j * h * fast, alpha)) ** early

            def fast_of(q, v, fast=fast, left=left):
                amplitude = np.hypot(fast * (q[:, 0] - q[:, 1]), v[:, 0] - v[:, 1]) / 2
                return abs(amplitude[early] - left)

            place = ("stiffness", "fast energy", name, f"stiffness {k:.0e}", k)
            yield judge(place, solution, fast_of, DIGITS, DIGITS)


def alpha_rows(quick: bool) -> Iterator[Row]:
    """All values in one `vmap` with the step: the limits are met without a jump."""
    system, start, args = ej.problems.double_pendulum()
    values, steps = [0.0, 1e-300, 1e-16, 1e-8, 0.5, 1.0], [0.005, 0.01]
    for family in (ej.EnergyDecaying, ej.EnergyConsistent):
        both = jnp.array([(a, h) for h in steps for a in values])
        batch = jax.vmap(
            lambda x: run((system, start, args), family(x[0]), x[1], 100)  # noqa: B023
        )(both)
        for lane, (alpha, h) in enumerate(np.asarray(both)):
            solution = jax.tree.map(lambda x, k=lane: x[k], batch)
            base = lane - lane % len(values)
            other = batch.ys.q[base]
            allowed = 1e-12 + 100 * alpha
            if alpha >= 0.5:  # far from zero: as it is alone
                other = run((system, start, args), family(float(alpha)), float(h), 100).ys.q
                allowed = 1e-10
            place = ("alpha", f"h = {h:g}", family.__name__, f"alpha = {alpha:g}", alpha)
            error_of = lambda q, v, e=other: np.max(np.abs(q - e))
            yield judge(place, solution, error_of, allowed)


def settling_rows(quick: bool) -> Iterator[Row]:
    """A damped motion dies out away from angle zero, where forces are pure round-off."""
    for name, scheme in alphas(0.5).items():
        for weight in (0.0, 5.0):
            for h, c in [(0.1, 5.0), (0.1, 0.5), (0.01, 5.0)][: 1 if quick else 3]:
                args = dict(k=20.0, rest=2.0, weight=weight, c=c)
                problem = SETTLING, ej.State([0.0], [0.0]), args
                solution = run(problem, scheme, h, 2000)

                def torque(q, v, weight=weight):
                    return abs(20 * (q[-1, 0] - 2) + weight * np.cos(q[-1, 0]))

                asked = f"h = {h:g}, damping {c:g}, weight {weight:g}"
                place = ("at rest", "settled", name, asked, c)
                # Slow creep at the start of the damped motion is over; round-off.
                yield judge(place, solution, torque, 1e-12)
