"""Calls that carry XLA's marks of what is one function of machine code."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array

from ..._types import Scalar


# The marks are those of these versions. Others would not know them, or not keep to them.
KNOWS_MARKS = (0, 10, 2) <= jaxlib.version.__version_info__ < (0, 11)
APART = {"inlineable": "false"}
ONE_FUNCTION = {"xla_cpu_small_call": "true"} | APART


def has_marks() -> bool:
    return KNOWS_MARKS and jax.default_backend() == "cpu"


def marked(
    program: Callable[[Sequence[Array]], list[Array]], numbers: Sequence[Array]
) -> list[Array]:
    """`program(numbers)` as one function; it must be possible as such."""

    # XLA ends the process where an input of such a function is not used: what is empty is
    # made inside, and of all others a number goes into a witness.
    def with_witness(*inputs):
        left = iter(inputs)
        made = lambda x: next(left) if x.size else jnp.zeros(x.shape, x.dtype)
        return program(list(map(made, numbers))), _witness(inputs)

    # Nor may it see that one is a constant, which it would put inside instead of the input;
    # and for one of more than 10 kB (a table that is looked up) it has no address there.
    inputs = jax.lax.optimization_barrier([x for x in numbers if x.size])
    out, sign = jax.jit(with_witness)(*inputs)
    # The marks go to what made the value: the call.
    witness: Any = set_xla_metadata(sign, **ONE_FUNCTION)
    # Nothing here may find that the witness is not needed.
    return [jnp.where(witness > 0, out[0], out[0]), *out[1:]]


def _witness(arrays: Sequence[Array]) -> Scalar:
    """A number to which each of some arrays contributes."""
    first = lambda x: jax.lax.slice(x, (0,) * x.ndim, tuple(min(n, 1) for n in x.shape))
    parts = (jnp.real(jnp.sum(first(x))).astype(float) for x in arrays)
    return functools.reduce(jnp.add, parts, jnp.zeros(()))
