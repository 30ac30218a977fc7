"""The sizes of programs."""

import math
from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, PyTree

from .jaxprs import programs_within
from .primitives import CONTRACTION, DATA_MOVEMENT, REDUCTIONS


def num_equations(jaxpr: Any) -> int:
    """The number of array operations of a program, including those of all branches."""
    inner = lambda eqn: sum(map(num_equations, programs_within(eqn)))
    return sum(inner(eqn) or 1 for eqn in jaxpr.eqns)


def num_operations(fn: Callable[..., PyTree[Array]], *args: PyTree[Array]) -> int:
    """The number of scalar operations of `fn(*args)`.

    Counted are one pass of each `while`, and the longest branch of each `cond`.
    """
    return _num_operations(jax.make_jaxpr(fn)(*args).jaxpr)


def _num_operations(jaxpr: Any) -> int:
    return sum(map(_operations_of, jaxpr.eqns))


def _operations_of(eqn: Any) -> int:
    name, params = eqn.primitive.name, eqn.params
    inner = [_num_operations(program) for program in programs_within(eqn)]
    if name == "cond":
        return max(inner)
    if inner:
        return params.get("length", 1) * sum(inner)
    size = sum(x.aval.size for x in eqn.outvars)
    if name == CONTRACTION:
        (contracted, _), _ = params["dimension_numbers"]
        return 2 * size * math.prod(eqn.invars[0].aval.shape[k] for k in contracted)
    if name in REDUCTIONS:
        return eqn.invars[0].aval.size
    return 0 if name in DATA_MOVEMENT else size
