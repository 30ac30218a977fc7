"""What steps of other lengths leave for the next: the guess that Newton begins from."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from .step import Warm


def for_length(
    warm: Warm, stages: tuple[float, ...], before: Float[Array, "3"], length: Scalar
) -> Warm:
    """The memory of steps of the lengths `before`, newest first, as one of equal steps.

    What a step adds to a free flight grows like its length, so the quotient of both is
    extrapolated, over the distances between the middles of the steps. `solve` itself
    extrapolates `3 x0 - 3 x1 + x2`, or repeats `x0`: entries that make it find both.
    """
    ends = np.cumsum(stages)
    # Of a backward stage the middle may lie outside of the step; distances stay positive.
    middle = jnp.asarray(np.clip(ends - 0.5 * np.asarray(stages), 0, 1), length.dtype)
    a, b, c = before
    first = (1 - middle) * a + middle * length
    second = first + (1 - middle) * b + middle * a
    third = second + (1 - middle) * c + middle * b
    weights = (
        second * third / ((second - first) * (third - first)),
        -first * third / ((second - first) * (third - second)),
        first * second / ((third - first) * (third - second)),
    )

    def resampled(x: Array) -> Array:
        shaped = lambda w: w.reshape(-1, *[1] * (x.ndim - 2))
        rates = x[:, 0] / a, x[:, 1] / b, x[:, 2] / c
        smooth = sum(shaped(w) * rate for w, rate in zip(weights, rates, strict=True))
        last = length * rates[0]
        return jnp.stack([last, last, length * smooth], axis=1)

    added = jax.tree.map(resampled, warm.stages.added)
    return eqx.tree_at(lambda warm: warm.stages.added, warm, added)


def with_history(new: Warm, old: Warm) -> Warm:
    """`new`, whose last step is as it was, and those before as they are in `old`."""
    join = lambda x, y: jnp.concatenate([x[:, :1], y[:, :2]], axis=1)
    added = jax.tree.map(join, new.stages.added, old.stages.added)
    return eqx.tree_at(lambda warm: warm.stages.added, new, added)
