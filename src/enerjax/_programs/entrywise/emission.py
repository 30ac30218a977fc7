"""Loops over lanes that compute the entries of a region."""

from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .entries import Entry, Number, Region
from .evaluation import Scan, While
from .kernels import filled, kernel


# The number of operations of one kernel: the time of compilation grows faster than that.
_LONGEST = 1_500

_Known = dict[Entry, Array]


def values_of(
    region: Region, numbers: list[Number], known: _Known, size: int
) -> tuple[list[Array], _Known]:
    """The values of some numbers for each of `size` lanes, and all that were computed.

    `known` are the values of the inputs of the region and of the entries around it.
    """
    known = dict(known)
    needed = [*numbers, *(x for loop in region.loops for x in _inputs(loop))]
    order = _sorted(region, needed)
    roots = {x for x in needed if isinstance(x, Entry)}
    for level in range(len(region.loops) + 1):
        here = [x for x in order if x.level == level]
        later = (x for x in order if x.level > level)
        wanted = roots.union(y for x in later for y in x.operands if isinstance(y, Entry))
        for part, cut in _parts(here, wanted):
            if cut:
                known.update(zip(cut, kernel(part, cut, known), strict=True))
        if level < len(region.loops):
            loop = region.loops[level]
            run = _scan if isinstance(loop, Scan) else _while
            known.update(zip(loop.after, run(loop, known, size), strict=True))
    return [_read(x, known, size) for x in numbers], known


def _read(number: Number, known: _Known, size: int) -> Array:
    return known[number] if isinstance(number, Entry) else filled(number, size)


def _parts(
    entries: list[Entry], wanted: set[Entry]
) -> Iterator[tuple[list[Entry], list[Entry]]]:
    """Kernels of moderate length, and the entries of each that are needed elsewhere."""
    count = -(-len(entries) // _LONGEST) or 1
    length = -(-len(entries) // count)
    parts = [entries[k * length : (k + 1) * length] for k in range(count)]
    for k, part in enumerate(parts):
        rest = (y for later in parts[k + 1 :] for x in later for y in x.operands)
        elsewhere = wanted.union(y for y in rest if isinstance(y, Entry))
        yield part, [x for x in part if x in elsewhere]


def _sorted(region: Region, numbers: Iterable[Number]) -> list[Entry]:
    """The operations of a region that numbers depend on, operands first."""
    done: set[Entry] = set()
    order: list[Entry] = []
    for number in numbers:
        stack = [(number, False)]
        while stack:
            x, is_ready = stack.pop()
            if not isinstance(x, Entry) or x.primitive is None or x.region is not region:
                continue
            if is_ready:
                order.append(x)
            elif x not in done:
                done.add(x)
                stack.append((x, True))
                stack.extend((y, False) for y in reversed(x.operands))
    return order


def _inputs(loop: While | Scan) -> list[Entry]:
    """The entries around a loop that its passes depend on, and those that it begins with."""
    found: dict[Entry, None] = {}
    seen: set[Entry] = set()
    stack: list[Any] = [*loop.outputs, *_inner_inputs(loop.region)]
    while stack:
        x = stack.pop()
        if not isinstance(x, Entry) or x in seen:
            continue
        seen.add(x)
        if x.region.depth < loop.region.depth:
            found[x] = None
        else:
            stack.extend(x.operands)
    before = (x for x in loop.inputs if isinstance(x, Entry))
    return list(dict.fromkeys([*before, *found]))


def _inner_inputs(region: Region) -> Iterator[Entry]:
    for loop in region.loops:
        yield from _inputs(loop)


def _while(loop: While, known: _Known, size: int) -> list[Array]:
    before = [_read(x, known, size) for x in loop.inputs]

    def turn(carry: list[Array]) -> list[Array]:
        now = known | dict(zip([*loop.carry, loop.active], carry, strict=True))
        return values_of(loop.region, loop.outputs, now, size)[0]

    return jax.lax.while_loop(lambda carry: jnp.any(carry[-1]), turn, before)[:-1]


def _scan(loop: Scan, known: _Known, size: int) -> list[Array]:
    before = [_read(x, known, size) for x in loop.before]
    rows = [_rows(column, known, size) for _, column in loop.rows]

    def turn(carry: list[Array], row: list[Array]) -> tuple[list[Array], list[Array]]:
        now = known | dict(zip(loop.carry, carry, strict=True))
        entries = (entry for entry, _ in loop.rows)
        now |= {x: jnp.broadcast_to(y, (size,)) for x, y in zip(entries, row, strict=True)}
        out, _ = values_of(loop.region, loop.outputs, now, size)
        return out[: len(carry)], out[len(carry) :]

    carry, stacked = jax.lax.scan(
        turn, before, rows, length=loop.length, reverse=loop.reverse
    )
    return [*carry, *stacked]


def _rows(column: list[Number], known: _Known, size: int) -> Array:
    if not any(isinstance(x, Entry) for x in column):
        return jnp.array(column, column[0].dtype)
    return jnp.stack([_read(x, known, size) for x in column])
