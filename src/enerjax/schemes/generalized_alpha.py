import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._operators import AbstractModel, Increment
from .._programs import is_known
from .._system import State
from .._types import Multipliers, Real, Scalar, Velocities
from ._arguments import (
    alpha_from_spectral_radius,
    check_formulation,
    refuse_nonholonomic,
)
from .base import AbstractSchemeWithMemory, Formulation, StepEnd, StepProblem


class _Carried(eqx.Module):
    # a_n, which approximates the acceleration at t_n + (alpha_m - alpha_f) h.
    auxiliary: Velocities
    # vdot_n, which satisfies the equations of motion at t_n.
    acceleration: Velocities


class _AlphaProblem(eqx.Module):
    step: StepProblem
    before: _Carried | None


class GeneralizedAlpha(AbstractSchemeWithMemory[Increment, _AlphaProblem]):
    """The generalized-alpha method for index-3 systems; for comparison.

    Positions and velocities are computed from an auxiliary acceleration `a`, which is
    passed from step to step. The acceleration `vdot` satisfies the equations of motion at
    the end of the step:

        M vdot1 + dV/dq(q1) + B1^T lambda1 = f(q1, v1, t1),      Phi(q1) = 0
        (1 - alpha_m) a1 + alpha_m a0 = (1 - alpha_f) vdot1 + alpha_f vdot0
        q1 = q0 + h v0 + h^2 ((1/2 - beta) a0 + beta a1)
        v1 = v0 + h ((1 - gamma) a0 + gamma a1)

    - Conserves: nothing exactly.
    - Dissipates: high-frequency oscillations; a step multiplies the amplitude of an
      infinitely fast one by `rho_inf`. The scheme has no energy identity: `dissipated` is
      the measured loss `E0 + work + drive_work - E1` of the step, of either sign. The work
      of forces and reactions is computed by the trapezoidal rule.
    - Constraints held at: position level; with `formulation="ggl"` velocity level too, by
      the term `- h M^-1 B0^T eta` in the equation of `q1`.
    - Order: 2, also of the multipliers. A run begins with `a0 = vdot0`, and the error of
      this start has to decay first. With constraints this requires `rho_inf < 1`: at 1
      (and for `newmark`) errors of the multipliers do not decay.
    - Multipliers: `lambda1`, those at the end of the step.
    - For a `System` without `kinematics` and `nonholonomic`. Others raise a `ValueError`.
    - `step` without `warm` begins again with `a0 = vdot0`.

    **Arguments:**

    - `rho_inf`: the spectral radius at infinite frequency, in [0, 1]. It can be traced.
    - `formulation`: `"index3"` or `"ggl"`.

    **Raises:** `ValueError` for a known `rho_inf` outside [0, 1].

    **Reference:** J. Chung and G. M. Hulbert, J. Appl. Mech. 60 (1993) 371-375, for the
    coefficients; M. Arnold and O. Bruls, Multibody Syst. Dyn. 18 (2007) 185-202, for the
    constrained form with `a`. Stabilised in the manner of C. Lunk and B. Simeon, Z. Angew.
    Math. Mech. 86 (2006) 772-784.
    """

    alpha_m: Scalar
    alpha_f: Scalar
    beta: Scalar
    gamma: Scalar
    formulation: Formulation = eqx.field(  # pyright: ignore[reportIncompatibleMethodOverride]
        default="index3", static=True
    )

    def __init__(self, rho_inf: Real, formulation: Formulation = "index3"):
        check_formulation("GeneralizedAlpha", formulation)
        # In terms of this alpha the four coefficients are polynomials.
        alpha = alpha_from_spectral_radius(rho_inf)
        self.alpha_m = 0.5 * (1 - 3 * alpha)
        self.alpha_f = 0.5 * (1 - alpha)
        self.beta = 0.25 * (1 + alpha) ** 2
        self.gamma = 0.5 + alpha
        self.formulation = formulation  # pyright: ignore[reportIncompatibleMethodOverride]

    @classmethod
    def hht(
        cls, alpha: Real = -0.1, formulation: Formulation = "index3"
    ) -> "GeneralizedAlpha":
        """The method of Hilber, Hughes and Taylor, `alpha` in [-1/3, 0].

        **Raises:** `ValueError` for a known `alpha` outside this interval.

        **Reference:** H. M. Hilber, T. J. R. Hughes and R. L. Taylor, Earthq. Eng. Struct.
        Dyn. 5 (1977) 283-292.
        """
        if is_known(alpha) and not -1 / 3 <= float(np.real(alpha)) <= 0:
            raise ValueError(
                f"`GeneralizedAlpha.hht(alpha={alpha})`: alpha must lie in [-1/3, 0]; -1/3 "
                "damps high frequencies most, 0 not at all."
            )
        alpha = jnp.asarray(alpha, float)
        beta, gamma = 0.25 * (1 - alpha) ** 2, 0.5 - alpha
        return cls._of(0 * alpha, -alpha, beta, gamma, formulation)

    @classmethod
    def newmark(
        cls, beta: Real = 0.25, gamma: Real = 0.5, formulation: Formulation = "index3"
    ) -> "GeneralizedAlpha":
        """The method of Newmark; it is of order 2 only with `gamma = 1/2`.

        **Raises:** `ValueError` for a known `beta` that is not positive.

        **Reference:** N. M. Newmark, J. Eng. Mech. Div. 85 (1959) 67-94.
        """
        if is_known(beta) and not float(np.real(beta)) > 0:
            raise ValueError(
                f"`GeneralizedAlpha.newmark(beta={beta})`: beta must be positive, for the "
                "constraints reach the accelerations through it. The explicit scheme for "
                "constraints is `Rattle()`."
            )
        beta, gamma = jnp.asarray(beta, float), jnp.asarray(gamma, float)
        return cls._of(0 * beta, 0 * beta, beta, gamma, formulation)

    @classmethod
    def _of(
        cls,
        alpha_m: Scalar,
        alpha_f: Scalar,
        beta: Scalar,
        gamma: Scalar,
        formulation: Formulation,
    ) -> "GeneralizedAlpha":
        coefficients = lambda x: (x.alpha_m, x.alpha_f, x.beta, x.gamma)
        new = (alpha_m, alpha_f, beta, gamma)
        return eqx.tree_at(coefficients, cls(1.0, formulation), new)

    @property
    def order(self) -> int:
        return 2

    @property
    def symmetric(self) -> bool:
        return False

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> _AlphaProblem:
        refuse_nonholonomic(
            "GeneralizedAlpha", model, "it imposes constraints on positions alone"
        )
        step = StepProblem.with_constant_inertia(
            "GeneralizedAlpha", model, start, h, self.formulation
        )
        return _AlphaProblem(step, None)

    def begin(
        self, model: AbstractModel, start: State, h: Scalar, acceleration: Velocities
    ) -> _Carried:
        return _Carried(acceleration, acceleration)

    def resume(self, problem: _AlphaProblem, carried: _Carried) -> _AlphaProblem:
        return _AlphaProblem(problem.step, carried)

    def predict(
        self, problem: _AlphaProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> Increment:
        return problem.step.guess(acceleration, multipliers)

    def residual(self, z: Increment, problem: _AlphaProblem) -> Increment:
        step, model = problem.step, problem.step.separable_model
        end, after = self._end(z, problem)
        load = model.inertia @ after.acceleration + model.slope(end)
        balance = step.h * load + model.constraint_force(end.q, end.t, z.impulse)
        return step.rows_of_balance(z, balance, end)

    def finish(self, z: Increment, problem: _AlphaProblem) -> StepEnd:
        step, before = problem.step, problem.before
        assert before is not None
        model, half = step.separable_model, 0.5 * step.h
        end, after = self._end(z, problem)
        powers = lambda law: [law(x.q, x.v, x.t) @ x.v for x in (step.start, end)]
        work = lambda law: half * sum(powers(law))
        drive_work = None
        if model.system.driven is not None:
            # The reactions follow from the equations of motion. Those of scleronomic joints
            # do no work.
            power = lambda x, vdot: (model.inertia @ vdot + model.slope(x)) @ x.v
            first, last = before.acceleration, after.acceleration
            drive_work = half * (power(step.start, first) + power(end, last))
        return StepEnd(
            state=end,
            displacement=step.h * z.rate,
            multipliers=z.impulse / step.h,
            energies=step.measured_account(end, work, drive_work),
            carried=after,
        )

    def _end(self, z: Increment, problem: _AlphaProblem) -> tuple[State, _Carried]:
        """The state and the accelerations at the end of the step."""
        step, before = problem.step, problem.before
        assert before is not None
        start, h = step.start, step.h
        alpha_m, alpha_f, beta, gamma = jax.tree.map(
            lambda x: x.astype(h.dtype), (self.alpha_m, self.alpha_f, self.beta, self.gamma)
        )
        a0 = before.auxiliary
        shift = step.separable_model.reaction_at(start.q, start.t, z.velocity_impulse)
        a1 = ((z.rate + shift - start.v) / h - (0.5 - beta) * a0) / beta
        mean = (1 - alpha_m) * a1 + alpha_m * a0
        vdot1 = (mean - alpha_f * before.acceleration) / (1 - alpha_f)
        v1 = start.v + h * ((1 - gamma) * a0 + gamma * a1)
        return State(step.position(z), v1, step.end_time), _Carried(a1, vdot1)
