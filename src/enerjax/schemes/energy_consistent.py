from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._discrete import AbstractDerivative, MeanValue
from .._operators import (
    AbstractModel,
    CanonicalModel,
    Drive,
    Increment,
    SeparableModel,
    Time,
)
from .._programs import is_known
from .._results import RESULTS
from .._solvers import Assembled
from .._system import State
from .._types import Coordinates, Multipliers, Real, Scalar, Velocities
from ._checks import check_derivative
from ._decaying import alpha_from_spectral_radius, as_alpha, JumpAndEnd
from ._frozen import freeze, Frozen
from .base import AbstractSingleSolve, Formulation, StepEnd, StepProblem


# The end of the step, and where it is an unknown the jump, a velocity.
_Unknowns: TypeAlias = Increment | JumpAndEnd


class EnergyConsistent(AbstractSingleSolve[_Unknowns, Frozen]):
    r"""One interval, order 4 or 3, and decay for any potential.

    The jump `j` of the discontinuous schemes in closed form, so that the unknowns are
    those of `EnergyPreserving`. With `z = (q, p)`, the symplectic matrix `J`, and
    `C = (Phi, psi)` with the multipliers `m = (lambda, eta)`:

        z1 - z0 = h J [DH + DC^T m + D j_D(0)/2 + P (j_P(alpha) - j_P(0))/2]
        j_A(a)  = -(h/6) J A (z1 - z0 - a j_A(a))
        E1      = E0 - alpha/2 j_P(alpha) . P j_P(alpha)

    `D = diag(K, M^-1)` with the stiffness `K = Hess(V + lambda . Phi)` at the midpoint
    drives the order and does no work. `P = diag(K+, M^-1)` with the positive
    semidefinite part of `K` (in the metric of the inertia, near the start of the step)
    can only dissipate, whatever the potential is.

    - Conserves: energy, to round-off, at `alpha = 0`.
    - Dissipates: `alpha/2 j . P j >= 0` in every step, also where `V` is not convex. On a
      linear oscillator `rho_inf = (1 - alpha) / (1 + alpha)`. Where the stiffness has no
      positive part there is nothing to damp, and nothing is removed. (Of a system with
      more than 64 coordinates whose potential is linear or made of `Elements`, `P` is the
      sum of the positive parts of its elements and constraints; of any other the whole
      matrix is decomposed, at a cost that grows with its cube.)
    - Constraints held at: position and velocity level.
    - Order: 4 at `alpha = 0` (then symmetric: `Composed` raises it to 6 or 8), else 3;
      2 where the `derivative` is no `MeanValue()` and `V` is not quadratic, and with
      forces, which enter as in `EnergyPreserving`. Driven constraints keep the order.
    - Needs canonical coordinates, `v = qdot` or momenta: with `kinematics` use
      `EnergyPreserving` or `EnergyDecaying`.

    **Arguments:**

    - `alpha`: in [0, 1]; a traced leaf, free to be swept and differentiated.
    - `derivative`: the discrete gradient; `MeanValue()` keeps the order.

    A concrete `alpha` outside [0, 1] raises a `ValueError`, and so does a system with
    `kinematics`.

    **Reference:** unconstrained at `alpha = 0` the fourth-order method of G. R. W. Quispel
    and D. I. McLaren, J. Phys. A 41 (2008) 045206, eq. (14); the dissipative and the
    constrained forms are this library's. Neighbours: L. Brugnano, G. Gurioli,
    F. Iavernaro and E. B. Weinmueller (2018), line-integral methods for holonomic
    constraints; P. L. Kinon, P. Betsch and S. Schneider (2023), energy-momentum schemes
    in Livens form; F. Armero and I. Romero (2001), energy-dissipating schemes.
    """

    alpha: Scalar
    derivative: AbstractDerivative
    # Decided when the scheme is made: under a transformation `alpha` may be traced.
    is_preserving: bool = eqx.field(static=True)

    def __init__(self, alpha: Real, derivative: AbstractDerivative = MeanValue(points=2)):
        check_derivative("EnergyConsistent", derivative)
        self.alpha = as_alpha(alpha)
        self.derivative = derivative
        # In NumPy: under `jit` a comparison of JAX arrays would be traced.
        self.is_preserving = is_known(self.alpha) and not np.any(np.asarray(self.alpha))

    @classmethod
    def from_spectral_radius(
        cls, rho_inf: Real, derivative: AbstractDerivative = MeanValue(points=2)
    ) -> "EnergyConsistent":
        """The scheme whose high-frequency limit is `rho_inf`, in [0, 1]."""
        return cls(alpha=alpha_from_spectral_radius(rho_inf), derivative=derivative)

    @property
    def formulation(self) -> Formulation:
        return "ggl"

    @property
    def symmetric(self) -> bool:
        return self.is_preserving

    @property
    def order(self) -> int:
        return 4 if self.symmetric else 3

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> Frozen:
        if not model.has_canonical_rates:
            raise ValueError(
                "`EnergyConsistent` needs velocities that are the rates of the "
                "coordinates, and this system has `kinematics`. Use `EnergyPreserving` "
                "or `EnergyDecaying`, or describe rotations without `kinematics` "
                "(directors, or `System.from_hamiltonian`)."
            )
        step = StepProblem(model, start, h, self.derivative, "ggl")
        return freeze(step, self._alpha(h))

    def predict(
        self, problem: Frozen, acceleration: Velocities, multipliers: Multipliers
    ) -> _Unknowns:
        guess = problem.step.guess(acceleration, multipliers)
        if not isinstance(problem.stiffness, Assembled):
            return guess
        none = guess.momentum
        return JumpAndEnd(Increment(none, jnp.zeros_like(guess.rate), none, none), guess)

    def residual(self, z: _Unknowns, problem: Frozen) -> _Unknowns:
        if not isinstance(z, JumpAndEnd):
            return self._rows(z, problem, *self._end(z, problem, None))
        h, alpha = problem.step.h, self._alpha(problem.step.h)
        end, jump_v = self._end(z.end, problem, z.jump.rate)
        # (M + lag^2 P) j_v - (h/6) P (dq + lag dv)
        dv = end.v - problem.step.start.v
        pushed = problem.stiffness @ (
            h * z.end.rate + alpha * h / 6 * (dv - alpha * jump_v)
        )
        jump_row = problem.inertia @ jump_v - h / 6 * pushed
        jump_rows = eqx.tree_at(lambda rows: rows.rate, z.jump, jump_row)
        return JumpAndEnd(jump_rows, self._rows(z.end, problem, end, jump_v))

    def _rows(
        self, z: Increment, problem: Frozen, end: State, jump_v: Velocities
    ) -> Increment:
        step, h = problem.step, problem.step.h
        drive = step.drive(step.start, end, z).less(step.step_load(end, z))
        twist = self._twist(z, problem, end.v - step.start.v)
        dissipation = h**2 / 12 * self._alpha(h) * (problem.stiffness @ jump_v)
        impulse = drive.impulse - h / 12 * twist.impulse + dissipation
        drift = drive.drift
        if step.model.has_own_momenta:
            undamped = h / 6 * problem.compliance @ (problem.stiffness @ (h * z.rate))
            drift = drift - h / 12 * twist.drift + 0.5 * (jump_v - undamped)
        return step.rows(z, end, Drive(impulse, drift))

    def finish(self, z: _Unknowns, problem: Frozen) -> StepEnd:
        step, h, alpha = problem.step, problem.step.h, self._alpha(problem.step.h)
        z, jump = (z.end, z.jump.rate) if isinstance(z, JumpAndEnd) else (z, None)
        end, jump_v = self._end(z, problem, jump)
        dv = self._velocity(problem, end.v - step.start.v)
        jump_q = -h / 6 * (dv - alpha * jump_v)
        size = jump_q @ (problem.stiffness @ jump_q) + jump_v @ (problem.inertia @ jump_v)
        work, drive_work = step.step_work(end, z), self._drive_work(z, problem, end)
        return StepEnd(
            end,
            h * z.rate,
            z.impulse / h,
            step.account(0.5 * alpha * size, work, drive_work),
            None,
            RESULTS.successful,
        )

    def _drive_work(self, z: Increment, problem: Frozen, end: State) -> Scalar | None:
        """The work of driven constraints, and what the twist adds to it."""
        step = problem.step
        if (work := step.drive_work(step.start, end, z)) is None:
            return None
        twist = self._twist(z, problem, end.v - step.start.v)
        assert twist.work is not None
        return work - step.h / 12 * twist.work

    def _alpha(self, h: Scalar) -> Scalar:
        return self.alpha.astype(h.dtype)

    def _velocity(self, problem: Frozen, dv: Velocities) -> Velocities:
        """A change of velocity, from what the states hold."""
        return problem.compliance @ dv if problem.step.model.has_own_momenta else dv

    def _twist(self, z: Increment, problem: Frozen, dv: Velocities) -> Drive:
        """`D J D (z1 - z0)`, `h` times in the first part, with `D` at the midpoint.

        It is orthogonal to `z1 - z0`, so it does no work. Where velocities are eliminated
        only the first part is needed: `h K dv`. Where time enters it is a coordinate,
        whose momentum nothing depends on.
        """
        step, model, h = problem.step, problem.step.model, problem.step.h
        no_lapse = jax.tree.map(jnp.zeros_like, step.middle_time)
        if isinstance(model, SeparableModel):
            force, power = self._stiffness(z, problem, (dv, no_lapse))
            return Drive(force, dv[:0], power)
        assert isinstance(model, CanonicalModel)

        def action(q: Coordinates, p: Velocities, t: Time) -> Scalar:
            return h * model.hamiltonian(q, p) + z.impulse @ model.constraint(q, t)

        forces = jax.grad(action, argnums=(0, 1, 2))
        middle = step.start.q + 0.5 * h * z.rate
        at = middle, step.start.v + 0.5 * dv, step.middle_time
        # h D: one factor h remains in the second product, and is divided out for `w_mu`.
        _, (force, rate, _) = jax.jvp(forces, at, (h * z.rate, dv, step.lapse))
        _, (force, rate, power) = jax.jvp(forces, at, (rate / h, -force / h, no_lapse))
        return Drive(force, rate / h, power)

    def _stiffness(
        self, z: Increment, problem: Frozen, along: tuple[Coordinates, Time]
    ) -> tuple[Coordinates, Time]:
        """`h K` at the midpoint times a vector, with its row and column of time."""
        step, model, h = problem.step, problem.step.model, problem.step.h
        assert isinstance(model, SeparableModel)
        middle = step.start.q + 0.5 * h * z.rate, step.middle_time
        action = lambda q, t: h * model.strain(q, t, z.impulse / h)
        return jax.jvp(jax.grad(action, argnums=(0, 1)), middle, along)[1]

    def _end(
        self, z: Increment, problem: Frozen, jump: Velocities | None
    ) -> tuple[State, Velocities]:
        """The end of the step, and `j_v` of the dissipative jump, where it is not given."""
        step, model, h = problem.step, problem.step.model, problem.step.h
        start, dq, lag = step.start, h * z.rate, self._alpha(h) * h / 6
        if not isinstance(model, SeparableModel):
            end = step.node(z, step.end_time)
            dv = self._velocity(problem, end.v - start.v)
            return end, problem.jump @ (dq + lag * dv)
        q1, t1 = step.at(z), step.end_time
        reaction = model.mean_reaction(start.q, start.t, q1, t1, z.velocity_impulse)
        curved, _ = self._stiffness(z, problem, (dq, step.lapse))
        # The upper half of the step equations, solved for the change of velocity; what
        # the dissipative jump adds to them depends on that change itself.
        right = (
            2 * (z.rate - start.v - reaction)
            - model.inverse_inertia @ (curved - h * (problem.stiffness @ dq)) / 6
        )
        if jump is not None:
            return State(q1, start.v + right - jump, t1), jump
        pushed = problem.jump @ dq
        dv = problem.damping @ (right - pushed)
        return State(q1, start.v + dv, t1), pushed + lag * problem.jump @ dv
