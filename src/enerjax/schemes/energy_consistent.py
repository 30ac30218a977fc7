from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._discrete import AbstractDerivative, MeanValue
from .._operators import (
    AbstractModel,
    ChordTerms,
    DelassusMatrix,
    Gradient,
    Increment,
    Reaction,
    terms_of_chord,
)
from .._programs import is_known
from .._solvers import Assembled
from .._system import State
from .._types import Multipliers, Real, Scalar, Velocities
from ._arguments import (
    alpha_from_spectral_radius,
    as_alpha,
    check_derivative,
    refuse_nonholonomic,
)
from ._chord import elastic_length, skew_chord, step_chord
from ._discontinuous import JumpAndEnd
from ._dissipative_stiffness import dissipative_stiffness, DissipativeStiffness
from .base import AbstractSchemeWithChord, Formulation, StepEnd, StepProblem


# The increment to the end of the step; for large systems also the jump of the velocities.
_Unknowns: TypeAlias = Increment | JumpAndEnd


class _Problem(eqx.Module):
    """The data of a step. If `alpha` is known to be zero, nothing is dissipative."""

    step: StepProblem
    dissipative: DissipativeStiffness | None


class EnergyConsistent(AbstractSchemeWithChord[_Unknowns, _Problem]):
    r"""Scheme of order 4 or 3 whose energy never grows, for any potential.

    It has the jump `j` of the discontinuous schemes in closed form, so its unknowns are
    those of `EnergyPreserving`. With `z = (q, p)`, the symplectic matrix `J`, and
    `C = (Phi, psi)` with the multipliers `m = (lambda, eta)`:

        z1 - z0 = h J [DH + DC^T m + D j_D(0)/2 + P (j_P(alpha) - j_P(0))/2]
        j_A(a)  = -(h/6) J A (z1 - z0 - a j_A(a))
        E1      = E0 - alpha/2 j_P(alpha) . P j_P(alpha)

    `D = diag(K, M^-1)` with the stiffness `K = Hess(V + lambda . Phi)` at the midpoint
    raises the order and does no work. `P = diag(K+, M^-1)`, with the positive semidefinite
    part `K+` of `K` (in the metric of the inertia, near the start of the step), can only
    dissipate, whatever the potential is.

    - Conserves: energy, to round-off, at `alpha = 0`.
    - Dissipates: `alpha/2 j . P j >= 0` in every step, also where `V` is not convex. On a
      linear oscillator `rho_inf = (1 - alpha) / (1 + alpha)`. Modes without positive
      stiffness are not damped. Rotations of stiff parts are damped like vibrations, unless
      the angle of a step times `h w` is small; `EnergyMomentumDecaying` does not damp them.
      (For a system with more than 64 coordinates whose potential is linear or consists of
      `Elements`, `K+` is the sum of the positive parts of its elements and constraints. For
      all others the eigenvalues of the whole matrix are computed, at a cost that grows with
      the cube of its size.)
    - Constraints held at: position and velocity level.
    - Order: 4 at `alpha = 0`, where the scheme is symmetric and `Composed` raises the order
      to 6 or 8; else 3. The order is 2 with forces, which enter as in `EnergyPreserving`,
      and where the `derivative` is not `MeanValue()` and `V` is not quadratic. Driven
      constraints do not reduce the order.
    - Requires `v = qdot` or momenta, and holonomic constraints. For systems with
      `kinematics` or `nonholonomic` use `EnergyPreserving` or `EnergyDecaying`.

    **Arguments:**

    - `alpha`: the dissipation, in [0, 1]. It can be traced, swept and differentiated. The
      Python number 0 leaves the dissipation out of the program, which is then shorter; for
      derivatives with respect to `alpha` at zero, pass `jnp.array(0.0)`.
    - `derivative`: the discrete gradient; `MeanValue()` for the full order.

    Raises a `ValueError` for a known `alpha` outside [0, 1] and for a system with
    `kinematics` or `nonholonomic` constraints.

    **Reference:** unconstrained at `alpha = 0` the fourth-order method of G. R. W. Quispel
    and D. I. McLaren, J. Phys. A 41 (2008) 045206, eq. (14); the dissipative and the
    constrained forms are new here. Related methods: L. Brugnano, G. Gurioli,
    F. Iavernaro and E. B. Weinmueller (2018), line-integral methods for holonomic
    constraints; P. L. Kinon, P. Betsch and S. Schneider (2023), energy-momentum schemes
    in Livens form; F. Armero and I. Romero (2001), energy-dissipating schemes.
    """

    alpha: Scalar | float
    derivative: AbstractDerivative
    # Determined at construction: under transformations of JAX `alpha` may be traced.
    is_preserving: bool = eqx.field(static=True)

    def __init__(self, alpha: Real, derivative: AbstractDerivative = MeanValue(points=2)):
        check_derivative("EnergyConsistent", derivative)
        # A Python number is static: it is not traced under `jit`, and has no derivative.
        self.alpha = 0.0 if _is_number(alpha, 0) else as_alpha(alpha)
        self.derivative = derivative
        # Compared in NumPy, because under `jit` a comparison of JAX arrays is traced.
        self.is_preserving = is_known(self.alpha) and not np.any(np.asarray(self.alpha))

    @classmethod
    def from_spectral_radius(
        cls, rho_inf: Real, derivative: AbstractDerivative = MeanValue(points=2)
    ) -> "EnergyConsistent":
        """The scheme with spectral radius `rho_inf`, in [0, 1], at infinite frequency."""
        alpha = 0.0 if _is_number(rho_inf, 1) else alpha_from_spectral_radius(rho_inf)
        return cls(alpha=alpha, derivative=derivative)

    @property
    def formulation(self) -> Formulation:
        return "ggl"

    @property
    def symmetric(self) -> bool:
        return self.is_preserving

    @property
    def order(self) -> int:
        return 4 if self.symmetric else 3

    @property
    def chord_terms(self) -> tuple[ChordTerms, ...]:
        # The damping of stiffness has a matrix of its own.
        return (("strains",), ("dampers",)) if isinstance(self.alpha, float) else ()

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> _Problem:
        refuse_nonholonomic(
            "EnergyConsistent",
            model,
            "its order rests on the Hessian of the constraints, and these have none",
        )
        if not model.has_canonical_rates:
            raise ValueError(
                "`EnergyConsistent` needs velocities that are the rates of the "
                "coordinates, and this system has `kinematics`. Use `EnergyPreserving` "
                "or `EnergyDecaying`, or describe rotations without `kinematics` "
                "(directors, or `System.from_hamiltonian`)."
            )
        step = StepProblem(model, start, h, self.derivative)
        if isinstance(self.alpha, float):
            return _Problem(step, None)
        return _Problem(step, dissipative_stiffness(step, self._alpha(h)))

    def predict(
        self, problem: _Problem, acceleration: Velocities, multipliers: Multipliers
    ) -> _Unknowns:
        guess = problem.step.guess(acceleration, multipliers)
        dissipative = problem.dissipative
        if dissipative is None or not isinstance(dissipative.matrix, Assembled):
            return guess
        none = guess.momentum
        return JumpAndEnd(Increment(none, jnp.zeros_like(guess.rate), none, none), guess)

    def residual(self, z: _Unknowns, problem: _Problem) -> _Unknowns:
        end, jump = self._end_and_jump(z, problem)
        step, dissipative = problem.step, problem.dissipative
        if not isinstance(z, JumpAndEnd):
            return self._rows(z, problem, end, jump)
        assert dissipative is not None
        assert jump is not None
        alpha = self._alpha(step.h)
        # (M + tau^2 K+) j_v - (h/6) K+ (dq + tau dv)
        dv = end.v - step.start.v
        moved = step.h * z.end.rate + alpha * step.h / 6 * (dv - alpha * jump)
        row = dissipative.inertia @ jump - step.h / 6 * (dissipative.matrix @ moved)
        jump_rows = eqx.tree_at(lambda rows: rows.rate, z.jump, row)
        return JumpAndEnd(jump_rows, self._rows(z.end, problem, end, jump))

    def delassus_matrix(self, z: _Unknowns, problem: _Problem) -> DelassusMatrix:
        elastic, h = None, problem.step.h
        if problem.dissipative is None:
            elastic = elastic_length(jnp.zeros_like(h), h)
            if terms_of_chord(problem.step.model) == ("dampers",):
                elastic = h
        return problem.step.delassus_matrix(_end_of(z), elastic)

    def chord(
        self, rows: _Unknowns, problem: _Problem, delassus: DelassusMatrix
    ) -> _Unknowns:
        if not isinstance(rows, JumpAndEnd):
            return skew_chord(rows, delassus)
        # The velocities at the end of the step are reduced by the unknown jump.
        jump = delassus.inverse_inertia @ rows.jump.rate
        end = eqx.tree_at(
            lambda end: (end.rate, end.velocity_impulse),
            rows.end,
            (
                rows.end.rate + rows.jump.rate,
                rows.end.velocity_impulse + delassus.product(jump),
            ),
        )
        jumps = eqx.tree_at(lambda rows: rows.rate, rows.jump, jump)
        return JumpAndEnd(jumps, step_chord(end, delassus))

    def finish(self, z: _Unknowns, problem: _Problem) -> StepEnd:
        step, h = problem.step, problem.step.h
        end, jump_v = self._end_and_jump(z, problem)
        z = _end_of(z)
        drive_work = step.drive_work(step.start, end, z)
        if drive_work is not None:
            skew_work = self._skew_gradient(z, step, end).work
            assert skew_work is not None
            drive_work = drive_work - h / 12 * skew_work
        return StepEnd(
            state=end,
            displacement=h * z.rate,
            multipliers=z.impulse / h,
            energies=step.account(
                self._dissipated(problem, end, jump_v), step.step_work(end, z), drive_work
            ),
        )

    def _dissipated(
        self, problem: _Problem, end: State, jump_v: Velocities | None
    ) -> Scalar:
        dissipative, h = problem.dissipative, problem.step.h
        if dissipative is None or jump_v is None:
            return jnp.zeros_like(h)
        alpha = self._alpha(h)
        dv = _velocity_change(problem.step, dissipative, end)
        jump_q = -h / 6 * (dv - alpha * jump_v)
        size = jump_q @ (dissipative.matrix @ jump_q)
        return 0.5 * alpha * (size + jump_v @ (dissipative.inertia @ jump_v))

    def _rows(
        self, z: Increment, problem: _Problem, end: State, jump_v: Velocities | None
    ) -> Increment:
        step, dissipative, h = problem.step, problem.dissipative, problem.step.h
        gradient = step.discrete_gradient(step.start, end, z)
        gradient = gradient.less(step.step_load(end, z))
        skew = self._skew_gradient(z, step, end)
        gradient = Gradient(
            impulse=gradient.impulse - h / 12 * skew.impulse,
            rate=gradient.rate - h / 12 * skew.rate,
            rows=gradient.rows,
        )
        if dissipative is None or jump_v is None:
            return step.rows(z, end, gradient)
        # The terms of `P (j(alpha) - j(0))/2` in both components of the gradient.
        force = h**2 / 12 * self._alpha(h) * (dissipative.matrix @ jump_v)
        undamped = dissipative.inverse_inertia @ (dissipative.matrix @ (h**2 / 6 * z.rate))
        rate = step.model.momentum_rows(0.5 * (jump_v - undamped))
        total = Gradient(
            impulse=gradient.impulse + force,
            rate=gradient.rate + rate,
            rows=gradient.rows,
        )
        return step.rows(z, end, total)

    def _end_and_jump(
        self, z: _Unknowns, problem: _Problem
    ) -> tuple[State, Velocities | None]:
        """The end of the step, and the jump `j_v` of the velocities, if there is one."""
        step, dissipative, h = problem.step, problem.dissipative, problem.step.h
        jump_v = z.jump.rate if isinstance(z, JumpAndEnd) else None
        z = _end_of(z)
        start, dq, q1, t1 = step.start, h * z.rate, step.position(z), step.end_time

        def velocity(reaction: Reaction) -> tuple[Velocities]:
            added = reaction((start.q, start.t), (q1, t1), z.velocity_impulse)
            curvature, _ = step.model.stiffness_product(
                self._middle(z, step, start.v), z.impulse / h, (dq, step.duration)
            )
            # The row S_mu, solved for v1 - v0. The jump depends on v1 - v0 too.
            right = 2 * (z.rate - start.v - added)
            if dissipative is None:
                middle = self._middle(z, step, start.v)
                inverse_inertia = step.model.inverse_metric(middle)
                return (start.v + right - inverse_inertia @ (h / 6 * curvature),)
            force = h / 6 * (curvature - dissipative.matrix @ dq)
            right = right - dissipative.inverse_inertia @ force
            if jump_v is not None:
                return (start.v + right - jump_v,)
            right = right - dissipative.jump_matrix @ dq
            return (start.v + dissipative.velocity_matrix @ right,)

        (end,) = step.nodes(velocity, (z, t1))
        if dissipative is not None and jump_v is None:
            dv = _velocity_change(step, dissipative, end)
            jump_v = dissipative.jump_matrix @ (dq + self._alpha(h) * h / 6 * dv)
        return end, jump_v

    def _skew_gradient(self, z: Increment, step: StepProblem, end: State) -> Gradient:
        """`D J D (z1 - z0)` at the midpoint; the rows of the coordinates times `h`."""
        dv = end.v - step.start.v
        middle = self._middle(z, step, step.start.v + 0.5 * dv)
        change = (step.h * z.rate, dv, step.duration)
        return step.model.skew_gradient(middle, z.impulse / step.h, change, step.h)

    def _middle(self, z: Increment, step: StepProblem, v: Velocities) -> State:
        return State(step.start.q + 0.5 * step.h * z.rate, v, step.middle_time)

    def _alpha(self, like: Scalar) -> Scalar:
        return jnp.asarray(self.alpha, like.dtype)


def _is_number(x: Real, number: int) -> bool:
    """Whether `x` is this number of Python; an array is not."""
    return isinstance(x, int | float) and x == number


def _velocity_change(
    step: StepProblem, dissipative: DissipativeStiffness, end: State
) -> Velocities:
    change = end.v - step.start.v
    return step.model.velocity_change(change, dissipative.inverse_inertia)


def _end_of(z: _Unknowns) -> Increment:
    return z.end if isinstance(z, JumpAndEnd) else z
