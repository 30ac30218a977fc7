import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative, ChainRule
from .._operators import AbstractModel, Drive, Increment, SeparableModel
from .._results import RESULTS
from .._system import State
from .._types import JointMultipliers, Multipliers, Scalar, Velocities
from ._checks import check_derivative
from ._decaying import (
    as_alpha,
    jump_drive,
    jump_energy,
    jump_loads,
    jump_work,
    JumpAndEnd,
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
    derivative: AbstractDerivative = ChainRule()

    def __check_init__(self):
        check_derivative("KappaDecaying", self.derivative)

    @property
    def order(self) -> int:
        return 2

    @property
    def formulation(self) -> Formulation:
        return "ggl"

    @property
    def symmetric(self) -> bool:
        return False

    def problem(self, model: AbstractModel, start: State, h: Scalar) -> StepProblem:
        return StepProblem(model, start, h, self.derivative, "ggl")

    def predict(
        self, problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> _Unknowns:
        nodes = predict_jump_and_end(problem, acceleration, multipliers)
        num_kappa = min(nodes.end.velocity_impulse.size, 1)
        return _Unknowns(nodes, jnp.ones((num_kappa,), problem.h.dtype))

    def residual(self, z: _Unknowns, problem: StepProblem) -> _Unknowns:
        model, start, h = problem.model, problem.start, problem.h
        jump, end = self._nodes(z, problem)
        nodes, kappa = z.nodes, _kappa(z)
        loads = jump_loads(self.alpha, nodes, problem, jump, end)
        after = problem.drive(jump, end, _position_level(nodes.end)).less(loads.after)
        before = problem.drive(start, jump, _position_level(nodes.jump)).less(loads.before)
        work = self._kappa_row(z, problem, jump, end, after, before)
        gradients = (
            model.gradient(start, h).less(loads.start),
            model.gradient(jump, h).less(loads.jump),
        )
        scaled = [_scaled(kappa, x) for x in (after, before, *gradients)]
        if model.has_own_momenta:
            at_jump = model.reaction(jump, _eta(nodes.jump))
            at_end = model.reaction(end, _eta(nodes.end))
            scaled[0] = _pushed(scaled[0], 0.5 * (at_jump + at_end))
            scaled[1] = _pushed(scaled[1], at_jump)
        to_jump = jump_drive(self.alpha, *scaled)  # eq. (66b)
        rows = JumpAndEnd(
            problem.rows(nodes.jump, jump, to_jump),
            problem.rows(nodes.end, end, scaled[0]),  # eq. (66a)
        )
        return _Unknowns(rows, work)

    def finish(self, z: _Unknowns, problem: StepProblem) -> StepEnd:
        jump, end = self._nodes(z, problem)
        kinetic, potential = jump_energy(problem, jump)
        kappa = _kappa(z)
        dissipated = self.alpha.astype(kappa.dtype) * (kappa * kinetic + potential)
        work = jump_work(self.alpha, z.nodes, problem, jump, end)
        drive_work = problem.drive_work(jump, end, _position_level(z.nodes.end))
        # A kappa without value comes from an iterate that broke down for other reasons.
        bounded = ((kappa > 0) & (kappa < 2)) | ~jnp.isfinite(kappa)
        return StepEnd(
            end,
            problem.h * z.nodes.end.rate,
            z.nodes.end.impulse / problem.h,
            problem.account(dissipated, work, drive_work),
            kappa,
            RESULTS.where(bounded, RESULTS.successful, RESULTS.kappa_out_of_range),
        )

    def _kappa_row(
        self,
        z: _Unknowns,
        problem: StepProblem,
        jump: State,
        end: State,
        after: Drive,
        before: Drive,
    ) -> Float[Array, " nk"]:
        """eq. (70, 71), multiplied out, over an energy of the step."""
        if z.kappa.size == 0:
            return z.kappa
        model, v0 = problem.model, problem.start.v
        if isinstance(model, SeparableModel):
            change = model.kinetic_of(end.v) - model.kinetic_of(v0)
        else:
            change = after.drift @ (end.v - jump.v) + before.drift @ (jump.v - v0)
        rate = lambda state, dv: jax.jvp(
            lambda v: model.joint_rate(state.q, v, state.t), (state.v,), (dv,)
        )[1]
        at_jump = rate(jump, end.v + jump.v - 2 * v0)
        at_end = rate(end, end.v - jump.v)
        work = _eta(z.nodes.jump) @ at_jump + _eta(z.nodes.end) @ at_end
        scale = model.energy_scale(problem.start, problem.h)
        return ((z.kappa - 1) * change + 0.5 * work) / scale

    def _nodes(self, z: _Unknowns, problem: StepProblem) -> tuple[State, State]:
        model, q0, kappa = problem.model, problem.start.q, _kappa(z)
        jump, end = z.nodes.jump, z.nodes.end
        t0, t1 = problem.start.t, problem.end_time
        if not isinstance(model, SeparableModel):
            return problem.node(jump, t0), problem.node(end, t1)
        qj, q1 = problem.at(jump), problem.at(end)
        at_jump = model.reaction_at(qj, t0, _eta(jump))
        at_end = model.reaction_at(q1, t1, _eta(end))
        vj, v1 = split_velocities(
            self.alpha,
            problem.start.v,
            # eq. (66c): vj + v1
            (2 * problem.velocity(end) - (at_jump + at_end)) / kappa,
            # eq. (66d)
            -(6 * model.push(q0, qj, jump.rate) + (at_end - at_jump)) / kappa,
        )
        return State(qj, vj, t0), State(q1, v1, t1)


def _kappa(z: _Unknowns) -> Scalar:
    return z.kappa[0] if z.kappa.size == 1 else jnp.ones((), z.kappa.dtype)


def _eta(increment: Increment) -> JointMultipliers:
    return increment.velocity_impulse


def _position_level(increment: Increment) -> Increment:
    """Without the velocity-level multipliers: in this scheme they drive no momentum."""
    return eqx.tree_at(_eta, increment, _eta(increment)[:0])


def _scaled(kappa: Scalar, drive: Drive) -> Drive:
    return Drive(drive.impulse, kappa * drive.drift)


def _pushed(drive: Drive, velocity: Velocities) -> Drive:
    return Drive(drive.impulse, drive.drift + velocity)
