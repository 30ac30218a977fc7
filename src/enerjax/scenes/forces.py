"""Forces. Points are passed as for joints, in the frames of the bodies.

Springs and constant forces have a potential, inerters a kinetic energy. Dampers, actuators
and loads have neither: their work is in `sol.audit.work`. Functions depend on the time and
the `args` of the system.
"""

import equinox as eqx
import numpy as np

from .._programs import module_of
from .._types import Real, Vector
from ._arguments import number
from ._beam import Beam
from ._beam_geometry import weights_of
from ._ends import Ends
from ._frames import GROUND, Numbers
from ._inerters import Inerter as Inerter, TorsionInerter as TorsionInerter
from ._laws import Elastic, Steady
from ._loads import (
    Actuator as Actuator,
    Damper as Damper,
    Follower as Follower,
    FollowerTorque as FollowerTorque,
    Load as Load,
    Torque as Torque,
    TorsionActuator as TorsionActuator,
    TorsionDamper as TorsionDamper,
)
from ._measures import AbstractLaw, Place, PlanarTurn, Separation, Turn
from ._part import (
    AbstractForce as AbstractForce,
    AbstractFunctionOfPose,
    only_parts,
    PoseFunction,
)


class Spring(AbstractForce):
    """A linear spring between two points, `stiffness (r - length)^2 / 2`.

    Points default to the origins of the frames, and `length` to their distance at the
    start. The points must never coincide, because the direction is undefined then.
    """

    stiffness: Real
    length: Real | None = None
    point_a: Vector | None = None
    point_b: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        numbers, start = ends.separate_points(self.point_a, self.point_b)
        length = start if self.length is None else self.length
        return Elastic(Separation(), "length"), numbers | dict(
            stiffness=number(ends.part, "`stiffness`", self.stiffness, ()),
            length=number(ends.part, "`length`", length, (), least=0.0),
        )


class TorsionSpring(AbstractForce):
    """A linear spring between the angles of two bodies, `stiffness (turn - angle)^2 / 2`.

    In the plane `turn` is the difference of the angles, which may exceed a full turn, and
    `angle` defaults to that of the start. In space `turn` is the rotation from the start
    pose about `axis`, in the frame of the first body, and `angle` defaults to zero;
    revolute or cylindrical joints must keep this axis common to both bodies. There the
    energy is not smooth at half a turn, and a run that passes it fails.
    """

    stiffness: Real
    angle: Real | None = None
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        numbers = dict(stiffness=number(ends.part, "`stiffness`", self.stiffness, ()))
        if ends.dimension == 2:
            ends.refuse_axes(self.axis)
            ends.only_bodies_that_turn()
            law, start = Elastic(PlanarTurn(), "angle"), ends.relative_angle()
        else:
            law, start = Elastic(Turn(), "angle"), 0.0
            numbers |= ends.common_axis(self.axis)
        angle = start if self.angle is None else self.angle
        return law, numbers | dict(angle=number(ends.part, "`angle`", angle, ()))


class ConstantForce(AbstractForce):
    """A force on a point of a `body` that is constant in space.

    `force` has two or three entries; `point` defaults to the mass centre.
    """

    force: Vector
    point: Vector | None

    def __init__(self, name: str, body: str, force: Vector, point: Vector | None = None):
        self.name, self.a, self.b = name, GROUND, body
        self.force, self.point = force, point

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        force = number(ends.part, "`force`", self.force, (ends.dimension,))
        return Steady(Place(), "force"), dict(force=force) | ends.point_of_body(self.point)


class ConstantTorque(AbstractForce):
    """A constant torque on a `body` in the plane, counterclockwise.

    Its opposite acts on `reacting`.
    """

    torque: Real

    def __init__(self, name: str, body: str, torque: Real, reacting: str = GROUND):
        self.name, self.a, self.b = name, reacting, body
        self.torque = torque

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        ends.only_in_plane("A constant torque has a potential only in the plane")
        ends.only_bodies_that_turn()
        torque = number(ends.part, "`torque`", self.torque, ())
        return Steady(PlanarTurn(), "torque"), dict(torque=torque)


class LineLoad(eqx.Module):
    """A force per length of a whole beam that is constant in space.

    `force` has two or three entries (force per length); the length is that without stress.
    """

    name: str
    beam: str
    force: Vector

    def numbers(self, beam: Beam) -> Numbers:
        """The force, and the `length` on which it acts at each section."""
        dimension = beam.nodes[0].kind.dimension
        force = number(f"'{self.name}'", "`force`", self.force, (dimension,))
        total = module_of(beam.numbers).sum(beam.numbers["length"])
        return dict(force=force, length=total * weights_of(np.array(beam.places)))


class Potential(AbstractFunctionOfPose):
    """A potential of your own: `function(view, args)`, a scalar (energy).

    `view` describes the pose: `view.position(body, point)`, `view.direction(body, axis)`,
    `view.angle(body)`, and the coordinates `view.q`.
    """

    name: str
    function: PoseFunction


__dir__ = only_parts(globals())
