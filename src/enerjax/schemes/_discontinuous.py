"""The common parts of the discontinuous schemes, whose state jumps at the step's start."""

from collections.abc import Callable

import equinox as eqx
import jax
from jaxtyping import Array

from .._operators import Gradient, Increment
from .._system import State
from .._types import Increments, Multipliers, Scalar, Velocities
from .base import ForceLaw, StepProblem


class JumpAndEnd(eqx.Module):
    """The increments to the nodes of a discontinuous step: after the jump, and the end."""

    jump: Increment
    end: Increment


def predict_jump_and_end(
    problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
) -> JumpAndEnd:
    """The initial guess: a Taylor step to the end, and a jump in the positions alone.

    The jump of the positions is chosen such that `vj = v0`. Without it the guess of `v1`
    would be `v0`, and the equation for kappa would be singular there.
    """
    end = problem.guess(acceleration, multipliers)
    start, rates = problem.start, lambda v: problem.model.rates(problem.start.q, v)
    _, rate = jax.jvp(rates, (start.v,), (-problem.h / 6 * acceleration,))
    momentum = start.v[: end.momentum.size]
    parts = lambda z: (z.rate, z.momentum)
    return JumpAndEnd(eqx.tree_at(parts, end, (rate, momentum)), end)


def split_velocities(
    alpha: Scalar, v0: Velocities, total: Velocities, difference: Velocities
) -> tuple[Velocities, Velocities]:
    """`vj, v1` from `vj + v1 = total`, `v1 - alpha vj - (1 - alpha) v0 = difference`."""
    alpha = alpha.astype(v0.dtype)
    vj = (total - difference - (1 - alpha) * v0) / (1 + alpha)
    return vj, total - vj


def jump_gradient(
    alpha: Scalar, after: Gradient, before: Gradient, start: Gradient, jump: Gradient
) -> Gradient:
    """The gradient in the equations of the jump from `z0` to `zj`, eq. (47b):

        -(DH_g - DH_h)/3 + alpha/6 (grad H(zj) - grad H(z0))

    `after` is `DH_g`, `before` is `DH_h`, `start` is `grad H(z0)`, `jump` is `grad H(zj)`.
    """

    def combined(g: Array, h: Array, x0: Array, xj: Array) -> Array:
        return -(g - h) / 3 + alpha.astype(g.dtype) / 6 * (xj - x0)

    no_time = lambda x: Gradient(x.impulse, x.rate, rows=x.rows)
    return jax.tree.map(combined, *map(no_time, (after, before, start, jump)))


class Loads(eqx.Module):
    """The impulses `h L^T f` of the forces in a discontinuous step.

    - `after`, `before`: over the intervals `zj -> z1` and `z0 -> zj`.
    - `start`, `jump`: at the nodes `z0` and `zj`.
    """

    after: Increments | None = None
    before: Increments | None = None
    start: Increments | None = None
    jump: Increments | None = None


def jump_loads(
    alpha: Scalar, z: JumpAndEnd, problem: StepProblem, jump: State, end: State
) -> Loads:
    """The forces of a discontinuous step; none for a system without forces.

    They enter the equations like `-grad V`, at velocities that are computed from the
    positions. The velocity over the jump is `(v0 + vj)/2` without constraints. It is
    written such that the work of a damper is a sum of squares for any step and any
    constraints: with `F = -c v`

        W = -c h (|(q1 - q0)/h|^2 + 3 |(qj - q0)/h|^2)
    """
    model = problem.model
    if model.system.force is None:
        return Loads()
    return Loads(*_loads(model.force, alpha, z, problem, jump, end))


def _loads(
    law: ForceLaw,
    alpha: Scalar,
    z: JumpAndEnd,
    problem: StepProblem,
    jump: State,
    end: State,
) -> tuple[Increments, Increments, Increments, Increments]:
    """The fields of `Loads` for one force."""
    model, start = problem.model, problem.start
    v0, vj = model.velocity(start), model.velocity(jump)
    jump_rate = model.push(start.q, problem.position(z.end), z.jump.rate)
    half = 0.5 * alpha.astype(v0.dtype)
    mean = problem.velocity(z.end) + 3 * jump_rate - half * (vj - v0)
    after = problem.load(law, jump, end, z.end, problem.velocity(z.end))
    before = problem.load(law, start, jump, z.end, mean)
    at_start = problem.load(law, start, start, z.end, v0)
    at_jump = problem.load(law, jump, jump, z.end, vj)
    return after, before, at_start, at_jump


def jump_work(
    alpha: Scalar, z: JumpAndEnd, problem: StepProblem, jump: State, end: State
) -> Callable[[ForceLaw], Scalar]:
    """The work that a force does in a discontinuous step."""

    def work(law: ForceLaw) -> Scalar:
        after, before, at_start, at_jump = _loads(law, alpha, z, problem, jump, end)
        # The last term is the work of `alpha/6 (F_j - F_0)`.
        over_jump = before + 0.5 * alpha.astype(before.dtype) * (at_jump - at_start)
        return after @ (z.end.rate - z.jump.rate) + over_jump @ z.jump.rate

    return work


def jump_energy(problem: StepProblem, jump: State) -> tuple[Scalar, Scalar]:
    """`K_jump` and `V_jump`, eq. (34) and (36)."""
    model, start, h = problem.model, problem.start, problem.h
    slope = model.gradient(jump, h).impulse - model.gradient(start, h).impulse
    return model.kinetic_of_jump(start, jump), 0.5 * (jump.q - start.q) @ slope / h
