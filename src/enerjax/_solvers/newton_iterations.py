"""The iterations of Newton's method, for unknowns and residuals scaled to order one.

An iteration computes a correction and compares its size with that of the correction before.
It then accepts the correction, halves the correction before, or requests a new Jacobian.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._types import Count, Flag, Scalar
from .linear.dense import AbstractFactors
from .linear.jacobian import Linearisable
from .linear.norms import largest
from .newton import Newton, Start


# Thresholds of the method -----------------------------------------------------------------

# The number of Jacobians of the first attempt, which takes whole corrections if they halve
# the residual. Unknowns that pass through zero have large relative corrections, so that the
# test of P. Deuflhard halves good ones; but coarse steps of stiff springs need that test.
_FIRST_PATIENCE = 6
# The number of Jacobians after which a search continues from another guess. Searches that
# converge quadratically need fewer.
PATIENCE = 12
# The number of Jacobians of an attempt without damping. The limit was found with a double
# pendulum whose inner mass is 200 times lighter, at h = 0.01: roots that such an attempt
# finds with up to 20 Jacobians continue the motion, and later ones usually do not.
_UNDAMPED_PATIENCE = 20
# A Jacobian is kept while each correction is smaller than the one before by this factor.
# Otherwise the correction is discarded, even if it might help: an outdated Jacobian lacks
# directions whose stiffness has decreased since it was evaluated, and the motion of a light
# body beside a heavy one is not resolved until the Jacobian is exact.
_SHRINKS = 0.3
# A Jacobian that has decreased a correction by this factor is accurate.
_SHRINKS_FAST = 0.1
# Corrections with it stop decreasing at once if their contraction grows by this factor.
_AT_ONCE = 5
# The round-off of residuals with stiff forces, relative to that of others.
_OF_STIFF_FORCES = 8
# Where coordinates lie far from the origin, a search ends after this many corrections in a
# row that do not decrease.
_STALLS = 4
# The smallest fraction of a correction that damping accepts.
_LEAST_FRACTION = 0.01


class Powers(NamedTuple):
    """Thresholds that depend on the precision: powers of the machine epsilon.

    - `of_unknowns`: a correction below this is round-off. It grows with the number of
      unknowns, as `round_off` does.
    - `floor`: a correction of an unknown is measured relative to that unknown plus this
      fraction of the largest unknown.
    - `small`: a correction or a residual below this is in the range of convergence.
    - `moderate`: a residual above this is not round-off, however far from the origin the
      coordinates lie.
    - `tiny`: a residual below this is round-off if a new Jacobian does not reduce it.
    - `elastic`: the same beside stiff springs, which turn round-off of positions to forces.
    - `round_off`: a residual below this is round-off if a Jacobian that has reduced it
      before no longer does. The largest residual of a long chain or beam is larger: forces
      are handed on from body to body, and their rounding errors with them.
    """

    eps: float
    of_unknowns: float
    floor: float
    small: float
    moderate: float
    tiny: float
    elastic: float
    round_off: float

    def stalled(self, is_elastic: bool) -> float:
        """A residual below this is round-off if chord corrections no longer reduce it."""
        return self.elastic if is_elastic else self.tiny


# Up to this number of unknowns the threshold of round-off is that of a single body.
_FEW = 64


def powers_of(x: Float[Array, " n"]) -> Powers:
    """The thresholds for the precision and the number of the unknowns."""
    eps = float(jnp.finfo(x.dtype).eps)
    growth = max(x.size / _FEW, 1)
    return Powers(
        eps=eps,
        of_unknowns=eps * growth,
        floor=eps**0.125,
        small=eps**0.25,
        moderate=eps**0.5,
        tiny=eps**0.75,
        elastic=eps**0.6875,
        round_off=min(eps**0.875 * growth, eps**0.75),
    )


# The search -------------------------------------------------------------------------------


def max_norm(x: PyTree[Array]) -> Scalar:
    """The largest absolute value of scaled residuals or corrections."""
    return largest(ravel_pytree(x)[0])


def correction_size(
    step: Float[Array, " n"], x: Float[Array, " n"], least: Scalar, powers: Powers
) -> Scalar:
    """The size of a correction that leads to `x`, relative to the unknowns.

    The correction of each unknown is divided by that unknown, because a common scale would
    hide the error of a light, slow body beside a heavy, fast one. A floor is added for
    unknowns that pass through zero. It is proportional to the largest unknown, but to no
    less than `least`, because all unknowns can be far smaller than their scales.
    """
    floor = powers.floor * jnp.clip(largest(x), least, 1.0)
    return largest(step / (jnp.abs(x) + floor))


class _Iterate(eqx.Module):
    """The state of a search.

    - `x`: the unknowns.
    - `factors`: the factors of the current Jacobian.
    - `step`, `fraction`: the last correction that was computed with a new Jacobian, and the
      fraction of it that was applied.
    - `size`: the size of the last correction, relative to the unknowns; infinite before the
      first correction.
    - `contraction`: `size` divided by the size of the correction before, if both were
      computed with the same Jacobian, else zero.
    - `accurate`: whether the current Jacobian has decreased a correction fast.
    - `corrections`, `jacobians`: the number of corrections and of Jacobians so far.
    - `stalls`: the number of consecutive new Jacobians whose correction was small and not
      smaller than the correction before.
    - `defect`: the largest residual before the last correction.
    - `fresh`: whether the factors are those of the Jacobian at `x`.
    - `stale`: whether the Jacobian must be evaluated again.
    - `done`, `broken`: whether the search has converged, or has become non-finite.
    """

    x: Float[Array, " n"]
    factors: AbstractFactors
    step: Float[Array, " n"]
    fraction: Scalar
    size: Scalar
    contraction: Scalar
    accurate: Flag
    corrections: Count
    jacobians: Count
    stalls: Count
    defect: Scalar
    fresh: Flag
    stale: Flag
    done: Flag
    broken: Flag


def newton_iterations(
    residual: Linearisable, newton: Newton, start: Start, max_jacobians: int
) -> _Iterate:
    """A search from several guesses, one after the other, until one converges.

    From the first guess there are two attempts: the first takes whole corrections if they
    halve the residual. The two attempts with P. Deuflhard's test use at most
    `max_jacobians` Jacobians together, and the last ones do not halve corrections.
    """
    guesses = [ravel_pytree(x)[0] for x in (start.guess, *start.others)]
    factors = residual.first_factors(start.factors, guesses[0])
    first = _first_iterate(factors, guesses[0], jnp.array(0), start.skip)
    if len(guesses) == 1:
        kind = _Kind(damped=True, whole=False)
        return _attempt(residual, newton, start, first, max_jacobians, kind)
    guesses = jnp.stack([guesses[0], *guesses])
    num_attempts = guesses.shape[0]
    limits = [_FIRST_PATIENCE, PATIENCE, max_jacobians - PATIENCE]
    limits += [_UNDAMPED_PATIENCE] * num_attempts

    def attempt(carry: tuple[Count, _Iterate]) -> tuple[Count, _Iterate]:
        k, last = carry
        begin = _first_iterate(last.factors, guesses[k], last.corrections, start.skip)
        limit = jnp.asarray(limits[:num_attempts])[k]
        kind = _Kind(damped=k < 3, whole=k == 0)
        return k + 1, _attempt(residual, newton, start, begin, limit, kind)

    unfinished = lambda carry: ~carry[1].done & (carry[0] < num_attempts)
    return jax.lax.while_loop(unfinished, attempt, (jnp.array(0), first))[1]


class _Kind(NamedTuple):
    """What an attempt does with a correction that does not pass P. Deuflhard's test.

    - `damped`: whether it is halved.
    - `whole`: whether it is taken all the same if it has halved the residual.
    """

    damped: Flag | bool
    whole: Flag | bool


def _first_iterate(
    factors: AbstractFactors, x: Float[Array, " n"], corrections: Count, done: Flag
) -> _Iterate:
    zero, one, infinite = (jnp.asarray(value, x.dtype) for value in (0.0, 1.0, jnp.inf))
    none, no, yes = jnp.array(0), jnp.array(False), jnp.array(True)
    return _Iterate(
        x=x,
        factors=factors,
        step=jnp.zeros_like(x),
        fraction=one,
        size=infinite,
        contraction=zero,
        accurate=no,
        corrections=corrections,
        jacobians=none,
        stalls=none,
        defect=zero,
        fresh=no,
        stale=yes,
        done=done,
        broken=no,
    )


def _attempt(
    residual: Linearisable,
    newton: Newton,
    start: Start,
    first: _Iterate,
    max_jacobians: Count | int,
    kind: _Kind,
) -> _Iterate:
    """A search from one guess."""
    powers = powers_of(first.x)

    def linearise(iterate: _Iterate) -> _Iterate:
        factors = iterate.factors.renewed(residual.jacobian(iterate.x))
        return eqx.tree_at(
            lambda c: (c.factors, c.jacobians, c.fresh, c.stale),
            iterate,
            (factors, iterate.jacobians + 1, jnp.array(True), jnp.array(False)),
        )

    def iteration(iterate: _Iterate) -> _Iterate:
        iterate = jax.lax.while_loop(lambda c: c.stale, linearise, iterate)
        correction = _propose(residual, iterate, start.least, powers)
        verdict = _classify(iterate, correction, newton, powers)
        return _next_iterate(iterate, correction, verdict, kind, powers)

    unfinished = lambda c: (
        ~(c.done | c.broken) & ~(c.stale & (c.jacobians >= max_jacobians))
    )
    return jax.lax.while_loop(unfinished, iteration, first)


# One iteration ----------------------------------------------------------------------------


class _Correction(NamedTuple):
    """A correction that has been computed, and not yet accepted.

    - `step`, `x`: the correction, and the unknowns after it.
    - `size`: its size, relative to these unknowns.
    - `contraction`: `size` divided by the size of the correction before.
    - `shrinks`: whether `contraction` is small enough to keep the Jacobian.
    - `defect`: the largest residual before the correction.
    """

    step: Float[Array, " n"]
    x: Float[Array, " n"]
    size: Scalar
    contraction: Scalar
    shrinks: Flag
    defect: Scalar


class _Verdict(NamedTuple):
    """The state of the convergence tests.

    - `is_root`: whether the residual is round-off.
    - `done`: whether the search has converged.
    - `stalls`: as in `_Iterate`.
    """

    is_root: Flag
    done: Flag
    stalls: Count


def _propose(
    residual: Linearisable, iterate: _Iterate, least: Scalar, powers: Powers
) -> _Correction:
    value, defect = _value_and_size(residual, iterate.x)
    step = iterate.factors.solve(value)
    x = iterate.x - step
    size = correction_size(step, x, least, powers)
    contraction = size / iterate.size
    shrinks = contraction < _SHRINKS
    return _Correction(
        step=step,
        x=x,
        size=size,
        contraction=contraction,
        shrinks=shrinks,
        defect=defect,
    )


def _value_and_size(
    residual: Linearisable, x: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Scalar]:
    """The residual, and its largest entry."""
    value = residual.value(x)
    return value, max_norm(value)


def _classify(
    iterate: _Iterate,
    correction: _Correction,
    newton: Newton,
    powers: Powers,
) -> _Verdict:
    _, _, size, contraction, shrinks, defect = correction
    fresh, small = iterate.fresh, size <= powers.small
    # The contraction of corrections with one Jacobian measures the error of that Jacobian,
    # which is nearly constant. A single smaller contraction is therefore coincidence, and
    # the bound on the next correction uses at least the contraction of the correction
    # before. It also uses at least the size of that correction, because the exact Jacobian
    # has changed by an amount of this size.
    rate = jnp.maximum(jnp.maximum(contraction, iterate.contraction), iterate.size)
    converged = size * rate <= newton.rtol * powers.of_unknowns
    converged = ~fresh & shrinks & converged & (defect <= powers.small)
    is_root = (defect <= newton.atol * powers.eps) & small
    # Larger corrections, such as those of stiff forces, are round-off if they suddenly
    # decrease far less than before. A Jacobian that is not exact contracts at a constant
    # rate. The motion of a light body can converge slowly after that of a heavy one, so the
    # correction must be tiny too.
    ends_at_once = iterate.accurate & (contraction > _AT_ONCE * iterate.contraction)
    ends_at_once = ends_at_once & (contraction > _SHRINKS_FAST) & (size <= powers.tiny)
    # Corrections with one Jacobian that have decreased and stop decreasing are round-off.
    met = ~fresh & (~shrinks | ends_at_once) & (iterate.contraction > 0)
    bound = jnp.where(ends_at_once, _OF_STIFF_FORCES, 1) * powers.round_off
    met = met & (defect <= bound) & small
    # A small correction with a new Jacobian that is not smaller than the one before is
    # round-off too, if the residual is tiny. It is larger where coordinates lie a million
    # lengths from the origin. It then must not decrease several times in a row, and must
    # not be large, because the residual can have a local minimum that is no root.
    stalled = fresh & small & ~shrinks
    stalls = jnp.where(fresh, jnp.where(stalled, iterate.stalls + 1, 0), iterate.stalls)
    repeatedly = (stalls == _STALLS) & (defect <= powers.moderate)
    met = met | (stalled & ((defect <= powers.tiny) | repeatedly))
    done = (is_root | converged | met) & jnp.isfinite(size)
    return _Verdict(is_root, done, stalls)


def _next_iterate(
    iterate: _Iterate,
    correction: _Correction,
    verdict: _Verdict,
    kind: _Kind,
    powers: Powers,
) -> _Iterate:
    """Accepts the correction, halves the one before, or requests a new Jacobian."""
    fresh, fraction = iterate.fresh, iterate.fraction
    taken = fresh | correction.shrinks | verdict.is_root
    # The second correction with a Jacobian estimates the error after the first one. If it
    # has not decreased enough and is larger than round-off, the first one is halved
    # (P. Deuflhard's natural monotonicity test).
    is_second = ~fresh & (iterate.contraction == 0) & (iterate.size > powers.small)
    is_monotone = correction.contraction <= 1 - 0.25 * fraction
    # `correction.defect` is the residual after the first correction.
    is_monotone = is_monotone | (kind.whole & (correction.defect <= 0.5 * iterate.defect))
    halves = (
        kind.damped
        & is_second
        & ~is_monotone
        & ~verdict.done
        & (fraction > _LEAST_FRACTION)
    )
    fraction = jnp.where(halves, 0.5 * fraction, jnp.ones_like(fraction))
    x_otherwise = jnp.where(halves, iterate.x + fraction * iterate.step, iterate.x)
    changes = (taken | halves).astype(iterate.corrections.dtype)
    return _Iterate(
        x=jnp.where(taken, correction.x, x_otherwise),
        factors=iterate.factors,
        step=jnp.where(fresh, correction.step, iterate.step),
        fraction=fraction,
        size=jnp.where(taken, correction.size, iterate.size),
        contraction=jnp.where(fresh | halves, 0, correction.contraction),
        accurate=~fresh & (iterate.accurate | (correction.contraction < _SHRINKS_FAST)),
        corrections=iterate.corrections + changes,
        jacobians=iterate.jacobians,
        stalls=verdict.stalls,
        defect=jnp.where(halves, iterate.defect, correction.defect),
        fresh=jnp.zeros_like(fresh),
        stale=~taken & ~halves,
        done=verdict.done,
        broken=fresh & ~jnp.isfinite(correction.size),
    )
