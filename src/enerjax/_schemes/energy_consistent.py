import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative, MeanValue
from .._model import Model
from .._results import RESULTS
from .._segment import Increment
from .._system import State
from .._tracing import is_known
from .._types import Coordinates, Multipliers, Real, Scalar, Velocities
from ._decaying import alpha_from_spectral_radius, as_alpha
from ._semidefinite import semidefinite_part
from .base import AbstractSingleSolve, Formulation, StepEnd, StepProblem


class _Frozen(eqx.Module):
    """A step's data, with the dissipative stiffness fixed before the solve."""

    step: StepProblem
    # P: positive semidefinite part of the stiffness near the start.
    stiffness: Float[Array, "nq nq"]
    # X: (M + (alpha h/6)^2 P)^-1 (h/6) P, so that j_v = X (dq + alpha h/6 dv).
    jump: Float[Array, "nq nq"]


class EnergyConsistent(AbstractSingleSolve[Increment, _Frozen]):
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
      positive part there is nothing to damp, and nothing is removed.
    - Constraints held at: position and velocity level.
    - Order: 4 at `alpha = 0` (then symmetric: `Composed` raises it to 6 or 8), else 3;
      2 where the `derivative` is `Gonzalez()` and `V` is not quadratic.
    - Needs `v = qdot`: with `kinematics` use `EnergyPreserving` or `EnergyDecaying`.

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

    alpha: Scalar = eqx.field(converter=as_alpha)
    derivative: AbstractDerivative = MeanValue(points=2)

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
        # In NumPy: under `jit` a comparison of JAX arrays would be traced.
        return is_known(self.alpha) and bool(np.all(np.asarray(self.alpha) == 0))

    @property
    def order(self) -> int:
        return 4 if self.symmetric else 3

    def problem(self, model: Model, start: State, h: Scalar) -> _Frozen:
        if not model.has_identity_kinematics:
            raise ValueError(
                "`EnergyConsistent` needs velocities that are the rates of the "
                "coordinates, and this system has `kinematics`. Use `EnergyPreserving` "
                "or `EnergyDecaying`, or describe rotations without `kinematics` "
                "(directors)."
            )
        step = StepProblem(model, start, h, self.derivative, "ggl")
        # P only has to be semidefinite and near the stiffness for the law and the order,
        # so the multipliers of the start serve. Inside the solve it would cost an
        # eigenvalue problem per iteration.
        _, multipliers = model.accelerations(start)
        middle = start.q + 0.5 * h * start.v
        stiffness = jax.hessian(lambda q: _strain(model, q, multipliers))(middle)
        stiffness = semidefinite_part(stiffness, model.inertia)
        lag = self.alpha.astype(h.dtype) * h / 6
        jump = jnp.linalg.solve(model.inertia + lag**2 * stiffness, h / 6 * stiffness)
        return _Frozen(step, stiffness, jump)

    def predict(
        self, problem: _Frozen, acceleration: Velocities, multipliers: Multipliers
    ) -> Increment:
        return problem.step.guess(acceleration, multipliers)

    def residual(self, z: Increment, problem: _Frozen) -> Increment:
        step, model, h = problem.step, problem.step.model, problem.step.h
        q0, v0 = step.start.q, step.start.v
        end, jump_v = self._end(z, problem)
        segment = step.segment(q0, end.q)
        dv = end.v - v0
        jump = segment.impulse(h, z, 0.5 * (v0 + end.v)) - h / 12 * self._stiffness(
            z, problem, dv
        )
        dissipation = h**2 / 12 * self._alpha(h) * problem.stiffness @ jump_v
        return step.rows(model.inertia @ dv + jump + dissipation, end)

    def finish(self, z: Increment, problem: _Frozen) -> StepEnd:
        step, h = problem.step, problem.step.h
        end, jump_v = self._end(z, problem)
        alpha = self._alpha(h)
        jump_q = -h / 6 * (end.v - step.start.v - alpha * jump_v)
        size = jump_q @ problem.stiffness @ jump_q + 2 * step.model.kinetic(jump_v)
        return StepEnd(end, z.impulse / h, 0.5 * alpha * size, None, RESULTS.successful)

    def _alpha(self, h: Scalar) -> Scalar:
        return self.alpha.astype(h.dtype)

    def _stiffness(self, z: Increment, problem: _Frozen, x: Coordinates) -> Coordinates:
        """`h K x` with the stiffness at the midpoint."""
        step = problem.step
        middle = step.start.q + 0.5 * step.h * z.rate
        forces = jax.grad(lambda q: step.h * _strain(step.model, q, z.impulse / step.h))
        return jax.jvp(forces, (middle,), (x,))[1]

    def _end(self, z: Increment, problem: _Frozen) -> tuple[State, Velocities]:
        """The end of the step, and `j_v` of the dissipative jump."""
        step, model, h = problem.step, problem.step.model, problem.step.h
        q1, dq, lag = step.at(z), h * z.rate, self._alpha(h) * h / 6
        reaction = step.segment(step.start.q, q1).reaction(z.velocity_impulse)
        inverse, jump = model.inverse_inertia, problem.jump
        # The upper half of the step equations, solved for the change of velocity; what
        # the dissipative jump adds to them depends on that change itself.
        undamped = h / 6 * inverse @ (problem.stiffness @ dq)
        right = (
            2 * (z.rate - step.start.v - reaction)
            - inverse @ self._stiffness(z, problem, dq) / 6
            - (jump @ dq - undamped)
        )
        dv = jnp.linalg.solve(jnp.eye(dq.size, dtype=dq.dtype) + lag * jump, right)
        return State(q1, step.start.v + dv), jump @ (dq + lag * dv)


def _strain(model: Model, q: Coordinates, multipliers: Multipliers) -> Scalar:
    """`V + lambda . Phi`, the energy whose Hessian is the stiffness."""
    return model.potential(q) + multipliers @ model.constraint(q)
