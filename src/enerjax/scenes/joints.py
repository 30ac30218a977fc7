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
import numpy as np
from jaxtyping import Array

from .._programs import is_known, module_of
from .._types import Real, Vector
from ._arguments import basis, direction, positive
from ._ends import Ends
from ._frames import Numbers
from ._laws import (
    AbstractConstraintLaw,
    Alignment,
    Curve,
    Edge,
    Length,
    Rolling,
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

    Three constraints in the plane, six in space. The point, if none is passed, is the
    origin of the second body. If both are passed, they must coincide.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        axis = [1.0, 0.0, 0.0][: ends.dimension]
        is_given = self.point_a is not None or self.point_b is not None
        point_b = self.point_b if is_given else [0.0] * ends.dimension
        numbers = ends.points(self.point_a, point_b) | ends.axes(axis)
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


class AbstractRolling(AbstractJoint):
    """A body that rolls without slip on a plane, in the plane on a line.

    - `radius`: of the rolling body, positive (length).
    - `normal`: of the plane, in the frame of the first body, on the side of the rolling
      body; by default the last axis of the frame.
    - `point_a`: a point of the plane, by default the origin of the first body.
    - `point_b`: the centre of the rolling body, by default its mass centre.
    """

    radius: Real
    normal: Vector | None = eqx.field(default=None, kw_only=True)
    point_a: Vector | None = eqx.field(default=None, kw_only=True)
    point_b: Vector | None = eqx.field(default=None, kw_only=True)

    def plane(self, ends: Ends) -> Numbers:
        """The plane, with its normal in the last row of `frame_a`, the centre and the
        radius."""
        ends.only_bodies_that_turn()
        up = [0.0] * (ends.dimension - 1) + [1.0] if self.normal is None else self.normal
        normal = direction(ends.part, "`normal`", up, ends.dimension)
        along = normal if ends.dimension == 3 else normal[::-1] * np.array([1.0, -1.0])
        radius = positive(ends.part, "`radius`", self.radius)
        numbers = dict(frame_a=basis(along), radius=radius)
        return numbers | ends.origins(self.point_a, self.point_b)


class RollingDisc(AbstractRolling):
    """A disc or wheel of the second body that rolls without slip on a plane of the first.

    One constraint keeps its edge on the plane. Nonholonomic constraints hold the lowest
    point of the edge: two in space, where the disc may lean and turn, and one in the plane,
    where it rolls on a line. `axis_b` is the axle of the disc, in the frame of the second
    body; in the plane there is none. A disc must not lie flat.

    The edge is a circle, without a width. In space the constraint is the square
    `height^2 - radius^2 cos(lean)^2`, so its multiplier is no force; `scene.reaction` tells
    the force and the torque about the centre.

    Raises a `ValueError` for a disc that lies flat or is below its plane at the start.
    """

    axis_b: Vector | None = eqx.field(default=None, kw_only=True)

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        numbers = self.plane(ends)
        if ends.dimension == 2:
            ends.refuse_axes(self.axis_b)
            return Rolling(has_axle=False), numbers
        if self.axis_b is None:
            raise ValueError(f"{ends.part} needs `axis_b`, the axle of the disc.")
        numbers["axle"] = direction(ends.part, "`axis_b`", self.axis_b, 3)
        _check_upright(ends, numbers)
        return Rolling(has_axle=True), numbers


def _check_upright(ends: Ends, numbers: Numbers) -> None:
    """Raises an error for a disc that is flat on its plane, or below it."""
    a, b = ends.frames
    if not is_known((a, b, numbers)):
        return
    normal, axle = numbers["frame_a"][2] @ a.axes, numbers["axle"] @ b.axes
    if abs(normal @ axle) > 1 - 1e-9:
        raise ValueError(f"The disc of {ends.part} lies flat on its plane at the start.")
    centre = b.origin + numbers["point_b"] @ b.axes
    if normal @ (centre - a.origin - numbers["point_a"] @ a.axes) < 0:
        raise ValueError(
            f"The centre of the disc of {ends.part} is below its plane at the start, on "
            "the side opposite to the `normal`."
        )


class RollingSphere(AbstractRolling):
    """A sphere of the second body that rolls without slip on a plane of the first.

    One constraint keeps it on the plane, and two nonholonomic ones hold its lowest point.
    It may spin about the normal. In space.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        ends.only_in_space("A rolling sphere")
        return Rolling(has_axle=False), self.plane(ends)


class KnifeEdge(AbstractJoint):
    """Keeps a point of the second body from moving sideways: a skate, blade or runner.

    One nonholonomic constraint: the velocity of the point relative to the first body has no
    component along `axis_b`. In space another joint, such as `OnCurve`, must keep the edge
    on its surface.

    - `axis_b`: the direction across the edge, in the frame of the second body. In the plane
      it is by default the second axis, so the edge is along the first.
    - `point_b`: the point of the edge, by default the mass centre.
    """

    axis_b: Vector | None = eqx.field(default=None, kw_only=True)
    point_b: Vector | None = eqx.field(default=None, kw_only=True)

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        ends.only_bodies_that_turn()
        axis = [0.0, 1.0] if self.axis_b is None and ends.dimension == 2 else self.axis_b
        if axis is None:
            raise ValueError(f"{ends.part} needs `axis_b`, the direction across the edge.")
        side = direction(ends.part, "`axis_b`", axis, ends.dimension)
        return Edge(), dict(side=side) | ends.point_of_body(self.point_b)


class Constraint(AbstractFunctionOfPose):
    """A constraint of your own: `function(view, args)`, a vector that vanishes.

    `view` describes the pose: `view.position(body, point)`, `view.direction(body, axis)`,
    `view.angle(body)`, and the coordinates `view.q`.
    """

    name: str
    function: PoseFunction


__dir__ = only_parts(globals())
