"""Laws of the springs and dampers of files that scenes have no part for."""

import math
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Scalar
from .._frames import Frame, Numbers, Point
from .._laws import AbstractForceLaw, AbstractPotentialLaw, AbstractSpringLaw
from .._measures import AbstractMeasure


# Below this value of `1 - cos x` the series of `x^2` is used. Its terms reach round-off:
# the next is `u^4 / 35`, 1e-14 of the first.
_SMALL_TURN = 1e-4


@dataclass(frozen=True)
class CubicSpring(AbstractSpringLaw):
    """A spring with the force `-(k x + k2 x^2 + k3 x^3)`, where `x` is its stretch."""

    measure: AbstractMeasure
    rest: str

    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        x = value - numbers[self.rest]
        cubic = numbers["quadratic"] * x**3 / 3 + numbers["cubic"] * x**4 / 4
        return 0.5 * numbers["stiffness"] * x**2 + cubic


@dataclass(frozen=True)
class CubicDamper(AbstractForceLaw):
    """A damper with the force `-(d x + d2 x |x| + d3 x^3)`, where `x` is the rate."""

    measure: AbstractMeasure

    def force(self, a: Frame, b: Frame, rate: Array, numbers: Numbers) -> Array:
        higher = numbers["quadratic"] * jnp.abs(rate) + numbers["cubic"] * rate**2
        return -(numbers["damping"] + higher) * rate


@dataclass(frozen=True)
class Anchored(AbstractPotentialLaw):
    """A spring from a point of the second body to a point of the first, of no length."""

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        apart = b.point(numbers["point_b"]) - a.point(numbers["point_a"])
        return 0.5 * numbers["stiffness"] * jnp.sum(apart**2)


@dataclass(frozen=True)
class TurnedApart(AbstractPotentialLaw):
    """A spring of the rotation between two bodies: half the stiffness times its angle
    squared.

    The angle is that of the rotation from `numbers["frame_a"]` to `numbers["frame_b"]`,
    about whichever axis. The energy has a kink at half a turn.
    """

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        of_a = numbers["frame_a"] @ a.rotation.T
        of_b = numbers["frame_b"] @ b.rotation.T
        cosine = 0.5 * (jnp.sum(of_a * of_b) - 1)
        sine = 0.5 * jnp.sum(jnp.cross(of_a, of_b), axis=0)
        return 0.5 * numbers["stiffness"] * _squared_angle(cosine, sine)


def _squared_angle(cosine: Scalar, sine: Point) -> Scalar:
    """The square of an angle between 0 and half a turn, smooth at 0."""
    less = 1 - cosine
    is_small = less < _SMALL_TURN
    series = less * (2 + less / 3 + 4 * less**2 / 45)
    size = jnp.sqrt(jnp.where(is_small, 1, jnp.sum(sine**2)))
    angle = jnp.arctan2(size, jnp.where(is_small, 1, cosine))
    return jnp.where(is_small, series, angle**2)


@dataclass(frozen=True)
class RelativeAxes(AbstractMeasure):
    """The cosines between all axes of two bodies, over the square root of two.

    The square of its rate is that of the relative angular velocity, so a viscous damper of
    this measure is one of the relative rotation.
    """

    is_vector = True

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Float[Array, " cosines"]:
        return (a.rotation.T @ b.rotation).reshape(-1) / math.sqrt(2)
