"""The calls that the rest of the package makes."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, PyTree

from ..._types import Flag
from .marks import APART, has_marks


class SideBySide(NamedTuple):
    """A program for the lanes of a batch side by side.

    - `fn`: returns the same values as the other program, and whether it has failed.
    - `fewest`: the number of lanes from which it is used.
    - `if_long`: whether it is used only if the other program is too long for one function.
    """

    fn: Callable[..., tuple[PyTree[Array], Flag]]
    fewest: int
    if_long: bool


def in_one_function(
    fn: Callable[..., PyTree[Array]],
    side_by_side: SideBySide | None = None,
) -> Callable[..., PyTree[Array]]:
    """`fn`, between trees of arrays, as one function of machine code where it can be.

    The values are the same either way, but for round-off. Derivatives of any order are one
    function each, where that is possible; `jax.checkpoint` inside of `fn` decides which
    values they keep. The lanes of a batch run one after the other, each with the iterations
    that it needs.

    With `side_by_side` the lanes of large batches run side by side instead. Lanes for which
    that fails are computed again by `fn`, and so are derivatives.
    """
    return _called(fn, False, side_by_side)


def part(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """`in_one_function(fn)` for a part of a program that may be one function as a whole.

    It is a function of its own only if the whole is none, for example because it is long:
    the time of compilation grows faster than the length of a function.
    """
    return _called(fn, True)


def _called(
    fn: Callable[..., PyTree[Array]],
    is_part: bool,
    side_by_side: SideBySide | None = None,
) -> Callable[..., PyTree[Array]]:
    if not has_marks():
        return fn
    # Imported here, because other versions of JAX may define primitives in another way.
    from .lanes import call

    return functools.partial(call, fn, is_part, side_by_side)


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


def run_side_by_side(jaxpr: Any, lanes: int) -> bool:
    """Whether a part of a program would run side by side in a batch of so many lanes."""
    if not has_marks():
        return False
    from .lanes import run_side_by_side

    return run_side_by_side(jaxpr, lanes)
