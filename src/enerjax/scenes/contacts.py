"""Contacts without friction: spheres, planes, and stops of hinges and sliders.

Each has a gap that must not become negative, and a law for what happens when it closes:
`Restitution`, an exact impact at an instant, or `Penalty`, a stiff spring with a damper.
Points and axes are passed as for joints. Impacts are events of the system, which `simulate`
finds in every run. `scene.measure(sol, name).value` is the gap.
"""

import equinox as eqx

from .._types import Real, Vector
from ._arguments import direction, number, positive
from ._ends import Ends
from ._frames import Numbers
from ._laws import Gap, Penalized
from ._measures import AbstractLaw, AbstractMeasure, Clearance, Height, Room, Slide, turn_of
from ._part import AbstractPart, only_parts


class Restitution(eqx.Module):
    """An exact impact: the rate of the gap is multiplied by `-coefficient`; see `Impact`.

    `coefficient` is a number from 0 to 1, and a number of the part, `args.set("floor",
    restitution=0.7)`. Without one, or with the integer 1, the impact is elastic: no energy
    is lost, no gap stays closed, and the program is smaller.
    """

    coefficient: Real | None = None


class Penalty(eqx.Module):
    """A force that grows with the penetration `d = -gap`, for a motion without jumps.

    It is `stiffness d^exponent (1 + damping ddot)`: Hertz's law for spheres with the
    exponent 3/2, and Hunt and Crossley's damper. The spring has a potential, so without
    `damping` energy is conserved like that of other springs, and `Composed` can be used.
    `stiffness` is a force per length^exponent, `exponent` at least one, and `damping` a
    time per length, which must be given here if it is to be changed in `args`.

    **Reference:** K. H. Hunt and F. R. E. Crossley, Coefficient of restitution interpreted
    as damping in vibroimpact, J. Appl. Mech. 42 (1975) 440-445.
    """

    stiffness: Real
    exponent: Real = 1.5
    damping: Real | None = None


class AbstractContact(AbstractPart):
    """A contact of a scene: a gap between two bodies and the law of its closing."""


def _resolved(
    ends: Ends, law: Restitution | Penalty, gap: AbstractMeasure, numbers: Numbers
) -> tuple[AbstractLaw, Numbers]:
    """The law of a contact with this gap, and all of its numbers."""
    if not isinstance(law, Restitution | Penalty):
        raise TypeError(
            f"The `law` of {ends.part} must be `ej.contacts.Restitution(...)` or "
            f"`ej.contacts.Penalty(...)`, got {law!r}."
        )
    if isinstance(law, Restitution):
        is_one = type(law.coefficient) is int and law.coefficient == 1
        if law.coefficient is None or is_one:
            return Gap(gap, is_elastic=True), numbers
        e = number(ends.part, "`coefficient`", law.coefficient, (), least=0.0)
        number(ends.part, "1 - `coefficient`", 1 - e, (), least=0.0)
        return Gap(gap, is_elastic=False), numbers | dict(restitution=e)
    numbers |= dict(
        stiffness=positive(ends.part, "`stiffness`", law.stiffness),
        exponent=number(ends.part, "`exponent`", law.exponent, (), least=1.0),
    )
    if law.damping is None:
        return Penalized(gap, is_damped=False), numbers
    damping = number(ends.part, "`damping`", law.damping, (), least=0.0)
    return Penalized(gap, is_damped=True), numbers | dict(damping=damping)


def _radius(ends: Ends, role: str, radius: Real) -> Numbers:
    return {role: number(ends.part, f"`{role}`", radius, (), least=0.0)}


class OnPlane(AbstractContact):
    """A point or a sphere of the second body against a plane of the first.

    The plane passes through `point_a`, with the `normal` towards the free side, both in the
    frame of the first body. `point_b` is the centre of the sphere of the given `radius`;
    with a radius of zero it is a point. Points default to the origins of the frames. In the
    plane the contact is that of a circle and a line.
    """

    normal: Vector
    law: Restitution | Penalty
    radius: Real = 0.0
    point_a: Vector | None = None
    point_b: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        normal = direction(ends.part, "`normal`", self.normal, ends.dimension)
        numbers = ends.origins(self.point_a, self.point_b) | dict(normal=normal)
        numbers |= _radius(ends, "radius", self.radius)
        return _resolved(ends, self.law, Height(), numbers)


class OnSphere(AbstractContact):
    """A point or a sphere of the second body against a sphere of the first.

    `point_a` and `point_b` are the centres, by default the origins of the frames, and
    `radius_a` and `radius_b` the radii, of which one may be zero. With `inside` the second
    sphere is inside of the first, as a ball in a bowl. The centres must never coincide. In
    the plane these are circles.
    """

    law: Restitution | Penalty
    radius_a: Real
    radius_b: Real = 0.0
    point_a: Vector | None = None
    point_b: Vector | None = None
    inside: bool = eqx.field(static=True, default=False)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        numbers, _ = ends.separate_points(self.point_a, self.point_b)
        numbers |= _radius(ends, "radius_a", self.radius_a)
        numbers |= _radius(ends, "radius_b", self.radius_b)
        return _resolved(ends, self.law, Clearance(self.inside), numbers)


class AngleStop(AbstractContact):
    """A stop of the angle between two bodies: of a hinge.

    The angle must not exceed `limit`; with `lower` it must not fall below (radians). It is
    that of `TorsionSpring`: in the plane the difference of the angles of the bodies, in
    space the rotation from the start pose about `axis`, which must not reach half a turn.
    """

    limit: Real
    law: Restitution | Penalty
    lower: bool = eqx.field(static=True, default=False)
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        numbers |= dict(limit=number(ends.part, "`limit`", self.limit, ()))
        return _resolved(ends, self.law, Room(measure, self.lower), numbers)


class SlideStop(AbstractContact):
    """A stop of the displacement of the second point from the first along an axis of `a`.

    The displacement must not exceed `limit`; with `lower` it must not fall below (length).
    Points default to the origins of the frames.
    """

    limit: Real
    law: Restitution | Penalty
    lower: bool = eqx.field(static=True, default=False)
    axis: Vector | None = None
    point_a: Vector | None = None
    point_b: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        numbers = ends.origins(self.point_a, self.point_b) | ends.first_axes(self.axis)
        numbers |= dict(limit=number(ends.part, "`limit`", self.limit, ()))
        return _resolved(ends, self.law, Room(Slide(), self.lower), numbers)


_PARTS = only_parts(globals())


def __dir__() -> list[str]:
    return sorted([*_PARTS(), "Penalty", "Restitution"])
