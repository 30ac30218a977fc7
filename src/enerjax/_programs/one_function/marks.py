"""Calls that carry the marks by which XLA compiles them into one function."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array

from ..._types import Scalar


# These versions know the marks; others might ignore them, or treat them differently.
KNOWS_MARKS = (0, 10, 2) <= jaxlib.version.__version_info__ < (0, 11)
APART = {"inlineable": "false"}
ONE_FUNCTION = {"xla_cpu_small_call": "true"} | APART


def has_marks() -> bool:
    """Whether this version of XLA, and its back end, know the marks."""
    return KNOWS_MARKS and jax.default_backend() == "cpu"


def marked(
    program: Callable[[Sequence[Array]], list[Array]], numbers: Sequence[Array]
) -> list[Array]:
    """`program(numbers)` in one function, for a program that `is_possible` in one."""

    # XLA ends the process if an input of such a function is not used. Empty inputs are
    # therefore created inside of the function, and a number of every other input is added
    # to a result that is returned beside the outputs: a witness that the input is used.
    def with_witness(*inputs):
        remaining = iter(inputs)
        restored = lambda x: next(remaining) if x.size else jnp.zeros(x.shape, x.dtype)
        return program(list(map(restored, numbers))), _witness(inputs)

    # The barrier hides from XLA which inputs are constants. It would put a constant inside
    # of the function, instead of the input, and cannot address one of more than 10 kB there
    # (a table that is looked up).
    inputs = jax.lax.optimization_barrier([x for x in numbers if x.size])
    out, sign = jax.jit(with_witness)(*inputs)
    # The marks apply to the operation that computed the value, which is the call.
    witness: Any = set_xla_metadata(sign, **ONE_FUNCTION)
    # This use keeps JAX and XLA from dropping the witness as unused.
    return [jnp.where(witness > 0, out[0], out[0]), *out[1:]]


def _witness(arrays: Sequence[Array]) -> Scalar:
    """A number to which each of the arrays contributes."""
    first = lambda x: jax.lax.slice(x, (0,) * x.ndim, tuple(min(n, 1) for n in x.shape))
    entries = (jnp.real(jnp.sum(first(x))).astype(float) for x in arrays)
    return functools.reduce(jnp.add, entries, jnp.zeros(()))
