import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative, Gonzalez
from .._model import Model
from .._results import RESULTS
from .._segment import Increment, reaction
from .._system import State
from .._types import JointMultipliers, Multipliers, Scalar, Velocities
from ._decaying import (
    as_alpha,
    jump_energy,
    JumpAndEnd,
    momentum_rows,
    predict_jump_and_end,
    split_velocities,
)
from .base import AbstractSingleSolve, Formulation, StepEnd, StepProblem


class _Unknowns(eqx.Module):
    nodes: JumpAndEnd
    # One entry, or none without joints: kappa is then 1 by construction.
    kappa: Float[Array, " nk"]


class KappaDecaying(AbstractSingleSolve[_Unknowns, StepProblem]):
    """The paper's decaying scheme with velocity constraints and the parameter kappa.

    Like `EnergyDecaying`, but with the velocity-level multipliers interpolated between
    the nodes, and a factor `kappa` on the velocities that restores the energy identity

        E1 = E0 - alpha (kappa K_jump + V_jump).

    `kappa - 1` is the work of the velocity-level multipliers divided by the change of
    kinetic energy in the step, so the scheme fails wherever that change passes through
    zero: in every oscillation of a system with more than one degree of freedom. It is
    here to reproduce the paper; prefer `EnergyDecaying` or `EnergyConsistent`.

    - Conserves: energy, to round-off, at `alpha = 0`.
    - Dissipates: `alpha (kappa K_jump + V_jump)`.
    - Constraints held at: position and velocity level, at `zj` and `z1`.
    - Order: 2. A `kappa` outside (0, 2) is reported as a failure of the step.
    - Reports: `solution.details`, the `kappa` of each saved step.

    **Arguments:**

    - `alpha`: in [0, 1]; a traced leaf.
    - `derivative`: the discrete gradient.

    A concrete `alpha` outside [0, 1] raises a `ValueError`.

    **Reference:** E. Lens and A. Cardona, section 5.3, eq. (66) to (71).
    """

    alpha: Scalar = eqx.field(converter=as_alpha)
    derivative: AbstractDerivative = Gonzalez()

    @property
    def order(self) -> int:
        return 2

    @property
    def formulation(self) -> Formulation:
        return "ggl"

    @property
    def symmetric(self) -> bool:
        return False

    def problem(self, model: Model, start: State, h: Scalar) -> StepProblem:
        return StepProblem(model, start, h, self.derivative, "ggl")

    def predict(
        self, problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> _Unknowns:
        nodes = predict_jump_and_end(problem, acceleration, multipliers)
        num_kappa = min(nodes.end.velocity_impulse.size, 1)
        return _Unknowns(nodes, jnp.ones((num_kappa,), problem.h.dtype))

    def residual(self, z: _Unknowns, problem: StepProblem) -> _Unknowns:
        h, v0 = problem.h, problem.start.v
        jump, end = self._nodes(z, problem)
        after = problem.segment(jump.q, end.q)
        before = problem.segment(problem.start.q, jump.q)
        momentum_jump, momentum_end = momentum_rows(  # eq. (66b, a)
            problem,
            self.alpha,
            jump,
            end,
            z.nodes,
            after.impulse(h, _position_level(z.nodes.end), v0),
            before.impulse(h, _position_level(z.nodes.jump), v0),
        )
        rows = JumpAndEnd(
            problem.rows(momentum_jump, jump), problem.rows(momentum_end, end)
        )
        return _Unknowns(rows, self._kappa_row(z, problem, jump, end))

    def finish(self, z: _Unknowns, problem: StepProblem) -> StepEnd:
        jump, end = self._nodes(z, problem)
        kinetic, potential = jump_energy(problem, jump)
        kappa = _kappa(z)
        # A kappa without value comes from an iterate that broke down for other reasons.
        bounded = ((kappa > 0) & (kappa < 2)) | ~jnp.isfinite(kappa)
        return StepEnd(
            end,
            z.nodes.end.impulse / problem.h,
            self.alpha.astype(kappa.dtype) * (kappa * kinetic + potential),
            kappa,
            RESULTS.where(bounded, RESULTS.successful, RESULTS.kappa_out_of_range),
        )

    def _kappa_row(
        self, z: _Unknowns, problem: StepProblem, jump: State, end: State
    ) -> Float[Array, " nk"]:
        """eq. (70, 71), multiplied out, over an energy of the step."""
        if z.kappa.size == 0:
            return z.kappa
        model, v0 = problem.model, problem.start.v
        change = model.kinetic(end.v) - model.kinetic(v0)
        at_jump = model.joint_rate(jump.q, end.v + jump.v - 2 * v0)
        at_end = model.joint_rate(end.q, end.v - jump.v)
        work = _eta(z.nodes.jump) @ at_jump + _eta(z.nodes.end) @ at_end
        scale = model.energy_scale(problem.start, problem.h)
        return ((z.kappa - 1) * change + 0.5 * work) / scale

    def _nodes(self, z: _Unknowns, problem: StepProblem) -> tuple[State, State]:
        q0, kappa = problem.start.q, _kappa(z)
        qj, q1 = problem.at(z.nodes.jump), problem.at(z.nodes.end)
        at_jump = reaction(problem.model, qj, _eta(z.nodes.jump))
        at_end = reaction(problem.model, q1, _eta(z.nodes.end))
        push_end = problem.segment(q0, q1).push(z.nodes.end.rate)
        push_jump = problem.segment(q0, qj).push(z.nodes.jump.rate)
        vj, v1 = split_velocities(
            self.alpha,
            problem.start.v,
            (2 * push_end - (at_jump + at_end)) / kappa,  # eq. (66c): vj + v1
            -(6 * push_jump + (at_end - at_jump)) / kappa,  # eq. (66d)
        )
        return State(qj, vj), State(q1, v1)


def _kappa(z: _Unknowns) -> Scalar:
    return z.kappa[0] if z.kappa.size == 1 else jnp.ones((), z.kappa.dtype)


def _eta(increment: Increment) -> JointMultipliers:
    return increment.velocity_impulse


def _position_level(increment: Increment) -> Increment:
    """Without the velocity-level multipliers: in this scheme they drive no momentum."""
    return Increment(increment.rate, increment.impulse, _eta(increment)[:0])
