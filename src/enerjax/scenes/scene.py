"""A scene: bodies, joints, forces and drives, and the system that they make."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._analysis import ConsistentStart, Equilibrium, freedoms, Mobility
from .._programs import is_known
from .._run import Solution
from .._system import State, System
from .._types import Coordinates, Real, Vector
from ._compile import compile_parts, join, sort_parts
from ._constraint_rows import check_reacting, row_names, rows_of
from ._feedback import Moving
from ._functions import make_system
from ._gaps import Gap, Measured
from ._law_checks import check_laws
from ._parameters import Parameters
from ._readouts import measured_along, Readout
from ._relative_motions import each, Reaction, reaction
from ._start import check_poses, closed_start, gaps_of, Told
from ._summary import summary
from ._view import View
from .bodies import AbstractBody
from .drives import AbstractDrive
from .forces import AbstractForce
from .joints import AbstractJoint


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
    far from closed at the start. A joint that is off by a little, as its bodies measure,
    is closed by `start`; `report` tells by how much.
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
        check_laws(self._layout, self.q, self.args)
        self._rows = rows_of(self._layout, self.q, self.args)
        if self.system.force is not None:  # a function of the user's own may not fit
            t = jnp.zeros((), self.q.dtype)
            jax.eval_shape(self.system.force, self.q, self.v, t, self.args)
        told = [flag for body in bodies for flag in body.given]
        self._given = tuple(k for k, flag in enumerate(told) if flag)
        if self._rows and is_known((self.q, self.v, self.args)):
            check_poses(self._gaps(None, 0.0, None), self._ends, 0.0)

    def build(self) -> tuple[System, State, Parameters]:
        """`(system, start, args)`, as all functions take them."""
        return self.system, self.start(), self.args

    def start(self, args: Parameters | None = None, *, t: Real = 0.0) -> State:
        """The state nearest to the poses of the parts with all joints closed.

        With other `args` than the scene's own where lengths or points have changed, at
        another time where drives start elsewhere. Velocities that parts tell are kept, and
        those that they leave out follow by the joints; what these leave open moves with
        the least kinetic energy.

        **Raises:** as `initial_state`, with the name of the joint that is to blame; where
        values are known also for velocities that no joint allows, and for drives that are
        not smooth at `t`. `ValueError` for a pose opposite to a driven angle in space,
        under `jit`, `vmap` and `grad` `equinox.EquinoxRuntimeError`.
        """
        args = self.args if args is None else args
        told = Told(State(self.q, self.v), self._given)
        return closed_start(self._layout, self.system, told, t, args, self._rows)

    def report(
        self,
        state: State | None = None,
        args: Parameters | None = None,
        *,
        t: Real = 0.0,
    ) -> dict[str, Gap]:
        """How far each joint is from closed, by name: in the start as the parts tell it,
        or in another state, such as `start()`, at its time `t`.

        `position` is a length (an angle counts as an arc of the size of its bodies),
        `velocity` its rate; velocities that the parts leave out count as zero.
        """
        found = self._gaps(state, t, args)
        return {name: Gap(gap.position, gap.velocity) for name, gap in found.items()}

    def mobility(
        self,
        state: State | None = None,
        args: Parameters | None = None,
        *,
        t: Real = 0.0,
    ) -> Mobility:
        """The freedoms of the scene in a pose, that of its parts if none is given; see
        `mobility`.

        Rows are named by their joint, `"hinge[0]"`; those within bodies by their number.
        Those are redundant that follow from rows before them; first come those within
        bodies.
        """
        state = State(self.q, self.v) if state is None else state
        args = self.args if args is None else args
        names = row_names(self._layout, self.q, args, self._rows)
        joined = {k for x in self._rows.values() for k in range(x.start, x.stop)}
        own = [k for k in range(len(names)) if k not in joined]
        return freedoms(self.system, state, args, t, names, own)

    def position(self, ys: State, body: str, point: Vector | None = None) -> Array:
        """A point of a body in space along a run, shape `(times, d)`; of one state `(d,)`.

        `point` is told in the frame of the body; its mass centre if it is not given. A
        batch of runs has its axes before that of time.
        """
        return self._along(lambda q, v: View(self._layout, q).position(body, point), ys)

    def velocity(self, ys: State, body: str, point: Vector | None = None) -> Array:
        """The velocity in space of a point of a body; otherwise as `position`."""
        moving = lambda q, v: Moving(self._layout, q, v, self.args)
        return self._along(lambda q, v: moving(q, v).velocity(body, point), ys)

    def direction(self, ys: State, body: str, axis: Vector) -> Array:
        """A direction that is fixed in a body, in space; otherwise as `position`."""
        return self._along(lambda q, v: View(self._layout, q).direction(body, axis), ys)

    def angle(self, ys: State, body: str) -> Array:
        """The angle of a body in the plane along a run, shape `(times,)`."""
        return self._along(lambda q, v: View(self._layout, q).angle(body), ys)

    def measure(
        self,
        sol: Solution | ConsistentStart | Equilibrium | State,
        name: str,
        args: Parameters | None = None,
        *,
        t: Real = 0.0,
    ) -> Readout:
        """Length or angle, its rate, and the force of a spring, damper, actuator, load or
        drive, of a hinge, slider or rod, along a run; also of a start or a state, at `t`.
        `args` are those of the run, where they are not the scene's own.

        Angles of hinges in space count full turns along a run, from within half a turn of
        the start pose; of a state alone these are not known.

        **Raises:** `ValueError` for a part without a length or angle, with those that have
        one.
        """
        args = self.args if args is None else args
        return measured_along(self._layout, self._rows, sol, name, t, args)

    def reaction(
        self,
        sol: Solution | ConsistentStart | Equilibrium,
        joint: str,
        args: Parameters | None = None,
    ) -> Reaction:
        """Force and torque of a joint or drive on its second body, along a run, at a start
        or in an equilibrium.

        `args` are those of the run, where they are not the scene's own. Multipliers of a
        run are means over the step that ends at a row, and are taken to act there.
        """
        check_reacting(joint, self._rows, self._ends)
        at_rest = isinstance(sol, ConsistentStart | Equilibrium)
        ys = sol.state if at_rest else sol.ys
        args, ends = self.args if args is None else args, self._ends[joint]
        of_state = lambda q, x: reaction(self._layout, q, x, joint, ends, args)
        return each(of_state, ys.q, self.multipliers(sol, joint))

    def multipliers(
        self, sol: Solution | ConsistentStart | Equilibrium, joint: str
    ) -> Float[Array, "... rows"]:
        """The multipliers of a joint, constraint or drive, one column for each row."""
        return sol.multipliers[..., self._rows[joint]]

    def __str__(self) -> str:
        parts = self._kinds, self._ends, self._rows
        return summary(self._layout, *parts, self.system.redundant, self._freedoms)

    def _freedoms(self) -> int | None:
        """Degrees of freedom at the start, or `None` where there is no start."""
        if not is_known((self.q, self.v, self.args)):
            return None
        try:
            start = self.start() if self.system.redundant else State(self.q, self.v)
            return self.mobility(start).degrees_of_freedom
        except ValueError:  # of a scene that cannot be closed
            return None

    def _along(self, function: Any, ys: State) -> Array:
        return each(function, ys.q, ys.v)

    def _gaps(
        self, state: State | None, t: Real, args: Parameters | None
    ) -> dict[str, Measured]:
        state = State(self.q, self.v) if state is None else state
        return gaps_of(self._layout, state, t, self.args if args is None else args)
