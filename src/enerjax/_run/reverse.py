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
from jaxtyping import Array, Bool

from .._programs import in_any_lane, in_one_function
from .._solvers import ROOT


# Steps beyond which the roots are not kept.
LONG = 10_000

Body: TypeAlias = Callable[[Any, Array], tuple[Any, Any]]
Scan: TypeAlias = Callable[[Body, Any, Bool[Array, " length"]], tuple[Any, Any]]


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
        return jax.lax.scan, functools.partial(_in_segments, total, length, done=done)
    in_segments = functools.partial(_in_segments, total, length // steps, done=done)
    return in_segments, jax.lax.scan


def _in_segments(
    total: int,
    about: int,
    body: Body,
    carry: Any,
    live: Bool[Array, " length"],
    done: Callable[[Any], Array] | None = None,
) -> tuple[Any, Any]:
    """A scan over `live` in segments of about so many turns, of a run of `total` steps.

    Where segments of no suitable length fill the run, turns that are not live are added. A
    segment of a small system is one function of machine code.
    """
    length = live.size
    size = min(range((about + 1) // 2, 2 * about + 1), key=lambda size: -length % size)
    live = jnp.append(live, jnp.zeros((-length % size,), bool)).reshape(-1, size)
    whole = keep_roots(lambda carry, live: jax.lax.scan(body, carry, live))
    segment = in_one_function(whole)
    if total > LONG:
        segment = _checkpoint(segment)
    if done is not None:
        segment = _unless(done, segment)
    carry, out = jax.lax.scan(segment, carry, live)
    join = lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])[:length]
    return carry, jax.tree.map(join, out)


def _unless(done: Callable[[Any], Array], segment: Body) -> Body:
    """`segment`, passed over where it would change nothing."""

    def idle(carry: Any, live: Array) -> tuple[Any, Any]:
        _, out = jax.eval_shape(segment, carry, live)
        return carry, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), out)

    skip = lambda carry: ~in_any_lane(~done(carry))
    return lambda carry, live: jax.lax.cond(skip(carry), idle, segment, carry, live)
