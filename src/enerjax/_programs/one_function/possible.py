"""Which computations can be one function: those that call nothing in XLA's runtime."""

import math
from collections.abc import Collection, Iterator
from typing import Any

import jax.numpy as jnp
from jax.extend.core import Jaxpr

from ..jaxprs import programs_within
from ..primitives import (
    CALLS,
    CALLS_OF_OTHER_VERSIONS,
    COMPONENTS,
    CONTRACTION,
    CONTROL_FLOW,
    CUMULATIVE,
    DATA_MOVEMENT,
    ELEMENTWISE,
    LOGICAL_REDUCTIONS,
    PLACES_OF_EXTREMES,
    REDUCTIONS,
    SCATTERS,
)


# XLA calls a library for sums of more entries; this limit leaves a margin.
LARGEST_SUM = 2048
# The largest number of array operations of one function. The time of its compilation grows
# faster than its length.
LARGEST_PROGRAM = 8_700
# The same for a program whose parts can be functions. Parts compile in less time, and their
# steps take a fifth longer: with Newton's method two hinged bodies compile in 11 s in parts
# and in 25 s as one function, and take 13.5 us a step and 11.6 us.
LARGEST_OF_PARTS = 2_600
# The same for a program with running sums, sorts or factors, which grows when these are
# rewritten. As one function, an arm of six angles (5 000 operations) compiles in 14 s, and
# takes 120 us a step. As several, it compiles in 6 s, and takes 100 us.
LARGEST_THAT_GROWS = 4_000
# XLA calls a library for products of matrices with as many rows and columns.
_FEW = 8

# The name of the primitive that runs a program in one function; it is only bound where
# that is possible.
NAME = "enerjax_one_function"
_OTHERS = frozenset(
    """
    custom_vmap_call empty2 iota name optimization_barrier platform_index stop_gradient
    xla_metadata_value
    """.split()
)
POSSIBLE = (
    (ELEMENTWISE - COMPONENTS)
    | (DATA_MOVEMENT.keys() - SCATTERS)
    | (CALLS.keys() - CALLS_OF_OTHER_VERSIONS)
    | CONTROL_FLOW
    | _OTHERS
)
# These have forms in plain operations; see `small_matrices.py` and `rewriting.py`.
FACTORS = frozenset("cholesky lu lu_pivots_to_permutation sort triangular_solve".split())
GROWING = FACTORS | CUMULATIVE
POSSIBLE_IF_SMALL = REDUCTIONS | LOGICAL_REDUCTIONS | PLACES_OF_EXTREMES


def has_parts(jaxpr: Jaxpr) -> bool:
    """Whether a program has parts that become functions where the whole becomes none."""
    return any(
        is_part(eqn) or any(map(has_parts, programs_within(eqn))) for eqn in jaxpr.eqns
    )


def is_part(eqn: Any) -> bool:
    """Whether an equation is such a part."""
    return eqn.primitive.name == NAME and eqn.params["program"].is_part


def longest(jaxpr: Jaxpr) -> int:
    """The largest number of array operations of a program like this as one function."""
    if has_parts(jaxpr):
        return LARGEST_OF_PARTS
    return LARGEST_THAT_GROWS if _grows(jaxpr) else LARGEST_PROGRAM


def _grows(jaxpr: Jaxpr) -> bool:
    return any(
        eqn.primitive.name in GROWING or any(map(_grows, programs_within(eqn)))
        for eqn in jaxpr.eqns
    )


def is_possible(jaxpr: Jaxpr, assumed: Collection[str] = ()) -> bool:
    """Whether a program can be one function, if all primitives in `assumed` can be."""
    return next(obstacles(jaxpr, assumed), None) is None


def obstacles(jaxpr: Any, assumed: Collection[str] = ()) -> Iterator[list[Any]]:
    """What keeps a program from being one function, if all primitives in `assumed` can be.

    Each obstacle is a list. Its last entry is an equation, or a variable that holds no
    plain numbers; the others are the equations whose programs it is in, outermost first.
    """
    yield from ([x] for x in (*jaxpr.constvars, *jaxpr.invars) if not _is_plain(x))
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name in assumed or name == NAME:
            continue
        if name in POSSIBLE_IF_SMALL:
            possible = all(x.aval.size <= LARGEST_SUM for x in eqn.invars)
        elif name == CONTRACTION:
            possible = is_small_product(eqn)
        else:
            possible = name in POSSIBLE
        if not possible:
            yield [eqn]
        for inner in programs_within(eqn):
            yield from ([eqn, *within] for within in obstacles(inner, assumed))


def _is_plain(variable: Any) -> bool:
    """Whether a variable holds numbers, and not random keys or parts of bytes."""
    kind = variable.aval.dtype
    return jnp.issubdtype(kind, jnp.inexact) or getattr(kind, "kind", "key") in "iub"


def is_small_product(eqn: Any) -> bool:
    """Whether XLA writes a product out, instead of calling a library."""
    shapes = [x.aval.shape for x in eqn.invars]
    contracted, batch = eqn.params["dimension_numbers"]
    rows, columns = (
        math.prod(n for k, n in enumerate(shape) if k not in (*used, *of_batch))
        for shape, used, of_batch in zip(shapes, contracted, batch, strict=True)
    )
    terms = math.prod(shapes[0][k] for k in contracted[0])
    if max(x.aval.size for x in eqn.invars) > LARGEST_SUM:
        return False
    return max(rows, columns, terms) < _FEW or min(rows, columns) == 1
