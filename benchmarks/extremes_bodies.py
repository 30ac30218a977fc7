"""Extremes of bodies and joints: masses, sizes, distances from the origin, rest, whips,
singular poses, long runs."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from extremes_runs import alphas, judge, Row, run, Vector
from scipy.integrate import solve_ivp

import enerjax as ej


def _plain(problem: ej.problems.Problem) -> tuple[ej.System, ej.State, Any]:
    system, start, args = problem
    assert isinstance(system, ej.System)
    return system, start, args


def _rates(m1: float, m2: float, g: float = 9.81):
    """A double pendulum of unit rods in its angles, from +x towards +y."""

    def rates(_, y):
        a, b, da, db = y
        coupling, swirl = m2 * np.cos(a - b), m2 * np.sin(a - b)
        inertia = np.array([[m1 + m2, coupling], [coupling, m2]])
        torque = [
            -swirl * db**2 + (m1 + m2) * g * np.cos(a),
            swirl * da**2 + m2 * g * np.cos(b),
        ]
        return [da, db, *np.linalg.solve(inertia, torque)]

    return rates


def _points(angles: Vector) -> Vector:
    a, b = angles
    inner = np.array([np.cos(a), np.sin(a)])
    return np.concatenate([inner, inner + np.array([np.cos(b), np.sin(b)])])


def exact(start: tuple[float, float], m1: float, m2: float, t: float) -> Vector:
    """The points at `t`, released at rest."""
    rates, begin = _rates(m1, m2), [*start, 0.0, 0.0]
    if m1 < 1e-4 * m2 and start[0] == start[1]:
        # Too stiff for the solver. On a taut line the light mass follows, and the
        # heavy one swings at twice the length, up to the order of the ratio.
        rates = lambda _, y: [y[2], y[3], *2 * [4.905 * np.cos(y[0])]]
    y = solve_ivp(rates, (0, t), begin, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return _points(y[:2])


# Two starts: both rods on one line, or those of the paper. In the first the light mass
# follows the heavy one; in the second it is thrown about, the faster the lighter it is.
STRAIGHT, BENT = (np.pi / 4, np.pi / 4), (0.0, np.pi / 2)


def mass_rows(quick: bool) -> Iterator[Row]:
    powers = (0, -4, -10) if quick else (0, -1, -2, -3, -4, -6, -8, -10)
    h, steps = 1e-3, 500
    for case, angles in (("straight", STRAIGHT), ("case d", BENT)):
        for order in ("inner", "outer"):
            for power in powers:
                ratio = 10.0**power
                m1, m2 = (ratio, 1.0) if order == "inner" else (1.0, ratio)
                # A thrown light mass turns too fast to be followed exactly.
                known = case == "straight" or power >= -6 or order == "outer"
                expected = exact(angles, m1, m2, h * steps) if known else None
                system, _, args = ej.problems.double_pendulum(m1=m1, m2=m2)
                problem = system, ej.State(_points(np.array(angles)), np.zeros(4)), args
                for name, scheme in alphas(0.0, 0.5).items():
                    solution = run(problem, scheme, h, steps)
                    label = f"{case}, light {order}"
                    place = ("mass ratio", label, name, f"{ratio:.0e}", ratio)
                    error_of = lambda q, v, e=expected: np.max(np.abs(q[-1] - e))
                    # Truncation of order 2.
                    yield judge(place, solution, error_of if known else None, 1e-3)


def _rods(q, args):
    inner, outer = q[:2] - args["at"], q[2:] - q[:2]
    lengths = jnp.array([inner @ inner, outer @ outer])
    return lengths - jnp.array([args["l1"] ** 2, args["l2"] ** 2])


def size_rows(quick: bool) -> Iterator[Row]:
    base = _plain(ej.problems.double_pendulum())[0]
    system = ej.System(base.kinetic, base.potential, _rods)
    h, steps, unit = 0.01, 50, np.array([1.0, 0.0, 1.0, 1.0])
    scales = {"length": (1e-9, 1e9), "mass": (1e-12, 1e12), "time": (1e-9, 1e9)}
    for name, scheme in alphas(0.5).items():

        def at(length=1.0, mass=1.0, time=1.0, place=0.0, *, scheme=scheme):
            numbers = dict(m1=mass, m2=mass, l1=length, l2=length)
            numbers |= dict(g=9.81 * length / time**2, at=place)
            start = ej.State(length * unit + place, np.zeros(4))
            return run((system, start, numbers), scheme, time * h, steps)

        one = at()
        expected = exact(BENT, 1.0, 1.0, h * steps)
        error_of = lambda q, v, e=expected: np.max(np.abs(q[-1] - e))
        row = ("size and place", "unit", name, "all 1", 1.0)
        yield judge(row, one, error_of, 1e-2)  # truncation
        for kind, values in scales.items():
            for value in values:
                row = ("size and place", kind, name, f"{value:g}", value)
                length = value if kind == "length" else 1.0
                error_of = lambda q, v, l=length, o=one: np.max(np.abs(q / l - o.ys.q))
                numbers: dict[str, Any] = {kind: value}
                yield judge(row, at(**numbers), error_of, 1e-10)
        for value in (1e4, 1e8):
            row = ("size and place", "offset", name, f"{value:g}", value)
            error_of = lambda q, v, x=value, o=one: np.max(np.abs(q - x - o.ys.q))
            # Some ulps of the coordinates there, in the lengths of the rods too.
            allowed = 100 * np.spacing(value)
            yield judge(row, at(place=value), error_of, allowed, max(1e-9, allowed))


def rest_rows(quick: bool) -> Iterator[Row]:
    """A system in equilibrium stays there, and its derivatives are finite."""
    double, _, args = ej.problems.double_pendulum()
    hanging = jnp.array([0.0, 1.0, 0.0, 2.0])
    cases = {
        "hanging": (double, ej.State(hanging, jnp.zeros(4)), args),
        "no gravity": (
            double,
            ej.State([1.0, 0.0, 1.0, 1.0], jnp.zeros(4)),
            args | dict(g=0.0),
        ),
    }
    for name, scheme in alphas(0.0, 0.5).items():
        for case, problem in cases.items():
            solution = run(problem, scheme, 0.01, 100)
            place = ("at rest", case, name, "100 steps", 0.0)
            # Bitwise, or the round-off of the weights.
            moved = lambda q, v: np.max(np.abs(q - q[0]))
            yield judge(place, solution, moved, 1e-15)

            def last(g, problem=problem, scheme=scheme):
                system, start, args = problem
                return jnp.sum(
                    run((system, start, args | dict(g=g)), scheme, 0.01, 100).ys.q[-1]
                )

            slope = jax.grad(last)(problem[2]["g"])
            place = ("at rest", f"{case}, gradient", name, "100 steps", 0.0)
            # Finite, whatever it is: NaN times zero is NaN.
            yield judge(place, solution, lambda q, v, d=slope: 0.0 * abs(d), 0.0)


def whip_rows(quick: bool) -> Iterator[Row]:
    links, steps = (16, 2000) if quick else (64, 2000)
    schemes: dict[str, ej.AbstractScheme] = {"EnergyPreserving()": ej.EnergyPreserving()}
    if not quick:
        schemes["EnergyConsistent(0.5)"] = ej.EnergyConsistent(0.5)
    problem = _plain(ej.problems.chain(links))
    for name, scheme in schemes.items():
        solution = run(problem, scheme, 1e-3, steps)
        place = ("whip", f"{links} links", name, "h = 1e-3 to 2 s", float(links))
        yield judge(place, solution)


def _skewed(q, args):
    rod = q @ q - args["l"] ** 2
    return jnp.stack([rod, (1 + args["skew"]) * rod + args["lean"] * (q[0] - 1.0)])


def singular_rows(quick: bool) -> Iterator[Row]:
    schemes = alphas(0.5)
    bars = _plain(ej.problems.parallel_bars(1))
    name = "EnergyPreserving()"
    for h in (0.01,) if quick else (0.01, 0.005):
        solution = run(bars, schemes[name], h, round((10 if quick else 100) / h), 10)
        # Uprights of a parallelogram are parallel: else it has folded.
        folded = lambda q, v: np.max(np.abs(q[:, :2] - q[:, 6:8] + [1.0, 0.0]))
        place = ("near singular", "A02, 1 cell", name, f"h = {h:g}", h)
        yield judge(place, solution, folded, 1e-6, 1e-6)
    crank = _plain(ej.problems.slider_crank())
    for name, scheme in schemes.items():
        solution = run(crank, scheme, 1e-3, 1000)
        place = ("near singular", "slider-crank, 12 dead centres", name, "h = 1e-3", 1e-3)
        yield judge(place, solution)
    yield from _repeated_rows(schemes)


def _repeated_rows(schemes: dict[str, ej.AbstractScheme]) -> Iterator[Row]:
    single, start, args = _plain(ej.problems.pendulum())
    for redundant in (False, True):
        system = ej.System(single.kinetic, single.potential, _skewed, redundant=redundant)
        for name, scheme in schemes.items():
            alone = run((single, start, args), scheme, 0.01, 200)
            for skew, lean in ((0.0, 0.0), (1e-12, 0.0), (0.0, 1e-12), (0.0, 1e-6)):
                numbers = args | dict(skew=skew, lean=lean)
                solution = run((system, start, numbers), scheme, 0.01, 200)
                still = lean > 0  # both constraints hold only at two points
                error_of = lambda q, v, s=still, o=alone: np.max(
                    np.abs(q - (q[0] if s else o.ys.q))
                )
                case = "rod twice" + (", declared" if redundant else "")
                asked = f"scale 1 + {skew:g}, lean {lean:g}"
                place = ("near singular", case, name, asked, max(skew, lean))
                yield judge(place, solution, error_of, 1e-9)


def length_rows(quick: bool, long: bool) -> Iterator[Row]:
    """The energy error of a long run walks at random: it grows like the root of time."""
    steps = 10_000_000 if long else 20_000 if quick else 200_000
    decaying = {"EnergyDecaying(0)": ej.EnergyDecaying(0.0)}
    double = {"EnergyPreserving()": ej.EnergyPreserving()} | decaying
    top = {"EnergyPreserving()": ej.EnergyPreserving()}
    for case, problem, h, schemes, share in (
        ("double pendulum", ej.problems.double_pendulum(), 0.01, double, 1),
        ("heavy top", ej.problems.heavy_top(), 1e-3, top, 10),
    ):
        for name, scheme in schemes.items():
            count = steps // share
            solution = run(_plain(problem), scheme, h, count, count // 1000)
            slope = exponent(np.asarray(solution.audit.energy))
            place = ("length of run", case, name, f"{count:.0e} steps", float(count))
            # The statistics of a thousand rows.
            yield judge(place, solution, lambda q, v, x=slope: x, 0.6)


def exponent(energy: Vector) -> float:
    """The exponent with which the root mean square of the change grows with the lag."""
    lags = np.unique(np.logspace(0, 2, 12).astype(int))
    sizes = [np.sqrt(np.mean((energy[k:] - energy[:-k]) ** 2)) for k in lags]
    return float(np.polyfit(np.log(lags), np.log(sizes), 1)[0])
