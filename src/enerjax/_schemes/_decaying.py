"""What the discontinuous schemes have in common."""

import equinox as eqx
import jax
import jax.numpy as jnp

from .._segment import Increment
from .._system import State
from .._tracing import is_known
from .._types import Coordinates, Multipliers, Real, Scalar, Velocities
from .base import StepProblem


class JumpAndEnd(eqx.Module):
    """The two nodes of a discontinuous step: after the jump, and at the end."""

    jump: Increment
    end: Increment


def as_alpha(alpha: Real) -> Scalar:
    """Checks a dissipation parameter where its value can be known."""
    alpha, inside = _unit_interval(alpha)
    if not inside:
        raise ValueError(
            f"alpha = {alpha} lies outside [0, 1]: 0 preserves the energy, 1 annihilates "
            "the highest frequencies in one step; beyond, the scheme would feed energy in."
        )
    return alpha


def _unit_interval(number: Real) -> tuple[Scalar, bool]:
    """A number as an array, and whether it may lie in [0, 1] as far as is known."""
    if not is_known(number):
        return jnp.asarray(number, float), True
    # A constant keeps its value inside `jit` too.
    with jax.ensure_compile_time_eval():
        array = jnp.asarray(number, float)
        return array, bool(jnp.all((array >= 0) & (array <= 1)))


def alpha_from_spectral_radius(rho_inf: Real) -> Scalar:
    """`alpha = (1 - rho_inf) / (1 + rho_inf)`"""
    rho_inf, inside = _unit_interval(rho_inf)
    if not inside:
        raise ValueError(
            f"rho_inf = {rho_inf} lies outside [0, 1]: it is the factor by which a step "
            "multiplies the amplitude of an infinitely fast oscillation."
        )
    return (1 - rho_inf) / (1 + rho_inf)


def predict_jump_and_end(
    problem: StepProblem, acceleration: Velocities, multipliers: Multipliers
) -> JumpAndEnd:
    """A Taylor step over the whole length, and the jump that leaves `vj` at `v0`.

    That jump is in the positions alone; without it `v1` would be guessed at `v0`, where
    the equation for kappa is singular.
    """
    end = problem.guess(acceleration, multipliers)
    rate = problem.model.lift(problem.start.q, -problem.h / 6 * acceleration)
    return JumpAndEnd(Increment(rate, end.impulse, end.velocity_impulse), end)


def split_velocities(
    alpha: Scalar, v0: Velocities, total: Velocities, difference: Velocities
) -> tuple[Velocities, Velocities]:
    """`vj, v1` from `vj + v1 = total`, `v1 - alpha vj - (1 - alpha) v0 = difference`."""
    alpha = alpha.astype(v0.dtype)
    vj = (total - difference - (1 - alpha) * v0) / (1 + alpha)
    return vj, total - vj


def momentum_rows(
    problem: StepProblem,
    alpha: Scalar,
    jump: State,
    end: State,
    z: JumpAndEnd,
    impulse_after: Coordinates,
    impulse_before: Coordinates,
) -> tuple[Coordinates, Coordinates]:
    """Balance of momentum from `z0` to `zj` and from `z0` to `z1`, eq. (47b, a)."""
    model, h = problem.model, problem.h
    q0, v0 = problem.start.q, problem.start.v
    curvature = model.potential_gradient(jump.q) - model.potential_gradient(q0)
    to_jump = problem.segment(q0, jump.q).momentum(v0, jump.v, h * z.jump.rate)
    to_end = problem.segment(q0, end.q).momentum(v0, end.v, h * z.end.rate)
    return (
        to_jump
        - (impulse_after - impulse_before) / 3
        + alpha.astype(h.dtype) * h / 6 * curvature,
        to_end + impulse_after,
    )


def jump_energy(problem: StepProblem, jump: State) -> tuple[Scalar, Scalar]:
    """`K_jump` and `V_jump`, eq. (34) and (36)."""
    model, start = problem.model, problem.start
    gradients = model.potential_gradient(jump.q) - model.potential_gradient(start.q)
    return model.kinetic(jump.v - start.v), 0.5 * (jump.q - start.q) @ gradients
