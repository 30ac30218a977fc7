"""Independent solutions: explicit Runge-Kutta in minimal coordinates, without JAX.

The equations here are derived independently of the library, so that both cannot share a
mistake: there are no constraints, no multipliers and no discrete derivatives.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray


try:
    from scipy.integrate import solve_ivp
except ImportError as error:
    raise SystemExit(
        "The references need scipy, which is part of the extra `test`: "
        'python -m pip install "enerjax[test]"'
    ) from error


Vector = NDArray[np.float64]
Args = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Minimal:
    """A mechanism in minimal coordinates: `rates(y, args)`, and `y` as `(q, v)`."""

    start: Callable[[Args], Vector]
    rates: Callable[[Vector, Args], Vector]
    as_state: Callable[[Vector, Args], tuple[Vector, Vector]]


@dataclasses.dataclass(frozen=True)
class Reference:
    """The motion at some times, and its change if the tolerance is ten times larger."""

    q: Vector
    v: Vector
    uncertainty_q: float
    uncertainty_v: float


def solve(mechanism: Minimal, args: Args, times: Vector) -> Reference:
    """The states at `times`, by DOP853 at a relative tolerance of 1e-13."""
    args = {name: np.asarray(value, np.float64) for name, value in args.items()}
    (q, v), (rough_q, rough_v) = (
        _states(mechanism, args, times, tolerance) for tolerance in (1e-13, 1e-12)
    )
    return Reference(q, v, np.abs(q - rough_q).max(), np.abs(v - rough_v).max())


def _states(
    mechanism: Minimal, args: Args, times: Vector, tolerance: float
) -> tuple[Vector, Vector]:
    now, y, states = 0.0, mechanism.start(args), []
    # Each time is the end of an integration, because an interpolant is less accurate.
    for time in times:
        solution = solve_ivp(
            lambda _, y: mechanism.rates(y, args),
            (now, time),
            y,
            method="DOP853",
            rtol=tolerance,
            atol=tolerance / 10,
        )
        if not solution.success:
            raise RuntimeError(f"The reference failed: {solution.message}")
        now, y = time, solution.y[:, -1]
        states.append(mechanism.as_state(y, args))
    q, v = zip(*states, strict=True)
    return np.array(q), np.array(v)


# Pendulums: angles from the direction of gravity, which is +y -------------------------


def _swing(y: Vector, args: Args) -> Vector:
    return np.array([y[1], -args["g"] / args["l"] * math.sin(y[0])])


def _horizontal(args: Args) -> Vector:
    return np.array([math.pi / 2, 0.0])


def _end_of_rod(angle: float, rate: float, length: float) -> tuple[Vector, Vector]:
    sine, cosine = math.sin(angle), math.cos(angle)
    return length * np.array([sine, cosine]), length * rate * np.array([cosine, -sine])


def _double_swing(y: Vector, args: Args) -> Vector:
    """`A(angles) accelerations = b(angles, rates)` of two points on two rods."""
    m1, m2, l1, l2, g = (args[name] for name in ("m1", "m2", "l1", "l2", "g"))
    angle1, angle2, rate1, rate2 = y
    coupling = m2 * l1 * l2 * math.cos(angle1 - angle2)
    twist = m2 * l1 * l2 * math.sin(angle1 - angle2)
    inertia = np.array([[(m1 + m2) * l1**2, coupling], [coupling, m2 * l2**2]])
    torque = np.array(
        [
            -twist * rate2**2 - (m1 + m2) * g * l1 * math.sin(angle1),
            twist * rate1**2 - m2 * g * l2 * math.sin(angle2),
        ]
    )
    return np.array([rate1, rate2, *np.linalg.solve(inertia, torque)])


def _double_state(y: Vector, args: Args) -> tuple[Vector, Vector]:
    x1, v1 = _end_of_rod(y[0], y[2], args["l1"])
    x2, v2 = _end_of_rod(y[1], y[3], args["l2"])
    return np.concatenate([x1, x1 + x2]), np.concatenate([v1, v1 + v2])


def _spring(y: Vector, args: Args) -> Vector:
    q, v = y[:2], y[2:]
    length = math.hypot(*q)
    force = -args["k"] * (length - args["l"]) / length * q
    force[1] += args["m"] * args["g"]
    return np.concatenate([v, force / args["m"]])


# The heavy top about its fixed point: a quaternion and the body's angular velocity ----


def _cross(a: Vector) -> Vector:
    """`a x`, as a matrix."""
    x, y, z = a
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _rotation(p: Vector) -> Vector:
    """`1 + 2 e0 e x + 2 e x e x`, as a matrix."""
    turn = _cross(p[1:])
    return np.eye(3) + 2 * p[0] * turn + 2 * turn @ turn


def _top(y: Vector, args: Args) -> Vector:
    p, spin = y[:4], y[4:]
    m, centre = args["m"], args["centre"]
    about_tip = np.diag(args["J"]) + m * (
        centre @ centre * np.eye(3) - np.outer(centre, centre)
    )
    weight = _rotation(p).T @ np.array([0.0, 0.0, -m * args["g"]])
    torque = _cross(centre) @ weight - _cross(spin) @ about_tip @ spin
    turn = 0.5 * np.array([-p[1:] @ spin, *(p[0] * spin + _cross(p[1:]) @ spin)])
    return np.concatenate([turn, np.linalg.solve(about_tip, torque)])


def _top_state(y: Vector, args: Args) -> tuple[Vector, Vector]:
    p, spin, rotation = y[:4], y[4:], _rotation(y[:4])
    x, xdot = rotation @ args["centre"], rotation @ _cross(spin) @ args["centre"]
    return np.concatenate([x, p]), np.concatenate([xdot, spin])


PENDULUM_ANGLE = Minimal(_horizontal, _swing, lambda y, args: (y[:1], y[1:]))
PENDULUM = Minimal(_horizontal, _swing, lambda y, args: _end_of_rod(y[0], y[1], args["l"]))
DOUBLE_PENDULUM = Minimal(
    lambda args: np.array([math.pi / 2, 0.0, 0.0, 0.0]), _double_swing, _double_state
)
STRETCHED_DOUBLE_PENDULUM = dataclasses.replace(
    DOUBLE_PENDULUM, start=lambda args: np.array([math.pi / 2, math.pi / 2, 0.0, 0.0])
)
SPRING_PENDULUM = Minimal(
    lambda args: np.array([args["l"], 0.0, 0.0, 0.0]),
    _spring,
    lambda y, args: (y[:2], y[2:]),
)
HEAVY_TOP = Minimal(
    lambda args: np.array([1.0, 0.0, 0.0, 0.0, 0.0, 150.0, -4.61538]), _top, _top_state
)
