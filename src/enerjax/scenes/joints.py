"""Joints: what constrains two bodies, or a body and the `"ground"`.

Points and axes are told in the frames of their bodies; those of the ground are in space. Of
two points, one that is not given is where the other one is in the start pose; if neither is
given they are the origins of the frames. Axes that are not given for the second body follow
from the start pose too. So `Revolute("pin", "ground", "crank", [0.3, 0])` is a pin through
the crank, where the crank starts.

`args["joints"][name]` holds `point_a`, `point_b` and, for joints with axes, the axes of the
joint in either body, `frame_a` and `frame_b`, as rows (the axis comes last in space, first
in the plane).
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
from ._laws import AbstractConstraintLaw, Alignment, Curve, Length
from ._measures import AbstractMeasure, PlanarTurn, Slide, Turn
from ._names import only_parts
from ._part import AbstractFunctionOfPose, AbstractPart, PoseFunction
from ._user_functions import check_function, vector_of


# Pairs of axes that stay perpendicular where bodies keep an axis, and all directions.
_SAME_AXIS = ((2, 0), (2, 1))
_SAME_DIRECTIONS = ((0, 1), (1, 2), (2, 0))


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

    Two constraints in the plane, where there is no `axis` to give, five in space. `axis`
    is told in the first body, `axis_b` in the second.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        points = ends.points(self.point_a, self.point_b)
        if ends.dimension == 2:
            ends.refuse_axes(self.axis, self.axis_b)
            return Alignment(None, measure=_turn_in_plane(ends)), points
        law = Alignment(None, _SAME_AXIS, Turn(), "axis")
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
    """Lets a body slide along an axis of the first body, and turn about none.

    Two constraints in the plane, five in space.
    """

    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        numbers = ends.points(self.point_a, self.point_b) | ends.axes(self.axis)
        if ends.dimension == 2:
            return Alignment((1,), ((0, 1),), Slide()), numbers
        return Alignment((0, 1), _SAME_DIRECTIONS, Slide(), "directions"), numbers


class Cylindrical(AbstractAxisJoint):
    """Lets a body slide along an axis of the first body and turn about it, in space.

    Four constraints.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        ends.only_in_space("A cylindrical joint")
        numbers = ends.points(self.point_a, self.point_b)
        law = Alignment((0, 1), _SAME_AXIS, Turn(), "axis")
        return law, numbers | ends.axes(self.axis, self.axis_b)


class Planar(AbstractAxisJoint):
    """Lets a body slide and turn in the plane of the first body that `axis` is normal to.

    Three constraints, in space.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        ends.only_in_space("A planar joint")
        numbers = ends.points(self.point_a, self.point_b)
        law = Alignment((2,), _SAME_AXIS, Turn(), "axis")
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
        return Alignment(None, _SAME_DIRECTIONS, keeps="directions"), numbers


class Distance(AbstractPointJoint):
    """Holds two points at a distance: a rod without mass. One constraint.

    Points that are not given are the origins of the frames, a `length` (positive) that is
    not given is that of the start. The points must not meet.
    """

    length: Real | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractConstraintLaw, Numbers]:
        numbers, start = ends.apart(self.point_a, self.point_b)
        length = start if self.length is None else self.length
        return Length(), numbers | dict(length=positive(ends.part, "`length`", length))


class OnCurve(AbstractJoint):
    """Holds a point of the second body on a curve or surface in the first.

    `curve(x, numbers)` is a vector of smooth functions of a point `x` in the frame of the
    first body, shape `(2,)` or `(3,)`, that vanish on the curve: one entry for a curve in
    the plane or a surface in space, two for a curve in space. `numbers` is the dictionary
    of floats given here, found again in `args["joints"][name]`.
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
        point = ends.origins(None, self.point_b)["point_b"]
        x = jnp.zeros((ends.dimension,))
        jax.eval_shape(lambda x: vector_of(self.name, self.curve, x, own), x)
        return Curve(self.curve), own | dict(point_b=point)


class Constraint(AbstractFunctionOfPose):
    """A constraint of your own: `function(view, args)`, a vector that vanishes.

    `view` tells where the bodies are: `view.position(body, point)`,
    `view.direction(body, axis)`, `view.angle(body)` and `view.q`, the coordinates.
    """

    name: str
    function: PoseFunction


__dir__ = only_parts(globals())
