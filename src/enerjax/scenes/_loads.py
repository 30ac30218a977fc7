"""Forces without a potential; they are public in `forces`."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Array
from typing_extensions import TypeAliasType

from .._types import Args, Real, Scalar, Vector
from ._arguments import number
from ._ends import Ends
from ._frames import GROUND, Numbers
from ._laws import Acting, Following, Viscous
from ._measures import AbstractLaw, Place, Separation, turn_of
from ._part import AbstractForce
from ._user_functions import takes_view


# What a program gives: a function of time, or of the bodies in motion too.
Program = TypeAliasType(
    "Program", Callable[[Scalar, Args], Array] | Callable[[Any, Scalar, Args], Array]
)


class Damper(AbstractForce):
    """A viscous damper between two points, along their line: `-damping * rdot`.

    Points that are not given are the origins of the frames; they must not meet.
    `damping` is a force per velocity and not negative. It takes energy out in every step,
    however long, with `EnergyPreserving` and `EnergyConsistent`; with the decaying schemes
    this is certain only where the line keeps its direction.
    """

    damping: Real
    point_a: Vector | None = None
    point_b: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        points, _ = ends.apart(self.point_a, self.point_b)
        return Viscous(Separation()), points | _damping(ends, self.damping)


class TorsionDamper(AbstractForce):
    """A viscous damper of the angle between two bodies: a torque `-damping * rate`.

    In space about `axis`, told in the first body, which revolute or cylindrical joints must
    keep common to both bodies. Full turns do not matter.
    """

    damping: Real
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        return Viscous(measure), numbers | _damping(ends, self.damping)


def _damping(ends: Ends, damping: Real) -> Numbers:
    return dict(damping=number(ends.part, "`damping`", damping, (), least=0.0))


class Actuator(AbstractForce):
    """A force between two points that a program gives: `force(t, args)`.

    A scalar, along the line of the points; positive, it pushes them apart. Points that
    are not given are the origins of the frames; they must not meet.

    With feedback a `force(view, t, args)`. `view` tells of the bodies as they move:

    - `view.position(body, point)`, `view.velocity(body, point)`: in space, shape `(d,)`
      (length, length per time); the mass centre if no point is given. `view.direction`.
    - `view.length(name)`, `view.angle(name)`: of a spring, damper, actuator, joint or drive
      that has one (radians); `view.angle` also of a body in the plane. About a hinge in
      space the angle is counted from the start pose and lies within half a turn, where it
      jumps: for more than that use its sine and cosine.
    - `view.rate(name)`: of this length or angle. It has no jumps.
    - `view.q`, `view.v`: all coordinates and velocities.

    Schemes ask in the middle of a step, and its work there is that of the audit: feedback
    is exact in the balance of every step, and of order 2.
    """

    force: Program
    point_a: Vector | None = None
    point_b: Vector | None = None

    def __check_init__(self):
        takes_view(self.name, "force", self.force)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        points, _ = ends.apart(self.point_a, self.point_b)
        feedback = takes_view(self.name, "force", self.force)
        return Acting(Separation(), self.force, feedback), points


class TorsionActuator(AbstractForce):
    """A torque between two bodies that a program gives: `torque(t, args)`, a scalar.

    It turns the second body counterclockwise, in space about `axis` as `TorsionDamper`,
    and its opposite acts on the first. With feedback a `torque(view, t, args)`, a servo;
    `view` tells what it does to an `Actuator`, so `view.angle(name)` and `view.rate(name)`
    of the actuator itself are the angle between its bodies and the rate.
    """

    torque: Program
    axis: Vector | None = None

    def __check_init__(self):
        takes_view(self.name, "torque", self.torque)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        feedback = takes_view(self.name, "torque", self.torque)
        return Acting(measure, self.torque, feedback), numbers


class Load(AbstractForce):
    """A force on a point of a `body` that a program gives in space: `force(t, args)`.

    A vector; `point` is the mass centre if it is not given. With feedback a
    `force(view, t, args)`, as of an `Actuator`.
    """

    force: Program
    point: Vector | None

    def __init__(self, name: str, body: str, force: Program, point: Vector | None = None):
        self.name, self.a, self.b = name, GROUND, body
        self.force, self.point = force, point

    def __check_init__(self):
        takes_view(self.name, "force", self.force)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        point = ends.origins(None, self.point)["point_b"]
        feedback = takes_view(self.name, "force", self.force)
        return Acting(Place(), self.force, feedback), dict(point_b=point)


class Follower(AbstractForce):
    """A force that turns with its `body`: as `Load`, but told in the axes of the body."""

    force: Program
    point: Vector | None

    def __init__(self, name: str, body: str, force: Program, point: Vector | None = None):
        self.name, self.a, self.b = name, GROUND, body
        self.force, self.point = force, point

    def __check_init__(self):
        takes_view(self.name, "force", self.force)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        ends.only_bodies_that_turn()
        point = ends.origins(None, self.point)["point_b"]
        feedback = takes_view(self.name, "force", self.force)
        return Following(Place(), self.force, feedback), dict(point_b=point)
