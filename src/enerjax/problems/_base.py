from typing import NamedTuple

import jax.numpy as jnp

from .._analysis import initial_state
from .._system import AbstractSystem, State
from .._types import Args, Scalar, Vector, Velocities
from ..scenes import Scene


class _Triple(NamedTuple):
    system: AbstractSystem
    start: State
    args: Args


class Problem(_Triple):
    """A system, a consistent start and `args`: `system, start, args = pendulum()`.

    `scene` is that of a mechanism, for pictures: `four_bar().scene.draw()`; `None` for
    other systems.
    """

    scene: Scene | None = None


def problem(system: AbstractSystem, q: Vector, v: Vector, args: Args) -> Problem:
    return Problem(system, initial_state(system, q, v, args), args)


def problem_of(scene: Scene) -> Problem:
    found = Problem(*scene.build())
    found.scene = scene
    return found


def equal_masses_kinetic(v: Velocities, args: Args) -> Scalar:
    """The kinetic energy of points with the same mass `m`."""
    return 0.5 * args["m"] * v @ v


def planar_points_kinetic(v: Velocities, args: Args) -> Scalar:
    """The kinetic energy of points in the plane with the masses `m`."""
    return 0.5 * args["m"] @ jnp.sum(v.reshape(-1, 2) ** 2, axis=1)
