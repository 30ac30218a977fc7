"""Drives: what is moved on a schedule.

Each takes a `motion(t, args)`, a smooth function of the time and of the `args` of the
system; its velocity and acceleration are derived. Points and axes are told as for joints.
A scene starts at `t = 0`, with the velocities that its drives prescribe there. What a drive
takes, force or torque, is its `scene.reaction`, and its power is in `sol.audit.drive_work`.
"""

import equinox as eqx

from .._types import Vector
from ._ends import Ends
from ._frames import GROUND, Numbers
from ._laws import Driven, Signal
from ._measures import AbstractLaw, Place, Separation, Slide, turn_of
from ._names import only_parts
from ._part import AbstractPart
from ._user_functions import check_function


class AbstractDrive(AbstractPart):
    """A drive of a scene."""

    motion: eqx.AbstractVar[Signal]

    def __check_init__(self):
        check_function(self.name, "motion", self.motion, "t", "args")


class Angle(AbstractDrive):
    """Prescribes the angle of the second body against the first: a motor that turns.

    In the plane the difference of their angles. In space the turn from the start pose
    about `axis`, told in the first body, which revolute or cylindrical joints must keep
    common to both bodies; over any number of turns.
    """

    motion: Signal
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        return Driven(measure, self.motion), numbers


class Displacement(AbstractDrive):
    """Prescribes how far the second point is from the first, along an axis of body `a`.

    Points that are not given are the origins of the frames.
    """

    motion: Signal
    point_a: Vector | None = None
    point_b: Vector | None = None
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        points = ends.origins(self.point_a, self.point_b)
        return Driven(Slide(), self.motion), points | ends.first_axes(self.axis)


class Distance(AbstractDrive):
    """Prescribes the distance of two points, which must stay positive: a hydraulic ram.

    Points that are not given are the origins of the frames.
    """

    motion: Signal
    point_a: Vector | None = None
    point_b: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        numbers, _ = ends.apart(self.point_a, self.point_b)
        return Driven(Separation(), self.motion), numbers


class Position(AbstractDrive):
    """Leads a point of a `body` along a path in space; `motion` returns the position.

    The point is the mass centre if it is not given.
    """

    motion: Signal
    point: Vector | None

    def __init__(
        self,
        name: str,
        body: str,
        motion: Signal,
        point: Vector | None = None,
    ):
        self.name, self.a, self.b = name, GROUND, body
        self.motion, self.point = motion, point

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        point = ends.origins(None, self.point)["point_b"]
        return Driven(Place(), self.motion), dict(point_b=point)


__dir__ = only_parts(globals())
