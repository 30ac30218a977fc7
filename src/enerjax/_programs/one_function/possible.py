"""Which computations can be one function: those that need nothing from the runtime."""

import math
from collections.abc import Collection
from typing import Any

import jax.numpy as jnp
from jax.extend.core import Jaxpr

from ..tracing import programs_within


# Entries of what is summed, above which XLA calls a library; here with room to spare.
LARGEST_SUM = 2048
# Rows or columns from which it does for products of matrices.
_THIN = 8

_CALLS = """
    closed_call jit remat2 custom_jvp_call custom_vjp_call custom_vmap_call while cond scan
    xla_metadata_value optimization_barrier
"""
_MOVES = """
    broadcast_in_dim concatenate copy dynamic_slice dynamic_update_slice gather iota pad
    platform_index reshape rev select_n slice split squeeze stack stop_gradient transpose
    tile unstack
"""
_ELEMENTWISE = """
    abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp
    convert_element_type cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge gt
    integer_pow is_finite le lgamma log log1p logistic lt max min mul name ne neg nextafter
    not or population_count pow rem round rsqrt shift_left shift_right_arithmetic
    shift_right_logical sign sin sinh sqrt square sub tan tanh xor
"""
_SUMS = "argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum"
# Of a program in one function, which is one only where it can be.
NAME = "enerjax_one_function"
POSSIBLE = frozenset((_CALLS + _MOVES + _ELEMENTWISE).split())
POSSIBLE_IF_SMALL = frozenset(_SUMS.split())


def is_possible(jaxpr: Jaxpr, besides: Collection[str] = ()) -> bool:
    """Whether all primitives of a program are; those `besides` these are taken to be."""
    if not all(map(_is_plain, (*jaxpr.constvars, *jaxpr.invars))):
        return False
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name in besides or name == NAME:
            continue
        if name in POSSIBLE_IF_SMALL:
            possible = all(x.aval.size <= LARGEST_SUM for x in eqn.invars)  # pyright: ignore
        elif name == "dot_general":
            possible = is_small_product(eqn)
        else:
            possible = name in POSSIBLE
        if not possible or not all(
            is_possible(inner, besides) for inner in programs_within(eqn)
        ):
            return False
    return True


def _is_plain(variable: Any) -> bool:
    """Whether it holds numbers, and not keys or parts of bytes."""
    kind = variable.aval.dtype
    return jnp.issubdtype(kind, jnp.inexact) or getattr(kind, "kind", "key") in "iub"


def is_small_product(eqn: Any) -> bool:
    """Whether XLA writes out a product, instead of calling a library."""
    shapes = [x.aval.shape for x in eqn.invars]
    contracted, batch = eqn.params["dimension_numbers"]
    rows, columns = (
        math.prod(n for k, n in enumerate(shape) if k not in (*used, *of_batch))
        for shape, used, of_batch in zip(shapes, contracted, batch, strict=True)
    )
    terms = math.prod(shapes[0][k] for k in contracted[0])
    if max(x.aval.size for x in eqn.invars) > LARGEST_SUM:
        return False
    return max(rows, columns, terms) < _THIN or min(rows, columns) == 1
