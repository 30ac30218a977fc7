"""Linkages of bodies in the plane, described for all programs."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

import enerjax as ej


Vector = NDArray[np.float64]
GROUND = -1


@dataclasses.dataclass(frozen=True)
class Body:
    """`pose` and `velocity`: those of the mass centre and of the angle at the start."""

    mass: float
    inertia: float
    pose: Vector
    velocity: Vector


@dataclasses.dataclass(frozen=True)
class Pin:
    """The points are in the frames of the bodies; those of the ground are in space."""

    first: int
    second: int
    point_a: Vector
    point_b: Vector


@dataclasses.dataclass(frozen=True)
class Linkage:
    """Bodies, pins, and the numbers of bodies that only slide along x."""

    bodies: tuple[Body, ...]
    pins: tuple[Pin, ...]
    guided: tuple[int, ...] = ()


def linkage_of(
    problem: ej.problems.Problem,
    pins: dict[str, tuple[int, int]],
    guided: tuple[int, ...] = (),
) -> Linkage:
    """The linkage of a problem in the plane; `pins` names its joints and their bodies."""
    _, start, args = problem
    poses, rates = (np.asarray(x).reshape(-1, 3) for x in (start.q, start.v))
    numbers = args["bodies"].values()
    bodies = tuple(
        Body(float(own["mass"]), float(own["inertia"]), pose, rate)
        for own, pose, rate in zip(numbers, poses, rates, strict=True)
    )
    points = lambda name: (
        np.asarray(args["joints"][name][end]) for end in ("point_a", "point_b")
    )
    joints = tuple(Pin(*pair, *points(name)) for name, pair in pins.items())
    return Linkage(bodies, joints, guided)


def slider_crank() -> Linkage:
    """`problems.slider_crank`."""
    pins = {"shaft": (GROUND, 0), "big end": (0, 1), "small end": (2, 1)}
    return linkage_of(ej.problems.slider_crank(), pins, guided=(2,))


def parallel_bars(num_cells: int) -> Linkage:
    """`problems.parallel_bars`: uprights and level rods in turn."""
    pins = {f"foot {k}": (GROUND, 2 * k) for k in range(num_cells + 1)}
    for k in range(1, num_cells + 1):
        pins |= {f"left {k}": (2 * k - 2, 2 * k - 1), f"right {k}": (2 * k - 1, 2 * k)}
    return linkage_of(ej.problems.parallel_bars(num_cells), pins)


def arm(num_rods: int) -> Linkage:
    """Rods of a metre and a kilogram in a row, horizontal and at rest."""
    bodies = tuple(
        Body(1.0, 1 / 12, np.array([k + 0.5, 0.0, 0.0]), np.zeros(3))
        for k in range(num_rods)
    )
    start, end = np.array([-0.5, 0.0]), np.array([0.5, 0.0])
    first = Pin(GROUND, 0, np.zeros(2), start)
    pins = (Pin(k - 1, k, end, start) for k in range(1, num_rods))
    return Linkage(bodies, (first, *pins))
