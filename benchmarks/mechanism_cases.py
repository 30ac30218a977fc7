"""The problems with published motions, and the quantities that are compared."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import enerjax as ej


Vector = NDArray[np.float64]
Published = list[tuple[float, Vector, Vector]]  # time, positions, velocities


@dataclasses.dataclass(frozen=True)
class Case:
    """A problem, its published motion, and the longest of three steps, each half the last.

    `observe` maps the coordinates and velocities of a run to the published quantities.
    """

    name: str
    problem: Callable[[], ej.problems.Problem]
    block: float  # a time that divides those of the publication
    steps: int  # in a block, at the longest step
    observe: Callable[[Vector, Vector, Vector], tuple[Vector, Vector]]
    published: Callable[[], Published]


def _data(name: str, num_positions: int) -> Callable[[], Published]:
    """The rows of a table: its first columns are positions, the others velocities."""

    def rows() -> Published:
        path = Path(__file__).parent / "data" / "mechanisms.json"
        table = np.array(json.loads(path.read_text())[name]["rows"])
        last = 1 + num_positions
        return [(row[0], row[1:last], row[last:]) for row in table]

    return rows


def _plain(q: Vector, v: Vector, published: Vector) -> tuple[Vector, Vector]:
    return q[: published.size], v


def _first_upright(q: Vector, v: Vector, _: Vector) -> tuple[Vector, Vector]:
    """Its top is twice as far from the foot, the origin, as its mass centre."""
    return 2 * q[:2], 2 * v[:2]


def _andrews(q: Vector, v: Vector, _: Vector) -> tuple[Vector, Vector]:
    def angles(x: Vector) -> Vector:
        k1, k2, k3, k4, k5, k6, k7 = x[2::3]
        return np.array([k1, k2 - k1, k3, k4 - k5, k5, k6 - k7, k7])

    return angles(q), angles(v)


def _wheels(q: Vector, v: Vector, _: Vector) -> tuple[Vector, Vector]:
    return q[:4], v[:4]


def _quaternion_last(q: Vector, v: Vector, published: Vector) -> tuple[Vector, Vector]:
    """A quaternion and its negative are one rotation."""
    sign = np.sign(q[-4:] @ published[-4:])
    return np.concatenate([q[:-4], sign * q[-4:]]), v


def _directors(q: Vector, v: Vector, _: Vector) -> tuple[Vector, Vector]:
    return q, v[:3]


def _turned(p: Vector) -> Vector:
    skew = np.array([[0, -p[3], p[2]], [p[3], 0, -p[1]], [-p[2], p[1], 0]])
    return np.eye(3) + 2 * p[0] * skew + 2 * skew @ skew


def _tethered() -> Published:
    """With the body axes one after another instead of the quaternion."""
    return [
        (t, np.concatenate([x[:3], _turned(x[3:]).T.ravel()]), v)
        for t, x, v in _data("tethered_body", 7)()
    ]


def _steady_top() -> Published:
    """`R(t) = Rz(10 t) Rx(pi/3) Rz(135.6 t)`, exact."""

    def about(axis: int, angle: float) -> Vector:
        c, s = np.cos(angle), np.sin(angle)
        turn, plane = np.eye(3), [(axis + 1) % 3, (axis + 2) % 3]
        turn[np.ix_(plane, plane)] = [[c, -s], [s, c]]
        return turn

    def at(t: float) -> tuple[float, Vector, Vector]:
        rotation = about(2, 10 * t) @ about(0, np.pi / 3) @ about(2, 135.6 * t)
        x = 0.075 * rotation[:, 2]
        place = np.concatenate([x, rotation.T.ravel()])
        return t, place, 10 * np.array([-x[1], x[0], 0.0])

    return [at(t) for t in (0.5, 1.0, 2.0)]


def _case(
    problem: Callable[..., Any],
    block: float,
    steps: int,
    num_positions: int = 0,
    observe: Callable = _plain,
    published: Callable[[], Published] | None = None,
) -> Case:
    name = problem.__name__
    published = published or _data(name, num_positions)
    return Case(
        name=name,
        problem=problem,
        block=block,
        steps=steps,
        observe=observe,
        published=published,
    )


CASES = (
    _case(ej.problems.point_pendulum, 1.0, 50, 2),
    _case(ej.problems.parallel_bars, 1.0, 50, 2, _first_upright),
    _case(ej.problems.squeezer, 0.01, 50, 7, _andrews),
    _case(ej.problems.car_axis, 1.0, 200, 4, _wheels),
    _case(ej.problems.heavy_top, 0.1, 100, 7, _quaternion_last),
    _case(ej.problems.free_rigid_body, 0.5, 500, 4, _quaternion_last),
    _case(ej.problems.steady_top, 0.5, 250, 12, _directors, _steady_top),
    _case(ej.problems.four_particles, 1.0, 100, 12),
    _case(ej.problems.tethered_body, 1.0, 500, 12, _directors, _tethered),
    _case(ej.problems.kepler, np.pi, 100, 2),
    _case(ej.problems.henon_heiles, 1.0, 10, 2),
    _case(ej.problems.fput, 1.0, 250, 6),
    _case(ej.problems.pleiades, 1.0, 1000, 14),
)
QUICK = ("point_pendulum", "parallel_bars", "car_axis")

SCHEMES: dict[str, tuple[ej.AbstractScheme, int]] = {
    "EnergyPreserving()": (ej.EnergyPreserving(), 2),
    "EnergyDecaying(0.5)": (ej.EnergyDecaying(0.5), 2),
    "Composed(EnergyPreserving(), 4)": (ej.Composed(ej.EnergyPreserving(), 4), 4),
}
