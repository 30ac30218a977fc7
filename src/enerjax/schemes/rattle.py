import equinox as eqx

from .._operators import AbstractModel, ChordTerms, DelassusMatrix, Increment
from .._system import State
from .._types import Coordinates, Multipliers, Scalar, Velocities
from ._chord import rattle_chord
from .base import AbstractSchemeWithChord, Formulation, StepEnd, StepProblem


class Rattle(AbstractSchemeWithChord[Increment, StepProblem]):
    """RATTLE: the constrained leapfrog (Stormer-Verlet) scheme; for comparison.

    With the velocity `V` in the middle of the step and the forces `F = -grad V + f`,

        M V  = M v0 + h/2 (F(q0, V) - B0^T lambda0),    q1 = q0 + h V,    Phi(q1) = 0
        M v1 = M V  + h/2 (F(q1, V) - B1^T lambda1),                      B1 v1 = 0

    - Conserves: the symplectic form, and linear and angular momentum. The energy error
      oscillates with an amplitude of order `h^2` and does not drift. The forces are
      explicit, so the step must be short: `h` times any frequency must be below 2.
    - Dissipates: nothing. It has no energy identity: `dissipated` is the measured loss
      `E0 + work + drive_work - E1` of the step, of either sign.
    - Constraints held at: position and velocity level.
    - Order: 2. Symmetric: `Composed` raises the order to 4, 6 or 8.
    - Multipliers: `(lambda0 + lambda1)/2`, the mean over the step.
    - With `nonholonomic` constraints `A((q0 + q1)/2) V = 0`, their rows are among those of
      `B0` and `B1`, and nothing is symplectic.
    - For a `System` without `kinematics`. Others raise a `ValueError`. A `force` may depend
      on the velocity; it is evaluated with `V` at both ends.

    **Reference:** H. C. Andersen, J. Comput. Phys. 52 (1983) 24-34; the form with general
    constraints and its symplecticity: B. Leimkuhler and R. D. Skeel, J. Comput. Phys. 112
    (1994) 117-125; E. Hairer, C. Lubich and G. Wanner, Geometric Numerical Integration,
    section VII.1.4.
    """

    @property
    def order(self) -> int:
        return 2

    @property
    def formulation(self) -> Formulation:
        return "ggl"

    @property
    def symmetric(self) -> bool:
        return True

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> StepProblem:
        return StepProblem.with_constant_inertia("Rattle", model, start, h)

    def predict(
        self, problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> Increment:
        """`rate` is `V`, `impulse` is `h lambda0`, `velocity_impulse` is `h lambda1`."""
        guess = problem.guess(acceleration, multipliers)
        return eqx.tree_at(lambda z: z.velocity_impulse, guess, guess.impulse)

    def residual(self, z: Increment, problem: StepProblem) -> Increment:
        start, middle = problem.start, z.rate
        pulled = self._pulled(problem, start.q, middle, start.t, z.impulse)
        balance = problem.separable_model.inertia @ (middle - start.v) + 0.5 * pulled
        return problem.rows_of_balance(z, balance, self._end(z, problem))

    @property
    def chord_terms(self) -> tuple[ChordTerms, ...]:
        return ()

    def delassus_matrix(self, z: Increment, problem: StepProblem) -> DelassusMatrix:
        return problem.delassus_matrix(z)

    def chord(
        self, rows: Increment, problem: StepProblem, delassus: DelassusMatrix
    ) -> Increment:
        return rattle_chord(rows, delassus)

    def finish(self, z: Increment, problem: StepProblem) -> StepEnd:
        end = self._end(z, problem)
        # The mean of the forces at both ends, times the displacement.
        at_ends = lambda law: [law(x.q, z.rate, x.t) for x in (problem.start, end)]
        work = lambda law: 0.5 * problem.h * sum(at_ends(law)) @ z.rate
        drive_work = self._drive_work(z, problem, end)
        return StepEnd(
            state=end,
            displacement=problem.h * z.rate,
            multipliers=0.5 * (z.impulse + z.velocity_impulse) / problem.h,
            energies=problem.measured_account(end, work, drive_work),
        )

    def _end(self, z: Increment, problem: StepProblem) -> State:
        q1, t1 = problem.position(z), problem.end_time
        pulled = self._pulled(problem, q1, z.rate, t1, z.velocity_impulse)
        v1 = z.rate - 0.5 * (problem.separable_model.inverse_inertia @ pulled)
        return State(q1, v1, t1)

    def _pulled(
        self,
        problem: StepProblem,
        q: Coordinates,
        middle: Velocities,
        t: Scalar | None,
        impulse: Multipliers,
    ) -> Coordinates:
        """`-h (F - B^T lambda)` at one end of the step."""
        model = problem.model
        slope = model.slope(State(q, middle, t))
        return problem.h * slope + model.constraint_force(q, t, impulse)

    def _drive_work(self, z: Increment, problem: StepProblem, end: State) -> Scalar | None:
        """The work of all reactions; those of scleronomic joints do no work."""
        model, start = problem.model, problem.start
        if model.system.driven is None:
            return None
        before = model.constraint_force(start.q, start.t, z.impulse)
        after = model.constraint_force(end.q, end.t, z.velocity_impulse)
        return -0.5 * (before + after) @ z.rate
