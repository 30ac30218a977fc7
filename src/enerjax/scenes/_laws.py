"""The laws of joints, forces and drives: functions of the frames of two bodies.

Laws are compared by value, and equal ones are evaluated together. Constraints consist of
differences of points and dot products of body-fixed directions, because with these the
chain rule for difference quotients conserves energy and momenta to round-off.
"""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from typing_extensions import TypeAliasType

from .._programs import at_places
from .._types import Args, Multipliers, Scalar
from ._frames import Frame, Numbers, Point
from ._measures import AbstractLaw, AbstractMeasure, offset, Separation


# Pairs of axes that stay perpendicular where bodies keep an axis, and all directions.
SAME_AXIS = ((2, 0), (2, 1))
SAME_DIRECTIONS = ((0, 1), (1, 2), (2, 0))

# The direction that a joint keeps common to its bodies, or all of them.
Keeps: TypeAlias = Literal["axis", "directions"] | None


class AbstractConstraintLaw(AbstractLaw):
    """The rows of a joint: smooth functions of two frames that vanish, a vector.

    - `measure`: the length or angle that `scene.measure` tells of the joint, if any.
    - `keeps`: in space, `"axis"` where the last row of `numbers["frame_a"]` stays an axis
      of both bodies, so that springs, dampers and drives can act on the angle about it;
      `"directions"` where the bodies do not turn against each other; else `None`.

    If there is a `numbers["point_b"]`, it is the point of the second body about which the
    torque of a reaction is taken.
    """

    measure: AbstractMeasure | None = None
    keeps: Keeps = None

    @abc.abstractmethod
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        """The rows, shape `(rows,)`."""


@dataclass(frozen=True)
class Alignment(AbstractConstraintLaw):
    """Keeps two points together and pairs of axes perpendicular.

    - `along`: the axes of the first frame along which the points must coincide; `None` if
      they must coincide altogether.
    - `square`: pairs of axes, of the first and second frame, that stay perpendicular.
    """

    along: tuple[int, ...] | None
    square: tuple[tuple[int, int], ...] = ()
    measure: AbstractMeasure | None = None
    keeps: Keeps = None

    @property
    def has_frames(self) -> bool:
        return bool(self.square or self.along)

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        apart = offset(a, b, numbers)
        if not self.has_frames:
            return apart
        rows = [apart]
        if self.along is not None:
            rows = [a.direction(_chosen(numbers["frame_a"], self.along)) @ apart]
        if self.square:
            i, j = zip(*self.square, strict=True)
            of_a = a.direction(_chosen(numbers["frame_a"], i))
            of_b = b.direction(_chosen(numbers["frame_b"], j))
            rows.append(jnp.sum(of_a * of_b, axis=1))
        return jnp.concatenate(rows)


def _chosen(frame: Array, axes: Sequence[int]) -> Array:
    """Some axes of a frame, shape `(n, d)`; a single one if all are the same."""
    chosen = axes[:1] if len(set(axes)) == 1 else axes
    return at_places(frame, np.array(chosen))


@dataclass(frozen=True)
class Length(AbstractConstraintLaw):
    measure = Separation()

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return (jnp.sum(offset(a, b, numbers) ** 2) - numbers["length"] ** 2)[None]


@dataclass(frozen=True)
class Curve(AbstractConstraintLaw):
    function: Callable[[Point, Numbers], Multipliers]

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        apart = b.point(numbers["point_b"]) - a.origin
        return self.function(a.components(apart), numbers)


class AbstractNonholonomicLaw(AbstractConstraintLaw):
    """A joint that also forbids two bodies to slip where they touch.

    Its rows keep the bodies in contact, and may be none. The velocities of both bodies at
    the contact are equal along some directions, which are nonholonomic constraints.
    """

    @abc.abstractmethod
    def contact(self, a: Frame, b: Frame, numbers: Numbers) -> tuple[Point, Array]:
        """The point in space where the bodies touch, and the directions along which they
        must not slip as rows, shape `(k, d)`."""

    def slip(self, a: Frame, b: Frame, at: tuple[Frame, Frame], numbers: Numbers) -> Array:
        """The displacements that are forbidden when the bodies move from the frames `at`
        to `a` and `b`, in the limit of short ones; shape `(k,)`.

        The points of the bodies are those that are in contact at first.
        """
        place, directions = self.contact(*at, numbers)
        first, second = (
            frame.point(old.components(place - old.origin))
            for frame, old in zip((a, b), at, strict=True)
        )
        return directions @ (second - first)


