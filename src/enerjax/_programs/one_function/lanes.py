"""Batches of programs that are one function: one lane after the other, or side by side."""

from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..jaxprs import programs_within
from .program import (
    call as call,
    has_rate,
    merged,
    new_primitive,
    no_rate,
    ONE_FUNCTION,
    Program,
    run_closed,
    set_rule_for_batches,
    split,
)


if TYPE_CHECKING:
    from ..entrywise import ProgramInLanes


# The most lanes side by side: the numbers of more would not fit into the cache.
_WIDEST = 104
# Lanes side by side are a multiple of the first number, the width of vector registers, and
# none of the second: vectors at such distances share few places of the cache.
_ROUND, _ALIASED = 8, 64
# Programs with more operations than this compile for ten seconds longer and more (a heavy
# top in Euler parameters, two hinged bodies), and need this many times as many lanes.
_LONG, _MORE = 5_500, 50


def _lanes(numbers: Any, axes: Any, *, program: Program) -> tuple[list, list[int]]:
    batched = [axis is not None for axis in axes]
    own = [
        x if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(numbers, axes, strict=True)
    ]
    size = next(len(x) for x, on in zip(own, batched, strict=True) if on)
    out = None
    if _is_worth(program, size) and not any(map(_is_sharded, own)):
        other = _side_by_side(program)
        if other is not None:
            times = _MORE if other.length > _LONG else 1
            if _is_worth(program, size, times):
                out = IN_LANES.bind(*own, program=program, batched=tuple(batched))
    if out is None:
        out = _in_turn(program, program.own(own), program.own(batched))
    return out, [0] * len(out)


def _is_worth(program: Program, lanes: int, times: int = 1) -> bool:
    """Whether lanes run side by side, if that is possible."""
    other = program.in_lanes
    if other is None or (other.if_long and program.is_possible):
        return False
    return lanes >= times * other.fewest


def run_side_by_side(jaxpr: Any, lanes: int) -> bool:
    """Whether a part of a program is to run side by side in a batch, if possible."""
    return any(
        (eqn.primitive is ONE_FUNCTION and _is_worth(eqn.params["program"], lanes))
        or any(run_side_by_side(inner, lanes) for inner in programs_within(eqn))
        for eqn in jaxpr.eqns
    )


def _in_turn(
    program: Program, numbers: Sequence[Array], batched: Sequence[bool]
) -> list[Array]:
    """The lanes of a program, each with the iterations that it needs."""
    own, shared = split(batched, numbers)
    of_lane = lambda own: program(merged(batched, own, shared))
    still = len(batched) - program.linear
    if any(map(_is_sharded, own)) or not program.is_possible:
        # Each device computes its own lanes.
        return jax.vmap(of_lane)(own)
    if program.linear and not any(batched[:still]):
        # Many directions at one point share everything but the directions themselves.
        closed = jax.make_jaxpr(jax.vmap(of_lane))(own)
        wanted = [True] * len(closed.out_avals)
        return run_closed(closed, own, wanted, program.is_part, len(own))
    # The lanes run one after the other. With few lanes side by side, calling the operations
    # would take longer than a whole lane in one function; many lanes side by side do not
    # fit into the cache.
    closed = jax.make_jaxpr(lambda own: jax.lax.map(of_lane, own))(own)
    return run_closed(closed, own, [True] * len(closed.out_avals), program.is_part)


def _is_sharded(x: Array) -> bool:
    """Whether an array is sharded over axes of a mesh that its type names."""
    return any(axis is not None for axis in jax.typeof(x).sharding.spec)


set_rule_for_batches(ONE_FUNCTION, _lanes)


# Lanes side by side ---------------------------------------------------------------------


def _side_by_side(program: Program) -> "ProgramInLanes | None":
    """The program for lanes, if there is one and it is possible."""
    if program.in_lanes is None:
        return None
    return program.in_lanes.function


