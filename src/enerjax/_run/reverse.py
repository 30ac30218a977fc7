"""Which numbers of a run are kept for the reverse pass, and which are computed again.

A step is computed again from the state before it and its root, without a search. Runs are
cut into segments of about the square root of their steps: the states within a segment are
computed again from its start and its roots. Long runs keep the starts of segments alone,
and search for the roots once more: the memory grows like the square root of the steps.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._programs import in_any_lane, in_one_function
from .._solvers import ROOT
from .._types import Flag


# Steps beyond which the roots are not kept.
LONG = 10_000

Body: TypeAlias = Callable[[Any, Any], tuple[Any, Any]]
# `scan(body, carry, count, live)` calls `body(carry, live)` so many times.
Scan: TypeAlias = Callable[[Body, Any, int, Flag], tuple[Any, Any]]


# In a loop nothing is merged with what a pass before computed.
_checkpoint = functools.partial(jax.checkpoint, prevent_cse=False)


def keep_roots(fn: Body) -> Body:
    """`fn`, of which the reverse pass keeps the inputs and the roots."""
    return _checkpoint(fn, policy=jax.checkpoint_policies.save_only_these_names(ROOT))


def loops(
    groups: int, steps: int, done: Callable[[Any], Array] | None
) -> tuple[Scan, Scan]:
    """The loops over the groups of steps of a run, and over the steps of a group.

    Segments that begin after `done(carry)` cost nothing, and what they hand out is zero; of
    a batch the last lane decides. `None` where all of them are needed.
    """
    total = groups * steps
    length = math.isqrt(total)
    # One of both loops is cut: a segment consists of whole groups, or is a part of one.
    if steps > length:
        return _scan, functools.partial(_in_segments, total, length, done=done)
    in_segments = functools.partial(_in_segments, total, length // steps, done=done)
    return in_segments, _scan


def _scan(body: Body, carry: Any, count: int, live: Flag) -> tuple[Any, Any]:
    return jax.lax.scan(lambda carry, _: body(carry, live), carry, None, length=count)


def _in_segments(
    total: int,
    length: int,
    body: Body,
    carry: Any,
    count: int,
    live: Flag,
    done: Callable[[Any], Array] | None = None,
) -> tuple[Any, Any]:
    """A scan cut into segments of about `length` turns, in a run of `total` steps.

    If the segments hold more turns than `count`, the last turns are not live. A segment of
    a small system is one function of machine code.
    """
    sizes = range((length + 1) // 2, 2 * length + 1)
    size = min(sizes, key=lambda size: -count % size)

    # Which turns are live is found within a segment: as an array for all turns it would
    # take more memory than the reverse pass of a long run keeps.
    def turns(carry: Any, given: tuple[Array, Flag]) -> tuple[Any, Any]:
        first, live = given
        turn = lambda carry, k: body(carry, live & (first + k < count))
        return jax.lax.scan(turn, carry, jnp.arange(size))

    segment = in_one_function(keep_roots(turns))
    if total > LONG:
        segment = _checkpoint(segment)
    if done is not None:
        segment = _unless(done, segment)
    of_first = lambda carry, first: segment(carry, (first, live))
    carry, out = jax.lax.scan(of_first, carry, size * jnp.arange(-(-count // size)))
    join = lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])[:count]
    return carry, jax.tree.map(join, out)


def _unless(done: Callable[[Any], Array], segment: Body) -> Body:
    """`segment`, passed over where it would change nothing."""

    def idle(carry: Any, given: Any) -> tuple[Any, Any]:
        _, out = jax.eval_shape(segment, carry, given)
        return carry, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), out)

    skip = lambda carry: ~in_any_lane(~done(carry))
    return lambda carry, given: jax.lax.cond(skip(carry), idle, segment, carry, given)
