"""Inerters, which users find in `forces`: kinetic energies of a length or an angle.

Each has a coordinate of its own, which a constraint keeps equal to the length or angle, so
the inertia of the system stays constant.
"""

from .._types import Real, Vector
from ._arguments import positive
from ._ends import Ends
from ._frames import Numbers
from ._laws import Flywheel
from ._measures import AbstractLaw, Separation, turn_of
from ._part import AbstractPart


class AbstractInerter(AbstractPart):
    """An inerter of a scene; its law is a `Flywheel`, and it has a number `inertance`."""


class Inerter(AbstractInerter):
    """An inertia between two points: a force `-inertance * rddot` along their line.

    It has the kinetic energy `inertance * rdot^2 / 2`, as the flywheel of a ball screw has.
    `inertance` is a mass, positive. Points default to the origins of the frames, and must
    not coincide.

    **Reference:** M. C. Smith, Synthesis of mechanical networks: the inerter, IEEE Trans.
    Automat. Control 47 (2002) 1648-1662.
    """

    inertance: Real
    point_a: Vector | None = None
    point_b: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        points, _ = ends.separate_points(self.point_a, self.point_b)
        return Flywheel(Separation()), points | _inertance(ends, self.inertance)


class TorsionInerter(AbstractInerter):
    """An inertia of the angle between two bodies: the torque of a rotor behind a gear.

    It has the kinetic energy `inertance * rate^2 / 2`. The `inertance` of a rotor of
    inertia `J` behind a reduction of `n` is `n^2 J` (mass length^2). The gyroscopic torque
    of the rotor is neglected. In space it acts about `axis`, in the frame of the first
    body. Revolute or cylindrical joints must keep this axis common to both bodies.
    """

    inertance: Real
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        return Flywheel(measure), numbers | _inertance(ends, self.inertance)


def _inertance(ends: Ends, inertance: Real) -> Numbers:
    return dict(inertance=positive(ends.part, "`inertance`", inertance))