def _in_chunks(
    numbers: Sequence[Array], program: Program, batched: Sequence[bool]
) -> tuple[list[Array], Array]:
    """The results of all lanes side by side, and for which lanes they are none."""
    fn = _side_by_side(program)
    assert fn is not None
    count = len(program.known)
    numbers, batched = numbers[count:], batched[count:]
    lanes = next(len(x) for x, on in zip(numbers, batched, strict=True) if on)
    needed = [numbers[k] for k in fn.needed]
    is_own = [batched[k] for k in fn.needed]
    own, shared = split(is_own, needed)
    chunks = -(-lanes // _WIDEST)
    width = -(-lanes // (chunks * _ROUND)) * _ROUND
    width += _ROUND if width % _ALIASED == 0 else 0
    chosen = np.minimum(np.arange(chunks * width), lanes - 1)

    def columns(x: Array) -> Array:
        x = x[chosen] if chosen.size > lanes else x
        return jnp.swapaxes(x.reshape(chunks, width, x.size // len(x)), 1, 2)

    rows = [jnp.broadcast_to(x.reshape(-1, 1), (x.size, width)) for x in shared]
    found = jax.lax.map(
        lambda own: fn(merged(is_own, own, rows), width), list(map(columns, own))
    )
    # The axis of the lanes of a chunk becomes the second one.
    found = (
        jnp.moveaxis(x, -1, 1).reshape(chunks * width, *x.shape[1:-1])[:lanes]
        for x in found
    )

    def output(same: int | None) -> Array:
        if same is None:
            return next(found)
        x = numbers[same]
        return x if batched[same] else jnp.broadcast_to(x, (lanes, *x.shape))

    *out, failed = map(output, fn.same)
    return out, failed


def _with_failed_again(
    *numbers: Array, program: Program, batched: Sequence[bool]
) -> list[Array]:
    out, failed = _in_chunks(numbers, program, batched)
    batched, numbers = program.own(batched), program.own(numbers)
    own, shared = split(batched, numbers)

    def of_lane(inputs: tuple[Array, list[Array], list[Array]]) -> list[Array]:
        failed, found, own = inputs
        again = lambda: program(merged(batched, own, shared))
        return jax.lax.cond(failed, again, lambda: found)

    def again() -> list[Array]:
        inputs = failed, out, own
        closed = jax.make_jaxpr(lambda *inputs: jax.lax.map(of_lane, inputs))(*inputs)
        wanted = [True] * len(closed.out_avals)
        return run_closed(closed, jax.tree.leaves(inputs), wanted, program.is_part)

    return jax.lax.cond(jnp.any(failed), again, lambda: out)


def _evaluated(*numbers: Array, **params: Any) -> list[Array]:
    return jax.jit(lambda *numbers: _with_failed_again(*numbers, **params))(*numbers)


def _shapes(*numbers: Any, program: Program, batched: Sequence[bool]) -> list[Any]:
    (lanes, *_), *_ = (x.shape for x, on in zip(numbers, batched, strict=True) if on)
    return [x.aval.update(shape=(lanes, *x.aval.shape)) for x in program.jaxpr.outvars]


def _jvp(
    primals: Any, tangents: Any, *, program: Program, batched: Sequence[bool]
) -> tuple[list, list]:
    """Derivatives are those of lanes that run one after the other."""
    batched = program.own(batched)
    primals, tangents = program.own(primals), program.own(tangents)
    has_tangent = list(map(has_rate, tangents))
    moved, still = split(has_tangent, primals)
    rates, _ = split(has_tangent, tangents)
    run = lambda *moved: _in_turn(program, merged(has_tangent, moved, still), batched)
    out, rates = jax.jvp(run, tuple(moved), tuple(rates))
    is_smooth = lambda x: jnp.issubdtype(x.dtype, jnp.inexact)
    pairs = zip(out, rates, strict=True)
    return out, [t if is_smooth(x) else no_rate(x) for x, t in pairs]


def _more_lanes(
    numbers: Any, axes: Any, *, program: Program, batched: Sequence[bool]
) -> tuple[list, list[int]]:
    """A batch of batches, as one batch of all lanes."""
    more = next(x.shape[k] for x, k in zip(numbers, axes, strict=True) if k is not None)
    lanes = next(
        x.shape[1 if k == 0 else 0]
        for x, k, on in zip(numbers, axes, batched, strict=True)
        if on
    )

    def joined(x: Array, axis: int | None, on: bool) -> Array:
        if axis is None and not on:
            return x
        x = x[None] if axis is None else jnp.moveaxis(x, axis, 0)
        x = x if on else x[:, None]
        shape = x.shape[2:]
        return jnp.broadcast_to(x, (more, lanes, *shape)).reshape(more * lanes, *shape)

    numbers = list(map(joined, numbers, axes, batched))
    joint = tuple(on or k is not None for on, k in zip(batched, axes, strict=True))
    out = IN_LANES.bind(*numbers, program=program, batched=joint)
    out = [x.reshape(more, lanes, *x.shape[1:]) for x in out]
    return out, [0] * len(out)


IN_LANES = new_primitive("enerjax_in_lanes", _evaluated, _shapes, _jvp, _with_failed_again)
set_rule_for_batches(IN_LANES, _more_lanes)
