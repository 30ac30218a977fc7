from typing import ClassVar

import equinox as eqx

from .._discrete import AbstractDerivative, ChainRule
from .._operators import AbstractModel, ChordTerms, DelassusMatrix, Reaction
from .._system import State
from .._types import Multipliers, Real, Scalar, Velocities
from ._arguments import (
    alpha_from_spectral_radius,
    as_alpha,
    check_derivative,
    check_formulation,
)
from ._chord import elastic_length, jump_chord
from ._discontinuous import (
    jump_energy,
    jump_gradient,
    jump_loads,
    jump_work,
    JumpAndEnd,
    predict_jump_and_end,
    split_velocities,
)
from .base import AbstractSchemeWithRotations, Formulation, StepEnd, StepProblem


class EnergyDecaying(AbstractSchemeWithRotations[JumpAndEnd, StepProblem]):
    """Discontinuous Galerkin scheme, whose energy decays by `alpha` times that of a jump.

    The state jumps from `z0` to `zj` at the start of the step and then moves to `z1`:

        S(z0, z1, DH_g) = 0,                   g the interval zj -> z1
        S(z0, zj, -(DH_g - DH_h)/3 + alpha/6 (grad H(zj) - grad H(z0))) = 0
        E1 = E0 - alpha (K_jump + V_jump),     h the interval z0 -> zj

    - Conserves: energy, to round-off, at `alpha = 0`.
    - Dissipates: `alpha (K_jump + V_jump)` with `K_jump = |vj - v0|_M^2 / 2` and
      `V_jump = (qj - q0) . (grad V(qj) - grad V(q0)) / 2`, which is never negative where
      `V` is convex over the jump. (With a Hamiltonian their sum is
      `(zj - z0) . (grad H(zj) - grad H(z0)) / 2`, and `H` must be convex.) On a linear
      oscillator of frequency `w` the spectral radius of a step tends to
      `rho_inf = (1 - alpha) / (1 + alpha)` as `h w` grows. Forces enter the intervals like
      `-grad V`; a damper `-C v` with constant `C` never creates energy.
    - Rigid bodies in space (`rigid_bodies` of a `System`) are moved by rotations. The
      angular momentum of a free body is conserved; that of connected bodies drifts with
      third order in each step.
    - Constraints held at: position level at `zj` and `z1`; with `formulation="ggl"`
      velocity level too.
    - Order: 2. For unconstrained systems with `v = qdot` it is 3 with `MeanValue()` or with
      one coordinate, also with linear dampers, but not with other forces. `"index3"` is the
      form of the paper: with constraints its order tends to 1, it *locks* at `alpha = 0`,
      and it dissipates far too much at larger `alpha`.

    **Arguments:**

    - `alpha`: the dissipation, in [0, 1]. It can be traced, swept and differentiated.
    - `formulation`: `"ggl"` or `"index3"`.
    - `derivative`: the discrete gradient.

    Raises a `ValueError` for a known `alpha` outside [0, 1].

    **Reference:** E. Lens and A. Cardona, sections 5.1 (alpha = 1, eq. 28) and 5.2
    (eq. 47).
    """

    # A jump does not rotate bodies as a step does, so in the plane it would gain nothing.
    rotates_in: ClassVar[tuple[int, ...]] = (3,)
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
        """The scheme with spectral radius `rho_inf`, in [0, 1], at infinite frequency."""
        alpha = alpha_from_spectral_radius(rho_inf)
        return cls(alpha=alpha, formulation=formulation, derivative=derivative)

    @property
    def order(self) -> int:
        return 2 if self.formulation == "ggl" else 1

    @property
    def symmetric(self) -> bool:
        return False

    @property
    def chord_terms(self) -> tuple[ChordTerms, ...]:
        return ("strains", "dampers"), ("strains",), ("dampers",)

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> StepProblem:
        return StepProblem(model, start, h, self.derivative, self.formulation)

    def predict(
        self, problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> JumpAndEnd:
        return predict_jump_and_end(problem, acceleration, multipliers)

    def residual(self, z: JumpAndEnd, problem: StepProblem) -> JumpAndEnd:
        model, start, h = problem.model, problem.start, problem.h
        jump, end = self._nodes(z, problem)
        loads = jump_loads(self.alpha, z, problem, jump, end)
        after = problem.discrete_gradient(jump, end, z.end)
        before = problem.discrete_gradient(start, jump, z.jump)
        after, before = after.less(loads.after), before.less(loads.before)
        at_start = model.gradient(start, h).less(loads.start)
        at_jump = model.gradient(jump, h).less(loads.jump)
        to_jump = jump_gradient(self.alpha, after, before, at_start, at_jump)
        return JumpAndEnd(
            jump=problem.rows(z.jump, jump, to_jump),  # eq. (47b)
            end=problem.rows(z.end, end, after, (z.jump, jump)),  # eq. (47a)
        )

    def delassus_matrix(self, z: JumpAndEnd, problem: StepProblem) -> DelassusMatrix:
        elastic = elastic_length(self.alpha, problem.h)
        return problem.delassus_matrix(z.end, elastic=elastic)

    def chord(
        self, rows: JumpAndEnd, problem: StepProblem, delassus: DelassusMatrix
    ) -> JumpAndEnd:
        return jump_chord(self.alpha, rows, delassus)

    def finish(self, z: JumpAndEnd, problem: StepProblem) -> StepEnd:
        jump, end = self._nodes(z, problem)
        kinetic, potential = jump_energy(problem, jump)
        dissipated = self.alpha.astype(kinetic.dtype) * (kinetic + potential)
        work = jump_work(self.alpha, z, problem, jump, end)
        drive_work = problem.drive_work(jump, end, z.end)
        return StepEnd(
            state=end,
            displacement=problem.displacement(z.end),
            multipliers=z.end.impulse / problem.h,
            energies=problem.account(dissipated, work, drive_work),
        )

    def _nodes(self, z: JumpAndEnd, problem: StepProblem) -> tuple[State, ...]:
        """The states after the jump, which takes no time, and at the end."""
        model, start = problem.model, problem.start
        qj, q1 = problem.position(z.jump), problem.position(z.end)
        t0, t1 = start.t, problem.end_time

        def velocities(reaction: Reaction) -> tuple[Velocities, Velocities]:
            at_start, at_jump, at_end = (start.q, t0), (qj, t0), (q1, t1)
            after = reaction(at_jump, at_end, z.end.velocity_impulse)
            before = reaction(at_start, at_jump, z.jump.velocity_impulse)
            return split_velocities(
                self.alpha,
                start.v,
                2 * (problem.velocity(z.end) - after),  # eq. (47d): vj + v1
                # eq. (47e)
                -6 * model.push(start.q, qj, z.jump.rate) - 2 * (after - before),
            )

        return problem.nodes(velocities, (z.jump, t0), (z.end, t1))
