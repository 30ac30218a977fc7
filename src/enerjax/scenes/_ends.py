"""The two bodies of a part in the start pose, from which missing points and axes follow."""

from typing import Any, NamedTuple

import numpy as np

from .._programs import is_known, module_of
from ._arguments import basis, direction, number
from ._frames import Frame, Numbers


# Axes count as parallel below this angle: users round them, and joints close small gaps.
_PARALLEL = 1e-3


class Hinge(NamedTuple):
    """A joint between two bodies, and the axis in space that it keeps common to both.

    The axis is `None` if the joint keeps every direction.
    """

    name: str
    bodies: frozenset[str]
    axis: Any

    def keeps(self, axis: Any) -> bool:
        if self.axis is None:
            return True
        return float(np.linalg.norm(np.cross(self.axis, axis))) <= _PARALLEL


class Hinges(tuple[Hinge, ...]):
    """All joints of a scene that keep an axis common to their bodies, at the start."""

    def share(self, a: str, b: str, axis: Any) -> bool:
        """Whether the joints keep an axis in space common to two bodies, directly or via
        other bodies. Axes that are traced count as common."""
        if not is_known((axis, [hinge.axis for hinge in self])):
            return True
        found, more = set(), {a}
        while more:
            found |= more
            joined = [x.bodies for x in self if x.keeps(axis) and x.bodies & found]
            more = set().union(*joined) - found
        return b in found

    def between(self, a: str, b: str) -> list[Hinge]:
        """The joints that directly connect two bodies and keep one axis."""
        return [x for x in self if x.bodies == {a, b} and x.axis is not None]


class Ends(NamedTuple):
    """The bodies that a part connects, in the start pose.

    - `part`, `bodies`: names, for messages.
    - `frames`: the frames of both bodies, with all fields.
    - `turns`: whether each body has an orientation; the ground has one.
    - `hinges`: the joints of the scene that keep an axis. It is empty while the joints
      themselves are resolved.
    """

    part: str
    bodies: tuple[str, str]
    frames: tuple[Frame, Frame]
    turns: tuple[bool, bool]
    hinges: Hinges = Hinges()

    @property
    def dimension(self) -> int:
        return self.frames[0].origin.size

    def points(self, point_a: Any, point_b: Any) -> Numbers:
        """Points in the body frames; a missing one is where the other is at the start."""
        a, b = self._point(0, point_a), self._point(1, point_b)
        if a is None and b is not None:
            a = self._in_frame(0, 1, b)
        elif b is None and a is not None:
            b = self._in_frame(1, 0, a)
        return self.origins(a, b)

    def origins(self, point_a: Any, point_b: Any) -> Numbers:
        """Points in the body frames; a missing one is the origin of its frame."""
        a, b = self._point(0, point_a), self._point(1, point_b)
        origin = 0 * self.frames[0].origin
        return dict(point_a=origin if a is None else a, point_b=origin if b is None else b)

    def point_of_body(self, point: Any) -> Numbers:
        """A point of the second body alone, by default its origin."""
        return dict(point_b=self.origins(None, point)["point_b"])

    def axes(self, axis_a: Any, axis_b: Any = None) -> Numbers:
        """The axes of the joint in both bodies, as rows; see `basis`."""
        self.only_bodies_that_turn()
        a, b = self.frames
        of_a = basis(self._axis("`axis`", axis_a))
        if axis_b is None:
            return dict(frame_a=of_a, frame_b=of_a @ a.axes @ b.axes.T)
        return dict(frame_a=of_a, frame_b=basis(self._axis("`axis_b`", axis_b)))

    def two_axes(self, axis_a: Any, axis_b: Any) -> Numbers:
        """`axes`, with an error if one is missing."""
        self._axis("`axis_b`", axis_b)
        return self.axes(axis_a, axis_b)

    def common_axis(self, axis: Any) -> Numbers:
        """`axes`, with an error unless joints keep the axis common to both bodies."""
        numbers = self.axes(axis)
        in_space = numbers["frame_a"][2] @ self.frames[0].axes
        (a, b), others = self.bodies, self.hinges.between(*self.bodies)
        if self.hinges.share(a, b, in_space):
            return numbers
        rounded = lambda axis: np.round(axis, 4).tolist()
        raise ValueError(
            f"{self.part} has an angle only with a joint about its axis, a `Revolute` or "
            f"`Cylindrical`, and none connects '{a}' and '{b}'"
            + "".join(f": '{x.name}' turns about {rounded(x.axis)}" for x in others)
            + (f", {self.part} about {rounded(in_space)}, in space." if others else ".")
        )

    def first_axes(self, axis_a: Any) -> Numbers:
        """The axes in the first body alone, as rows."""
        self._must_turn(0)
        return dict(frame_a=basis(self._axis("`axis`", axis_a)))

    def _axis(self, role: str, axis: Any) -> Any:
        if axis is None:
            raise ValueError(f"{self.part} needs {role}, a vector of {self.dimension}.")
        return direction(self.part, role, axis, self.dimension)

    def separate_points(self, point_a: Any, point_b: Any) -> tuple[Numbers, Any]:
        """`origins` and the distance of the points at the start, which must be positive."""
        numbers = self.origins(point_a, point_b)
        ends = zip(self.frames, ("point_a", "point_b"), strict=True)
        a, b = (frame.origin + numbers[key] @ frame.axes for frame, key in ends)
        xp = module_of(a, b)
        length = xp.sqrt(xp.sum((b - a) ** 2))
        if is_known(length) and length <= 1e-12 * (abs(a).max() + abs(b).max()):
            raise ValueError(
                f"{self.part} acts along the line between two points, but at the start "
                f"those of '{self.bodies[0]}' and '{self.bodies[1]}' coincide, in "
                f"{a.tolist()}."
            )
        return numbers, length

    def relative_angle(self) -> Any:
        """The difference of the angles of planar bodies at the start."""
        return self.frames[1].angle - self.frames[0].angle

    def refuse_axes(self, *axes: Any) -> None:
        if any(axis is not None for axis in axes):
            raise ValueError(f"{self.part} is in the plane, where it takes no axis.")

    def only_bodies_that_turn(self) -> None:
        self._must_turn(0)
        self._must_turn(1)

    def _must_turn(self, k: int) -> None:
        if not self.turns[k]:
            raise ValueError(
                f"{self.part} needs the orientation of '{self.bodies[k]}', and a point "
                "mass has none."
            )

    def only_in_space(self, what: str) -> None:
        if self.dimension == 2:
            raise ValueError(f"{what} ({self.part}) is for bodies in space.")

    def only_in_plane(self, what: str) -> None:
        if self.dimension == 3:
            raise ValueError(f"{what} ({self.part}).")

    def _point(self, k: int, point: Any) -> Any:
        if point is None:
            return None
        role = ("`point_a`", "`point_b`")[k]
        point = number(self.part, role, point, (self.dimension,))
        if not self.turns[k] and not (is_known(point) and not point.any()):
            raise ValueError(
                f"{role} of {self.part} is off '{self.bodies[k]}', which is a point mass: "
                "leave it out."
            )
        return point

    def _in_frame(self, k: int, other: int, point: Any) -> Any:
        """A point of the other body at the start, in the frame of body `k`."""
        if not self.turns[k]:
            return None
        there, here = self.frames[other], self.frames[k]
        return here.axes @ (there.origin + point @ there.axes - here.origin)
