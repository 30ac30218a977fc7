"""A scene: bodies, joints, forces and drives, and the system that they make."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._analysis import Mobility, mobility
from .._initial import ConsistentStart, initial_state
from .._solution import Solution
from .._system import State, System
from .._tracing import is_known
from .._types import Coordinates, Real, Vector
from ._compile import compile_parts, join, sort_parts
from ._frames import Numbers, Point
from ._functions import lift, make_system
from ._laws import Driven
from ._layout import Links
from ._motions import first_dependent, Gap, gaps, reaction
from ._parameters import Parameters
from ._rows import members, row_names, rows_of
from ._summary import summary
from ._view import View
from .bodies import AbstractBody
from .drives import AbstractDrive
from .forces import AbstractForce
from .joints import AbstractJoint


# A joint that is further from closed than this part of the scene is a mistake.
_FAR = 0.05


class Reaction(NamedTuple):
    """What a joint does to its second body, in space, at each saved time.

    - `force`: shape `(times, d)`.
    - `torque`: about the joint's point on that body, `(times, 3)`, in the plane
      `(times, 1)`.
    """

    force: Array
    torque: Array


class Scene:
    """Bodies, joints, forces and drives under names, compiled to a `System`.

        scene = ej.Scene(
            [
                ej.bodies.PointMass("inner", 1.0, [1.0, 0.0]),
                ej.bodies.PointMass("outer", 1.0, [1.0, -1.0]),
                ej.joints.Distance("upper", "ground", "inner"),
                ej.joints.Distance("lower", "inner", "outer"),
            ],
            gravity=[0.0, -9.81],
        )
        system, start, args = scene.build()
        sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=500)
        scene.position(sol.ys, "outer")

    **Arguments:**

    - `parts`: bodies, joints, forces and drives in any order, each with a name of its own;
      the name `"ground"` is taken. Coordinates stand body by body in this order.
    - `gravity`: the acceleration in space, two or three entries; none if not given.
    - `args`: numbers of your own, for functions of yours, found again under their names
      in the `args` of the system.
    - `redundant`: whether joints may repeat what others hold; see `System`.

    A scene does not change. `system` is what `simulate` takes, `args` its `Parameters`, `q`
    and `v` the start as the parts tell it. Parts of a kind are evaluated together, so the
    size of the program depends on the kinds in use and not on the number of parts; two
    scenes that differ in numbers alone share their programs.

    **Raises:** `ValueError` or `TypeError` for parts that do not fit together, with their
    names: unknown or repeated names, masses and inertias that no body has, a joint that is
    far from closed at the start. A joint that is off by a little is closed by `start`;
    `report` tells by how much.
    """

    system: System
    args: Parameters
    q: Coordinates
    v: Array

    def __init__(
        self,
        parts: Sequence[Any],
        gravity: Vector | None = None,
        args: dict[str, Any] | None = None,
        *,
        redundant: bool = False,
    ):
        found = sort_parts(parts)
        bodies: list[AbstractBody] = found[AbstractBody]
        self._layout, self.args = compile_parts(found, gravity, dict(args or {}))
        self._ends = {
            part.name: (part.a, part.b)
            for kind in (AbstractJoint, AbstractForce, AbstractDrive)
            for part in found[kind]
        }
        self._kinds = {part.name: type(part).__name__ for part in parts}
        self.system = make_system(self._layout, redundant)
        self.q, self.v = (join([getattr(b, x) for b in bodies]) for x in ("q", "v"))
        self._rows = rows_of(self._layout, self.q, self.args)
        if self.system.force is not None:  # a function of the user's own may not fit
            t = jnp.zeros((), self.q.dtype)
            jax.eval_shape(self.system.force, self.q, self.v, t, self.args)
        self._check_gaps()

    def build(self) -> tuple[System, State, Parameters]:
        """`(system, start, args)`, as all functions take them."""
        return self.system, self.start(), self.args

    def start(self, args: Parameters | None = None) -> State:
        """The state nearest to the poses of the parts with all joints closed.

        With other `args` than the scene's own where lengths or points have changed.

        **Raises:** as `initial_state`, with the name of the joint that is to blame.
        """
        args = self.args if args is None else args
        try:
            return initial_state(self.system, self.q, self.v, args)
        except ValueError as error:
            name = first_dependent(self._layout, self.q, args, self._rows)
            if name is None:
                raise
            raise ValueError(
                f"{error} In this scene '{name}' repeats what other joints hold already."
            ) from None

    def report(self, state: State | None = None) -> dict[str, Gap]:
        """How far each joint is from closed, by name: in the start as the parts tell it,
        or in another state, such as `start()`.

        `position` is a length (an angle counts as an arc of the size of the scene),
        `velocity` its rate.
        """
        return self._gaps(state)[0]

    def mobility(self, state: State | None = None, *, t: Real = 0.0) -> Mobility:
        """The freedoms of the scene in a pose, its start if none is given; see `mobility`.

        Rows are named by their joint, `"hinge[0]"`; those within bodies by their number.
        """
        state = State(self.q, self.v) if state is None else state
        names = row_names(self._layout, self.q, self.args, self._rows)
        return mobility(self.system, state, self.args, t=t, names=names)

    def position(self, ys: State, body: str, point: Vector | None = None) -> Array:
        """A point of a body in space along a run, shape `(times, d)`; of one state `(d,)`.

        `point` is told in the frame of the body; its mass centre if it is not given.
        """
        return self._along(lambda q, v: View(self._layout, q).position(body, point), ys)

    def velocity(self, ys: State, body: str, point: Vector | None = None) -> Array:
        """The velocity in space of a point of a body; otherwise as `position`."""

        def velocity(q: Coordinates, v: Array) -> Point:
            place = lambda x: View(self._layout, x).position(body, point)
            return jax.jvp(place, (q,), (lift(self._layout, q, v),))[1]

        return self._along(velocity, ys)

    def direction(self, ys: State, body: str, axis: Vector) -> Array:
        """A direction that is fixed in a body, in space; otherwise as `position`."""
        return self._along(lambda q, v: View(self._layout, q).direction(body, axis), ys)

    def angle(self, ys: State, body: str) -> Array:
        """The angle of a body in the plane along a run, shape `(times,)`."""
        return self._along(lambda q, v: View(self._layout, q).angle(body), ys)

    def reaction(
        self, sol: Solution | ConsistentStart, joint: str, args: Parameters | None = None
    ) -> Reaction:
        """Force and torque of a joint or drive on its second body, along a run or at a
        start.

        `args` are those of the run, where they are not the scene's own. Multipliers of a
        run are means over the step that ends at a row, and are taken to act there.
        """
        args = self.args if args is None else args
        if joint not in self._rows or joint not in self._ends:
            raise ValueError(f"There is no joint '{joint}'; there are {[*self._rows]}.")
        group, numbers = self._link(joint, args)

        def at(q: Coordinates, multipliers: Array) -> tuple[Point, Array]:
            a, b = (View(self._layout, q).frame(body) for body in self._ends[joint])
            return reaction(group, a, b, numbers, multipliers)

        ys = sol.state if isinstance(sol, ConsistentStart) else sol.ys
        at = at if ys.q.ndim == 1 else jax.vmap(at)
        return Reaction(*at(ys.q, self.multipliers(sol, joint)))

    def _link(self, joint: str, args: Parameters) -> tuple[Links, Numbers]:
        places = self._layout.places
        if joint in places["joints"]:
            number, _ = places["joints"][joint]
            return self._layout.joint_groups[number], args["joints"][joint]
        number, _ = places["drives"][joint]
        group = self._layout.drive_groups[number]
        assert isinstance(group.law, Driven)
        # What it prescribes has the slope of its measure.
        return group._replace(law=group.law.measure), args["drives"][joint]

    def multipliers(
        self, sol: Solution | ConsistentStart, joint: str
    ) -> Float[Array, "... rows"]:
        """The multipliers of a joint, constraint or drive, one column for each row."""
        return sol.multipliers[..., self._rows[joint]]

    def __str__(self) -> str:
        return summary(self._layout, self._kinds, self._ends, self._rows)

    def _along(self, function: Any, ys: State) -> Array:
        return (jax.vmap(function) if ys.q.ndim == 2 else function)(ys.q, ys.v)

    def _gaps(self, state: State | None = None) -> tuple[dict[str, Gap], float]:
        """The gaps by name, and the size of the scene."""
        state = State(self.q, self.v) if state is None else state
        rates = lift(self._layout, state.q, state.v)
        found, size = jax.device_get(gaps(self._layout, state.q, rates, self.args))
        named = {
            name: Gap(float(x), float(v))
            for names, (xs, vs) in zip(members(self._layout), found, strict=True)
            for name, x, v in zip(names, xs, vs, strict=True)
        }
        return named, float(size)

    def _check_gaps(self) -> None:
        if not self._rows or not is_known((self.q, self.v, self.args)):
            return
        found, size = self._gaps()
        for name, gap in found.items():
            if gap.position > _FAR * size and name in self._ends:
                a, b = self._ends[name]
                raise ValueError(
                    f"'{name}' is off by {gap.position:.3g} at the start, in a scene of "
                    f"size {size:.3g}: the poses of '{a}' and '{b}' do not fit its points, "
                    "axes or length. Those are told in the frames of the bodies, whose "
                    "origin is the mass centre."
                )
