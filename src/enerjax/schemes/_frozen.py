"""What `EnergyConsistent` fixes before a step is solved: its dissipative stiffness."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import SeparableModel
from .._solvers import as_dense, Assembled, inverse, product, Symmetric
from .._system import State
from .._types import Scalar
from ._semidefinite import semidefinite_part
from .base import StepProblem


class Frozen(eqx.Module):
    """A step's data, with the dissipative stiffness fixed before the solve."""

    step: StepProblem
    # P = diag(K+, M^-1): the positive semidefinite part of the stiffness near the start,
    # and the inertia there.
    stiffness: Float[Array, "nq nq"] | Assembled
    inertia: Symmetric
    compliance: Float[Array, "np np"]
    # X = (M + lag^2 K+)^-1 (h/6) K+ with lag = alpha h/6: j_v = X (dq + lag dv). Empty
    # where the stiffness is assembled: X would be full, so j_v is an unknown there.
    jump: Float[Array, "nx nx"]
    # (1 + lag X)^-1, where velocities are eliminated.
    damping: Float[Array, "nd nd"]


def freeze(step: StepProblem, alpha: Scalar) -> Frozen:
    """The stiffness half-way of a free flight, and what follows from it.

    P only has to be semidefinite and near the stiffness for the law and the order, so the
    multipliers of the start serve. Inside the solve it would cost an eigenvalue problem
    per iteration.
    """
    model, start, h = step.model, step.start, step.h
    multipliers = model.multipliers(start)
    half_way = start.q + 0.5 * h * model.lift(start.q, start.v)
    middle = State(half_way, start.v, step.middle_time)
    stiffness, inertia = model.stiffness(middle, multipliers)
    stiffness = semidefinite_part(stiffness, inertia)
    lag, none = alpha * h / 6, jnp.zeros((0, 0), h.dtype)
    if isinstance(stiffness, Assembled):
        return Frozen(step, stiffness, inertia, none, none, none)
    inertia = as_dense(inertia)
    jump = product(inverse(inertia + lag**2 * stiffness), h / 6 * stiffness)
    if isinstance(model, SeparableModel):
        damping = inverse(jnp.eye(start.q.size, dtype=h.dtype) + lag * jump)
        return Frozen(step, stiffness, inertia, none, jump, damping)
    return Frozen(step, stiffness, inertia, inverse(inertia), jump, none)
