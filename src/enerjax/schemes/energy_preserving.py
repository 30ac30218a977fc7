import equinox as eqx
import jax.numpy as jnp

from .._discrete import AbstractDerivative, ChainRule
from .._operators import AbstractModel, ChordTerms, DelassusMatrix, Increment, Reaction
from .._system import State
from .._types import Multipliers, Scalar, Velocities
from ._arguments import check_derivative, check_formulation
from ._chord import step_chord
from .base import AbstractSchemeWithRotations, Formulation, StepEnd, StepProblem


class EnergyPreserving(AbstractSchemeWithRotations[Increment, StepProblem]):
    """Continuous Galerkin scheme, which preserves the total energy.

    Solves `S(z0, z1, DH(z0, z1)) = 0` with the constraints at the end of the step.

    - Conserves: energy, to round-off, for any step length. With forces and driven
      constraints the energy changes by their work. Forces act in the middle of the step, at
      the velocity `Lm (q1 - q0)/h`, so a damper never creates energy.
    - Dissipates: nothing, not even high-frequency oscillations.
    - Constraints held at: position level; with `formulation="ggl"` velocity level too.
      Nonholonomic constraints hold for the displacement, `A(qm) (q1 - q0) = 0`, instead of
      the position.
    - Order: 2. Symmetric: `Composed` raises the order to 4, 6 or 8.
    - Rigid bodies (`rigid_bodies` of a `System`) are moved by rotations; linear and angular
      momentum are conserved to round-off where forces permit it, of bodies in the plane
      with `ChainRule`. A body that turns freely is late by the part `(h omega)^2/12` of its
      angle, and turns by less than half a turn in a step.

    **Arguments:**

    - `formulation`: `"ggl"` (velocity-level constraints have multipliers of their own) or
      `"index3"` (as in the paper; velocities satisfy the constraints to second order).
    - `derivative`: the discrete gradient.

    **Reference:** E. Lens and A. Cardona, section 4.1, eq. (14). The `"ggl"` form adds
    the stabilisation of C. W. Gear, B. Leimkuhler and G. K. Gupta (1985). Rotations: J. C.
    Simo and K. K. Wong (1991), with discrete gradients of any potential and constraints.
    """

    formulation: Formulation = eqx.field(  # pyright: ignore[reportIncompatibleMethodOverride]
        default="ggl", static=True
    )
    derivative: AbstractDerivative = ChainRule()

    def __check_init__(self):
        check_formulation("EnergyPreserving", self.formulation)
        check_derivative("EnergyPreserving", self.derivative)

    @property
    def order(self) -> int:
        return 2

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def chord_terms(self) -> tuple[ChordTerms, ...]:
        return ("strains", "dampers"), ("strains",), ("dampers",)

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> StepProblem:
        return StepProblem(
            model, start, h, self.derivative, self.formulation, is_one_interval=True
        )

    def predict(
        self, problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> Increment:
        return problem.guess(acceleration, multipliers)

    def residual(self, z: Increment, problem: StepProblem) -> Increment:
        end = self._end(z, problem)
        gradient = problem.discrete_gradient(problem.start, end, z)
        load = problem.step_load(end, z)
        return problem.rows(z, end, gradient.less(load))  # eq. (14a, c)

    def delassus_matrix(self, z: Increment, problem: StepProblem) -> DelassusMatrix:
        return problem.delassus_matrix(z, elastic=problem.h)

    def chord(
        self, rows: Increment, problem: StepProblem, delassus: DelassusMatrix
    ) -> Increment:
        return step_chord(rows, delassus)

    def finish(self, z: Increment, problem: StepProblem) -> StepEnd:
        end = self._end(z, problem)
        work, drive_work = (
            problem.step_work(end, z),
            problem.drive_work(problem.start, end, z),
        )
        return StepEnd(
            state=end,
            displacement=problem.displacement(z),
            multipliers=z.impulse / problem.h,
            energies=problem.account(jnp.zeros_like(problem.h), work, drive_work),
        )

    def _end(self, z: Increment, problem: StepProblem) -> State:
        start, q1, t1 = problem.start, problem.position(z), problem.end_time

        def velocity(reaction: Reaction) -> tuple[Velocities]:
            added = reaction((start.q, start.t), (q1, t1), z.velocity_impulse)
            # eq. (14b), solved for v1
            return (2 * (problem.velocity(z) - added) - start.v,)

        (end,) = problem.nodes(velocity, (z, t1))
        return end
