"""The search for the zeros of functions within a step, by lengths of the step.

If a function has passed a zero in an attempted step, the step is repeated with lengths
that enclose the first zero, by the Illinois form of regula falsi, until the function is
round-off at the end of the step.

A function can also pass zero twice within a step. If a motion interpolated between the ends
of the step does so, the step is repeated up to the extremum between these zeros.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._programs import in_any_lane
from .._results import RESULTS
from .._types import Count, Flag, Scalar


# A function counts as zero below this multiple of the round-off of its largest value.
ZERO = 64.0
# The same for the force of a closed gap, which has the error of a linear solve.
_ZERO_FORCE = 1e4
# The part of its largest value below which a function is not expected to be exact.
_FAINTEST = 1e-3
# The attempts of one search. Ten usually suffice; steps that are halved forty times, for a
# function that touches zero at their start, need more.
MAX_TRIES = 80
USUAL_TRIES = 16


class Watch(eqx.Module):
    """What is known of the events at the start of a step.

    - `side`: the sign that each function has before its next zero.
    - `values`: of all functions.
    - `sizes`: the largest absolute values of late, in the first row of the functions of the
      user and in the second of the forces of closed gaps. Each step halves those of
      functions, down to a thousandth of the largest.
    - `largest`: the largest absolute values of the functions of the user so far.
    - `is_force`: for which events the function is the force of a closed gap.
    - `starts`: which functions are zero and move to their side.
    - `search`: the interval of lengths that encloses the first zero in the step.
    - `count`: the number of events so far.
    - `ended`: whether a terminal event has happened.
    """

    side: Float[Array, " events"]
    values: Float[Array, " events"]
    sizes: Float[Array, "2 events"]
    largest: Float[Array, " events"]
    is_force: Bool[Array, " events"]
    starts: Bool[Array, " events"]
    search: "Search"
    count: Count
    ended: Flag

    def faded(self) -> "Watch":
        """With smaller sizes of functions, so that those that decay have zeros too."""
        functions = jnp.maximum(0.5 * self.sizes[0], _FAINTEST * self.largest)
        sizes = jnp.stack([functions, self.sizes[1]])
        return eqx.tree_at(lambda watch: watch.sizes, self, sizes)

    def sizes_with(self, values: Array, is_force: Array) -> Float[Array, "2 events"]:
        """The sizes of late with those of these values."""
        size = jnp.where(jnp.isfinite(values), jnp.abs(values), 0.0)[None]
        here = jnp.stack([~is_force, is_force])
        return jnp.where(here, jnp.maximum(self.sizes, size), self.sizes)


def round_off(sizes: Float[Array, "2 events"], is_force: Array) -> Float[Array, " events"]:
    """The values below which a function counts as zero."""
    size = jnp.where(is_force, _ZERO_FORCE * sizes[1], ZERO * sizes[0])
    return jnp.finfo(size.dtype).eps * size


class Search(eqx.Module):
    """An interval of lengths of a step: steps of the upper length pass a zero.

    - `active`: whether there is a search.
    - `lower`, `upper`: the ends of the interval.
    - `at_lower`, `at_upper`: the distances to the first zero there, positive and negative;
      those of an end that has been kept are halved.
    - `moved`: 1 if the last attempt has moved the upper end, -1 the lower end, 0 none.
    - `tries`: the number of attempts.
    - `probes`: whether the step to the upper end is tried next, because a function may pass
      zero twice.
    """

    active: Flag
    lower: Scalar
    upper: Scalar
    at_lower: Scalar
    at_upper: Scalar
    moved: Scalar
    tries: Count
    probes: Flag

    @property
    def length(self) -> Scalar:
        """The length to try next."""
        width = self.upper - self.lower
        part = self.at_lower / (self.at_lower - self.at_upper)
        # Where the function vanishes at the lower end too, the secant finds this zero.
        part = jnp.where(self.at_lower > 0, part, 0.5)
        margin = jnp.where(self.tries > MAX_TRIES // 4, 0.5, 0.0)
        part = jnp.where(self.probes, 1.0, part)
        return self.lower + jnp.clip(part, margin, 1 - margin) * width

    def narrowed(self, length: Scalar, distance: Scalar, beyond: Flag) -> "Search":
        """The interval after an attempt of this length, which ends beyond a zero or not."""
        distance = jnp.where(beyond, jnp.minimum(distance, 0), jnp.maximum(distance, 0))
        moved = jnp.where(beyond, 1.0, -1.0).astype(length.dtype)
        again = self.moved == moved
        at_lower = jnp.where(beyond & again, 0.5 * self.at_lower, self.at_lower)
        at_upper = jnp.where(~beyond & again, 0.5 * self.at_upper, self.at_upper)
        return Search(
            active=jnp.array(True),
            lower=jnp.where(beyond, self.lower, length),
            upper=jnp.where(beyond, length, self.upper),
            at_lower=jnp.where(beyond, at_lower, distance),
            at_upper=jnp.where(beyond, distance, at_upper),
            moved=moved,
            tries=self.tries + 1,
            probes=jnp.array(False),
        )


def no_search(dtype: Any) -> Search:
    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    return Search(
        active=jnp.array(False),
        lower=zero,
        upper=one,
        at_lower=one,
        at_upper=-one,
        moved=zero,
        tries=jnp.array(0),
        probes=jnp.array(False),
    )


class Found(eqx.Module):
    """What an attempted step has found.

    - `happens`: which events happen at the end of the step.
    - `searches`: whether the step must be repeated with another length.
    - `search`: for the next attempt.
    - `values`: the functions at the end.
    - `result`: a failure of the search.
    """

    happens: Bool[Array, " events"]
    searches: Flag
    search: Search
    values: Float[Array, " events"]
    result: RESULTS


def find(
    watch: Watch,
    armed: Bool[Array, " events"],
    values: Array,
    length: Scalar,
    extremum: tuple[Scalar, Flag],
) -> Found:
    """What happens in a step of this length.

    `armed` are the functions whose next zero is an event.
    """
    values_now = jax.lax.stop_gradient(values)
    length = jax.lax.stop_gradient(length)
    search, starts = watch.search, watch.starts
    zero = round_off(watch.sizes_with(values_now, watch.is_force), watch.is_force)
    left = watch.side * values_now
    # A function that is zero at the start must first become positive.
    least = jnp.where(starts & ~search.active, -zero, zero)
    distance = jnp.min(jnp.where(armed, left, jnp.inf))
    beyond = jnp.any(armed & (left <= jnp.where(starts, -zero, 0)))
    near = armed & (left <= least)
    first = jnp.all(~armed | (left >= -zero))
    narrowed = search.narrowed(length, distance, beyond)
    eps = jnp.finfo(length.dtype).eps
    is_narrow = search.active & (narrowed.upper - narrowed.lower <= 4 * eps * length)
    found = jnp.any(near) & (first | (is_narrow & beyond))
    part, passes_twice = extremum
    probes = passes_twice & ~beyond & ~search.active
    # A step that only leads to an extremum is a step as any other.
    narrows = search.active & ~search.probes
    searches = ~found & (narrows | beyond | probes)
    start = _first_interval(watch, length, distance, armed)
    probe = eqx.tree_at(
        lambda x: (x.upper, x.probes), start, (part * length, jnp.array(True))
    )
    use = lambda flag: lambda x, y: jnp.where(flag, x, y)
    following = jax.tree.map(use(probes), probe, start)
    following = jax.tree.map(use(narrows), narrowed, following)
    following = jax.tree.map(
        lambda x, y: jnp.where(searches, x, y), following, no_search(length.dtype)
    )
    failed = searches & (following.tries > MAX_TRIES)
    result = RESULTS.where(failed, RESULTS.event_not_found, RESULTS.successful)
    return Found(
        happens=found & near,
        searches=searches,
        search=following,
        values=values,
        result=result,
    )


def _first_interval(watch: Watch, length: Scalar, distance: Scalar, armed: Array) -> Search:
    left = jnp.where(armed, watch.side * watch.values, jnp.inf)
    at_zero = watch.starts[jnp.argmin(left)]
    return Search(
        active=jnp.array(True),
        lower=jnp.zeros_like(length),
        upper=length,
        at_lower=jnp.where(at_zero, 0.0, jnp.maximum(jnp.min(left), 0)),
        at_upper=jnp.minimum(distance, 0),
        moved=jnp.zeros_like(length),
        tries=jnp.array(1),
        probes=jnp.array(False),
    )


@eqx.filter_custom_jvp
def settle(attempt: Any) -> tuple[Any, Scalar, Found]:
    """An attempted step, its length, and what it has found.

    `attempt` is a module with the attribute `length` and a method `run` that returns the
    step and what it has found. If an event happens, the derivative of the length is such
    that the function of the event stays zero: with the derivative `slope` of the function
    by the length it is minus the change of the function, divided by `slope`.
    """
    out, found = attempt.run()
    return out, attempt.length, found


@settle.def_jvp
def _settle_jvp(primals: Any, tangents: Any) -> Any:
    (attempt,), (t_attempt,) = primals, tangents

    def result(attempt: Any) -> tuple[Any, Scalar, Found]:
        out, found = attempt.run()
        return out, attempt.length, found

    ends, change = eqx.filter_jvp(result, (attempt,), (t_attempt,))
    change = _without_none(change, ends)
    _, length, found = ends
    first = jnp.arange(found.happens.size) == jnp.argmax(found.happens)
    value_of = lambda tangent: jnp.sum(jnp.where(first, tangent[2].values, 0))

    def of_length(length: Scalar) -> Any:
        return result(eqx.tree_at(lambda attempt: attempt.length, attempt, length))

    def corrected(change: Any) -> Any:
        _, along = eqx.filter_jvp(of_length, (length,), (jnp.ones_like(length),))
        along = _without_none(along, ends)
        slope = value_of(along)
        shift = -value_of(change) / jnp.where(slope == 0, 1, slope)
        shift = jnp.where(jnp.any(found.happens), shift, 0)
        return jax.tree.map(lambda x, y: x + shift * y, change, along)

    happens = in_any_lane(jnp.any(found.happens))
    return ends, jax.lax.cond(happens, corrected, lambda change: change, change)


def _without_none(tangents: Any, values: Any) -> Any:
    """The tangents, with zeros for those of numbers that do not change."""

    def tangent(t: Any, x: Any) -> Any:
        is_number = eqx.is_inexact_array(x)
        return jnp.zeros_like(x) if t is None and is_number else t

    return jax.tree.map(tangent, tangents, values, is_leaf=lambda x: x is None)
