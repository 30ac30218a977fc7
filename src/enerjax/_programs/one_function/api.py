"""The calls that the rest of the package makes."""

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, PyTree

from ..._types import Flag
from .marks import APART, has_marks


def in_one_function(
    fn: Callable[..., PyTree[Array]],
    in_lanes: Callable[..., tuple[PyTree[Array], Flag]] | None = None,
    fewest_lanes: int = 1,
) -> Callable[..., PyTree[Array]]:
    """`fn`, between trees of arrays, as one function of machine code where it can be.

    The values are the same either way, but for round-off. Derivatives of any order are one
    function each, where that is possible; `jax.checkpoint` inside of `fn` decides which
    values they keep. The lanes of a batch run one after the other, each with the iterations
    that it needs.

    With `in_lanes`, batches of `fewest_lanes` or more run side by side instead: it returns
    the same values by a shorter program, and whether it has failed. Lanes for which it has
    failed are computed again by `fn`, and so are derivatives.
    """
    return _called(fn, False, in_lanes, fewest_lanes)


def part(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """`in_one_function(fn)` for a part of a program that may be one function as a whole.

    It is a function of its own only if the whole is none, for example because it is long:
    the time of compilation grows faster than the length of a function.
    """
    return _called(fn, True)


def _called(
    fn: Callable[..., PyTree[Array]],
    is_part: bool,
    in_lanes: Callable[..., tuple[PyTree[Array], Flag]] | None = None,
    fewest_lanes: int = 1,
) -> Callable[..., PyTree[Array]]:
    if not has_marks():
        return fn
    # Imported here, because other versions of JAX may define primitives in another way.
    from .lanes import call

    return functools.partial(call, fn, is_part, in_lanes, fewest_lanes)


def unmerged(fn: Callable[..., tuple[Array, ...]]) -> Callable[..., tuple[Array, ...]]:
    """`fn`, whose operations XLA does not merge with those around it.

    If an operation uses an entry of another several times, merging them computes the entry
    as many times. The values are the same either way. `fn` must return two arrays or more:
    XLA would divide a call with one result among threads, which is not possible inside of
    one function. The result cannot be differentiated.
    """
    if not has_marks():
        return fn
    call = jax.jit(fn)

    def apart(*args: Array) -> tuple[Array, ...]:
        first, *others = call(*args)
        # The mark applies to the operation that computed the value, which is the call.
        first: Any = set_xla_metadata(first, **APART)
        return first, *others

    return apart
