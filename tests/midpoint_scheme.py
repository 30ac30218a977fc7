"""The constrained implicit midpoint rule, written with public names alone."""

from jax import Array

from enerjax import State
from enerjax.schemes import (
    AbstractModel,
    AbstractOneSolveScheme,
    Formulation,
    Gradient,
    Increment,
    Reaction,
    StepEnd,
    StepProblem,
)


class Midpoint(AbstractOneSolveScheme[Increment, StepProblem]):
    """The implicit midpoint rule with constraints at position and velocity level.

    - Conserves: quadratic energies of unconstrained systems; else nothing exactly.
    - Constraints held at: position and velocity level.
    - Order: 2.
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

    def problem(self, model: AbstractModel, start: State, h: Array) -> StepProblem:
        return StepProblem(model, start, h)

    def predict(
        self, problem: StepProblem, acceleration: Array, multipliers: Array
    ) -> Increment:
        return problem.guess(acceleration, multipliers)

    def residual(self, z: Increment, problem: StepProblem) -> Increment:
        model, end = problem.model, self._end(z, problem)
        middle = self._middle(z, problem, end)
        gradient = model.gradient(middle, problem.h)
        joints = model.constraint_force(middle.q, middle.t, z.impulse)
        reaction = model.reaction_row(middle, z.velocity_impulse)
        total = Gradient(gradient.impulse + joints, gradient.rate + reaction)
        return problem.rows(z, end, total.less(problem.step_load(end, z)))

    def finish(self, z: Increment, problem: StepProblem) -> StepEnd:
        end = self._end(z, problem)
        drive_work = None
        if problem.model.system.driven is not None:
            middle = self._middle(z, problem, end)
            joints = problem.model.constraint_force(middle.q, middle.t, z.impulse)
            drive_work = -joints @ z.rate
        return StepEnd(
            state=end,
            displacement=problem.h * z.rate,
            multipliers=z.impulse / problem.h,
            energies=problem.measured_account(end, problem.step_work(end, z), drive_work),
        )

    def _middle(self, z: Increment, problem: StepProblem, end: State) -> State:
        q = problem.start.q + 0.5 * problem.h * z.rate
        return State(q, 0.5 * (problem.start.v + end.v), problem.middle_time)

    def _end(self, z: Increment, problem: StepProblem) -> State:
        start, middle = problem.start, problem.start.q + 0.5 * problem.h * z.rate

        def velocity(reaction: Reaction) -> tuple[Array]:
            at = middle, problem.middle_time
            correction = reaction(at, at, z.velocity_impulse)
            return (2 * (problem.velocity(z) - correction) - start.v,)

        (end,) = problem.nodes(velocity, (z, problem.end_time))
        return end
