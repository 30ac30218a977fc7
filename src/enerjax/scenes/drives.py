"""Drives, which prescribe a motion.

Each takes a `motion(t, args)`, a smooth function of the time and of the `args` of the
system; its velocity and acceleration are derived. Points and axes are passed as for joints.
A scene starts at `t = 0`, with the velocities that its drives prescribe there. The force or
torque of a drive is its `scene.reaction`, and its work is in `sol.audit.drive_work`.
"""

import equinox as eqx

from .._types import Vector
from ._ends import Ends
from ._frames import GROUND, Numbers
from ._laws import Driven, Signal
from ._measures import AbstractLaw, Place, Separation, Slide, turn_of
from ._part import AbstractPart, only_parts
from ._user_functions import check_function


class AbstractDrive(AbstractPart):
    """A drive of a scene."""

    motion: eqx.AbstractVar[Signal]

    def __check_init__(self):
        check_function(self.name, "motion", self.motion, "t", "args")


class Angle(AbstractDrive):
    """Prescribes the angle of the second body relative to the first, as a motor does.

    In the plane this is the difference of their angles. In space it is the rotation from
    the start pose about `axis`, in the frame of the first body; revolute or cylindrical
    joints must keep this axis common to both bodies. The angle may exceed a full turn.
    """

    motion: Signal
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        return Driven(measure, self.motion), numbers


class Displacement(AbstractDrive):
    """Prescribes the displacement of the second point from the first along an axis of `a`.

    Points default to the origins of the frames.
    """

    motion: Signal
    point_a: Vector | None = None
    point_b: Vector | None = None
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        points = ends.origins(self.point_a, self.point_b)
        return Driven(Slide(), self.motion), points | ends.first_axes(self.axis)


class Distance(AbstractDrive):
    """Prescribes the distance of two points, as a hydraulic cylinder does.

    The distance must stay positive. Points default to the origins of the frames.
    """

    motion: Signal
    point_a: Vector | None = None
    point_b: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        numbers, _ = ends.separate_points(self.point_a, self.point_b)
        return Driven(Separation(), self.motion), numbers


class Position(AbstractDrive):
    """Moves a point of a `body` along a path in space; `motion` returns the position.

    The point defaults to the mass centre.
    """

    motion: Signal
    point: Vector | None

    def __init__(self, name: str, body: str, motion: Signal, point: Vector | None = None):
        self.name, self.a, self.b = name, GROUND, body
        self.motion, self.point = motion, point

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        return Driven(Place(), self.motion), ends.point_of_body(self.point)


__dir__ = only_parts(globals())
