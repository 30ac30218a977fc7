"""The two bodies of a joint or force in the start pose: what was not given follows."""

from typing import Any, NamedTuple

import numpy as np

from .._programs import is_known
from ._arguments import basis, direction, module_of, number
from ._frames import Frame, Numbers
from ._hinges import Hinges


class Ends(NamedTuple):
    """The bodies that a part connects, in the start pose.

    - `part`, `bodies`: names, for messages.
    - `frames`: with all fields that the plane or space has.
    - `turns`: whether each has an orientation; the ground counts as one that has.
    - `hinges`: the joints of the scene that keep an axis; none are known to joints.
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
        """Points in the body frames; where one is missing, where the other one is."""
        a, b = self._point(0, point_a), self._point(1, point_b)
        if a is None and b is not None:
            a = self._seen(0, 1, b)
        elif b is None and a is not None:
            b = self._seen(1, 0, a)
        return self.origins(a, b)

    def origins(self, point_a: Any, point_b: Any) -> Numbers:
        """Points in the body frames; where one is missing, the origin."""
        a, b = self._point(0, point_a), self._point(1, point_b)
        origin = 0 * self.frames[0].origin
        return dict(point_a=origin if a is None else a, point_b=origin if b is None else b)

    def axes(self, axis_a: Any, axis_b: Any = None) -> Numbers:
        """The axes of the joint in both bodies, as rows; see `basis`."""
        self.only_bodies_that_turn()
        a, b = self.frames
        of_a = basis(self._axis("`axis`", axis_a))
        if axis_b is None:
            return dict(frame_a=of_a, frame_b=of_a @ a.axes @ b.axes.T)
        return dict(frame_a=of_a, frame_b=basis(self._axis("`axis_b`", axis_b)))

    def two_axes(self, axis_a: Any, axis_b: Any) -> Numbers:
        """As `axes`, where both must be given."""
        self._axis("`axis_b`", axis_b)
        return self.axes(axis_a, axis_b)

    def about(self, axis: Any) -> Numbers:
        """As `axes`, of one that joints keep common to both bodies."""
        numbers = self.axes(axis)
        along = numbers["frame_a"][2] @ self.frames[0].axes
        (a, b), others = self.bodies, self.hinges.between(*self.bodies)
        if self.hinges.share(a, b, along):
            return numbers
        told = lambda axis: np.round(axis, 4).tolist()
        raise ValueError(
            f"{self.part} has an angle only with a joint about its axis, a `Revolute` or "
            f"`Cylindrical`, and none connects '{a}' and '{b}'"
            + "".join(f": '{x.name}' turns about {told(x.axis)}" for x in others)
            + (f", {self.part} about {told(along)}, in space." if others else ".")
        )

    def first_axes(self, axis_a: Any) -> Numbers:
        """Axes in the first body alone, as rows."""
        self._must_turn(0)
        return dict(frame_a=basis(self._axis("`axis`", axis_a)))

    def _axis(self, role: str, axis: Any) -> Any:
        if axis is None:
            raise ValueError(f"{self.part} needs {role}, a vector of {self.dimension}.")
        return direction(self.part, role, axis, self.dimension)

    def apart(self, point_a: Any, point_b: Any) -> tuple[Numbers, Any]:
        """As `origins`, of points that do not meet, and their distance at the start."""
        numbers = self.origins(point_a, point_b)
        ends = zip(self.frames, ("point_a", "point_b"), strict=True)
        a, b = (frame.origin + numbers[key] @ frame.axes for frame, key in ends)
        xp = module_of(a, b)
        length = xp.sqrt(xp.sum((b - a) ** 2))
        if is_known(length) and length <= 1e-12 * (abs(a).max() + abs(b).max()):
            raise ValueError(
                f"{self.part} acts along the line of two points, and at the start those of "
                f"'{self.bodies[0]}' and '{self.bodies[1]}' meet, in {a.tolist()}."
            )
        return numbers, length

    def turn(self) -> Any:
        """The difference of the angles at the start."""
        return self.frames[1].angle - self.frames[0].angle

    def refuse_axes(self, *axes: Any) -> None:
        if any(axis is not None for axis in axes):
            raise ValueError(f"{self.part} is in the plane, where it has no axis to give.")

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

    def _seen(self, k: int, other: int, point: Any) -> Any:
        """In one body, where a point of the other one is at the start."""
        if not self.turns[k]:
            return None
        there, here = self.frames[other], self.frames[k]
        return here.axes @ (there.origin + point @ there.axes - here.origin)
