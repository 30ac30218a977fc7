"""Chord iterations: one approximate inverse serves a whole search.

Where the Jacobian hardly differs from a matrix that is known in closed form, corrections
with that matrix shrink the residual quickly, and each costs one evaluation of it. The
search is given up as soon as they do not: Newton's method follows.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Count, Flag, Scalar
from .newton import Newton, Start
from .newton_iterations import correction_size, max_norm, powers_of


# The search is given up where a correction leaves more than this part of the residual:
# Newton's method is then cheaper.
_SHRINKS = 0.5
# Corrections after which it is given up.
_PATIENCE = 16

Vector = Float[Array, " n"]


class _Chord(eqx.Module):
    """The state of a search.

    - `x`: the unknowns.
    - `defect`: the largest residual at the iterate that was corrected last; infinite
      before the first correction.
    - `contraction`: `defect` divided by the one before; zero before there are two.
    - `corrections`: how many have been made.
    - `done`, `failed`: whether the search has converged, or is given up.
    """

    x: Vector
    defect: Scalar
    contraction: Scalar
    corrections: Count
    done: Flag
    failed: Flag


def chord_iterations(
    value: Callable[[Vector], Vector],
    solve: Callable[[Vector], Vector],
    newton: Newton,
    start: Start,
    guess: Vector,
) -> _Chord:
    """Searches the root of `value` with the corrections `solve(value(x))`.

    Residuals decide, because some unknowns are small and not well determined: those of the
    velocity-level constraints, whose rows are.
    """
    powers = powers_of(guess.dtype)

    def iteration(before: _Chord) -> _Chord:
        right = value(before.x)
        step = solve(right)
        x = before.x - step
        defect, size = max_norm(right), correction_size(step, x, start.least, powers)
        contraction = defect / before.defect
        rate = jnp.maximum(contraction, before.contraction)
        # The residual that this correction leaves; unknown after the first.
        left = jnp.where(before.corrections > 0, rate, 1.0) * defect
        # A light, slow body beside a heavy, fast one has a small residual: corrections must
        # be small too.
        done = (left <= newton.rtol * powers.eps) & (rate * size <= powers.moderate)
        done = done | ((defect <= newton.atol * powers.eps) & (size <= powers.small))
        # A residual that is almost round-off, and shrinks no longer, is round-off.
        shrinks = contraction < _SHRINKS
        done = done | (~shrinks & (defect <= powers.round_off) & (size <= powers.small))
        done = done & jnp.isfinite(size)
        late = before.corrections + 1 >= _PATIENCE
        return _Chord(
            x=x,
            defect=defect,
            contraction=contraction,
            corrections=before.corrections + 1,
            done=done,
            failed=~done & (~shrinks | late | ~jnp.isfinite(size)),
        )

    first = _Chord(
        x=guess,
        defect=jnp.full((), jnp.inf, guess.dtype),
        contraction=jnp.zeros((), guess.dtype),
        corrections=jnp.array(0),
        done=start.skip,
        failed=~start.by_chord,
    )
    return jax.lax.while_loop(lambda c: ~(c.done | c.failed), iteration, first)
