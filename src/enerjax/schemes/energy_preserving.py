import equinox as eqx
import jax.numpy as jnp

from .._discrete import AbstractDerivative, ChainRule
from .._operators import AbstractModel, Increment, SeparableModel
from .._results import RESULTS
from .._system import State
from .._types import Multipliers, Scalar, Velocities
from ._checks import check_derivative, check_formulation
from .base import AbstractSimplifiedSolve, Formulation, StepEnd, StepProblem


class EnergyPreserving(AbstractSimplifiedSolve[Increment, StepProblem]):
    """Continuous Galerkin scheme: keeps the total energy, damps nothing.

    Solves `S(z0, z1, DH(z0, z1)) = 0` with the constraints at the end of the step.

    - Conserves: energy, to round-off, at any step. With forces and drives it changes by
      their work: that of a force in the middle of the step, at the velocity
      `Lm (q1 - q0)/h`, so a damper never feeds energy in.
    - Dissipates: nothing, high-frequency noise included.
    - Constraints held at: position level; with `formulation="ggl"` velocity level too.
    - Order: 2. Symmetric: `Composed` raises the order to 4, 6 or 8.

    **Arguments:**

    - `formulation`: `"ggl"` (velocity-level constraints with their own multipliers) or
      `"index3"` (the paper's; velocity constraints are then met to second order).
    - `derivative`: the discrete gradient.

    **Reference:** E. Lens and A. Cardona, section 4.1, eq. (14). The `"ggl"` form adds
    the stabilisation of C. W. Gear, B. Leimkuhler and G. K. Gupta (1985).
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

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> StepProblem:
        return StepProblem(model, start, h, self.derivative, self.formulation)

    def predict(
        self, problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> Increment:
        return problem.guess(acceleration, multipliers)

    def residual(self, z: Increment, problem: StepProblem) -> Increment:
        end = self._end(z, problem, z)
        return self._rows(z, problem, end, end, end)

    def simplified(self, z: Increment, held: Increment, problem: StepProblem) -> Increment:
        if not isinstance(problem.model, SeparableModel):
            return self.residual(z, problem)
        # In the velocity that `psi` is taken of, the reaction with the gradients as they
        # are: these change it by as little as eta is small. In its drive, which has the
        # factor eta, the whole reaction.
        end, moving = self._end(z, problem, z), self._end(z, problem, held)
        still = eqx.tree_at(lambda z: z.velocity_impulse, z, held.velocity_impulse)
        return self._rows(z, problem, end, moving, self._end(still, problem, held))

    def _rows(
        self, z: Increment, problem: StepProblem, end: State, moving: State, driven: State
    ) -> Increment:
        """The rows; the ends differ in the reaction that is part of their velocities."""
        drive = problem.drive(problem.start, driven, z)
        load = problem.step_load(end, z)
        return problem.rows(z, end, drive.less(load), moving)  # eq. (14a, c)

    def finish(self, z: Increment, problem: StepProblem) -> StepEnd:
        end = self._end(z, problem, z)
        drive_work = problem.drive_work(problem.start, end, z)
        nothing = jnp.zeros_like(problem.h)
        return StepEnd(
            end,
            problem.h * z.rate,
            z.impulse / problem.h,
            problem.account(nothing, problem.step_work(end, z), drive_work),
            None,
            RESULTS.successful,
        )

    def _end(self, z: Increment, problem: StepProblem, held: Increment) -> State:
        """The end of the step, with its reaction where `held` is."""
        model, start = problem.model, problem.start
        if not isinstance(model, SeparableModel):
            return problem.node(z, problem.end_time)
        q1, t1 = problem.at(z), problem.end_time
        # eq. (14b), solved for the velocity
        mean = problem.velocity(z)
        r1 = q1 if held is z else problem.at(held)
        mean = mean - model.mean_reaction(start.q, start.t, r1, t1, z.velocity_impulse)
        return State(q1, 2 * mean - start.v, t1)
