"""What keeps a computation from being one function of machine code, in words."""

import math
from collections.abc import Callable
from typing import Any

import jax
from jax.extend import source_info_util
from jaxtyping import Array, PyTree

from ..primitives import CONTRACTION, DATA_MOVEMENT, REDUCTIONS
from ..tracing import programs_within
from .marks import has_marks
from .possible import is_possible, LARGEST_PROGRAM, num_equations, obstacles


def why_not_one_function(
    fn: Callable[..., PyTree[Array]], *args: PyTree[Array]
) -> tuple[str, ...]:
    """The operations that keep `fn(*args)` from being one function, and where they are.

    The result is empty if it can be one function.
    """
    if not has_marks():
        return ("this version of jaxlib, which cannot be told to make one function",)
    # Imported here, because other versions of JAX may define primitives in another way.
    from .rewriting import as_index, rewritten

    closed = jax.make_jaxpr(fn)(*args)
    length = num_equations(closed.jaxpr)
    if length > LARGEST_PROGRAM:
        return (f"its length, {length} array operations, which would compile slowly",)
    if is_possible(closed.jaxpr):
        return ()
    known = [*map(as_index, closed.consts), *[None] * len(closed.jaxpr.invars)]
    names = set(map(_name, obstacles(rewritten(closed.jaxpr, known).jaxpr)))
    # The places are those of the program as it was written.
    found = {_name(x): _place(x) for x in obstacles(closed.jaxpr) if _name(x) in names}
    return tuple(f"{name}{found.get(name, '')}" for name in sorted(names))


def _name(obstacle: Any) -> str:
    is_operation = hasattr(obstacle, "primitive")
    return f"`{obstacle.primitive.name}`" if is_operation else "an array without numbers"


def _place(obstacle: Any) -> str:
    info = getattr(obstacle, "source_info", None)
    line = "" if info is None else source_info_util.summarize(info)
    return f" in {line}" if line else ""


def num_operations(fn: Callable[..., PyTree[Array]], *args: PyTree[Array]) -> int:
    """The number of scalar operations of `fn(*args)`, with one pass of each `while`."""
    return _count(jax.make_jaxpr(fn)(*args).jaxpr)


def _count(jaxpr: Any) -> int:
    count = 0
    for eqn in jaxpr.eqns:
        name, params, inner = eqn.primitive.name, eqn.params, list(programs_within(eqn))
        size = sum(x.aval.size for x in eqn.outvars)
        if name == "cond":
            count += max(map(_count, inner))
        elif inner:
            count += params.get("length", 1) * sum(map(_count, inner))
        elif name == CONTRACTION:
            contracted, _ = params["dimension_numbers"]
            shape = eqn.invars[0].aval.shape
            count += 2 * size * math.prod(shape[k] for k in contracted[0])
        elif name in REDUCTIONS:
            count += eqn.invars[0].aval.size
        elif name not in DATA_MOVEMENT:
            count += size
    return count
