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

    - `differences`: what the last step has added to the unknowns of a free flight, and the
      backward differences of this over the last five steps, of the orders one to four.
    - `choice`: the number of the candidate for the next prediction; see `predicted`.
    - `factors`: the factors of the Jacobians of the last three steps, newest first; `None`
      for large systems, and where the chord method is used.
    - `chord_wait`: the number of steps until the chord method is tried again; `None` where
      the equations have no chord method.
    - `carried`: the data that a scheme with a memory passes to its next step; `None` for
      other schemes.
    """

    differences: PyTree[Any]
    choice: Count
    factors: AbstractFactors | None
    chord_wait: Count | None
    carried: PyTree[Any]

    @property
    def added(self) -> PyTree[Any]:
        """What the last step has added to the unknowns of a free flight."""
        return jax.tree.map(lambda x: x[0], self.differences)


def initial_memory(
    added: PyTree[Any],
    factors: AbstractFactors | None,
    chord_wait: Count | None,
    carried: PyTree[Any],
) -> Memory:
    """The memory before the first step, which is predicted to add `added`."""
    steady = lambda x: jnp.stack([x] + [jnp.zeros_like(x)] * (_NUM_KEPT - 1))
    return Memory(
        differences=jax.lax.stop_gradient(jax.tree.map(steady, added)),
        choice=jnp.array(0),
        factors=jax.tree.map(lambda x: jnp.stack([x] * 3), factors),
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

    def chosen(differences: Array) -> Array:
        total = best = differences[0]
        for k in range(1, len(_CANDIDATES)):
            # An extrapolated value is the sum of the differences.
            for difference in differences[_CANDIDATES[k - 1] : _CANDIDATES[k]]:
                total = total + difference
            best = jnp.where(memory.choice == k, total, best)
        return best

    return jax.tree.map(chosen, memory.differences)


def differences_after(added: PyTree[Any], before: PyTree[Any]) -> PyTree[Any]:
    """The differences after a step that adds `added`.

    They go one order higher than those `before` it.
    """

    def after(x: Array, old: Array) -> Array:
        new = [x]
        for difference in old:
            new.append(new[-1] - difference)
        return jnp.stack(new)

    return jax.tree.map(after, added, before)


def memory_after(
    memory: Memory,
    differences: PyTree[Any],
    per_unknown: PyTree[Any],
    root: Root,
    carried: PyTree[Any],
) -> Memory:
    """The memory after a step; `differences` are the result of `differences_after`.

    `per_unknown` are the reciprocals of the scales of the unknowns.
    """

    def error(count: int) -> Scalar:
        # The error of an extrapolation from `count` steps is the difference of this order.
        scaled = lambda x, factor: x[count] * factor
        return max_norm(jax.tree.map(scaled, differences, per_unknown))

    errors = [error(count) for count in _CANDIDATES]
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
        differences=jax.tree.map(lambda x: x[:_NUM_KEPT], differences),
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
    steps of equal lengths: the differences are chosen such that all candidates but the
    first, which is the last value, are this value.
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
        newest, first, second = x[:, 0], x[:, 1], x[:, 2]
        steps = newest, newest - first, newest - 2 * first + second
        rates = [step / each for step, each in zip(steps, before, strict=True)]
        smooth = sum(shaped(w) * rate for w, rate in zip(weights, rates, strict=True))
        last, rise = length * rates[0], length * (smooth - rates[0])
        # The second difference of a parabola is what its extrapolation adds.
        zero = jnp.zeros_like(last)
        return jnp.stack([last, zero, rise, zero, zero], axis=1)

    differences = jax.tree.map(resampled, memory.differences)
    return eqx.tree_at(lambda memory: memory.differences, memory, differences)


def with_history(new: Memory, old: Memory) -> Memory:
    """The last step of the stacked memory `new`, and before it the steps of `old`."""
    newest = jax.tree.map(lambda x: x[:, 0], new.differences)
    after = jax.vmap(differences_after)(newest, old.differences)
    differences = jax.tree.map(lambda x: x[:, :_NUM_KEPT], after)
    return eqx.tree_at(lambda memory: memory.differences, new, differences)
