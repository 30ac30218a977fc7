"""The corrections of the chord method, in closed form.

The approximate Jacobian contains the inertia and the constraint gradients `C`, and in
`step_chord` the stiffness `K` of strains; all other terms of the stiffness are omitted. The
right-hand sides are the rows of the balance of momentum `r_m`, the constraints divided by
`h`, `r_phi`, and their rates `r_psi`. After block elimination each kind of multiplier has a
linear system with the matrix `G = C M^-1 C^T`.
Coordinate constraints are taken out first, and their multipliers follow from the normal
components of the balance of momentum. Where momenta are unknowns, they are taken out too.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import DelassusMatrix, Increment
from .._types import Scalar, Velocities
from ._discontinuous import JumpAndEnd


def step_chord(rows: Increment, delassus: DelassusMatrix) -> Increment:
    """The correction of a step with `v1 = 2 (rate - M^-1 C^T eta) - v0`; it solves

    2 (M + h^2/4 K) rate + C^T (impulse - 2 eta) = r_m
    C rate = r_phi,   2 C rate - 2 G eta = r_psi
    """
    if rows.momentum.size > 0:
        found = step_chord(_without_momenta(rows, delassus), delassus)
        momentum = rows.rate - delassus.force(found.impulse)
        return _with_momenta(found, rows, momentum)
    reduced = delassus.reduced(rows)
    inner = reduced.rows
    free = 0.5 * (delassus.inverse_inertia @ inner.rate)
    if inner.velocity_impulse.size == 0:
        impulse, rate, _ = delassus.motion(free, inner.impulse)
        reaction = inner.velocity_impulse
        both = impulse
    else:
        slip = inner.impulse - 0.5 * inner.velocity_impulse
        impulse, rate, (reaction,) = delassus.motion(free, inner.impulse, slip)
        both = impulse + reaction
    relations = reduced.normal - delassus.normal_forces(2 * both)
    return Increment(
        impulse=jnp.concatenate([2 * both, relations]),
        rate=delassus.rates(rate, reduced),
        momentum=rows.momentum,
        velocity_impulse=reaction,
    )


def _without_momenta(rows: Increment, delassus: DelassusMatrix) -> Increment:
    """The rows of a node for `rate - r_p`, where `r_p` are those of its momenta.

    With the momenta `p1` of a step as unknowns, for example, its rows `S_mu` are

        rate - M^-1 (p1 / 2 + C^T eta) = r_p

    so `2 (rate - r_p - M^-1 C^T eta)` is the velocity that belongs to `p1`.
    """
    parts = lambda rows: (rows.impulse, rows.momentum)
    impulse = rows.impulse - delassus.product(rows.momentum)
    return eqx.tree_at(parts, rows, (impulse, rows.momentum[:0]))


def _with_momenta(found: Increment, rows: Increment, momentum: Velocities) -> Increment:
    """The correction of a node from that for `rate - r_p`."""
    parts = lambda found: (found.rate, found.momentum)
    return eqx.tree_at(parts, found, (found.rate + rows.momentum, momentum))


def rattle_chord(rows: Increment, delassus: DelassusMatrix) -> Increment:
    """The correction of a step of RATTLE, whose coordinates are not redundant; it solves

    M rate + C^T impulse / 2 = r_m
    C rate = r_phi,   C rate - G velocity_impulse / 2 = r_psi
    """
    free = delassus.inverse_inertia @ rows.rate
    before = delassus.product(free) - rows.impulse
    right = jnp.stack([before, rows.impulse - rows.velocity_impulse])
    before, after = delassus.solve(right)
    return Increment(
        impulse=2 * before,
        rate=free - delassus.velocity(before),
        momentum=rows.momentum,
        velocity_impulse=2 * after,
    )


def jump_chord(alpha: Scalar, rows: JumpAndEnd, delassus: DelassusMatrix) -> JumpAndEnd:
    """The correction of a discontinuous step, whose velocities `vj` and `v1` satisfy

        vj + v1 = 2 (rate_1 - M^-1 C^T eta_1)
        (1 + alpha) vj = 2 rate_1 + 6 rate_j - 2 M^-1 C^T eta_j

    It solves `M v1 + C^T impulse_1 = r_1` and `M vj - C^T (impulse_1 - impulse_j)/3 = r_j`,
    and the rows of the constraints at both nodes; with strains see below.
    """
    if rows.end.momentum.size > 0:
        shifted = JumpAndEnd(
            *(_without_momenta(x, delassus) for x in (rows.jump, rows.end))
        )
        found = jump_chord(alpha, shifted, delassus)
        force, force_j = (delassus.force(x.impulse) for x in (found.end, found.jump))
        return JumpAndEnd(
            jump=_with_momenta(
                found.jump, rows.jump, rows.jump.rate + (force - force_j) / 3
            ),
            end=_with_momenta(found.end, rows.end, rows.end.rate - force),
        )
    alpha = alpha.astype(rows.end.rate.dtype)
    of_jump, of_end = delassus.reduced(rows.jump), delassus.reduced(rows.end)
    jump, end = of_jump.rows, of_end.rows
    v1, vj = (delassus.inverse_inertia @ x for x in (end.rate, jump.rate))
    is_ggl = end.velocity_impulse.size > 0
    s1, sj = (x.velocity_impulse for x in (end, jump))
    if not is_ggl:
        # Without velocity constraints, those of the positions determine both velocities.
        sj = (2 * end.impulse + 6 * jump.impulse) / (1 + alpha)
        s1 = 2 * end.impulse - sj
    right = [delassus.product(v1) - s1, 3 * (sj - delassus.product(vj))]
    if is_ggl:
        right.append(end.impulse - 0.5 * (s1 + sj))
        right.append(end.impulse + 3 * jump.impulse - 0.5 * (1 + alpha) * sj)
    after, before, *reactions = delassus.solve(jnp.stack(right))
    v1 = v1 - delassus.velocity(after)
    vj = vj + delassus.velocity(before) / 3
    eta_1, eta_j = reactions if is_ggl else (end.velocity_impulse, jump.velocity_impulse)
    none = jnp.zeros_like(v1)
    slips = none, none
    if is_ggl:
        slips = delassus.velocity(eta_1), delassus.velocity(eta_j)
    if delassus.elastic is not None:
        v1, vj, change = _with_strains(alpha, (v1, vj), slips, delassus)
        after, before = after + change[0], before + change[1]
    rate = 0.5 * (v1 + vj) + slips[0]
    jump_rate = (1 + alpha) * vj + 2 * slips[1]
    relations = of_end.normal - delassus.normal_forces(after)
    difference = -3 * of_jump.normal - delassus.normal_forces(before)
    return JumpAndEnd(
        jump=Increment(
            impulse=jnp.concatenate([after - before, relations - difference]),
            rate=delassus.rates((jump_rate - 2 * rate) / 6, of_jump),
            momentum=rows.jump.momentum,
            velocity_impulse=eta_j,
        ),
        end=Increment(
            impulse=jnp.concatenate([after, relations]),
            rate=delassus.rates(rate, of_end),
            momentum=rows.end.momentum,
            velocity_impulse=eta_1,
        ),
    )


# With the stiffness of strains the balances of momentum of the end and of the jump (rows
# of `A`) also contain `h^2 K A (v1, vj)`, where
#
#     A = [[1/6, 1/4 + alpha/12], [-(1/12 + alpha/36), -1/12 + alpha^2/36]]
#
# Let `T` be `h^2 M^-1 K`, restricted to motions that the joints permit. The velocities are
# those without stiffness times
#
#     (I + T A)^-1 = (I + T adj A) / (1 + tr A T + det A T^2)
#
# The roots of this denominator are complex. The chord method has `D = (1 + g T)^2` in its
# place, with `g = (1 + alpha)/12`, the root of `det A`. It is exact for motions without
# stiffness and in the limit of high frequencies. In between the part
#
#     E = (2 g - tr A) T / D,   at most (g - tr A / 2)/(2 g) <= 1/3,
#
# of `D` is too much, so the exact inverse is `(1 + E + E^2 + ...) / D`.

# The number of terms of this sum. A correction leaves at most (1/3)^3 of the error.
_TERMS = 3


def elastic_length(alpha: Scalar, h: Scalar) -> Scalar:
    """The length of time whose square is `4 g h^2`."""
    return h * jnp.sqrt((1 + alpha.astype(h.dtype)) / 3)


def _divided(
    alpha: Scalar, free: Float[Array, "k nv"], delassus: DelassusMatrix
) -> tuple[Float[Array, "k nv"], Float[Array, "k nv"]]:
    """`k` velocities divided by `1 + tr A T + det A T^2`, and `T` times these."""
    share, trace = (1 + alpha) / 12, (3 + alpha**2) / 36

    def add(_: int, sums: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        rest, total, by_stiffness = sums
        once = delassus.softened(rest)
        twice = delassus.softened(once)
        # T / D
        moved = (once - twice) / share
        return (2 * share - trace) * moved, total + twice, by_stiffness + moved

    none = jnp.zeros_like(free)
    _, total, by_stiffness = jax.lax.fori_loop(0, _TERMS, add, (free, none, none))
    return total, by_stiffness


def velocities_with_strains(
    alpha: Scalar, v1: Velocities, vj: Velocities, delassus: DelassusMatrix
) -> tuple[Velocities, Velocities]:
    """The velocities with stiffness, from those without."""
    divided = _divided(alpha, jnp.stack([v1, vj]), delassus)
    (at_end, at_jump), (by_end, by_jump) = divided
    v1 = at_end + (alpha**2 - 3) / 36 * by_end - (3 + alpha) / 12 * by_jump
    return v1, at_jump + (3 + alpha) / 36 * by_end + by_jump / 6


def _with_strains(
    alpha: Scalar,
    free: tuple[Velocities, Velocities],
    slips: tuple[Velocities, Velocities],
    delassus: DelassusMatrix,
) -> tuple[Velocities, Velocities, Float[Array, "2 nc"]]:
    """The velocities `v1` and `vj` with stiffness, and the change of the multipliers of the
    joints by the forces of strains.

    `free` are the velocities without stiffness, and `slips` those by which rates differ
    from them, `M^-1 C^T eta_1` and `M^-1 C^T eta_j`.
    """

    def slowed(rate: Velocities, jump_rate: Velocities) -> tuple[Velocities, Velocities]:
        """What the strains of these rates take from the velocities of both nodes."""
        stiff = lambda x: 12 / (1 + alpha) * delassus.elastic_force(x)
        end, jump = (delassus.inverse_inertia @ stiff(x) for x in (rate, jump_rate))
        return 0.5 * (end + jump), (alpha * jump - end) / 6

    of_slips = slips[0], (slips[1] - slips[0]) / 3
    by_slip = slowed(*of_slips)
    held = delassus.solve(jnp.stack([delassus.product(x) for x in by_slip]))
    v1, vj = (
        x - by + delassus.velocity(impulse)
        for x, by, impulse in zip(free, by_slip, held, strict=True)
    )
    v1, vj = velocities_with_strains(alpha, v1, vj, delassus)
    end, jump = slowed(0.5 * (v1 + vj) + of_slips[0], (alpha * vj - v1) / 6 + of_slips[1])
    right = jnp.stack([-delassus.product(end), 3 * delassus.product(jump)])
    return v1, vj, delassus.solve(right)


def skew_chord(rows: Increment, delassus: DelassusMatrix) -> Increment:
    """The correction of a step of order 4, `EnergyConsistent(0)`, with stiff strains:

        v1 = 2 rate - 2 M^-1 C^T eta - M^-1 h^2 K rate / 6
        M v1 + C^T impulse + h^2 K (rate / 2 - v1 / 12) = r_m
        C rate = r_phi,   C v1 = r_psi

    Its denominator is that of the nodes above for `alpha = 0`.
    """
    if delassus.elastic is None or rows.momentum.size > 0:
        return step_chord(rows, delassus)
    inverse, slip = delassus.inverse_inertia, rows.velocity_impulse
    stiff = lambda velocity: 12 * delassus.elastic_force(velocity)
    (own,) = delassus.solve((rows.impulse - 0.5 * slip)[None])
    free = 0.5 * (inverse @ (rows.rate - stiff(delassus.velocity(own)) / 6))
    (held,) = delassus.solve((delassus.product(free) - rows.impulse)[None])
    none = jnp.zeros((), free.dtype)
    without = free - delassus.velocity(held)
    rate = _divided(none, without[None], delassus)[0][0]
    moved = inverse @ (stiff(rate) / 12)
    (eta,) = delassus.solve((rows.impulse - 0.5 * slip - delassus.product(moved))[None])
    v1 = 2 * (rate - moved - delassus.velocity(eta))
    force = stiff(0.5 * rate - v1 / 12)
    balance = delassus.product(inverse @ (rows.rate - force)) - slip
    (impulse,) = delassus.solve(balance[None])
    return Increment(impulse, rate, rows.momentum, eta)
