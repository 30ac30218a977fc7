"""Bodies.

The origin of a body frame is the mass centre. Poses and velocities are those of the start,
in space; points, axes and inertias are in the frame of the body. Velocities that are left
out follow from the others and the joints.

`shape` is what pictures show of a body: one of `ej.shapes`, or a list of them, which is
empty if the body is not to be seen. By default it follows from the joints and the inertia:
see `docs/pictures.md`.
"""

from .._programs import module_of
from .._types import Real, Vector
from ._arguments import joined, number, positive, velocities
from ._beam import Beam as Beam
from ._body import AbstractBody as AbstractBody
from ._body_coordinates import (
    AbstractBodyCoordinates,
    DirectorBodies,
    PlanarBodies,
    Points,
    QuaternionBodies,
)
from ._part import only_parts
from ._rotations import mass_and_inertia, quaternion_of, rotation_matrix
from .shapes import as_shapes, Capsule, Shape


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
        self,
        name: str,
        mass: Real,
        position: Vector,
        velocity: Vector | None = None,
        *,
        shape: Shape | None = None,
    ):
        self.name, self.shapes = name, as_shapes(f"'{name}'", shape)
        self.numbers = dict(mass=positive(f"'{name}'", "`mass`", mass))
        self.q = number(f"'{name}'", "`position`", position, (2,), (3,))
        self.v, self.prescribed = velocities(f"'{name}'", (velocity, self.q.shape))

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

    Its coordinates are the mass centre and the angle, which counts full turns. Each is
    a body in `rigid_bodies` of `System`.
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
        shape: Shape | None = None,
    ):
        part = f"'{name}'"
        self.name, self.shapes = name, as_shapes(part, shape)
        self.numbers = dict(
            mass=positive(part, "`mass`", mass),
            inertia=positive(part, "`inertia`", inertia),
        )
        place = number(part, "`position`", position, (2,))
        self.q = joined(place, number(part, "`angle`", angle, ()))
        self.v, self.prescribed = velocities(part, (velocity, (2,)), (angular_velocity, ()))

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
        *,
        shape: Shape | None = None,
    ) -> "PlanarBody":
        """A uniform slender rod between two points of the plane.

        Its ends are `[-l/2, 0]` and `[l/2, 0]` in its frame, with the inertia `m l^2/12`.
        """
        first = number(f"'{name}'", "`start`", start, (2,))
        along = number(f"'{name}'", "`end`", end, (2,)) - first
        xp = module_of(along)
        turned = xp.arctan2(along[1], along[0])
        mass = positive(f"'{name}'", "`mass`", mass)
        squared = xp.sum(along**2)
        if shape is None:
            shape = Capsule(None, xp.sqrt(squared))
        return PlanarBody(
            name,
            mass,
            mass * squared / 12,
            first + along / 2,
            turned,
            velocity=velocity,
            angular_velocity=angular_velocity,
            shape=shape,
        )


class RigidBody(AbstractBody):
    """A rigid body in space, with directors as coordinates: the recommended kind.

    **Arguments:**

    - `name`: a string, unique in the scene.
    - `mass`: positive.
    - `inertia`: about the mass centre, in the frame of the body: three principal moments
      or a matrix `(3, 3)` (mass length^2).
    - `position`, `velocity`: of the mass centre at the start, three entries each.
    - `rotation`: at the start, a unit quaternion (scalar first) or a matrix `(3, 3)` with
      the body axes in space along its columns; the identity by default.
    - `angular_velocity`: at the start, in space (angle per time).

    The body has twelve coordinates, the mass centre and the body axes as vectors in space.
    `EnergyPreserving`, `EnergyDecaying`, `EnergyMomentumDecaying` and their compositions
    move it by rotations, with six unknowns in a step. The first and the third conserve
    momenta to round-off. Other schemes impose six constraints between its axes; see
    `rigid_bodies` of `System`.

    The body can be flat, so that one of its principal moments is the sum of the other two:
    a plate, or a rod whose inertia about its own axis is small. Schemes that impose
    constraints between the axes refuse flat bodies.

    **Raises:** `ValueError` for moments of inertia that no body has, and for a moment of
    zero.
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
        shape: Shape | None = None,
    ):
        self.name, self.shapes = name, as_shapes(f"'{name}'", shape)
        self.numbers = mass_and_inertia(name, mass, inertia)
        axes = rotation_matrix(name, rotation).T
        self.q = joined(number(f"'{name}'", "`position`", position, (3,)), axes)
        v, flags = velocities(f"'{name}'", (velocity, (3,)), (angular_velocity, (3,)))
        self.v = joined(v[:3], module_of(v, axes).cross(v[None, 3:], axes))
        self.prescribed = (*flags[:3], *flags[3:] * 3)

    @property
    def kind(self) -> AbstractBodyCoordinates:
        return DirectorBodies()


class QuaternionBody(AbstractBody):
    """A rigid body in space, with Euler parameters as coordinates.

    The arguments are those of `RigidBody`. It has seven coordinates, the mass centre and a
    unit quaternion (scalar first); its velocities are that of the mass centre and the
    angular velocity in body axes. Angular momentum is conserved to second order only, and
    `EnergyConsistent` cannot be used.
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
        shape: Shape | None = None,
    ):
        self.name, self.shapes = name, as_shapes(f"'{name}'", shape)
        self.numbers = mass_and_inertia(name, mass, inertia)
        matrix, part = rotation_matrix(name, rotation), f"'{name}'"
        position = number(part, "`position`", position, (3,))
        self.q = joined(position, quaternion_of(matrix))
        v, self.prescribed = velocities(part, (velocity, (3,)), (angular_velocity, (3,)))
        self.v = joined(v[:3], v[3:] @ matrix)

    @property
    def kind(self) -> AbstractBodyCoordinates:
        return QuaternionBodies()


__dir__ = only_parts(globals())
