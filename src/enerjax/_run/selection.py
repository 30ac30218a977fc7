"""Where a run stops, or does not begin: good states are kept, others are no numbers."""

import jax
import jax.numpy as jnp

from .._operators import AbstractModel
from .._results import RESULTS
from .._system import State
from .._types import Flag, Scalar
from ..schemes import AbstractScheme


def select(good: Flag, new, old):
    return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)


def nan_unless(good: Flag, tree):
    return jax.tree.map(lambda x: jnp.where(good, x, jnp.nan), tree)


def check_start(
    scheme: AbstractScheme, model: AbstractModel, start: State, h: Scalar
) -> RESULTS:
    """Whether the start satisfies what the scheme holds, to half the digits of a step.

    An error there would stay in the energy balance of the first step. The measure is
    the motion or velocity that would repair it, against those of a step, wherever the
    origin lies.
    """
    scales = model.scales
    root = jnp.sqrt(model.energy_scale(start, h))
    # NaN compares false: a start that cannot be measured fails at its first step.
    tolerance = jnp.sqrt(jnp.finfo(h.dtype).eps)
    position = jnp.abs(model.constraint(start.q, start.t))
    rounding = 1e3 * jnp.finfo(h.dtype).eps * scales.constraint_size
    far = position > 1e2 * tolerance * h * root * scales.constraint + rounding
    bad = jnp.any(far)
    if scheme.stage.formulation == "ggl":
        rate = jnp.abs(model.joint_rate(start.q, start.v, start.t))
        fast = rate > 1e2 * tolerance * root * scales.constraint[: rate.size]
        bad = bad | jnp.any(fast)
    return RESULTS.where(bad, RESULTS.inconsistent_start, RESULTS.successful)
