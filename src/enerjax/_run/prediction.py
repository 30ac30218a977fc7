"""Initial guesses of Newton's method after steps of other lengths."""

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
    """Converts the memory of steps with the lengths `before`, newest first, to steps of
    the length `length`.

    What a step adds to a free flight is proportional to its length, so their quotient is
    extrapolated quadratically from the midpoints of the three steps. `solve` extrapolates
    `3 x0 - 3 x1 + x2`, or repeats `x0`: the entries are chosen such that it finds the
    extrapolated value, or the last one.
    """
    ends = np.cumsum(stages)
    # The midpoint of a backward stage may lie outside of the step, hence the clipping.
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
    """The last step of `new`, and before it the steps of `old`."""
    join = lambda x, y: jnp.concatenate([x[:, :1], y[:, :2]], axis=1)
    added = jax.tree.map(join, new.stages.added, old.stages.added)
    return eqx.tree_at(lambda warm: warm.stages.added, new, added)
