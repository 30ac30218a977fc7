"""The corrections of the chord method, in closed form.

The approximate Jacobian contains the inertia and the constraint gradients `C`, and where
the Delassus matrix has them the stiffness `K` of strains and the resistance `c` of dampers.
All other terms are omitted. The right-hand sides are the rows of the balance of momentum
`r_m`, the constraints divided by `h`, `r_phi`, and their rates `r_psi`. After block
elimination each kind of multiplier has a linear system with the matrix `G = C M^-1 C^T`.
Coordinate constraints are taken out first, and their multipliers follow from the normal
components of the balance of momentum. Where momenta are unknowns, they are taken out too.
"""

from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import DelassusMatrix, Increment
from .._types import Scalar, Velocities
from ._discontinuous import JumpAndEnd


def step_chord(rows: Increment, delassus: DelassusMatrix) -> Increment:
    """The correction of a step with `v1 = 2 (rate - M^-1 C^T eta) - v0`; it solves

    2 (M + h^2/4 K + h/2 c) rate + C^T (impulse - 2 eta) = r_m
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
    and the rows of the constraints at both nodes. With strains and dampers there are more
    terms; see the comment above `_resisted`.
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
        v1, vj, change = _with_resistance(alpha, (v1, vj), slips, delassus)
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


# With the stiffness `K` of strains and the resistance `c` of dampers the balances of
# momentum of the end and of the jump (rows of `A` and `R`) also contain
# `(h^2 K A + h c R)(v1, vj)`,
#
#     A = [[1/6, 1/4 + alpha/12], [-(1/12 + alpha/36), -1/12 + alpha^2/36]]
#     R = [[1/2, 1/2], [-1/6, alpha/6]],   det A = g^2,   det R = g,   g = (1 + alpha)/12
#
# The rows of `S` are scaled such that `S^T S = g h^2 K + sqrt(g) h c`. With `N = A/g` for
# rows of strains and `N = R/sqrt(g)` for those of dampers, `det N = 1`, the terms are
# `S^T N S`, and among the motions that the joints permit
#
#     (M + S^T N S)^-1  ~  P = (M + S^T S)^-1 (M + S^T adj(N) S) (M + S^T S)^-1
#
# This is exact for motions without stiffness and resistance, and in the limit of high
# frequencies. In between, for one mass with `x = S^T S / M`, the part
#
#     E = (2 - tr N) x / (1 + x)^2,   at most (2 - tr N)/4 <= 1/3,
#
# is too much, so the exact inverse is `(1 + E + E^2 + ...) P`.

# The number of terms of this sum. A correction leaves at most (1/3)^3 of the error. With
# dampers alone `(2 - tr N)/4` is at most 0.1.
_TERMS, _TERMS_OF_DAMPERS = 3, 2

# Velocities at the end of a step and after its jump, and products of `S` with such vectors,
# behind zeros for the joints.
_Nodes: TypeAlias = Float[Array, "2 nv"]
_Rows: TypeAlias = Float[Array, "2 rows"]


def elastic_length(alpha: Scalar, h: Scalar) -> Scalar:
    """The length of time `l` with `g h^2 = l^2/4` and `sqrt(g) h = l/2`."""
    return h * jnp.sqrt((1 + alpha.astype(h.dtype)) / 3)


def _resisted(alpha: Scalar, rates: _Rows, delassus: DelassusMatrix) -> _Nodes:
    """The velocities that strains and dampers take at both nodes.

    `rates` are `S` times the rates of the increments to the end and to the jump.
    """
    share, (end, jump) = (1 + alpha) / 12, rates
    of_strains = jnp.stack([0.5 * (end + jump), (alpha * jump - end) / 6]) / share
    of_dampers = rates / jnp.sqrt(share)
    return delassus.pulled(jnp.where(delassus.is_strain[None], of_strains, of_dampers))


def _by_adjoint(alpha: Scalar, rows: _Rows, delassus: DelassusMatrix) -> _Nodes:
    """`M^-1 S^T adj(N) rows`"""
    share, (end, jump) = (1 + alpha) / 12, rows
    of_strains = [
        (alpha**2 - 3) / 36 * end - (3 + alpha) / 12 * jump,
        (3 + alpha) / 36 * end + jump / 6,
    ]
    of_dampers = [alpha / 6 * end - 0.5 * jump, end / 6 + 0.5 * jump]
    both = jnp.stack(of_strains) / share, jnp.stack(of_dampers) / jnp.sqrt(share)
    return delassus.pulled(jnp.where(delassus.is_strain[None], *both))


def _rates_of_nodes(alpha: Scalar, velocities: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
    """The rates of the increments to the end and to the jump, without multipliers."""
    v1, vj = velocities
    return jnp.stack([0.5 * (v1 + vj), (alpha * vj - v1) / 6])


def velocities_of_nodes(
    alpha: Scalar, free: _Nodes, delassus: DelassusMatrix, by_slip: _Nodes | None = None
) -> tuple[_Nodes, _Rows]:
    """The velocities at both nodes with strains and dampers, and `S` times these.

    `free` are those without; their rates of the joints are kept. `by_slip` is what other
    motions have taken from them.
    """

    def add(_: int, sums: tuple[Array, ...]) -> tuple[Array, ...]:
        rest, joints, total, rows = sums
        once, by_once = delassus.resisted(rest, joints)
        turned = once + _by_adjoint(alpha, by_once, delassus)
        found, by_found = delassus.resisted(turned, joints)
        taken = _resisted(alpha, _rates_of_nodes(alpha, by_found), delassus)
        # What is left moves no joint.
        none = jnp.zeros_like(joints)
        return rest - found - taken, none, total + found, rows + by_found

    joints = jax.vmap(delassus.product)(free)
    rest = free if by_slip is None else free - by_slip
    rows = jnp.zeros((2, delassus.is_strain.size), free.dtype)
    first = rest, joints, jnp.zeros_like(free), rows
    terms = _TERMS if delassus.num_strains else _TERMS_OF_DAMPERS
    _, _, velocities, rows = jax.lax.fori_loop(0, terms, add, first)
    return velocities, rows


def _with_resistance(
    alpha: Scalar,
    free: tuple[Velocities, Velocities],
    slips: tuple[Velocities, Velocities],
    delassus: DelassusMatrix,
) -> tuple[Velocities, Velocities, Float[Array, "2 nc"]]:
    """The velocities `v1` and `vj` with strains and dampers, and the change of the
    multipliers of the joints by their forces.

    `free` are the velocities without, and `slips` those by which rates differ from them,
    `M^-1 C^T eta_1` and `M^-1 C^T eta_j`.
    """
    of_slips = jnp.stack([slips[0], (slips[1] - slips[0]) / 3])
    by_slips = jax.vmap(delassus.elastic_rates)(of_slips)
    by_slip = _resisted(alpha, by_slips, delassus)
    (v1, vj), rows = velocities_of_nodes(alpha, jnp.stack(free), delassus, by_slip)
    taken = _resisted(alpha, _rates_of_nodes(alpha, rows) + by_slips, delassus)
    end, jump = jax.vmap(delassus.product)(taken)
    return v1, vj, delassus.solve(jnp.stack([-end, 3 * jump]))


def skew_chord(rows: Increment, delassus: DelassusMatrix) -> Increment:
    """The correction of a step of order 4, `EnergyConsistent(0)`, with stiff strains:

        v1 = 2 rate - 2 M^-1 C^T eta - M^-1 h^2 K rate / 6
        M v1 + C^T impulse + h^2 K (rate / 2 - v1 / 12) = r_m
        C rate = r_phi,   C v1 = r_psi

    Its denominator `1 + tr A h^2 K + det A (h^2 K)^2` is that of the nodes above for
    `alpha = 0`.
    """
    if delassus.num_strains == 0 or rows.momentum.size > 0:
        return step_chord(rows, delassus)
    inverse, slip = delassus.inverse_inertia, rows.velocity_impulse
    stiff = lambda velocity: 12 * delassus.elastic_force(velocity)
    (own,) = delassus.solve((rows.impulse - 0.5 * slip)[None])
    free = 0.5 * (inverse @ (rows.rate - stiff(delassus.velocity(own)) / 6))
    (held,) = delassus.solve((delassus.product(free) - rows.impulse)[None])
    none = jnp.zeros((), free.dtype)
    without = free - delassus.velocity(held)
    nodes = jnp.stack([without, jnp.zeros_like(without)])
    # The sum of both velocities is `without`, divided by the denominator.
    rate = jnp.sum(velocities_of_nodes(none, nodes, delassus)[0], axis=0)
    moved = inverse @ (stiff(rate) / 12)
    (eta,) = delassus.solve((rows.impulse - 0.5 * slip - delassus.product(moved))[None])
    v1 = 2 * (rate - moved - delassus.velocity(eta))
    force = stiff(0.5 * rate - v1 / 12)
    balance = delassus.product(inverse @ (rows.rate - force)) - slip
    (impulse,) = delassus.solve(balance[None])
    return Increment(impulse, rate, rows.momentum, eta)
