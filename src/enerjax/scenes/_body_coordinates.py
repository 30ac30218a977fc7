"""The coordinates of each kind of body.

A kind is a set of plain functions of the coordinates `q` and velocities `v` of one body.
Kinds are compared by value, so that scenes with the same structure share their programs.
"""

import abc
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import at_places
from .._types import Coordinates, Multipliers, Scalar, Velocities
from ._frames import Numbers, Point


class AbstractBodyCoordinates(abc.ABC):
    """The coordinates of one kind of body.

    - `dimension`: 2 in the plane, 3 in space.
    - `turns`: whether the body has an orientation.
    - `num_coordinates`, `num_velocities`: of one body.
    - `num_internal`: constraints between its directors, which `System` adds.
    - `num_redundant`: relations between its coordinates whose rate vanishes for every `v`.
    - `is_section`: whether these are the sections of beams, whose mass and inertia follow
      from the numbers of the beams.
    """

    dimension: int
    turns: ClassVar[bool]
    is_section: bool = False
    num_internal: ClassVar[int] = 0
    num_redundant: ClassVar[int] = 0

    @property
    @abc.abstractmethod
    def num_coordinates(self) -> int: ...

    @property
    def num_velocities(self) -> int:
        return self.num_coordinates - self.num_redundant

    @property
    @abc.abstractmethod
    def names(self) -> tuple[list[str], list[str]]:
        """The names of the coordinates and of the velocities."""

    def origin(self, q: Coordinates) -> Point:
        """The mass centre in space."""
        return q[: self.dimension]

    def axes(self, q: Coordinates) -> Float[Array, "d d"]:
        """The body axes in space, as rows of a matrix."""
        return jnp.eye(self.dimension, dtype=q.dtype)

    def angle(self, q: Coordinates) -> Scalar:
        """The angle of rotation, in the plane."""
        return jnp.zeros((), q.dtype)

    @abc.abstractmethod
    def kinetic(self, v: Velocities, numbers: Numbers) -> Scalar:
        """The kinetic energy, quadratic in `v`."""

    def redundant(self, q: Coordinates) -> Multipliers:
        """The relations between redundant coordinates, `num_redundant` rows."""
        return jnp.zeros((0,), q.dtype)

    def velocity_map(self, q: Coordinates) -> Float[Array, "nv nq"]:
        """`L(q)` in `v = L(q) qdot`."""
        return jnp.eye(self.num_coordinates, dtype=q.dtype)

    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        """The rates of the coordinates."""
        return v


# The axes of space.
AXES = ("x", "y", "z")


def _of_centre(dimension: int) -> tuple[list[str], list[str]]:
    axes = AXES[:dimension]
    return [*axes], [f"v{axis}" for axis in axes]


def translation(v: Velocities, numbers: Numbers) -> Scalar:
    return 0.5 * numbers["mass"] * jnp.sum(v**2)


@dataclass(frozen=True)
class Points(AbstractBodyCoordinates):
    """`q`: position."""

    dimension: int
    turns = False

    @property
    def num_coordinates(self) -> int:
        return self.dimension

    @property
    def names(self):
        return _of_centre(self.dimension)

    def kinetic(self, v, numbers):
        return translation(v, numbers)


@dataclass(frozen=True)
class PlanarBodies(AbstractBodyCoordinates):
    """`q`: mass centre and angle."""

    dimension: int = 2
    is_section: bool = False
    turns = True

    @property
    def num_coordinates(self) -> int:
        return 3

    @property
    def names(self):
        q, v = _of_centre(2)
        return [*q, "angle"], [*v, "angle_rate"]

    def axes(self, q):
        first = jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])
        return at_places(jnp.concatenate([first, -first]), np.array([[0, 1], [3, 0]]))

    def angle(self, q):
        return q[2]

    def kinetic(self, v, numbers):
        return translation(v[:2], numbers) + 0.5 * numbers["inertia"] * v[2] ** 2


@dataclass(frozen=True)
class DirectorBodies(AbstractBodyCoordinates):
    """`q`: mass centre and the three body axes, as vectors in space."""

    dimension: int = 3
    is_section: bool = False
    turns = True
    num_internal = 6

    @property
    def num_coordinates(self) -> int:
        return 12

    @property
    def names(self):
        q, v = _of_centre(3)
        axes = [f"axis{k}_{axis}" for k in (1, 2, 3) for axis in AXES]
        return [*q, *axes], [*v, *(f"{name}_rate" for name in axes)]

    def axes(self, q):
        return q[3:].reshape(3, 3)

    def kinetic(self, v, numbers):
        inertia, rates = numbers["inertia"], v[3:].reshape(3, 3)
        # Second moments of the mass; moments of inertia are sums of two of them.
        moments = 0.5 * jnp.trace(inertia) * jnp.eye(3, dtype=v.dtype) - inertia
        turning = 0.5 * jnp.sum(moments * (rates @ rates.T))
        return translation(v[:3], numbers) + turning


def rotation(p: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """The rotation matrix of a unit quaternion, scalar first: body axes along columns."""
    scalar, vector = p[0], p[1:]
    x, y, z = vector
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    isotropic = (scalar**2 - vector @ vector) * jnp.eye(3, dtype=p.dtype)
    return isotropic + 2 * (jnp.outer(vector, vector) + scalar * cross)


def quaternion_rates(p: Float[Array, "4"]) -> Float[Array, "3 4"]:
    """`2 E(p)` in `Omega = 2 E(p) pdot`, with the angular velocity in body axes."""
    a, b, c, d = p
    rows = [[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]]
    return 2 * jnp.stack([jnp.stack(row) for row in rows])


@dataclass(frozen=True)
class QuaternionBodies(AbstractBodyCoordinates):
    """`q`: mass centre and unit quaternion; `v`: its velocity, and the angular velocity
    in body axes."""

    dimension: int = 3
    turns = True
    num_redundant = 1

    @property
    def num_coordinates(self) -> int:
        return 7

    @property
    def names(self):
        q, v = _of_centre(3)
        return [*q, "p0", "p1", "p2", "p3"], [*v, "omega1", "omega2", "omega3"]

    def axes(self, q):
        return rotation(q[3:]).T

    def kinetic(self, v, numbers):
        spin = v[3:]
        return translation(v[:3], numbers) + 0.5 * spin @ numbers["inertia"] @ spin

    def redundant(self, q):
        return jnp.sum(q[3:] ** 2)[None] - 1

    def velocity_map(self, q):
        corner = jnp.zeros((3, 4), q.dtype)
        eye = jnp.eye(3, dtype=q.dtype)
        return jnp.block([[eye, corner], [corner[:, :3], quaternion_rates(q[3:])]])

    def lift(self, q, v):
        return jnp.concatenate([v[:3], 0.25 * v[3:] @ quaternion_rates(q[3:])])
