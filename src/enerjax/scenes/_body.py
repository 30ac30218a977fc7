"""The interface of bodies."""

import abc
from typing import Any

import equinox as eqx

from ._body_coordinates import AbstractBodyCoordinates
from ._frames import Numbers
from .shapes import AbstractShape


class AbstractBody(eqx.Module):
    """A body of a scene.

    - `numbers`: mass and inertia, the entries of `args["bodies"][name]`.
    - `q`, `v`: its coordinates and velocities at the start.
    - `prescribed`: which velocities the user has passed; the others are zeros.
    - `shapes`: of pictures; `None` if the user has passed none.
    """

    name: str
    numbers: Numbers
    q: Any
    v: Any
    prescribed: tuple[bool, ...]
    shapes: tuple[AbstractShape, ...] | None

    @property
    @abc.abstractmethod
    def kind(self) -> AbstractBodyCoordinates:
        """The functions of its coordinates."""