def all_rows(
    law: AbstractLaw, a: Frame, b: Frame, at: tuple[Frame, Frame], numbers: Numbers
) -> Any:
    """The rows of a law, followed by the slip of a contact from the frames `at`."""
    rows = law(a, b, numbers)
    if isinstance(law, AbstractNonholonomicLaw):
        rows = jnp.concatenate([rows, law.slip(a, b, at, numbers)])
    return rows


@dataclass(frozen=True)
class Rolling(AbstractNonholonomicLaw):
    """A disc or sphere on a plane (in the plane, on a line) of the first body.

    - `has_axle`: whether it is a disc in space, whose axle is `numbers["axle"]`.

    The row of a disc is quadratic in the frames, so that its discrete gradient is exact.
    """

    has_axle: bool

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        normal, radius = self._normal(a, numbers), numbers["radius"]
        height = jnp.sum(offset(a, b, numbers) * normal)
        if not self.has_axle:
            return (height - radius)[None]
        lean = jnp.sum(b.direction(numbers["axle"]) * normal)
        return (height**2 + radius**2 * (lean**2 - 1))[None]

    def contact(self, a: Frame, b: Frame, numbers: Numbers) -> tuple[Point, Array]:
        down = -self._normal(a, numbers)
        if self.has_axle:
            axle = b.direction(numbers["axle"])
            down = down - jnp.sum(down * axle) * axle
            down = down / jnp.sqrt(jnp.sum(down**2))
        place = b.point(numbers["point_b"]) + numbers["radius"] * down
        along = [a.direction(numbers["frame_a"][k]) for k in range(down.size)]
        return place, jnp.stack(along[:1] if down.size == 2 else along[:2])

    def _normal(self, a: Frame, numbers: Numbers) -> Point:
        return a.direction(numbers["frame_a"][-1])


@dataclass(frozen=True)
class Edge(AbstractNonholonomicLaw):
    """A point of the second body that does not slip along the direction
    `numbers["side"]`."""

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return b.origin[:0]

    def contact(self, a: Frame, b: Frame, numbers: Numbers) -> tuple[Point, Array]:
        return b.point(numbers["point_b"]), b.direction(numbers["side"])[None]


class AbstractPotentialLaw(AbstractLaw):
    """A potential energy of two bodies, a smooth function of their frames."""

    @abc.abstractmethod
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        """The energy, a scalar."""


class AbstractLawOfMeasure(AbstractLaw):
    """A law of a length, an angle or a vector; it reads what this measure reads."""

    measure: AbstractMeasure

    @property
    def reads(self) -> tuple[str, ...]:
        return self.measure.reads


class AbstractSpringLaw(AbstractLawOfMeasure):
    """A potential energy of a measure; the force along the measure is minus its slope.

    - `damper`: a force along the same measure that acts as well, if any.
    """

    measure: AbstractMeasure
    damper: "AbstractForceLaw | None" = None

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return self.energy(self.measure(a, b, numbers), numbers)

    @abc.abstractmethod
    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        """The energy, a scalar, for the value of the measure."""


@dataclass(frozen=True)
class Elastic(AbstractSpringLaw):
    """A linear spring, whose force vanishes if the measure is `numbers[rest]`."""

    measure: AbstractMeasure
    rest: str

    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        return 0.5 * numbers["stiffness"] * self.strain(value, numbers) ** 2

    def strain(self, value: Array, numbers: Numbers) -> Scalar:
        """The difference of the measure from its value without force."""
        return value - numbers[self.rest]


@dataclass(frozen=True)
class Steady(AbstractSpringLaw):
    """A constant force `numbers[load]` along a measure."""

    measure: AbstractMeasure
    load: str

    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        return -jnp.sum(numbers[self.load] * value)


# Laws that depend on time or velocities -------------------------------------------------

# A function of time and of the `args` of the system.
Signal = TypeAliasType("Signal", Callable[[Scalar, Args], Array])


