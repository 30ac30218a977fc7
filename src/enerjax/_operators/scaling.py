"""The scaling of the step equations to order one, and estimates of the local error."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._system import State
from .._types import Increments, Scalar
from .base import AbstractModel
from .interval import Increment


# The smallest scale of the balance of momentum, as a fraction of the size of the forces.
# Larger scales would end Newton's method too early where springs are stiff.
_ROUND_OFF_PART = 0.01


def scales_like(
    z: PyTree[Any], model: AbstractModel, start: State, h: Scalar
) -> tuple[PyTree[Any], PyTree[Any], Scalar]:
    """The scales of the unknowns in `z`, those of the rows, and `least` of `find_root`.

    Scaled unknowns can be much smaller than one: a stiff spring stops a body long before
    its force has acted for a whole step. Below `least` they are round-off.
    """
    scales = model.scales
    root = jnp.sqrt(model.energy_scale(start, h))
    forces = jnp.abs(h) * model.force_size(start)
    # At rest the computed unknowns are round-off of the forces and of the coordinates.
    # Newton's corrections are measured relative to the unknowns, so they need this floor.
    rounding = jnp.maximum(
        jnp.linalg.norm(forces / scales.step),
        jnp.linalg.norm(scales.coordinate * start.q / h),
    )
    small = jnp.finfo(h.dtype).eps ** 0.5
    least = small * jax.lax.stop_gradient(rounding)
    unit = jnp.maximum(root, least)
    is_increment = lambda x: isinstance(x, Increment)

    def unknown(x):
        if not is_increment(x):
            return jnp.ones_like(x)
        joint = scales.constraint[: x.velocity_impulse.size]
        # Increments without a rate have only multipliers.
        rate = unit / scales.step if x.rate.size > 0 else x.rate
        momentum = (unit * scales.step)[: x.momentum.size]
        impulse = (unit / scales.constraint)[: x.impulse.size]
        return Increment(impulse, rate, momentum, unit / joint)

    def row(x):
        if not is_increment(x):
            return jnp.ones_like(x)
        joint = scales.constraint[: x.velocity_impulse.size]
        # A constraint is a difference of terms that can be much larger than their change
        # in a step. Its row cannot be more accurate than the round-off of these terms.
        position = root * scales.constraint + scales.constraint_size / jnp.abs(h)
        # Likewise, the balance of momentum is limited by the round-off of the forces.
        momentum = jnp.maximum(root * scales.step, _ROUND_OFF_PART * forces)
        momentum = momentum if x.rate.size > 0 else x.rate
        rate = (root / scales.step)[: x.momentum.size]
        return Increment(position[: x.impulse.size], momentum, rate, root * joint)

    unknowns, rows = (jax.tree.map(f, z, is_leaf=is_increment) for f in (unknown, row))
    return unknowns, rows, jnp.clip(least / root, small, 1.0)


def roughness(
    inertia: Increments,
    differences: PyTree[Any],
    before: PyTree[Any],
    per_unknown: PyTree[Any],
) -> Float[Array, " 3"]:
    """The norms of the second and third differences of the velocities of the last steps.

    `differences` and `before` are those of `Memory` after this step and before it.
    `inertia` is the scale `step` of `Scales`, and `per_unknown` are the reciprocals of the
    scales of the unknowns. Returns the norm of the second difference and that of the third
    (square root of an energy), and the norm of the scaled second difference. They have zero
    derivatives.
    """
    is_increment = lambda x: isinstance(x, Increment)
    leaves = lambda z: jax.tree.leaves(z, is_leaf=is_increment)
    ends = lambda z: list(filter(is_increment, leaves(z)))[-1].rate
    new, old = ends(differences), ends(before)
    size = lambda x: jnp.linalg.norm(x * inertia)
    # The larger of two successive differences, because one of them can pass through zero.
    second = jnp.maximum(size(new[2]), size(old[2]))
    part = jnp.linalg.norm(new[2] * ends(per_unknown))
    return jax.lax.stop_gradient(jnp.stack([second, size(new[3]), part]))


def local_error(sizes: Float[Array, "stages 3"], order: int) -> Scalar:
    """An estimate of the local error of the velocities (square root of an energy).

    `sizes` are the values of `roughness`. The estimate for order 2 is a sixth of the second
    difference, as for the trapezoidal rule. The ratio of the third to the second difference
    estimates the phase angle `omega h` of a step. For methods of higher order, the estimate
    is multiplied by a power of that angle and divided by a constant of Gauss methods. It is
    not reduced where the step does not resolve the motion, which shows in alternating
    differences that are not small relative to the velocities.
    """
    second, third, part = sizes.T
    angle = jnp.clip(third / jnp.where(second > 0, second, 1), _LEAST_ANGLE, 2.0)
    resolved = (angle < _RESOLVED) | (part < _SMALL_DIFFERENCE)
    better = jnp.where(resolved, angle ** (order - 2) / _ERROR_RATIO[order], 1.0)
    return jnp.sum(better * second) / 6


# The phase angle above which a step does not resolve the motion; the smallest phase angle
# (a method of order 1 divides by it); and the scaled size of a second difference below
# which the motion counts as resolved at any angle.
_RESOLVED = 1.2
_LEAST_ANGLE = 1e-3
_SMALL_DIFFERENCE = 0.3
# The error of the midpoint rule over that of a method of this order, at a phase angle of 1.
_ERROR_RATIO = {1: 1.0, 2: 1.0, 3: 6.0, 4: 60.0, 6: 8400.0, 8: 2.1e6}


def shortened(flight: PyTree[Any], part: float) -> PyTree[Any]:
    """The unknowns of a free flight with its rates multiplied by `part`."""
    is_increment = lambda x: isinstance(x, Increment)
    way = lambda x: eqx.tree_at(lambda x: x.rate, x, part * x.rate)
    change = lambda x: way(x) if is_increment(x) else x
    return jax.tree.map(change, flight, is_leaf=is_increment)
