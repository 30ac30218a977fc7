"""The initial guesses of Newton's method, extrapolated from the last steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._solvers import AbstractFactors, max_norm, Root
from .._types import Count, Flag, Scalar


# The number of steps without the chord method after it has failed. The causes of a failure
# (stiff forces, fast rotations) usually last for several steps, and each attempt costs a
# few evaluations of the residual.
_CHORD_WAITS = 10


class Memory(eqx.Module):
    """The data of the last steps that a solve uses.

    - `added`: the unknowns of the last three steps minus those of a free flight, newest
      first.
    - `is_smooth`: whether the extrapolation of `added` was a better guess for the last step
      than the step before it.
    - `factors`: the factors of the Jacobians of the last three steps, newest first; `None`
      for large systems, and where the chord method is used.
    - `chord_wait`: the number of steps until the chord method is tried again; `None` where
      the equations have no chord method.
    - `carried`: the data that a scheme with a memory passes to its next step; `None` for
      other schemes.
    """

    added: PyTree[Any]
    is_smooth: Flag
    factors: AbstractFactors | None
    chord_wait: Count | None
    carried: PyTree[Any]


def predicted(memory: Memory) -> PyTree[Any]:
    """The predicted difference between the unknowns of a step and those of a free flight.

    For a smooth motion this is an extrapolation of the last three steps, and for one that
    changes quickly it is the difference of the last step. The choice is the one that would
    have been better for the last step. An extrapolation of four steps needs fewer
    corrections in short steps, but more searches fail in long ones.
    """
    smooth, last = _candidates(memory)
    choose = lambda x, y: jnp.where(memory.is_smooth, x, y)
    return jax.tree.map(choose, smooth, last)


def _candidates(memory: Memory) -> tuple[PyTree[Any], PyTree[Any]]:
    """The two predictions: the extrapolation, and the difference of the last step."""
    smooth = jax.tree.map(extrapolated, memory.added)
    return smooth, jax.tree.map(lambda x: x[0], memory.added)


def memory_after(
    memory: Memory,
    added: PyTree[Any],
    unknown_scale: PyTree[Any],
    root: Root,
    carried: PyTree[Any],
) -> Memory:
    """The memory after a step whose difference from a free flight is `added`."""

    def error(guess: PyTree[Any]) -> Scalar:
        difference = lambda x, y, unit: (x - y) / unit
        return max_norm(jax.tree.map(difference, added, guess, unknown_scale))

    smooth, last = _candidates(memory)
    # A search by the chord method alone has no factors; those of earlier steps are kept.
    factors = memory.factors
    if root.factors is not None:
        factors = jax.tree.map(_shifted, root.factors, memory.factors)
    return Memory(
        added=jax.tree.map(_shifted, added, memory.added),
        is_smooth=error(smooth) <= error(last),
        factors=factors,
        chord_wait=_wait_after(memory.chord_wait, root),
        carried=carried,
    )


def _wait_after(wait: Count | None, root: Root) -> Count | None:
    if wait is None:
        return None
    passed = jnp.where(root.by_chord, 0, _CHORD_WAITS)
    return jnp.where(wait == 0, passed, wait - 1).astype(wait.dtype)


def extrapolated(x: Array) -> Array:
    """The quadratic extrapolation of the last three values, which are newest first."""
    return 3 * x[0] - 3 * x[1] + x[2]


def _shifted(new: Array, old: Array) -> Array:
    """The last three values after a step with the value `new`."""
    return jnp.stack([new, old[0], old[1]])


def for_length(
    memory: Memory, stages: tuple[float, ...], before: Float[Array, "3"], length: Scalar
) -> Memory:
    """Converts the stacked memory of the stages of steps with the lengths `before`, newest
    first, to steps of the length `length`.

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

    added = jax.tree.map(resampled, memory.added)
    return eqx.tree_at(lambda memory: memory.added, memory, added)


def with_history(new: Memory, old: Memory) -> Memory:
    """The last step of the stacked memory `new`, and before it the steps of `old`."""
    join = lambda x, y: jnp.concatenate([x[:, :1], y[:, :2]], axis=1)
    added = jax.tree.map(join, new.added, old.added)
    return eqx.tree_at(lambda memory: memory.added, new, added)
