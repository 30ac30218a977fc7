"""The corrections of the chord method, in closed form.

The approximate Jacobian contains the inertia and the constraint gradients `B`, and omits
all terms of the stiffness. The right-hand sides are the rows of the balance of momentum
`r_m`, the constraints divided by `h`, `r_phi`, and their rates `r_psi`. After block
elimination each kind of multiplier has a linear system with the matrix `G = B M^-1 B^T`.
"""

import jax.numpy as jnp

from .._operators import ConstraintMatrix, Increment
from .._types import Scalar
from ._discontinuous import JumpAndEnd


def step_chord(rows: Increment, constraints: ConstraintMatrix) -> Increment:
    """The correction of a step with `v1 = 2 (rate - M^-1 B^T eta) - v0`; it solves

    2 M rate + B^T (impulse - 2 eta) = r_m
    B rate = r_phi,   2 B rate - 2 G eta = r_psi
    """
    free = 0.5 * (constraints.inverse_inertia @ rows.rate)
    impulse = constraints.product(free) - rows.impulse
    if rows.velocity_impulse.size == 0:
        (impulse,) = constraints.solve(impulse[None])
        reaction = rows.velocity_impulse
        both = impulse
    else:
        right = jnp.stack([impulse, rows.impulse - 0.5 * rows.velocity_impulse])
        impulse, reaction = constraints.solve(right)
        both = impulse + reaction
    return Increment(
        impulse=2 * both,
        rate=free - constraints.velocity(impulse),
        momentum=rows.momentum,
        velocity_impulse=reaction,
    )


def jump_chord(
    alpha: Scalar, rows: JumpAndEnd, constraints: ConstraintMatrix
) -> JumpAndEnd:
    """The correction of a discontinuous step, whose velocities `vj` and `v1` satisfy

        vj + v1 = 2 (rate_1 - M^-1 B^T eta_1)
        (1 + alpha) vj = 2 rate_1 + 6 rate_j - 2 M^-1 B^T eta_j

    It solves `M v1 + B^T impulse_1 = r_1` and `M vj - B^T (impulse_1 - impulse_j)/3 = r_j`,
    with the rows of the constraints at both nodes.
    """
    alpha = alpha.astype(rows.end.rate.dtype)
    jump, end = rows.jump, rows.end
    v1, vj = (constraints.inverse_inertia @ x for x in (end.rate, jump.rate))
    is_ggl = end.velocity_impulse.size > 0
    s1, sj = (x.velocity_impulse for x in (end, jump))
    if not is_ggl:
        # Without velocity constraints, those of the positions determine both velocities.
        sj = (2 * end.impulse + 6 * jump.impulse) / (1 + alpha)
        s1 = 2 * end.impulse - sj
    right = [constraints.product(v1) - s1, 3 * (sj - constraints.product(vj))]
    if is_ggl:
        right.append(end.impulse - 0.5 * (s1 + sj))
        right.append(end.impulse + 3 * jump.impulse - 0.5 * (1 + alpha) * sj)
    after, before, *reactions = constraints.solve(jnp.stack(right))
    v1 = v1 - constraints.velocity(after)
    vj = vj + constraints.velocity(before) / 3
    rate = 0.5 * (v1 + vj)
    jump_rate = (1 + alpha) * vj
    eta_1, eta_j = reactions if is_ggl else (end.velocity_impulse, jump.velocity_impulse)
    if is_ggl:
        rate = rate + constraints.velocity(eta_1)
        jump_rate = jump_rate + 2 * constraints.velocity(eta_j)
    return JumpAndEnd(
        jump=Increment(
            impulse=after - before,
            rate=(jump_rate - 2 * rate) / 6,
            momentum=jump.momentum,
            velocity_impulse=eta_j,
        ),
        end=Increment(
            impulse=after,
            rate=rate,
            momentum=end.momentum,
            velocity_impulse=eta_1,
        ),
    )
