"""Which numbers of a run are kept for the reverse pass, and which are recomputed.

A step is recomputed from the state before it and its root, without Newton's method. A run
of `n` steps is divided into segments of about `sqrt(n)` steps, whose states are recomputed
from the start of the segment and the roots. Long runs keep only the starts of the segments
and repeat Newton's method, so that their memory grows like `sqrt(n)`.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from .._programs import in_any_lane, in_one_function
from .._solvers import ROOT
from .._types import Flag


# With more steps than this the roots are not kept.
LONG = 10_000

Body: TypeAlias = Callable[[Any, Any], tuple[Any, Any]]


# A loop: called with `(body, carry, count, live)` it makes `count` passes of `body`.
Scan: TypeAlias = Callable[[Body, Any, int, Flag], tuple[Any, Any]]


# XLA cannot merge a recomputation with the original across the passes of a loop.
_checkpoint = functools.partial(jax.checkpoint, prevent_cse=False)


def keep_roots(fn: Body) -> Body:
    """`fn`, of which the reverse pass keeps the inputs and the roots."""
    return _checkpoint(fn, policy=jax.checkpoint_policies.save_only_these_names(ROOT))


def moving(x: PyTree[Array], numbers: PyTree[Array]) -> PyTree[Array]:
    """`x`, the start of a carry, with rates where one of the `numbers` has a rate.

    The carry of a loop that depends on these numbers has rates after the first pass. Where
    its start has none, JAX derives the whole loop before it finds out, and then once more.
    """
    inexact = [x for x in jax.tree.leaves(numbers) if eqx.is_inexact_array(x)]
    return _moving(x, inexact)


@jax.custom_jvp
def _moving(x: PyTree[Array], numbers: list[Array]) -> PyTree[Array]:
    del numbers
    return x


def _moving_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    x, _ = primals
    is_zero = lambda rate: isinstance(rate, SymbolicZero)
    moved = [rate for rate in tangents[1] if not is_zero(rate)]
    # A zero that JAX does not take for one, because it is computed from a rate.
    zero = jnp.sum(jnp.where(False, moved[0], 0)) if moved else 0
    rates = jax.tree.map(
        lambda x, rate: jnp.zeros_like(x) + zero if is_zero(rate) else rate,
        x,
        tangents[0],
        is_leaf=is_zero,
    )
    return x, rates


_moving.defjvp(_moving_jvp, symbolic_zeros=True)


def loops(
    groups: int, steps: int, done: Callable[[Any], Array] | None
) -> tuple[Scan, Scan]:
    """The loops over the groups of steps of a run, and over the steps of a group.

    A segment that begins after `done(carry)` is skipped, and its outputs are zero; in a
    batch it is skipped when all lanes are done. `None` if all segments are needed.
    """
    total = groups * steps
    length = math.isqrt(total)
    # One of the loops is divided: a segment consists of whole groups, or is part of one.
    if steps > length:
        return _scan, functools.partial(_in_segments, total, length, done=done)
    in_segments = functools.partial(_in_segments, total, length // steps, done=done)
    return in_segments, _scan


def scan(body: Body, carry: Any, inputs: Any, count: int) -> tuple[Any, Any]:
    """`jax.lax.scan` with `count` passes, of which a single one is no loop.

    The reverse pass of a loop gets index tables as numbers that the loop has computed, and
    updates at computed places have no machine code where there are many.
    """
    if count > 1:
        return jax.lax.scan(body, carry, inputs, length=count)
    carry, out = body(carry, jax.tree.map(lambda x: x[0], inputs))
    return carry, jax.tree.map(lambda x: jnp.asarray(x)[None], out)


def _scan(body: Body, carry: Any, count: int, live: Flag) -> tuple[Any, Any]:
    return scan(lambda carry, _: body(carry, live), carry, None, count)


def _in_segments(
    total: int,
    length: int,
    body: Body,
    carry: Any,
    count: int,
    live: Flag,
    done: Callable[[Any], Array] | None = None,
) -> tuple[Any, Any]:
    """A scan divided into segments of about `length` passes, in a run of `total` steps.

    The passes of the last segment that exceed `count` are not live. A segment of a small
    system is one function of machine code.
    """
    sizes = range((length + 1) // 2, 2 * length + 1)
    size = min(sizes, key=lambda size: -count % size)

    # Whether a pass is live is computed within its segment. An array of flags for all
    # passes would take more memory than the reverse pass of a long run keeps.
    def passes(fn: Body, carry: Any, inputs: tuple[Array, Flag]) -> tuple[Any, Any]:
        first, live = inputs
        one_pass = lambda carry, k: fn(carry, live & (first + k < count))
        return jax.lax.scan(one_pass, carry, jnp.arange(size))

    whole = functools.partial(passes, body)
    segment = in_one_function(keep_roots(whole))
    if total > LONG:
        segment = _checkpoint(segment)
    if done is not None:
        segment = _unless(done, segment)
    of_first = lambda carry, first: segment(carry, (first, live))
    carry, out = jax.lax.scan(of_first, carry, size * jnp.arange(-(-count // size)))
    join = lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:])[:count]
    return carry, jax.tree.map(join, out)


def _unless(done: Callable[[Any], Array], segment: Body) -> Body:
    """`segment`, which is skipped if it would change nothing."""
    # Both branches need its program, which is traced once.
    segment = jax.jit(segment)

    def skipped(carry: Any, inputs: Any) -> tuple[Any, Any]:
        _, out = jax.eval_shape(segment, carry, inputs)
        return carry, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), out)

    skip = lambda carry: ~in_any_lane(~done(carry))
    return lambda carry, inputs: jax.lax.cond(skip(carry), skipped, segment, carry, inputs)
