"""The initial guesses of Newton's method, extrapolated from the last steps."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._solvers import AbstractFactors, max_norm, Root
from .._types import Count, Scalar


# The numbers of steps from which the candidates for a prediction are extrapolated, and by
# how many times an extrapolation must have been better than those of fewer steps. In steps
# that do not resolve the motion, the one of five steps leads to other roots.
_CANDIDATES, _BETTER = (1, 3, 5), (1, 1, 10)
# The number of steps whose unknowns are kept.
_NUM_KEPT = max(_CANDIDATES)
# The number of steps without the chord method after it has failed. The causes of a failure
# (stiff forces, fast rotations) usually last for several steps, and each attempt costs a
# few evaluations of the residual.
_CHORD_WAITS = 10


class Memory(eqx.Module):
    """The data of the last steps that a solve uses.

    - `added`: the unknowns of the last five steps minus those of a free flight, newest
      first.
    - `choice`: the number of the candidate for the next prediction; see `predicted`.
    - `factors`: the factors of the Jacobians of the last three steps, newest first; `None`
      for large systems, and where the chord method is used.
    - `chord_wait`: the number of steps until the chord method is tried again; `None` where
      the equations have no chord method.
    - `carried`: the data that a scheme with a memory passes to its next step; `None` for
      other schemes.
    """

    added: PyTree[Any]
    choice: Count
    factors: AbstractFactors | None
    chord_wait: Count | None
    carried: PyTree[Any]


def initial_memory(
    added: PyTree[Any],
    factors: AbstractFactors | None,
    chord_wait: Count | None,
    carried: PyTree[Any],
) -> Memory:
    """The memory before the first step, which is predicted to add `added`."""
    repeated = lambda tree, count: jax.tree.map(lambda x: jnp.stack([x] * count), tree)
    return Memory(
        added=jax.lax.stop_gradient(repeated(added, _NUM_KEPT)),
        choice=jnp.array(0),
        factors=repeated(factors, 3),
        chord_wait=chord_wait,
        carried=carried,
    )


def predicted(memory: Memory) -> PyTree[Any]:
    """The predicted difference between the unknowns of a step and those of a free flight.

    For a motion that changes quickly it is the difference of the last step. For a smooth
    one it is the quadratic extrapolation of the last three steps, and for short steps that
    of degree four from five. The last step decides: the candidate is chosen that would have
    been best for it, that of degree four only if it would have been ten times better.
    """
    candidates = _candidates(memory)

    def chosen(*xs: Array) -> Array:
        x = xs[0]
        for k, other in enumerate(xs[1:], 1):
            x = jnp.where(memory.choice == k, other, x)
        return x

    return jax.tree.map(chosen, *candidates)


def _candidates(memory: Memory) -> tuple[PyTree[Any], ...]:
    of = lambda count: lambda x: extrapolated(x[:count])
    return tuple(jax.tree.map(of(count), memory.added) for count in _CANDIDATES)


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

    errors = [error(guess) for guess in _candidates(memory)]
    least, choice = errors[0], jnp.zeros_like(memory.choice)
    for k, each in enumerate(errors[1:], 1):
        is_best = _BETTER[k] * each <= least
        choice = jnp.where(is_best, jnp.asarray(k, choice.dtype), choice)
        least = jnp.minimum(each, least)
    # A search by the chord method alone has no factors; those of earlier steps are kept.
    factors = memory.factors
    if root.factors is not None:
        factors = jax.tree.map(_shifted, root.factors, memory.factors)
    return Memory(
        added=jax.tree.map(_shifted, added, memory.added),
        choice=choice,
        factors=factors,
        chord_wait=_wait_after(memory.chord_wait, root),
        carried=carried,
    )


def _wait_after(wait: Count | None, root: Root) -> Count | None:
    if wait is None:
        return None
    passed = jnp.where(root.by_chord, 0, _CHORD_WAITS)
    return jnp.where(wait == 0, passed, wait - 1).astype(wait.dtype)


def extrapolated(x: Array | Sequence[Array]) -> Array:
    """The value after equidistant values, newest first, by the polynomial through them."""
    count = len(x)
    total = count * x[0]
    for k in range(1, count):
        total = total + (-1) ** k * math.comb(count, k + 1) * x[k]
    return total


def _shifted(new: Array, old: Array) -> Array:
    """The last values after a step with the value `new`, as many as before."""
    return jnp.concatenate([new[None], old[:-1]])


def for_length(
    memory: Memory, stages: tuple[float, ...], before: Float[Array, "3"], length: Scalar
) -> Memory:
    """Converts the stacked memory of the stages of steps with the lengths `before`, newest
    first, to steps of the length `length`.

    What a step adds to a free flight is proportional to its length, so their quotient is
    extrapolated quadratically from the midpoints of the three steps. `solve` extrapolates
    steps of equal lengths: the entries are chosen such that it finds this value, or the
    last one.
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
        # A parabola through the last value and, after it, the extrapolated one.
        last, rise = length * rates[0], length * (smooth - rates[0])
        values = [last + 0.5 * k * (k - 1) * rise for k in range(_NUM_KEPT)]
        return jnp.stack(values, axis=1)

    added = jax.tree.map(resampled, memory.added)
    return eqx.tree_at(lambda memory: memory.added, memory, added)


def with_history(new: Memory, old: Memory) -> Memory:
    """The last step of the stacked memory `new`, and before it the steps of `old`."""
    join = lambda x, y: jnp.concatenate([x[:, :1], y[:, :-1]], axis=1)
    added = jax.tree.map(join, new.added, old.added)
    return eqx.tree_at(lambda memory: memory.added, new, added)
