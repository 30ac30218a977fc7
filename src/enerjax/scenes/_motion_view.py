"""The motion of a scene: positions, velocities and measures, for laws with feedback."""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array

from .._types import Coordinates, Scalar, Vector, Velocities
from ._frames import Numbers, Point
from ._laws import (
    AbstractConstraintLaw,
    AbstractForceLaw,
    AbstractSpringLaw,
    Driven,
    Flywheel,
    Gap,
)
from ._layout import Layout, Links
from ._measures import AbstractMeasure, Orientation
from ._parameters import Parameters
from ._pose_view import evaluate, lift, View


class Moving(View):
    """A scene with the coordinates `q` and velocities `v`.

    It has the methods of `View`, and:

    - `velocity(body, point)`: of a point of a body, in space.
    - `angle(name)`, `length(name)`: of a hinge, spring, damper, actuator or drive; `angle`
      also of a body in the plane. In space an angle is zero in the start pose (for a joint
      with an `axis_b`, where its `frame_a` and `frame_b` agree), and jumps at half a turn.
    - `rate(name)`: of this angle or length. It does not jump.

    `added` is added to all these angles and lengths, and to all these rates. The gains of a
    feedback are derivatives by these two numbers.
    """

    def __init__(
        self,
        layout: Layout,
        q: Coordinates,
        v: Velocities,
        args: Parameters,
        added: tuple[Scalar, Scalar] | None = None,
    ):
        super().__init__(layout, q)
        self.v = v
        self._args = args
        self._added = added

    def velocity(self, body: str, point: Vector | None = None) -> Point:
        """The velocity in space of a point of a body; its mass centre if none is given."""
        return self._rate_of(lambda view: view.position(body, point))

    def angle(self, body: str) -> Scalar:
        """The angle of a body in the plane, or of a part that has one."""
        if self._is_part(body):
            return self._value(body, is_angle=True)
        return super().angle(body)

    def length(self, name: str) -> Scalar:
        """The length of a part that has one."""
        return self._value(name, is_angle=False)

    def rate(self, name: str) -> Scalar:
        """The rate of the angle or length of a part, or of the angle of a body."""
        if self._is_part(name):
            return self.measured(name)[1]
        return self._rate_of(lambda view: view.angle(name))

    def measured(self, name: str) -> tuple[Array, Array]:
        """The measure of a part, and its rate."""
        measure = measure_of(self.layout, name)
        group, numbers = link_of(self.layout, name, self._args)
        group = group._replace(law=measure)
        value, rate = self.with_rate(lambda view: evaluate(group, view, numbers)[0])
        if self._added is None:
            return value, rate
        return value + self._added[0], rate + self._added[1]

    def with_rate(self, value: Callable[[View], Array]) -> tuple[Array, Array]:
        """A quantity and its rate."""
        of_q = lambda x: value(View(self.layout, x))
        return jax.jvp(of_q, (self.q,), (lift(self.layout, self.q, self.v),))

    def _value(self, name: str, *, is_angle: bool) -> Scalar:
        kinds = measures_of(self.layout).items()
        names = [x for x, m in kinds if m.is_angle == is_angle and not m.is_vector]
        if name not in names:
            what = "angle" if is_angle else "length"
            raise ValueError(f"'{name}' has no {what}; the parts with one are {names}.")
        return self.measured(name)[0]

    def _is_part(self, name: str) -> bool:
        return isinstance(name, str) and name not in self.layout.numbers_of_bodies

    def _rate_of(self, value: Callable[[View], Array]) -> Array:
        return self.with_rate(value)[1]


def measure_of(layout: Layout, name: str) -> AbstractMeasure:
    """The measure of a part; an error if it has none."""
    found = measures_of(layout)
    if name not in found:
        raise ValueError(
            f"'{name}' is no part with a length or an angle; there are {[*found]}."
        )
    return found[name]


def measures_of(layout: Layout) -> dict[str, AbstractMeasure]:
    """The measures of all parts that have one."""
    found = {}
    for link in (
        *layout.joints,
        *layout.forces,
        *layout.drives,
        *layout.inerters,
        *layout.contacts,
    ):
        measure = link.law.measure if isinstance(link.law, _MEASURED) else None
        if not (measure is None or isinstance(measure, Orientation)):
            found[link.name] = measure
    return found


_MEASURED = (
    AbstractConstraintLaw | AbstractSpringLaw | AbstractForceLaw | Driven | Flywheel | Gap
)


def link_of(layout: Layout, name: str, args: Parameters) -> tuple[Links, Numbers]:
    """One joint, force, drive or inerter, and its numbers as tables with one row."""
    groups = dict(
        joints=layout.joint_groups,
        forces=layout.force_groups,
        drives=layout.drive_groups,
        inerters=[group.links for group in layout.inerter_groups],
        contacts=layout.contact_groups,
    )
    section = next(key for key in groups if name in layout.places[key])
    number, row = layout.places[section][name]
    group, only = groups[section][number], slice(row, row + 1)
    table = {key: x[only] for key, x in args.tables[section][number].items()}
    a, b = (np.asarray(x[only]) for x in (group.a, group.b))
    return Links(group.law, (name,), a, b), table
