"""Chord iterations: one approximate inverse serves a whole search.

Where the Jacobian hardly differs from a matrix that is known in closed form, corrections
with that matrix shrink quickly and each costs one evaluation of the residual. The search is
given up as soon as they do not: Newton's method follows.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Count, Flag, Scalar
from .newton import Newton, Start
from .newton_iterations import correction_size, max_norm, powers_of


# The search is given up when a correction is not smaller than the one before by this
# factor: Newton's method is then cheaper.
_SHRINKS = 0.4
# Corrections after which it is given up.
_PATIENCE = 16

Vector = Float[Array, " n"]


class _Chord(eqx.Module):
    """The state of a search.

    - `x`: the unknowns.
    - `size`: of the last correction, relative to the unknowns; infinite before the first.
    - `contraction`: `size` divided by that of the correction before; zero before there
      are two.
    - `corrections`: how many have been made.
    - `defect`: the largest residual at the iterate that was corrected last.
    - `done`, `failed`: whether the search has converged, or is given up.
    """

    x: Vector
    size: Scalar
    contraction: Scalar
    corrections: Count
    defect: Scalar
    done: Flag
    failed: Flag


def chord_iterations(
    value: Callable[[Vector], Vector],
    solve: Callable[[Vector], Vector],
    newton: Newton,
    start: Start,
    guess: Vector,
) -> _Chord:
    """Searches the root of `value` with the corrections `solve(value(x))`."""
    powers = powers_of(guess.dtype)
    zero, infinite = jnp.zeros((), guess.dtype), jnp.full((), jnp.inf, guess.dtype)

    def iteration(before: _Chord) -> _Chord:
        right = value(before.x)
        step = solve(right)
        x = before.x - step
        defect, size = max_norm(right), correction_size(step, x, start.least, powers)
        contraction = size / before.size
        shrinks = contraction < _SHRINKS
        small = size <= powers.small
        # The bound on the next correction: by the contraction so far, which measures the
        # error of the matrix.
        rate = jnp.maximum(contraction, before.contraction)
        is_second = before.corrections > 0
        converged = is_second & shrinks & (size * rate <= newton.rtol * powers.eps)
        converged = converged & (defect <= powers.small)
        is_root = (defect <= newton.atol * powers.eps) & small
        # Corrections that did shrink, and no longer do, have met round-off.
        met = ~shrinks & (before.contraction > 0) & (defect <= powers.round_off) & small
        done = (converged | is_root | met) & jnp.isfinite(size)
        late = before.corrections + 1 >= _PATIENCE
        return _Chord(
            x=jnp.where(met & ~is_root, before.x, x),
            size=size,
            contraction=jnp.where(is_second, contraction, zero),
            corrections=before.corrections + 1,
            defect=defect,
            done=done,
            failed=~done & (~shrinks | late | ~jnp.isfinite(size)),
        )

    first = _Chord(
        x=guess,
        size=infinite,
        contraction=zero,
        corrections=jnp.array(0),
        defect=zero,
        done=start.skip,
        failed=jnp.array(False),
    )
    return jax.lax.while_loop(lambda c: ~(c.done | c.failed), iteration, first)
