"""Joints: constraints between two bodies, or a body and the `"ground"`.

Points and axes are in the frames of their bodies; those of the ground are in space. If one
of the two points is left out, it coincides with the other in the start pose; if both are,
they are the origins of the frames. The axis in the second body follows from the start pose
too. So `Revolute("pin", "ground", "crank", [0.3, 0])` is a pin at `[0.3, 0]`, through the
point of the crank that is there at the start.

`args["joints"][name]` contains `point_a`, `point_b` and, for joints with axes, the axes of
the joint in both bodies, `frame_a` and `frame_b`, as rows (the axis itself is the last of
them in space, and the first in the plane).
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._types import Real, Vector
from ._arguments import module_of, positive
from ._ends import Ends
from ._frames import Numbers
from ._laws import (
    AbstractConstraintLaw,
    Alignment,
    Curve,
    Length,
    SAME_AXIS,
    SAME_DIRECTIONS,
)
from ._measures import AbstractMeasure, PlanarTurn, Slide, Turn
from ._part import AbstractFunctionOfPose, AbstractPart, only_parts, PoseFunction
from ._user_functions import check_function, vector_of


def _turn_in_plane(ends: Ends) -> AbstractMeasure | None:
    """The angle of a pin in the plane, where both bodies have one."""
    return PlanarTurn() if ends.dimension == 2 and all(ends.turns) else None


class AbstractJoint(AbstractPart):
    """A joint of a scene; its law is that of its rows."""

    @abc.abstractmethod
    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        """Its law and its numbers, from the start pose of its bodies."""


class AbstractPointJoint(AbstractJoint):
    """A joint of a point of the first body and a point of the second."""

    point_a: Vector | None = None
    point_b: Vector | None = None


class AbstractAxisJoint(AbstractPointJoint):
    """A joint of two points, an `axis` in the first body and `axis_b` in the second."""

    axis: Vector | None = None
    axis_b: Vector | None = None


class Spherical(AbstractPointJoint):
    """Holds two points together: a ball joint, three constraints in space.

    Their multipliers are minus the force on the second body.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        points = ends.points(self.point_a, self.point_b)
        return Alignment(None, measure=_turn_in_plane(ends)), points


class Revolute(AbstractAxisJoint):
    """Holds two points together, and in space an axis: a pin or hinge.

    Two constraints in the plane, where it takes no `axis`, five in space. `axis` is in the
    frame of the first body, `axis_b` in that of the second.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        points = ends.points(self.point_a, self.point_b)
        if ends.dimension == 2:
            ends.refuse_axes(self.axis, self.axis_b)
            return Alignment(None, measure=_turn_in_plane(ends)), points
        law = Alignment(None, SAME_AXIS, Turn(), "axis")
        return law, points | ends.axes(self.axis, self.axis_b)


class Universal(AbstractAxisJoint):
    """Holds two points together and two axes perpendicular: a Cardan joint, in space.

    Four constraints. `axis` is fixed in the first body, `axis_b` in the second.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        ends.only_in_space("A universal joint")
        points = ends.points(self.point_a, self.point_b)
        return Alignment(None, ((2, 2),)), points | ends.two_axes(self.axis, self.axis_b)


class Prismatic(AbstractPointJoint):
    """Lets a body slide along an axis of the first body, without turning.

    Two constraints in the plane, five in space.
    """

    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        numbers = ends.points(self.point_a, self.point_b) | ends.axes(self.axis)
        if ends.dimension == 2:
            return Alignment((1,), ((0, 1),), Slide()), numbers
        return Alignment((0, 1), SAME_DIRECTIONS, Slide(), "directions"), numbers


class Cylindrical(AbstractAxisJoint):
    """Lets a body slide along an axis of the first body and turn about it, in space.

    Four constraints.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        ends.only_in_space("A cylindrical joint")
        numbers = ends.points(self.point_a, self.point_b)
        law = Alignment((0, 1), SAME_AXIS, Turn(), "axis")
        return law, numbers | ends.axes(self.axis, self.axis_b)


class Planar(AbstractAxisJoint):
    """Lets a body slide and turn in a plane of the first body, to which `axis` is normal.

    Three constraints, in space.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        ends.only_in_space("A planar joint")
        numbers = ends.points(self.point_a, self.point_b)
        law = Alignment((2,), SAME_AXIS, Turn(), "axis")
        return law, numbers | ends.axes(self.axis, self.axis_b)


class Fixed(AbstractPointJoint):
    """Holds two bodies in the relative pose of the start.

    Three constraints in the plane, six in space.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        axis = [1.0, 0.0, 0.0][: ends.dimension]
        numbers = ends.points(self.point_a, self.point_b) | ends.axes(axis)
        if ends.dimension == 2:
            return Alignment(None, ((0, 1),)), numbers
        return Alignment(None, SAME_DIRECTIONS, keeps="directions"), numbers


class Distance(AbstractPointJoint):
    """Keeps the distance of two points: a rod without mass. One constraint.

    Points default to the origins of the frames, and the `length` (positive) to their
    distance at the start. The points must not coincide.
    """

    length: Real | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        numbers, start = ends.separate_points(self.point_a, self.point_b)
        length = start if self.length is None else self.length
        return Length(), numbers | dict(length=positive(ends.part, "`length`", length))


class OnCurve(AbstractJoint):
    """Keeps a point of the second body on a curve or surface of the first.

    `curve(x, numbers)` is a vector of smooth functions of a point `x` in the frame of the
    first body, shape `(2,)` or `(3,)`, that vanish on the curve: one entry for a curve in
    the plane or a surface in space, two for a curve in space. `numbers` is a dictionary of
    floats, which are also entries of `args["joints"][name]`.
    """

    curve: Callable[[Array, Numbers], Array]
    numbers: Numbers = eqx.field(default_factory=dict)
    point_b: Vector | None = None

    def __check_init__(self):
        check_function(self.name, "curve", self.curve, "x", "numbers")

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        own = {
            key: module_of(value).asarray(value) * 1.0
            for key, value in self.numbers.items()
        }
        x = jnp.zeros((ends.dimension,))
        jax.eval_shape(lambda x: vector_of(self.name, self.curve, x, own), x)
        return Curve(self.curve), own | ends.point_of_body(self.point_b)


class Constraint(AbstractFunctionOfPose):
    """A constraint of your own: `function(view, args)`, a vector that vanishes.

    `view` describes the pose: `view.position(body, point)`, `view.direction(body, axis)`,
    `view.angle(body)`, and the coordinates `view.q`.
    """

    name: str
    function: PoseFunction


__dir__ = only_parts(globals())
