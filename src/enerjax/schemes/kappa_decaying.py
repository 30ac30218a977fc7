import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative, ChainRule
from .._operators import AbstractModel, Gradient, Increment, Reaction
from .._results import RESULTS
from .._system import State
from .._types import Multipliers, Scalar, Velocities
from ._arguments import as_alpha, check_derivative, refuse_nonholonomic
from ._discontinuous import (
    jump_energy,
    jump_gradient,
    jump_loads,
    jump_work,
    JumpAndEnd,
    predict_jump_and_end,
    split_velocities,
)
from .base import AbstractOneSolveScheme, Formulation, StepEnd, StepProblem


class _Unknowns(eqx.Module):
    nodes: JumpAndEnd
    # Shape `(1,)`; `(0,)` for systems without joints, for which kappa is 1.
    kappa: Float[Array, " nk"]


class KappaDecaying(AbstractOneSolveScheme[_Unknowns, StepProblem]):
    """The energy-decaying scheme of the paper with velocity constraints and `kappa`.

    It differs from `EnergyDecaying` in the velocity-level multipliers, which are
    interpolated between the nodes, and in a factor `kappa` on the velocities, which
    restores the energy identity

        E1 = E0 - alpha (kappa K_jump + V_jump).

    `kappa - 1` is the work of the velocity-level multipliers divided by the change of
    kinetic energy in the step, so the scheme fails wherever that change passes through
    zero, as in every oscillation of a system with more than one degree of freedom. It is
    included to reproduce the paper; prefer `EnergyDecaying` or `EnergyConsistent`.

    - Conserves: energy, to round-off, at `alpha = 0`.
    - Dissipates: `alpha (kappa K_jump + V_jump)`.
    - Constraints held at: position and velocity level, at `zj` and `z1`.
    - Order: 2. A `kappa` outside (0, 2) is reported as a failure of the step.
    - Reports: `solution.details`, the `kappa` of each saved step.

    **Arguments:**

    - `alpha`: the dissipation, in [0, 1]. It can be traced, swept and differentiated.
    - `derivative`: the discrete gradient.

    Raises a `ValueError` for a known `alpha` outside [0, 1] and for a system with
    `nonholonomic` constraints.

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
        refuse_nonholonomic(
            "KappaDecaying", model, "the paper defines it for holonomic constraints"
        )
        return StepProblem(model, start, h, self.derivative)

    def predict(
        self, problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
    ) -> _Unknowns:
        nodes = predict_jump_and_end(problem, acceleration, multipliers)
        num_kappa = min(nodes.end.velocity_impulse.size, 1)
        return _Unknowns(nodes, jnp.ones((num_kappa,), problem.h.dtype))

    def residual(self, z: _Unknowns, problem: StepProblem) -> _Unknowns:
        model, start, h = problem.model, problem.start, problem.h
        nodes, kappa = z.nodes, _kappa(z)
        jump, end = self._nodes(z, problem)
        loads = jump_loads(self.alpha, nodes, problem, jump, end)
        after = problem.discrete_gradient(jump, end, _position_level(nodes.end))
        before = problem.discrete_gradient(start, jump, _position_level(nodes.jump))
        after, before = after.less(loads.after), before.less(loads.before)
        at_start = model.gradient(start, h).less(loads.start)
        at_jump = model.gradient(jump, h).less(loads.jump)
        # Where momenta are unknowns, the reactions are terms of the rows. Otherwise they
        # are terms of the velocities.
        reaction_jump = model.reaction_row(jump, nodes.jump.velocity_impulse)
        reaction_end = model.reaction_row(end, nodes.end.velocity_impulse)
        to_end = _scaled(kappa, after, 0.5 * (reaction_jump + reaction_end))
        to_jump = jump_gradient(
            self.alpha,
            to_end,
            _scaled(kappa, before, reaction_jump),
            _scaled(kappa, at_start),
            _scaled(kappa, at_jump),
        )
        return _Unknowns(
            nodes=JumpAndEnd(
                jump=problem.rows(nodes.jump, jump, to_jump),  # eq. (66b)
                end=problem.rows(nodes.end, end, to_end),  # eq. (66a)
            ),
            kappa=self._kappa_row(z, problem, jump, end, after, before),
        )

    def finish(self, z: _Unknowns, problem: StepProblem) -> StepEnd:
        jump, end = self._nodes(z, problem)
        kinetic, potential = jump_energy(problem, jump)
        kappa = _kappa(z)
        dissipated = self.alpha.astype(kappa.dtype) * (kappa * kinetic + potential)
        work = jump_work(self.alpha, z.nodes, problem, jump, end)
        drive_work = problem.drive_work(jump, end, _position_level(z.nodes.end))
        # A non-finite kappa means that the iteration has failed for another reason.
        bounded = ((kappa > 0) & (kappa < 2)) | ~jnp.isfinite(kappa)
        return StepEnd(
            state=end,
            displacement=problem.h * z.nodes.end.rate,
            multipliers=z.nodes.end.impulse / problem.h,
            energies=problem.account(dissipated, work, drive_work),
            details=kappa,
            result=RESULTS.where(bounded, RESULTS.successful, RESULTS.kappa_out_of_range),
        )

    def _kappa_row(
        self,
        z: _Unknowns,
        problem: StepProblem,
        jump: State,
        end: State,
        after: Gradient,
        before: Gradient,
    ) -> Float[Array, " nk"]:
        """Eq. (70, 71), multiplied out and divided by the energy scale of the step."""
        if z.kappa.size == 0:
            return z.kappa
        model, start = problem.model, problem.start
        change = model.kinetic_change(jump, end, after)
        change = change + model.kinetic_change(start, jump, before)
        rate = lambda state, dv: jax.jvp(
            lambda v: model.joint_rate(state.q, v, state.t), (state.v,), (dv,)
        )[1]
        at_jump = rate(jump, end.v + jump.v - 2 * start.v)
        at_end = rate(end, end.v - jump.v)
        jump_eta, end_eta = z.nodes.jump.velocity_impulse, z.nodes.end.velocity_impulse
        work = jump_eta @ at_jump + end_eta @ at_end
        scale = model.energy_scale(start, problem.h)
        return ((z.kappa - 1) * change + 0.5 * work) / scale

    def _nodes(self, z: _Unknowns, problem: StepProblem) -> tuple[State, ...]:
        """The states after the jump, which takes no time, and at the end."""
        model, start, kappa = problem.model, problem.start, _kappa(z)
        jump, end = z.nodes.jump, z.nodes.end
        qj, q1 = problem.position(jump), problem.position(end)
        t0, t1 = start.t, problem.end_time

        def velocities(reaction: Reaction) -> tuple[Velocities, Velocities]:
            node = lambda q, t, eta: reaction((q, t), (q, t), eta)
            at_jump = node(qj, t0, jump.velocity_impulse)
            at_end = node(q1, t1, end.velocity_impulse)
            # eq. (66c): vj + v1, and eq. (66d)
            total = 2 * problem.velocity(end) - (at_jump + at_end)
            difference = -(6 * model.push(start.q, qj, jump.rate) + (at_end - at_jump))
            return split_velocities(self.alpha, start.v, total / kappa, difference / kappa)

        return problem.nodes(velocities, (jump, t0), (end, t1))


def _kappa(z: _Unknowns) -> Scalar:
    return z.kappa[0] if z.kappa.size == 1 else jnp.ones((), z.kappa.dtype)


def _position_level(increment: Increment) -> Increment:
    """The increment without its velocity-level multipliers, which do not enter the balance
    of momentum in this scheme."""
    eta = increment.velocity_impulse
    return eqx.tree_at(lambda z: z.velocity_impulse, increment, eta[:0])


def _scaled(kappa: Scalar, gradient: Gradient, reaction: Velocities | float = 0.0):
    """The gradient with the rate `kappa * gradient.rate + reaction`."""
    rate = kappa * gradient.rate + reaction
    return Gradient(gradient.impulse, rate, rows=gradient.rows)
