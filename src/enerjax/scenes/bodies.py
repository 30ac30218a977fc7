"""Bodies: what has mass.

The origin of a body frame is the mass centre. Poses and velocities are told in space, at
the start; points, axes and inertias in the frame of the body. Velocities that are left out
follow from those that are given, by the joints.
"""

import abc
from typing import Any

import equinox as eqx

from .._types import Real, Vector
from ._arguments import joined, module_of, number, positive, velocities
from ._body_coordinates import (
    AbstractBodyCoordinates,
    DirectorBodies,
    PlanarBodies,
    Points,
    QuaternionBodies,
)
from ._frames import Numbers
from ._names import only_parts
from ._rotations import mass_and_inertia, quaternion_of, rotation_matrix


class AbstractBody(eqx.Module):
    """A body of a scene: a name, its numbers and its start.

    - `numbers`: mass and inertia, as they stand in `args["bodies"][name]`.
    - `q`, `v`: its coordinates and velocities at the start.
    - `given`: which velocities are told; the others are zeros.
    """

    name: str
    numbers: Numbers
    q: Any
    v: Any
    given: tuple[bool, ...]

    @property
    @abc.abstractmethod
    def kind(self) -> AbstractBodyCoordinates:
        """The functions of its coordinates."""


class PointMass(AbstractBody):
    """A point with mass, in the plane or in space.

    **Arguments:**

    - `name`: a string, unique in the scene.
    - `mass`: positive.
    - `position`, `velocity`: at the start, of two or three entries (length, length per
      time).

    Its coordinates are the position. It has no orientation: joints that hold one refuse it.
    """

    def __init__(
        self, name: str, mass: Real, position: Vector, velocity: Vector | None = None
    ):
        self.name = name
        self.numbers = dict(mass=positive(f"'{name}'", "`mass`", mass))
        self.q = number(f"'{name}'", "`position`", position, (2,), (3,))
        self.v, self.given = velocities(f"'{name}'", (velocity, self.q.shape))

    @property
    def kind(self) -> AbstractBodyCoordinates:
        return Points(self.q.size)


class PlanarBody(AbstractBody):
    """A rigid body in the plane.

    **Arguments:**

    - `name`: a string, unique in the scene.
    - `mass`, `inertia`: positive; the inertia about the mass centre (mass length^2).
    - `position`, `velocity`: of the mass centre at the start, two entries each.
    - `angle`, `angular_velocity`: from the axes of space to those of the body,
      counterclockwise, and its rate.

    Its coordinates are the mass centre and the angle, which counts full turns.
    """

    def __init__(
        self,
        name: str,
        mass: Real,
        inertia: Real,
        position: Vector,
        angle: Real = 0.0,
        *,
        velocity: Vector | None = None,
        angular_velocity: Real | None = None,
    ):
        part = f"'{name}'"
        self.name = name
        self.numbers = dict(
            mass=positive(part, "`mass`", mass),
            inertia=positive(part, "`inertia`", inertia),
        )
        place = number(part, "`position`", position, (2,))
        self.q = joined(place, number(part, "`angle`", angle, ()))
        self.v, self.given = velocities(
            f"'{name}'", (velocity, (2,)), (angular_velocity, ())
        )

    @property
    def kind(self) -> AbstractBodyCoordinates:
        return PlanarBodies()

    @staticmethod
    def rod(
        name: str,
        mass: Real,
        start: Vector,
        end: Vector,
        velocity: Vector | None = None,
        angular_velocity: Real | None = None,
    ) -> "PlanarBody":
        """A uniform slender rod between two points of the plane.

        Its ends are `[-l/2, 0]` and `[l/2, 0]` in its frame, with the inertia `m l^2/12`.
        """
        first = number(f"'{name}'", "`start`", start, (2,))
        along = number(f"'{name}'", "`end`", end, (2,)) - first
        xp = module_of(along)
        turned = xp.arctan2(along[1], along[0])
        mass = positive(f"'{name}'", "`mass`", mass)
        return PlanarBody(
            name,
            mass,
            mass * xp.sum(along**2) / 12,
            first + along / 2,
            turned,
            velocity=velocity,
            angular_velocity=angular_velocity,
        )


class RigidBody(AbstractBody):
    """A rigid body in space, in directors: the one to take first.

    **Arguments:**

    - `name`: a string, unique in the scene.
    - `mass`: positive.
    - `inertia`: about the mass centre, in the frame of the body: three principal moments
      or a matrix `(3, 3)` (mass length^2).
    - `position`, `velocity`: of the mass centre at the start, three entries each.
    - `rotation`: at the start, a unit quaternion (scalar first) or a matrix `(3, 3)` with
      the body axes in space along its columns; parallel to space where not given.
    - `angular_velocity`: at the start, in space (angle per time).

    Twelve coordinates, the mass centre and the body axes as vectors in space, and six
    constraints of their own. Inertia is constant and points are linear in the
    coordinates, so that `EnergyPreserving` keeps momenta to round-off, and the equations
    of many bodies stay sparse.

    **Raises:** `ValueError` for moments of inertia that no body has, and for those of a
    flat body or a thin rod: with no mass across, an axis would have no inertia of its own.
    Give such a body its thickness, or take `QuaternionBody`.
    """

    def __init__(
        self,
        name: str,
        mass: Real,
        inertia: Vector,
        position: Vector,
        rotation: Vector | None = None,
        *,
        velocity: Vector | None = None,
        angular_velocity: Vector | None = None,
    ):
        self.name = name
        self.numbers = mass_and_inertia(name, mass, inertia, may_be_flat=False)
        place = number(f"'{name}'", "`position`", position, (3,))
        axes = rotation_matrix(name, rotation).T
        self.q = joined(place, axes)
        v, given = velocities(f"'{name}'", (velocity, (3,)), (angular_velocity, (3,)))
        self.v = joined(v[:3], module_of(v, axes).cross(v[None, 3:], axes))
        self.given = (*given[:3], *given[3:] * 3)

    @property
    def kind(self) -> AbstractBodyCoordinates:
        return DirectorBodies()


class QuaternionBody(AbstractBody):
    """A rigid body in space, in Euler parameters.

    Arguments as for `RigidBody`. Seven coordinates, the mass centre and a unit quaternion
    (scalar first); velocities are those of the mass centre and the angular velocity in
    body axes. For flat bodies, which `RigidBody` refuses. Angular momentum is kept to
    second order, steps are solved densely, and `EnergyConsistent` needs `RigidBody`.
    """

    def __init__(
        self,
        name: str,
        mass: Real,
        inertia: Vector,
        position: Vector,
        rotation: Vector | None = None,
        *,
        velocity: Vector | None = None,
        angular_velocity: Vector | None = None,
    ):
        self.name = name
        self.numbers = mass_and_inertia(name, mass, inertia, may_be_flat=True)
        place = number(f"'{name}'", "`position`", position, (3,))
        matrix = rotation_matrix(name, rotation)
        self.q = joined(place, quaternion_of(matrix))
        v, self.given = velocities(f"'{name}'", (velocity, (3,)), (angular_velocity, (3,)))
        self.v = joined(v[:3], v[3:] @ matrix)

    @property
    def kind(self) -> AbstractBodyCoordinates:
        return QuaternionBodies()


__dir__ = only_parts(globals())
