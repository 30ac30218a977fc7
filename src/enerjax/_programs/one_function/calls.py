"""What the rest of the package asks for."""

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, PyTree

from .marks import APART, has_marks


def in_one_function(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """`fn`, between trees of arrays, as one function of machine code where it can be.

    The same values either way, but for round-off. Its derivatives, of any order, are one
    function each where they can be; what they keep of the values is for `jax.checkpoint`
    inside of `fn` to say. The lanes of a batch run one after the other, each with the
    iterations that it needs.
    """
    if not has_marks():
        return fn
    # Only here: other versions of JAX may define primitives otherwise.
    from .program import call

    return functools.partial(call, fn)


def unmerged(fn: Callable[..., tuple[Array, ...]]) -> Callable[..., tuple[Array, ...]]:
    """`fn`, whose operations XLA does not merge with those around it.

    Where one operation needs an entry of another several times, merging computes it as
    often. The same values either way. `fn` must return two arrays or more: XLA would share
    the work of a call with one result among threads, which is not possible inside of one
    function. Not to be differentiated.
    """
    if not has_marks():
        return fn
    call = jax.jit(fn)

    def apart(*args: Array) -> tuple[Array, ...]:
        first, *others = call(*args)
        # The mark goes to what made the value: the call.
        first: Any = set_xla_metadata(first, **APART)
        return first, *others

    return apart
