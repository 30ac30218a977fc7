"""What scales the step equations to order one, so that Newton needs to know no units."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._system import State
from .._types import Coordinates, Scalar
from .base import AbstractModel
from .interval import Increment


# What Newton may try to resolve of that round-off. It stops where corrections no longer
# shrink; a floor at the round-off itself would let stiff springs stop it before.
_BEYOND = 0.01


def scales_like(
    z: PyTree[Any], model: AbstractModel, start: State, h: Scalar
) -> tuple[PyTree[Any], PyTree[Any], Scalar]:
    """The sizes of the unknowns in `z`, and of the rows that stand in their places.

    Unknowns can turn out smaller: a stiff spring stops a body long before its force has
    acted for all of a step. The last value is the part down to which it is not round-off.
    """
    scales = model.scales
    root = jnp.sqrt(model.energy_scale(start, h))
    forces = jnp.abs(h) * model.force_size(start)
    # At rest the unknowns are the round-off of the rows, which is far below their floor,
    # and of the coordinates; Newton compares its corrections with their size.
    rounding = jnp.maximum(
        forces / scales.coordinate, scales.coordinate * jnp.abs(start.q / h)
    )
    small = jnp.finfo(h.dtype).eps ** 0.5
    least = small * jax.lax.stop_gradient(jnp.linalg.norm(rounding))
    unit = jnp.maximum(root, least)
    is_increment = lambda x: isinstance(x, Increment)

    def unknown(x):
        if not is_increment(x):
            return jnp.ones_like(x)
        joint = scales.constraint[: x.velocity_impulse.size]
        rate = unit / scales.coordinate
        momentum = (unit * scales.coordinate)[: x.momentum.size]
        impulse = (unit / scales.constraint)[: x.impulse.size]
        return Increment(impulse, rate, momentum, unit / joint)

    def row(x):
        if not is_increment(x):
            return jnp.ones_like(x)
        joint = scales.constraint[: x.velocity_impulse.size]
        # A constraint is a difference of numbers that can be large against what a step
        # changes: its rows are resolved to the round-off of those.
        position = root * scales.constraint + scales.constraint_size / jnp.abs(h)
        # Those of the momenta not much beyond the round-off of the terms of the forces.
        momentum = jnp.maximum(root * scales.coordinate, _BEYOND * forces)
        rate = (root / scales.coordinate)[: x.momentum.size]
        return Increment(position[: x.impulse.size], momentum, rate, root * joint)

    unknowns, rows = (jax.tree.map(f, z, is_leaf=is_increment) for f in (unknown, row))
    return unknowns, rows, jnp.clip(least / root, small, 1.0)


def roughness(
    coordinate: Coordinates, added: PyTree[Any], before: PyTree[Any], unit: PyTree[Any]
) -> Float[Array, " 3"]:
    """How large the second and the third difference of velocities are, from step to step.

    Of what steps add to a free flight, this one and the three before: in the square root
    of an energy, without derivatives. And the second in parts of that of the step, by the
    units of the unknowns.
    """
    is_increment = lambda x: isinstance(x, Increment)
    leaves = lambda z: jax.tree.leaves(z, is_leaf=is_increment)
    ends = lambda z: list(filter(is_increment, leaves(z)))[-1].rate
    rates = jnp.concatenate([ends(added)[None], ends(before)])
    new, old = jnp.diff(rates, n=2, axis=0)
    size = lambda x: jnp.linalg.norm(x * coordinate)
    # The larger of two: a difference that passes through zero is no sign of anything.
    second = jnp.maximum(size(new), size(old))
    part = jnp.linalg.norm(new / ends(unit))
    return jax.lax.stop_gradient(jnp.stack([second, size(new - old), part]))


def local_error(sizes: Float[Array, "stages 3"], order: int) -> Scalar:
    """What a step is off by, in velocities, as the square root of an energy.

    Of the trapezoidal rule a sixth of the second difference. Methods of higher order are
    better by powers of the angle in a step, which the third difference tells, and by the
    constants of Gauss' methods; not where the motion is not resolved: where differences
    alternate, and a step is off by a good part of its velocities.
    """
    second, third, part = sizes.T
    angle = jnp.clip(third / jnp.where(second > 0, second, 1), _LEAST_ANGLE, 2.0)
    resolved = (angle < _RESOLVED) | (part < _CALM)
    better = jnp.where(resolved, angle ** (order - 2) / _BETTER[order], 1.0)
    return jnp.sum(better * second) / 6


# An angle in a step beyond which no order helps, and one that is not told from none (a
# method of order 1 divides by it); and the size of a second difference that is no noise.
_RESOLVED = 1.2
_LEAST_ANGLE = 1e-3
_CALM = 0.3
# The error of the midpoint rule over that of a method of this order, at an angle of one.
_BETTER = {1: 1.0, 2: 1.0, 3: 6.0, 4: 60.0, 6: 8400.0, 8: 2.1e6}


def shortened(flight: PyTree[Any], part: float) -> PyTree[Any]:
    """A free flight that goes a part of the way."""
    is_increment = lambda x: isinstance(x, Increment)
    way = lambda x: eqx.tree_at(lambda x: x.rate, x, part * x.rate)
    change = lambda x: way(x) if is_increment(x) else x
    return jax.tree.map(change, flight, is_leaf=is_increment)
