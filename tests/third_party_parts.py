"""Parts of scenes, written with public names alone."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

import enerjax as ej
from enerjax.scenes import Ends, Frame


@dataclass(frozen=True)
class RollingRows(ej.scenes.AbstractConstraintLaw):
    """The centre stays at the height of the radius, and rolls as far as it turns."""

    reads = ("origin", "axes", "angle")
    measure = ej.scenes.PlanarTurn()

    def __call__(self, a: Frame, b: Frame, numbers: dict) -> jax.Array:
        line, normal = map(a.direction, numbers["frame_a"])
        apart = b.origin - a.point(numbers["point_a"])
        turned = numbers["radius"] * (b.angle - a.angle)
        rolled = apart @ line + turned - numbers["offset"]
        return jnp.stack([apart @ normal - numbers["radius"], rolled])


class Rolling(ej.joints.AbstractJoint):
    """A wheel `b` of the given `radius` rolls on a line of body `a`, in the plane.

    The line goes through `point_a` along `axis`; the wheel is on its left.
    """

    radius: float
    axis: list[float]
    point_a: list[float] | None = None

    def resolve(self, ends: Ends) -> tuple[RollingRows, dict]:
        ends.only_in_plane("A rolling wheel is a part of the plane")
        ends.only_bodies_that_turn()
        numbers = ends.first_axes(self.axis)
        numbers["point_a"] = ends.origins(self.point_a, None)["point_a"]
        numbers |= dict(radius=self.radius, offset=0.0)
        # From the start pose: what the wheel has rolled there counts as nothing.
        _, numbers["offset"] = RollingRows()(*ends.frames, numbers)
        return RollingRows(), numbers


@dataclass(frozen=True)
class Hardening(ej.scenes.AbstractSpringLaw):
    """The energy of a spring with a cubic term, over the distance of two points."""

    measure = ej.scenes.Separation()

    def energy(self, value: jax.Array, numbers: dict) -> jax.Array:
        stretch = value - numbers["length"]
        cubic = numbers["cubic"] * stretch**4 / 4
        return numbers["stiffness"] * stretch**2 / 2 + cubic


class HardeningSpring(ej.forces.AbstractForce):
    """A spring with the force `stiffness x + cubic x^3`, where `x` is its stretch."""

    stiffness: float
    cubic: float
    length: float

    def resolve(self, ends: Ends) -> tuple[Hardening, dict]:
        numbers, _ = ends.separate_points(None, None)
        own = dict(stiffness=self.stiffness, cubic=self.cubic, length=self.length)
        return Hardening(), numbers | own


@dataclass(frozen=True)
class Attraction(ej.scenes.AbstractPotentialLaw):
    """The energy of two masses that attract each other."""

    def __call__(self, a: Frame, b: Frame, numbers: dict) -> jax.Array:
        apart = b.origin - a.origin
        return -numbers["strength"] / jnp.sqrt(apart @ apart)


class Gravitation(ej.forces.AbstractForce):
    """Two bodies attract each other; `strength` is `G m1 m2`."""

    strength: float

    def resolve(self, ends: Ends) -> tuple[Attraction, dict]:
        return Attraction(), dict(strength=self.strength)


@dataclass(frozen=True)
class QuadraticDrag(ej.scenes.AbstractForceLaw):
    """A force against the velocity of a point, which grows with its square."""

    measure = ej.scenes.Place()

    def force(self, a: Frame, b: Frame, rate: jax.Array, numbers: dict) -> jax.Array:
        return -numbers["coefficient"] * jnp.sqrt(rate @ rate) * rate


class Drag(ej.forces.AbstractForce):
    """The resistance of the air, or of what else body `a` is, to the centre of body `b`."""

    coefficient: float

    def resolve(self, ends: Ends) -> tuple[QuadraticDrag, dict]:
        return QuadraticDrag(), ends.origins(None, None) | dict(
            coefficient=self.coefficient
        )


def cuboid(name: str, density: float, sides: list[float], position, **start):
    """A rigid body that fills a box; its mass and its inertia follow from the sides."""
    x, y, z = sides
    mass = density * x * y * z
    moments = [y**2 + z**2, z**2 + x**2, x**2 + y**2]
    inertia = [mass / 12 * moment for moment in moments]
    return ej.bodies.RigidBody(name, mass, inertia, position, **start)