@dataclass(frozen=True)
class Driven(AbstractLawOfMeasure):
    """Keeps a measure at the value of a signal, which is in `numbers["value"]`."""

    measure: AbstractMeasure
    signal: Signal

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return self.measure.constraint(a, b, numbers, numbers["value"])


@dataclass(frozen=True)
class Flywheel(AbstractLawOfMeasure):
    """Keeps a measure at the coordinate of an inerter, which is in `numbers["value"]`."""

    measure: AbstractMeasure

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return self.measure.constraint(a, b, numbers, numbers["value"])


@dataclass(frozen=True)
class Deviation(AbstractLawOfMeasure):
    """The difference of a measure from `numbers["value"]`, at which it is to be kept."""

    measure: AbstractMeasure

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Multipliers:
        return self.measure.deviation(a, b, numbers, numbers["value"])


class AbstractForceLaw(AbstractLawOfMeasure):
    """A force along a measure that has no potential; its power is `force * rate`.

    - `resists`: whether the force depends on this rate.
    """

    measure: AbstractMeasure

    @property
    def resists(self) -> bool:
        return True

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Any:
        return self.measure(a, b, numbers)

    @abc.abstractmethod
    def force(self, a: Frame, b: Frame, rate: Array, numbers: Numbers) -> Array:
        """The force at this rate of the measure, of the shape of the measure."""


@dataclass(frozen=True)
class Viscous(AbstractForceLaw):
    measure: AbstractMeasure

    def force(self, a: Frame, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return -numbers["damping"] * rate


@dataclass(frozen=True)
class Gap(AbstractLawOfMeasure):
    """A gap that must not become negative, with an impact where it closes."""

    measure: AbstractMeasure
    is_elastic: bool

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Scalar:
        return self.measure(a, b, numbers)


def _compression(gap: Scalar, numbers: Numbers, exponent: Scalar) -> Scalar:
    """A power of the penetration, zero where the gap is open."""
    closed = gap < 0
    # The inner choice keeps the derivative with respect to the exponent finite.
    return jnp.where(closed, jnp.where(closed, -gap, 1.0) ** exponent, 0.0)


@dataclass(frozen=True)
class Penalized(AbstractSpringLaw):
    """The energy of a spring that acts where a gap is negative; it may have a damper."""

    measure: AbstractMeasure
    is_damped: bool

    @property
    def damper(self) -> "AbstractForceLaw | None":
        return CompressionDamper(self.measure) if self.is_damped else None

    def energy(self, value: Array, numbers: Numbers) -> Scalar:
        exponent = numbers["exponent"] + 1
        energy = _compression(value, numbers, exponent)
        return numbers["stiffness"] * energy / exponent


@dataclass(frozen=True)
class CompressionDamper(AbstractForceLaw):
    """The damper of Hunt and Crossley."""

    measure: AbstractMeasure

    def force(self, a: Frame, b: Frame, rate: Array, numbers: Numbers) -> Array:
        gap = self.measure(a, b, numbers)
        force = numbers["stiffness"] * _compression(gap, numbers, numbers["exponent"])
        return -numbers["damping"] * force * rate


@dataclass(frozen=True)
class Acting(AbstractForceLaw):
    """A force with the value of a signal, which is in `numbers["value"]`.

    With `feedback` the signal also depends on the motion of the bodies.
    """

    measure: AbstractMeasure
    signal: Callable[..., Array]
    feedback: bool

    @property
    def resists(self) -> bool:
        return self.feedback and not self.measure.is_vector

    def force(self, a: Frame, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return numbers["value"]


@dataclass(frozen=True)
class Following(Acting):
    """A force whose signal is a vector in the axes of its body."""

    def force(self, a: Frame, b: Frame, rate: Array, numbers: Numbers) -> Array:
        return b.direction(numbers["value"])


@dataclass(frozen=True)
class Turning(Acting):
    """A torque in space, or in the axes of the body that it `follows`.

    It acts on the axes: with the forces `torque x d_i / 2` and the rates `omega x d_i` the
    power is `torque . omega`.
    """

    follows: bool

    def force(self, a: Frame, b: Frame, rate: Array, numbers: Numbers) -> Array:
        torque = numbers["value"]
        if self.follows:
            torque = b.direction(torque)
        return 0.5 * jnp.cross(torque[None], b.axes).ravel()
