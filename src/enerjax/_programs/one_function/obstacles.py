"""What keeps a computation from being one function of machine code, in words."""

from collections.abc import Callable
from typing import Any

import jax
from jax.extend import source_info_util
from jaxtyping import Array, PyTree

from ..counting import num_equations
from .marks import has_marks
from .possible import has_parts, longest, obstacles


def why_not_one_function(
    fn: Callable[..., PyTree[Array]], *args: PyTree[Array]
) -> tuple[str, ...]:
    """The operations that keep `fn(*args)` from being one function, and their lines.

    The result is empty if it can be one function.
    """
    if not has_marks():
        return ("this version of jaxlib, which cannot be told to make one function",)
    # Imported here, because other versions of JAX may define primitives in another way.
    from .program import Program
    from .rewriting import as_index, rewritten

    closed = jax.make_jaxpr(fn)(*args)
    known = [*map(as_index, closed.consts), *[None] * len(closed.jaxpr.invars)]
    if Program(closed.jaxpr, known).is_possible:
        return ()
    length = num_equations(closed.jaxpr)
    if length > longest(closed.jaxpr):
        parts = "; its parts are compiled apart" if has_parts(closed.jaxpr) else ""
        reason = f"its length, {length} array operations, which would compile slowly"
        return (reason + parts,)
    names = {_name(x[-1]) for x in obstacles(rewritten(closed.jaxpr, known).jaxpr)}
    # The lines are those of the program as it was written.
    lines = {_name(x[-1]): _line(x) for x in obstacles(closed.jaxpr)}
    return tuple(f"{name}{lines.get(name, '')}" for name in sorted(names))


def _name(obstacle: Any) -> str:
    is_operation = hasattr(obstacle, "primitive")
    return f"`{obstacle.primitive.name}`" if is_operation else "an array without numbers"


def _line(obstacle: list[Any]) -> str:
    """The line of an obstacle, or of the call that it is in."""
    info = [x.source_info for x in obstacle if hasattr(x, "source_info")]
    lines = [line for line in map(source_info_util.summarize, info) if line]
    return f" in {lines[-1]}" if lines else ""
