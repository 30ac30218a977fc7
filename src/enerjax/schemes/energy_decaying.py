import equinox as eqx

from .._discrete import AbstractDerivative, ChainRule
from .._operators import AbstractModel, SeparableModel
from .._results import RESULTS
from .._system import State
from .._types import Multipliers, Real, Scalar, Velocities
from ._checks import check_derivative, check_formulation
from ._decaying import (
    alpha_from_spectral_radius,
    as_alpha,
    jump_drive,
    jump_energy,
    jump_loads,
    jump_work,
    JumpAndEnd,
    predict_jump_and_end,
    split_velocities,
)
from .base import AbstractSimplifiedSolve, Formulation, StepEnd, StepProblem


class EnergyDecaying(AbstractSimplifiedSolve[JumpAndEnd, StepProblem]):
    """Discontinuous Galerkin scheme: the energy decays by `alpha` times a jump.

    The state jumps from `z0` to `zj` at the start of the step and moves on to `z1`:

        S(z0, z1, DH_g) = 0,                   g the interval zj -> z1
        S(z0, zj, -(DH_g - DH_h)/3 + alpha/6 (grad H(zj) - grad H(z0))) = 0
        E1 = E0 - alpha (K_jump + V_jump),     h the interval z0 -> zj

    - Conserves: energy, to round-off, at `alpha = 0`.
    - Dissipates: `alpha (K_jump + V_jump)` with `K_jump = |vj - v0|_M^2 / 2` and
      `V_jump = (qj - q0) . (grad V(qj) - grad V(q0)) / 2`, which is never negative where
      `V` is convex over the jump. (With a Hamiltonian their sum is
      `(zj - z0) . (grad H(zj) - grad H(z0)) / 2`, and `H` must be convex.) On a linear
      oscillator of frequency `w` the step tends to `rho_inf = (1 - alpha) / (1 + alpha)`
      as `h w` grows. Forces enter the intervals like `-grad V`; a damper `-C v` with
      constant `C` never feeds energy in.
    - Constraints held at: position level at `zj` and `z1`; with `formulation="ggl"`
      velocity level too.
    - Order: 2. Unconstrained with `v = qdot`, 3 with `MeanValue()` or one coordinate, and
      with linear dampers, but not with other forces.
      `"index3"` is the paper's: on constrained motion it tends to order 1, *locks* at
      `alpha = 0` and dissipates far too much above.

    **Arguments:**

    - `alpha`: in [0, 1]; a traced leaf, free to be swept and differentiated.
    - `formulation`: `"ggl"` or `"index3"`.
    - `derivative`: the discrete gradient.

    A concrete `alpha` outside [0, 1] raises a `ValueError`.

    **Reference:** E. Lens and A. Cardona, sections 5.1 (alpha = 1, eq. 28) and 5.2
    (eq. 47).
    """

    alpha: Scalar = eqx.field(converter=as_alpha)
    formulation: Formulation = eqx.field(  # pyright: ignore[reportIncompatibleMethodOverride]
        default="ggl", static=True
    )
    derivative: AbstractDerivative = ChainRule()

    def __check_init__(self):
        check_formulation("EnergyDecaying", self.formulation)
        check_derivative("EnergyDecaying", self.derivative)

    @classmethod
    def from_spectral_radius(
        cls,
        rho_inf: Real,
        formulation: Formulation = "ggl",
        derivative: AbstractDerivative = ChainRule(),
    ) -> "EnergyDecaying":
        """The scheme whose high-frequency limit is `rho_inf`, in [0, 1]."""
        alpha = alpha_from_spectral_radius(rho_inf)
        return cls(alpha=alpha, formulation=formulation, derivative=derivative)

    @property
    def order(self) -> int:
        return 2 if self.formulation == "ggl" else 1

    @property
    def symmetric(self) -> bool:
        return False

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> StepProblem:
        return StepProblem(model, start, h, self.derivative, self.formulation)

    def predict(
        self, problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> JumpAndEnd:
        return predict_jump_and_end(problem, acceleration, multipliers)

    def residual(self, z: JumpAndEnd, problem: StepProblem) -> JumpAndEnd:
        nodes = self._nodes(z, problem, z)
        return self._rows(z, problem, nodes, nodes, nodes)

    def simplified(
        self, z: JumpAndEnd, held: JumpAndEnd, problem: StepProblem
    ) -> JumpAndEnd:
        if not isinstance(problem.model, SeparableModel):
            return self.residual(z, problem)
        # As of `EnergyPreserving`.
        parts = lambda z: (z.jump.velocity_impulse, z.end.velocity_impulse)
        still = eqx.tree_at(parts, z, parts(held))
        nodes, moving = self._nodes(z, problem, z), self._nodes(z, problem, held)
        return self._rows(z, problem, nodes, moving, self._nodes(still, problem, held))

    def _rows(
        self,
        z: JumpAndEnd,
        problem: StepProblem,
        nodes: tuple[State, State],
        moving: tuple[State, State],
        driven: tuple[State, State],
    ) -> JumpAndEnd:
        """The rows; the nodes differ in the reactions that are part of their velocities."""
        model, start, h = problem.model, problem.start, problem.h
        jump, end = nodes
        loads = jump_loads(self.alpha, z, problem, jump, end)
        after = problem.drive(*driven, z.end).less(loads.after)
        before = problem.drive(start, driven[0], z.jump).less(loads.before)
        at_start = model.gradient(start, h).less(loads.start)
        at_jump = model.gradient(jump, h).less(loads.jump)
        to_jump = jump_drive(self.alpha, after, before, at_start, at_jump)
        return JumpAndEnd(
            problem.rows(z.jump, jump, to_jump, moving[0]),
            problem.rows(z.end, end, after, moving[1]),
        )

    def finish(self, z: JumpAndEnd, problem: StepProblem) -> StepEnd:
        jump, end = self._nodes(z, problem, z)
        kinetic, potential = jump_energy(problem, jump)
        dissipated = self.alpha.astype(kinetic.dtype) * (kinetic + potential)
        work = jump_work(self.alpha, z, problem, jump, end)
        drive_work = problem.drive_work(jump, end, z.end)
        return StepEnd(
            end,
            problem.h * z.end.rate,
            z.end.impulse / problem.h,
            problem.account(dissipated, work, drive_work),
            None,
            RESULTS.successful,
        )

    def _nodes(
        self, z: JumpAndEnd, problem: StepProblem, held: JumpAndEnd
    ) -> tuple[State, State]:
        """After the jump and at the end, with their reactions where `held` is."""
        model, q0, v0 = problem.model, problem.start.q, problem.start.v
        # The jump takes no time.
        t0, t1 = problem.start.t, problem.end_time
        if not isinstance(model, SeparableModel):
            return problem.node(z.jump, t0), problem.node(z.end, t1)
        qj, q1 = problem.at(z.jump), problem.at(z.end)
        rj, r1 = (qj, q1) if held is z else map(problem.at, (held.jump, held.end))
        after = model.mean_reaction(rj, t0, r1, t1, z.end.velocity_impulse)
        before = model.mean_reaction(q0, t0, rj, t0, z.jump.velocity_impulse)
        vj, v1 = split_velocities(
            self.alpha,
            v0,
            2 * (problem.velocity(z.end) - after),  # eq. (47d): vj + v1
            -6 * model.push(q0, qj, z.jump.rate) - 2 * (after - before),  # eq. (47e)
        )
        return State(qj, vj, t0), State(q1, v1, t1)
