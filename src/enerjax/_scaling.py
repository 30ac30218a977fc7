"""What scales the step equations to order one, so that Newton needs to know no units."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from ._model import AbstractModel, Increment
from ._system import State
from ._types import Scalar


def scales_like(
    z: PyTree[Any], model: AbstractModel, start: State, h: Scalar
) -> tuple[PyTree[Any], PyTree[Any]]:
    """The sizes of the unknowns in `z`, and of the rows that stand in their places."""
    scales = model.scales
    root = jnp.sqrt(model.energy_scale(start, h))
    is_increment = lambda x: isinstance(x, Increment)

    def unknown(x):
        if not is_increment(x):
            return jnp.ones_like(x)
        joint = scales.constraint[: x.velocity_impulse.size]
        rate = root / scales.coordinate
        momentum = (root * scales.coordinate)[: x.momentum.size]
        impulse = (root / scales.constraint)[: x.impulse.size]
        return Increment(rate, momentum, impulse, root / joint)

    def row(x):
        if not is_increment(x):
            return jnp.ones_like(x)
        joint = scales.constraint[: x.velocity_impulse.size]
        # A constraint is a difference of numbers that can be large against what a step
        # changes: its rows are resolved to the round-off of those.
        position = root * scales.constraint + scales.constraint_size / jnp.abs(h)
        momentum = root * scales.coordinate
        rate = (root / scales.coordinate)[: x.momentum.size]
        return Increment(momentum, rate, position[: x.impulse.size], root * joint)

    return tuple(jax.tree.map(f, z, is_leaf=is_increment) for f in (unknown, row))  # pyright: ignore
