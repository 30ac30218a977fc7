"""What the discontinuous schemes have in common."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._operators import Drive, Increment, SeparableModel
from .._programs import is_known
from .._system import State
from .._types import Coordinates, Multipliers, Real, Scalar, Velocities
from .base import Law, StepProblem


class JumpAndEnd(eqx.Module):
    """The two nodes of a discontinuous step: after the jump, and at the end."""

    jump: Increment
    end: Increment


def as_alpha(alpha: Real) -> Scalar:
    """Checks a dissipation parameter where its value can be known."""
    alpha, inside = _unit_interval("alpha", alpha)
    if not inside:
        raise ValueError(
            f"alpha = {alpha} lies outside [0, 1]: 0 preserves the energy, 1 annihilates "
            "the highest frequencies in one step; beyond, the scheme would feed energy in."
        )
    return alpha


def _unit_interval(name: str, number: Real) -> tuple[Scalar, bool]:
    """A number as an array, and whether it may lie in [0, 1] as far as is known."""
    if isinstance(number, str) or jnp.iscomplexobj(number):
        raise TypeError(f"`{name}` must be a real number in [0, 1], got {number!r}.")
    if not is_known(number):
        return jnp.asarray(number, float), True
    # A constant keeps its value inside `jit` too.
    with jax.ensure_compile_time_eval():
        array = jnp.asarray(number, float)
        return array, bool(jnp.all((array >= 0) & (array <= 1)))


def alpha_from_spectral_radius(rho_inf: Real) -> Scalar:
    """`alpha = (1 - rho_inf) / (1 + rho_inf)`"""
    rho_inf, inside = _unit_interval("rho_inf", rho_inf)
    if not inside:
        raise ValueError(
            f"rho_inf = {rho_inf} lies outside [0, 1]: it is the factor by which a step "
            "multiplies the amplitude of an infinitely fast oscillation."
        )
    if not is_known(rho_inf):
        return (1 - rho_inf) / (1 + rho_inf)
    with jax.ensure_compile_time_eval():
        return (1 - rho_inf) / (1 + rho_inf)


def predict_jump_and_end(
    problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
) -> JumpAndEnd:
    """A Taylor step over the whole length, and the jump that leaves `vj` at `v0`.

    That jump is in the positions alone; without it `v1` would be guessed at `v0`, where
    the equation for kappa is singular.
    """
    end = problem.guess(acceleration, multipliers)
    start, lift = problem.start, lambda v: problem.model.lift(problem.start.q, v)
    _, rate = jax.jvp(lift, (start.v,), (-problem.h / 6 * acceleration,))
    momentum = start.v[: end.momentum.size]
    moved = lambda z: (z.rate, z.momentum)
    return JumpAndEnd(eqx.tree_at(moved, end, (rate, momentum)), end)


def split_velocities(
    alpha: Scalar, v0: Velocities, total: Velocities, difference: Velocities
) -> tuple[Velocities, Velocities]:
    """`vj, v1` from `vj + v1 = total`, `v1 - alpha vj - (1 - alpha) v0 = difference`."""
    alpha = alpha.astype(v0.dtype)
    vj = (total - difference - (1 - alpha) * v0) / (1 + alpha)
    return vj, total - vj


def jump_drive(
    alpha: Scalar, after: Drive, before: Drive, start: Drive, jump: Drive
) -> Drive:
    """What drives `z0 -> zj`: `-(DH_g - DH_h)/3 + alpha/6 (grad H(zj) - grad H(z0))`.

    eq. (47b); `start` and `jump` are the gradients there.
    """

    def combined(g: Array, h: Array, x0: Array, xj: Array) -> Array:
        return -(g - h) / 3 + alpha.astype(g.dtype) / 6 * (xj - x0)

    drives = after, before, start, jump
    return Drive(
        combined(*(x.impulse for x in drives)), combined(*(x.drift for x in drives))
    )


class Loads(eqx.Module):
    """`h L^T f` over `zj -> z1`, over `z0 -> zj`, at `z0` and at `zj`."""

    after: Coordinates | None = None
    before: Coordinates | None = None
    start: Coordinates | None = None
    jump: Coordinates | None = None


def jump_loads(
    alpha: Scalar, z: JumpAndEnd, problem: StepProblem, jump: State, end: State
) -> Loads:
    """The forces of a discontinuous step; none for a system without.

    They enter like `-grad V`, at velocities that come from the positions. That over the
    jump, without constraints `(v0 + vj)/2`, is written so that the work of a damper is a
    sum of squares for any step and any constraints: with `F = -c v`

        W = -c h (|(q1 - q0)/h|^2 + 3 |(qj - q0)/h|^2)
    """
    model = problem.model
    if model.system.force is None:
        return Loads()
    return Loads(*_loads(model.force, alpha, z, problem, jump, end))


def _loads(
    law: Law,
    alpha: Scalar,
    z: JumpAndEnd,
    problem: StepProblem,
    jump: State,
    end: State,
) -> tuple[Coordinates, Coordinates, Coordinates, Coordinates]:
    """The fields of `Loads` for one force."""
    model, start = problem.model, problem.start
    v0, vj = model.velocity(start), model.velocity(jump)
    lag = model.push(start.q, problem.at(z.end), z.jump.rate)
    half = 0.5 * alpha.astype(v0.dtype)
    mean = problem.velocity(z.end) + 3 * lag - half * (vj - v0)
    after = problem.load(law, jump, end, z.end, problem.velocity(z.end))
    before = problem.load(law, start, jump, z.end, mean)
    at_start = problem.load(law, start, start, z.end, v0)
    at_jump = problem.load(law, jump, jump, z.end, vj)
    return after, before, at_start, at_jump


def jump_work(
    alpha: Scalar, z: JumpAndEnd, problem: StepProblem, jump: State, end: State
) -> Callable[[Law], Scalar]:
    """The work that a force does in a discontinuous step."""

    def work(law: Law) -> Scalar:
        after, before, at_start, at_jump = _loads(law, alpha, z, problem, jump, end)
        # The last part is the work of `alpha/6 (F_j - F_0)`.
        over_jump = before + 0.5 * alpha.astype(before.dtype) * (at_jump - at_start)
        return after @ (z.end.rate - z.jump.rate) + over_jump @ z.jump.rate

    return work


def jump_energy(problem: StepProblem, jump: State) -> tuple[Scalar, Scalar]:
    """`K_jump` and `V_jump`, eq. (34) and (36)."""
    model, start, h = problem.model, problem.start, problem.h
    before, after = model.gradient(start, h), model.gradient(jump, h)
    potential = 0.5 * (jump.q - start.q) @ (after.impulse - before.impulse) / h
    dv = jump.v - start.v
    if isinstance(model, SeparableModel):
        return model.kinetic_of(dv), potential
    return 0.5 * dv @ (after.drift - before.drift), potential
