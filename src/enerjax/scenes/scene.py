"""A scene: bodies, joints, forces and drives, and the system that they form."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._analysis import ConsistentStart, Equilibrium, freedoms, Mobility
from .._programs import is_known
from .._run import ReachedRows, Solution
from .._system import State, System
from .._types import Coordinates, Real, Vector
from ._closure_errors import Gap, Measured
from ._columns import of_bodies, of_reaction, of_readout
from ._compile import compile_parts, LINKS, sort_parts, start_of
from ._default_shapes import all_shapes, given_shapes
from ._functions import make_system
from ._law_checks import check_laws
from ._motion import Motion, motion_of, numbers_by_name, Parts, states_of
from ._motion_view import measures_of, Moving
from ._parameters import Parameters
from ._pose_view import View
from ._reactions import each, Reaction, reaction
from ._readouts import measured_along, Readout
from ._row_index import check_reacting, row_names, rows_of, slips_of
from ._section_forces import centreline, section_forces, SectionForces
from ._start import check_poses, closed_start, gaps_of, PartialStart
from ._summary import summary
from .bodies import AbstractBody
from .shapes import Shape


class Scene:
    """Named bodies, joints, forces and drives, which are compiled to a `System`.

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

    - `parts`: bodies, joints, forces and drives in any order, with unique names; the name
      `"ground"` is reserved. The order of the bodies is that of their coordinates.
    - `gravity`: the acceleration in space, two or three entries; none by default.
    - `args`: numbers for your own functions, which find them by name in the `args` of the
      system.
    - `redundant`: whether joints may be redundant; see `System`.
    - `ground`: shapes of what is fixed in space, for pictures, such as a floor: one of
      `ej.shapes`, or a list of them.

    A scene is immutable. `system` is passed to `simulate`, `args` are its `Parameters`, and
    `q` and `v` are the start before joints are closed. Parts of a kind are evaluated
    together, so the size of the program does not depend on the number of parts; scenes that
    differ only in numbers share their programs.

    **Raises:** `ValueError` or `TypeError` for parts that do not fit together, with their
    names: unknown or repeated names, impossible masses and inertias, a joint that is far
    from closed at the start. A small gap is closed by `start`, and listed by `report`.
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
        ground: Shape = (),
    ):
        found = sort_parts(parts)
        bodies: list[AbstractBody] = found[AbstractBody]
        self._layout, self.args = compile_parts(found, gravity, dict(args or {}))
        self._ends = {part.name: (part.a, part.b) for kind in LINKS for part in found[kind]}
        self._kinds = {part.name: type(part).__name__ for part in parts}
        self._shapes = given_shapes(bodies, ground)
        self.q, self.v = start_of(self._layout, self.args, bodies)
        check_laws(self._layout, self.q, self.args)
        self._rows = rows_of(self._layout, self.q, self.args)
        self._slips = slips_of(self._layout, self.q, self.args, self._rows)
        names = row_names(self._layout, self.q, self.args, self._rows, self._slips)
        self.system = make_system(self._layout, redundant, names)
        if self.system.force is not None:  # checks the users' functions
            t = jnp.zeros((), self.q.dtype)
            jax.eval_shape(self.system.force, self.q, self.v, t, self.args)
        flags = [flag for body in bodies for flag in body.prescribed]
        self._prescribed = tuple(k for k, flag in enumerate(flags) if flag)
        if self._rows and is_known((self.q, self.v, self.args)):
            check_poses(self._gaps(None, 0.0, None), self._ends, 0.0)

    def build(self) -> tuple[System, State, Parameters]:
        """`(system, start, args)`, the first arguments of `simulate`."""
        return self.system, self.start(), self.args

    def start(self, args: Parameters | None = None, *, t: Real = 0.0) -> State:
        """The state nearest to the poses of the bodies in which all joints are closed.

        Pass `args` if lengths or points have changed, and `t` if drives start at another
        time. The prescribed velocities of bodies are kept. The others follow from the
        joints; those that joints do not determine are such that the kinetic energy is
        least.

        **Raises:** as `initial_state`, with the name of the joint. If values are known,
        also for velocities that joints do not admit, and for drives that are not smooth at
        `t`. `ValueError` for a pose opposite to a driven angle in space, under `jit`,
        `vmap` and `grad` `equinox.EquinoxRuntimeError`.
        """
        args = self.args if args is None else args
        partial = PartialStart(State(self.q, self.v), self._prescribed)
        return closed_start(self._layout, self.system, partial, t, args, self._rows)

    def report(
        self,
        state: State | None = None,
        args: Parameters | None = None,
        *,
        t: Real = 0.0,
    ) -> dict[str, Gap]:
        """The gap of each joint by name, in the poses of the bodies, or in another state.

        `position` is a length (an angle counts as an arc with the size of the bodies as
        radius), `velocity` its rate. Velocities that are left out count as zero. `t` is the
        time of the state.
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
        """The degrees of freedom in a pose, by default that of the bodies; see `mobility`.

        Rows of constraints are named after their joint, `"hinge[0]"`; internal rows of
        bodies have numbers, and count before all others.
        """
        state = State(self.q, self.v) if state is None else state
        args = self.args if args is None else args
        names = row_names(self._layout, self.q, args, self._rows, self._slips)
        places = [*self._rows.values(), *self._slips.values()]
        joined = {k for x in places for k in range(x.start, x.stop)}
        own = [k for k in range(len(names)) if k not in joined]
        return freedoms(self.system, state, args, t, names, own)

    def position(self, ys: State, body: str, point: Vector | None = None) -> Array:
        """A point of a body in space along a run, shape `(times, d)`; for a state `(d,)`.

        `point` is in the frame of the body, by default the mass centre. For a batch of runs
        the axes of the batch come before that of time.
        """
        return self._along(lambda q, v: View(self._layout, q).position(body, point), ys)

    def velocity(self, ys: State, body: str, point: Vector | None = None) -> Array:
        """The velocity in space of a point of a body; otherwise as `position`."""
        moving = lambda q, v: Moving(self._layout, q, v, self.args)
        return self._along(lambda q, v: moving(q, v).velocity(body, point), ys)

    def direction(self, ys: State, body: str, axis: Vector) -> Array:
        """A body-fixed direction in space; otherwise as `position`."""
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
        """The length or angle of a part along a run, its rate, and the force along it.

        Parts are springs, dampers, inerters, actuators, loads, drives, hinges, sliders and
        rods. For a start or a state, `t` is its time. Pass the `args` of the run if they
        are not those of the scene.

        Along a run, angles of hinges in space include full turns; for a single state these
        are not known.

        **Raises:** `ValueError` for a part without a length or angle.
        """
        args = self.args if args is None else args
        return measured_along(self._layout, self._rows, sol, name, t, args)

    def reaction(
        self,
        sol: Solution | ConsistentStart | Equilibrium,
        joint: str,
        args: Parameters | None = None,
    ) -> Reaction:
        """The force and torque of a joint or drive on its second body, along a run, at a
        start or in an equilibrium.

        Pass the `args` of the run if they are not those of the scene. The multipliers of a
        run are means over the step that ends at a row, and count as those of the row.
        """
        check_reacting(joint, self._rows, self._ends)
        ys = self._ys(sol)
        args, ends = self.args if args is None else args, self._ends[joint]
        of_state = lambda q, x: reaction(self._layout, q, x, joint, ends, args)
        return each(of_state, ys.q, self.multipliers(sol, joint))

    def section_forces(
        self,
        sol: Solution | ConsistentStart | Equilibrium | State,
        beam: str,
        args: Parameters | None = None,
    ) -> SectionForces:
        """The strains of a beam, and the forces and moments in its sections, along a run or
        in one state.

        Pass the `args` of the run if they are not those of the scene.

        **Raises:** `ValueError` for what is no beam.
        """
        args = self.args if args is None else args
        return section_forces(self._layout, self._ys(sol), beam, args)

    def centreline(
        self, sol: Solution | ConsistentStart | Equilibrium | State, beam: str
    ) -> Array:
        """The places of all sections of a beam, shape `(times, sections, d)` (length).

        For one state it is `(sections, d)`. `scene.position(sol.ys, "arm:3")` and
        `scene.direction` are those of one section.

        **Raises:** `ValueError` for what is no beam.
        """
        return centreline(self._layout, self._ys(sol), beam)

    def motion(
        self,
        sol: Solution | ConsistentStart | Equilibrium | State | None = None,
        times: Vector | None = None,
        args: Parameters | None = None,
    ) -> Motion:
        """The poses of all bodies with their shapes, and the places of joints and forces,
        along a run: all that pictures show, as NumPy arrays.

        **Arguments:**

        - `sol`: a run, of which the rows that it reached count; or one state, by default
          the poses of the bodies.
        - `times`: shape `(times,)`, within the rows; by default those of the rows. Between
          rows positions and rotations are interpolated by their values and rates, with an
          error of fourth order in the distance of the rows, and a warning if it can be
          seen.
        - `args`: those of the run if they are not those of the scene.

        **Raises:** `ValueError` or `TypeError` for states that are not of this scene, a
        batch, states that are all NaN, times outside of the rows, and too few rows.
        """
        args = self.args if args is None else args
        state = State(self.q, self.v) if sol is None else sol
        rows = states_of(self._layout, state)
        numbers = numbers_by_name(self._layout, args)
        shapes = all_shapes(self._layout, numbers, self.q, self._shapes)
        parts = Parts(self._kinds, self._ends, shapes)
        return motion_of(self._layout, rows, times, numbers, parts)

    def draw(
        self,
        sol: Solution | ConsistentStart | Equilibrium | State | None = None,
        times: Vector | None = None,
        args: Parameters | None = None,
        *,
        ax: Any = None,
        traces: Sequence[Any] = (),
        names: bool = False,
        units: dict[str, str] | None = None,
    ) -> Any:
        """A picture of the scene: bodies with their shapes, joints, springs and dampers.

        **Arguments:**

        - `sol`, `args`: as for `motion`. Of a run the last row that it reached is drawn.
        - `times`: of a run, the times to draw instead. Earlier ones are paler.
        - `ax`: axes of matplotlib, by default new ones; in space those with
          `projection="3d"`.
        - `traces`: points whose paths along the run are drawn: names of bodies, for their
          mass centres, or pairs `(body, point)` with a point in the frame of the body.
        - `names`: whether the names of bodies and joints are written.
        - `units`: names for the labels, such as `{"length": "m"}`.

        **Returns:** the axes.

        **Raises:** as `motion`, and `ValueError` or `TypeError` for axes that do not fit
        and for traces of what is no body.
        """
        from ._drawing import draw

        whole = self.motion(sol, None, args)
        shown = self.motion(sol, whole.ts[-1:] if times is None else times, args)
        return draw(shown, whole, ax, traces, names, units)

    def animate(
        self,
        sol: Solution,
        args: Parameters | None = None,
        *,
        speed: float = 1.0,
        fps: float = 25.0,
        ax: Any = None,
        traces: Sequence[Any] = (),
        energy: bool = False,
        units: dict[str, str] | None = None,
    ) -> Any:
        """A film of a run, with frames at equal times whatever its steps were.

        Notebooks show it as a player, and `scene.animate(sol).save("run.gif")` writes a
        file. Between rows the motion is interpolated as by `motion`.

        **Arguments:**

        - `sol`: a run whose unit of time is the second, of which the rows that it reached
          are shown.
        - `args`: those of the run if they are not those of the scene.
        - `speed`: of the film, relative to the motion: 0.1 shows it ten times slower.
        - `fps`: frames per second.
        - `ax`, `traces`, `units`: as for `draw`.
        - `energy`: whether the energies are plotted beside the scene.

        **Returns:** the film. `save(path)` writes a .gif, .mp4 (if the program ffmpeg is
        found) or .html file; `show(k)` draws the frame of the time `ts[k]` into `figure`,
        of matplotlib.

        **Raises:** as `draw`, and `ValueError` for a run that is too short or too long for
        a film at this speed.
        """
        from .._pictures import frame_times
        from ._drawing import animate

        ReachedRows(sol)  # checks that it is one run
        whole = self.motion(sol, None, args)
        times = frame_times(whole.ts[0], whole.ts[-1], speed, fps)
        shown = self.motion(sol, times, args)
        return animate(shown, whole, sol, ax, fps, speed, traces, energy, units)

    def view(
        self,
        sol: Solution | ConsistentStart | Equilibrium | State | None = None,
        args: Parameters | None = None,
        *,
        speed: float = 1.0,
        fps: float = 30.0,
    ) -> Any:
        """A run in space, which a browser plays, scrubs and turns.

        Notebooks show it. `scene.view(sol).open()` shows it in the browser, and
        `scene.view(sol).save("run.html")` writes a page that opens without Python, and
        without a network. Frames are at equal times whatever the steps were; between rows
        the motion is interpolated as by `motion`. A scene in the plane stands upright.

        **Arguments:**

        - `sol`: a run whose unit of time is the second, of which the rows that it reached
          are shown; or one state, by default the poses of the bodies.
        - `args`: those of the run if they are not those of the scene.
        - `speed`: of the film, relative to the motion: 0.1 shows it ten times slower.
        - `fps`: frames per second.

        **Returns:** the page, with the methods `open` and `save`.

        **Raises:** `ImportError` without the extra `view`. As `motion`, and `ValueError`
        for a run that is too short or too long for a film at this speed.
        """
        from .._pictures import frame_times
        from ._recording import record

        shown = self.motion(sol, None, args)
        if isinstance(sol, Solution):
            times = frame_times(shown.ts[0], shown.ts[-1], speed, fps)
            shown = self.motion(sol, times, args)
        numbers = self.args if args is None else args
        return record(shown, numbers.own.get("gravity"), speed, fps)

    def plot_reactions(
        self,
        sol: Solution,
        joint: str,
        args: Parameters | None = None,
        *,
        ax: Any = None,
        units: dict[str, str] | None = None,
    ) -> Any:
        """The force and torque of a joint or drive over time; see `reaction`.

        `units` are names for the labels, such as `{"time": "s", "force": "N"}`; torques
        have an axis at the right if there are forces. **Returns:** the axes.
        """
        from ._drawing import plot_reaction

        ReachedRows(sol)  # checks that it is one run
        found = self.reaction(sol, joint, args)
        return plot_reaction(sol, found, joint, ax, units)

    def multipliers(
        self, sol: Solution | ConsistentStart | Equilibrium, joint: str
    ) -> Float[Array, "... rows"]:
        """The multipliers of a joint, constraint or drive, one column for each row.

        Those that keep contacts from slipping follow those that keep them closed.
        """
        found = sol.multipliers[..., self._rows[joint]]
        if joint not in self._slips:
            return found
        slip = sol.multipliers[..., self._slips[joint]]
        return jnp.concatenate([found, slip], axis=-1)

    def columns(
        self, sol: Solution, args: Parameters | None = None
    ) -> dict[str, np.ndarray]:
        """The motion along a run by name, for `sol.to_csv` and `sol.to_pandas`.

        Every column has shape `(times,)`. There are

        - of each body `crank.x`, `crank.y`, `crank.vx`, `crank.vy` of its mass centre; in
          the plane `crank.angle` and `crank.angle_rate`; in space the unit quaternion
          `crank.qw` to `crank.qz` and the angular velocity `crank.omega_x` in space;
        - of each part that `measure` knows `spring.length`, `spring.length_rate` and
          `spring.force`, or `hinge.angle`, `hinge.angle_rate` and `hinge.torque`; of parts
          that act on a point `load.x`, `load.vx` and `load.force_x`;
        - of each joint and drive `hinge.reaction_x` and `hinge.reaction_torque`; see
          `reaction`.

        Pass the `args` of the run if they are not those of the scene.

        **Raises:** `ValueError` for a batch of runs, and for a run that has saved a
        function in place of its states.
        """
        if not isinstance(sol.ys, State) or sol.ys.q.ndim != 2:
            raise ValueError(
                "`scene.columns` needs the states of one run: neither a batch, nor the "
                "values of `SaveAt(fn=...)`."
            )
        args = self.args if args is None else args
        found = of_bodies(self._layout, sol.ys.q, sol.ys.v, args)
        for name in measures_of(self._layout):
            found |= of_readout(self._layout, name, self.measure(sol, name, args))
        for name in (name for name in self._rows if name in self._ends):
            found |= of_reaction(name, self.reaction(sol, name, args))
        return found

    def __str__(self) -> str:
        parts = self._kinds, self._ends, self._rows, self._slips
        return summary(self._layout, *parts, self.system.redundant, self._freedoms)

    def _freedoms(self) -> int | None:
        """Degrees of freedom at the start, or `None` where there is no start."""
        if not is_known((self.q, self.v, self.args)):
            return None
        try:
            start = self.start() if self.system.redundant else State(self.q, self.v)
            return self.mobility(start).degrees_of_freedom
        except ValueError:  # the joints cannot be closed
            return None

    @staticmethod
    def _ys(sol: Solution | ConsistentStart | Equilibrium | State) -> State:
        if isinstance(sol, State):
            return sol
        at_rest = isinstance(sol, ConsistentStart | Equilibrium)
        return sol.state if at_rest else sol.ys

    def _along(self, function: Any, ys: State) -> Array:
        return each(function, ys.q, ys.v)

    def _gaps(
        self, state: State | None, t: Real, args: Parameters | None
    ) -> dict[str, Measured]:
        state = State(self.q, self.v) if state is None else state
        return gaps_of(self._layout, state, t, self.args if args is None else args)
