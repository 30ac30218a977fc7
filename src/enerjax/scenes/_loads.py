"""Forces without a potential; they are public in `forces`."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Array

from .._types import Args, Real, Scalar, Vector
from ._forces import AbstractForce
from ._frames import GROUND, Numbers
from ._laws import Acting, Following, Viscous
from ._measures import (
    AbstractLaw,
    Place,
    Separation,
    turn_of,
)
from ._numbers import number
from ._own import check_function
from ._start import Ends


class Damper(AbstractForce):
    """A viscous damper between two points, along their line: `-damping * rdot`.

    Points that are not given are the origins of the frames; they must not meet.
    `damping` is a force per velocity and not negative. It takes energy out in every step,
    however long, with `EnergyPreserving` and `EnergyConsistent`; with the decaying schemes
    this is certain only where the line keeps its direction.
    """

    name: str
    a: str
    b: str
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

    name: str
    a: str
    b: str
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
    """

    name: str
    a: str
    b: str
    force: Callable[[Scalar, Args], Array]
    point_a: Vector | None = None
    point_b: Vector | None = None

    def __check_init__(self):
        check_function(self.name, "force", self.force, "t", "args")

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        points, _ = ends.apart(self.point_a, self.point_b)
        return Acting(Separation(), self.force), points


class TorsionActuator(AbstractForce):
    """A torque between two bodies that a program gives: `torque(t, args)`, a scalar.

    It turns the second body counterclockwise, in space about `axis` as `TorsionDamper`,
    and its opposite acts on the first.
    """

    name: str
    a: str
    b: str
    torque: Callable[[Scalar, Args], Array]
    axis: Vector | None = None

    def __check_init__(self):
        check_function(self.name, "torque", self.torque, "t", "args")

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        return Acting(measure, self.torque), numbers


class Load(AbstractForce):
    """A force on a point of a `body` that a program gives in space: `force(t, args)`.

    A vector; `point` is the mass centre if it is not given.
    """

    name: str
    a: str
    b: str
    force: Callable[[Scalar, Args], Array]
    point: Vector | None

    def __init__(self, name: str, body: str, force: Any, point: Vector | None = None):
        self.name, self.a, self.b = name, GROUND, body
        self.force, self.point = force, point

    def __check_init__(self):
        check_function(self.name, "force", self.force, "t", "args")

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        point = ends.origins(None, self.point)["point_b"]
        return Acting(Place(), self.force), dict(point_b=point)


class Follower(AbstractForce):
    """A force that turns with its `body`: as `Load`, but told in the axes of the body."""

    name: str
    a: str
    b: str
    force: Callable[[Scalar, Args], Array]
    point: Vector | None

    def __init__(self, name: str, body: str, force: Any, point: Vector | None = None):
        self.name, self.a, self.b = name, GROUND, body
        self.force, self.point = force, point

    def __check_init__(self):
        check_function(self.name, "force", self.force, "t", "args")

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        ends.only_bodies_that_turn()
        point = ends.origins(None, self.point)["point_b"]
        return Following(Place(), self.force), dict(point_b=point)
