"""Forces without a potential, which users find in `forces`."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Array
from typing_extensions import TypeAliasType

from .._types import Args, Real, Scalar, Vector
from ._arguments import number
from ._ends import Ends
from ._frames import GROUND, Numbers
from ._laws import Acting, Following, Turning, Viscous
from ._measures import AbstractLaw, Orientation, Place, Separation, turn_of
from ._part import AbstractForce
from ._user_functions import takes_view


# A function (t, args), or (view, t, args) with feedback.
ForceFunction = TypeAliasType(
    "ForceFunction", Callable[[Scalar, Args], Array] | Callable[[Any, Scalar, Args], Array]
)


class Damper(AbstractForce):
    """A viscous damper along the line between two points: `-damping * rdot`.

    Points default to the origins of the frames, and must not coincide. `damping` is a force
    per velocity, not negative. With `EnergyPreserving` and `EnergyConsistent` it removes
    energy in every step of any length. With the decaying schemes this is certain only if
    the line keeps its direction.
    """

    damping: Real
    point_a: Vector | None = None
    point_b: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        points, _ = ends.separate_points(self.point_a, self.point_b)
        return Viscous(Separation()), points | _damping(ends, self.damping)


class TorsionDamper(AbstractForce):
    """A viscous damper of the angle between two bodies: a torque `-damping * rate`.

    In space it acts about `axis`, in the frame of the first body. Revolute or cylindrical
    joints must keep this axis common to both bodies.
    """

    damping: Real
    axis: Vector | None = None

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        return Viscous(measure), numbers | _damping(ends, self.damping)


def _damping(ends: Ends, damping: Real) -> Numbers:
    return dict(damping=number(ends.part, "`damping`", damping, (), least=0.0))


class Actuator(AbstractForce):
    """A force between two points that a function defines: `force(t, args)`.

    It is a scalar along the line between the points; a positive force pushes them apart.
    Points default to the origins of the frames, and must not coincide.

    With feedback it is a `force(view, t, args)`, where `view` describes the motion:

    - `view.position(body, point)`, `view.velocity(body, point)`: in space, shape `(d,)`
      (length, length per time); of the mass centre by default. `view.direction(body,
      axis)`.
    - `view.length(name)`, `view.angle(name)`: of a spring, damper, actuator, joint or drive
      that has one (radians); `view.angle` also of a body in the plane. About a hinge in
      space the angle is zero in the start pose and jumps at half a turn: beyond, use its
      sine and cosine.
    - `view.rate(name)`: of this length or angle. It does not jump.
    - `view.q`, `view.v`: all coordinates and velocities.

    Schemes evaluate the force in the middle of a step, and the audit counts its work there:
    the energy balance of every step is exact, and the motion is of order 2.
    """

    force: ForceFunction
    point_a: Vector | None = None
    point_b: Vector | None = None

    def __check_init__(self):
        takes_view(self.name, "force", self.force)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        points, _ = ends.separate_points(self.point_a, self.point_b)
        feedback = takes_view(self.name, "force", self.force)
        return Acting(Separation(), self.force, feedback), points


class TorsionActuator(AbstractForce):
    """A torque between two bodies that a function defines: `torque(t, args)`, a scalar.

    It turns the second body counterclockwise, in space about `axis` (see `TorsionDamper`),
    and its opposite acts on the first body. With feedback, as for a servo, it is a
    `torque(view, t, args)`; see `Actuator`. `view.angle(name)` and `view.rate(name)` of the
    actuator itself are the angle between its bodies and its rate.
    """

    torque: ForceFunction
    axis: Vector | None = None

    def __check_init__(self):
        takes_view(self.name, "torque", self.torque)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        measure, numbers = turn_of(ends, self.axis)
        feedback = takes_view(self.name, "torque", self.torque)
        return Acting(measure, self.torque, feedback), numbers


class Load(AbstractForce):
    """A force on a point of a `body` that a function defines in space: `force(t, args)`.

    It is a vector; `point` defaults to the mass centre. With feedback it is a
    `force(view, t, args)`; see `Actuator`.
    """

    force: ForceFunction
    point: Vector | None

    def __init__(
        self, name: str, body: str, force: ForceFunction, point: Vector | None = None
    ):
        self.name, self.a, self.b = name, GROUND, body
        self.force, self.point = force, point

    def __check_init__(self):
        takes_view(self.name, "force", self.force)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        feedback = takes_view(self.name, "force", self.force)
        return Acting(Place(), self.force, feedback), ends.point_of_body(self.point)


class Follower(AbstractForce):
    """A force that turns with its `body`: a `Load` in the axes of the body."""

    force: ForceFunction
    point: Vector | None

    def __init__(
        self, name: str, body: str, force: ForceFunction, point: Vector | None = None
    ):
        self.name, self.a, self.b = name, GROUND, body
        self.force, self.point = force, point

    def __check_init__(self):
        takes_view(self.name, "force", self.force)

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        ends.only_bodies_that_turn()
        feedback = takes_view(self.name, "force", self.force)
        return Following(Place(), self.force, feedback), ends.point_of_body(self.point)


class AbstractTorque(AbstractForce):
    """A torque on a body in space."""

    torque: ForceFunction

    def __init__(self, name: str, body: str, torque: ForceFunction):
        self.name, self.a, self.b, self.torque = name, GROUND, body, torque

    def __check_init__(self):
        takes_view(self.name, "torque", self.torque)


class Torque(AbstractTorque):
    """A torque on a `body` in space that a function defines: `torque(t, args)`.

    It is a vector in space, and it has no potential: its work depends on the path. In
    the plane use a `TorsionActuator` between the ground and the body. With feedback it is a
    `torque(view, t, args)`; see `Actuator`.
    """

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        return _turning(ends, self.name, self.torque, follows=False), {}


class FollowerTorque(AbstractTorque):
    """A torque that turns with its `body`: a `Torque` in the axes of the body."""

    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        return _turning(ends, self.name, self.torque, follows=True), {}


def _turning(ends: Ends, name: str, torque: ForceFunction, *, follows: bool) -> AbstractLaw:
    ends.only_in_space("A torque about any axis")
    ends.only_bodies_that_turn()
    return Turning(Orientation(), torque, takes_view(name, "torque", torque), follows)
