"""The chord method: all corrections of a search use one approximate Jacobian.

Where the Jacobian is close to a matrix whose inverse is known in closed form, corrections
with that inverse reduce the residual quickly, and each of them costs one evaluation of the
residual. If they do not reduce it quickly, the search stops and Newton's method follows.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Count, Flag, Scalar
from .newton import Newton, Start
from .newton_iterations import correction_size, max_norm, powers_of


# The search stops without a root where two corrections in a row leave more than the square
# of this fraction of the residual: Newton's method is then cheaper. A single correction can
# leave more, because residuals of the two constraint levels shrink in turn.
_SHRINKS = 0.5
# The smallest contraction that the estimate of the next residual assumes. For the same
# reason a single quotient can be far too small: without this bound two hinged bodies in
# space leak 3e-15 J a step; with it, 1e-16 J.
_LEAST_CONTRACTION = 1e-2
# The search also stops without a root after this many corrections. Without Newton's method
# behind it the whole run would have to be made again, so more of them are worth a try.
PATIENCE, PATIENCE_ALONE = 16, 24

Vector = Float[Array, " n"]


class _Chord(eqx.Module):
    """The state of a search.

    - `x`: the unknowns.
    - `defect`: the largest residual at the iterate that was corrected last; infinite
      before the first correction.
    - `contraction`: `defect` divided by the `defect` of the correction before; zero before
      the second correction.
    - `corrections`: the number of corrections so far.
    - `has_shrunk`: whether a correction has reduced the residual quickly.
    - `done`, `failed`: whether the search has converged, or has stopped without a root.
    """

    x: Vector
    defect: Scalar
    contraction: Scalar
    corrections: Count
    has_shrunk: Flag
    done: Flag
    failed: Flag


def chord_iterations(
    value: Callable[[Vector], Vector],
    solve: Callable[[Vector], Vector],
    newton: Newton,
    start: Start,
    guess: Vector,
    patience: int,
    is_elastic: bool,
) -> _Chord:
    """Searches a root of `value` with at most `patience` corrections `solve(value(x))`.

    Convergence is measured mainly by the residual. Corrections alone would be misleading:
    the multipliers of the velocity-level constraints are small and poorly determined,
    although their equations are satisfied accurately.
    """
    powers = powers_of(guess)

    def iteration(before: _Chord) -> _Chord:
        right = value(before.x)
        step = solve(right)
        x = before.x - step
        defect, size = max_norm(right), correction_size(step, x, start.least, powers)
        contraction = defect / before.defect
        rate = jnp.maximum(contraction, before.contraction)
        rate = jnp.maximum(rate, _LEAST_CONTRACTION)
        # An estimate of the residual after this correction. The first correction has no
        # contraction to estimate it from.
        left = jnp.where(before.corrections > 0, rate, 1.0) * defect
        # A light, slow body contributes little to the residual beside a heavy, fast one, so
        # the correction must be small too.
        done = (left <= newton.rtol * powers.eps) & (rate * size <= powers.moderate)
        done = done | ((defect <= newton.atol * powers.eps) & (size <= powers.small))
        # A residual of almost round-off size that stops decreasing is round-off.
        shrinks = contraction < _SHRINKS
        done = done | (~shrinks & (defect <= powers.round_off) & (size <= powers.small))
        stalls = ~shrinks & ~(contraction * before.contraction < _SHRINKS**2)
        # So is a larger one, if corrections have reduced it and two in a row no longer do:
        # the inertia of an arm is ill-conditioned, and its rates have few exact digits.
        is_floor = stalls & before.has_shrunk & (defect <= powers.stalled(is_elastic))
        # The corrections of singular equations do not show rows that contradict each other,
        # so a small correction proves nothing there.
        if start.regularisation is None:
            done = done | (is_floor & (size <= powers.small))
        # One correction alone may leave a light, slow body where it was predicted.
        done = done & jnp.isfinite(size) & (before.corrections > 0)
        late = before.corrections + 1 >= patience
        return _Chord(
            x=x,
            defect=defect,
            contraction=contraction,
            corrections=before.corrections + 1,
            has_shrunk=before.has_shrunk | (shrinks & (before.corrections > 0)),
            done=done,
            failed=~done & (stalls | late | ~jnp.isfinite(size)),
        )

    first = _Chord(
        x=guess,
        defect=jnp.full((), jnp.inf, guess.dtype),
        contraction=jnp.zeros((), guess.dtype),
        corrections=jnp.array(0),
        has_shrunk=jnp.array(False),
        done=start.skip,
        failed=~start.by_chord,
    )
    return jax.lax.while_loop(lambda c: ~(c.done | c.failed), iteration, first)
