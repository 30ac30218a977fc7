from typing import NamedTuple

from .._analysis import initial_state
from .._system import AbstractSystem, State
from .._types import Args, Vector
from ..scenes import Scene


class Problem(NamedTuple):
    """A system, a consistent start and its arguments.

    Use as `system, start, args = pendulum()`.
    """

    system: AbstractSystem
    start: State
    args: Args


def problem(system: AbstractSystem, q: Vector, v: Vector, args: Args) -> Problem:
    return Problem(system, initial_state(system, q, v, args), args)


def made(scene: Scene) -> Problem:
    return Problem(*scene.build())
