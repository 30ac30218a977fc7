"""Loops and branches of programs that are evaluated entry by entry."""

import itertools
from collections.abc import Callable
from typing import Any, TYPE_CHECKING

import numpy as np
from jax import lax

from .entries import (
    array_of,
    Entry,
    is_same,
    Number,
    objects,
    Region,
    scalar,
    UnsupportedError,
)


if TYPE_CHECKING:
    from .evaluation import Evaluation


# Loops of at most this length within a step are unrolled; longer ones are not supported.
_UNROLLED = 8


class While:
    """A loop whose passes go on until no lane is active; a lane that has ended keeps its
    values.

    - `carry`, `results`: the entries that change, as the inputs and the results of a pass.
    - `before`, `after`: their values before the loop, and entries for those after it.
    - `active`: whether the lane is active at the beginning of a pass; `first` before the
      first pass, `remains` after a pass.
    """

    def __init__(self, region: Region):
        self.region = region
        self.carry: list[Entry] = []
        self.before: list[Number] = []
        self.results: list[Number] = []
        self.after: list[Entry] = []
        self.active = Entry(bool, region)
        self.first: Number = np.True_
        self.remains: Number = np.True_

    @property
    def inputs(self) -> list[Number]:
        return [*self.before, self.first]

    @property
    def outputs(self) -> list[Number]:
        return [*self.results, self.remains]


class Scan:
    """A loop of a fixed number of passes, which stacks what it returns of each.

    - `carry`, `results`, `before`, `after`: as in `While`.
    - `rows`: the inputs of a pass, with the values of all passes.
    - `stacked`: the numbers that each pass returns.
    """

    def __init__(self, region: Region, length: int, reverse: bool):
        self.region, self.length, self.reverse = region, length, reverse
        self.carry: list[Entry] = []
        self.before: list[Number] = []
        self.results: list[Number] = []
        self.after: list[Entry] = []
        self.rows: list[tuple[Entry, list[Number]]] = []
        self.stacked: list[Number] = []

    @property
    def inputs(self) -> list[Number]:
        return [*self.before, *(x for _, values in self.rows for x in values)]

    @property
    def outputs(self) -> list[Number]:
        return [*self.results, *self.stacked]


class Stack:
    """What all passes of a loop return, shape `(passes, *shape)`, as entries with rows."""

    def __init__(self, entries: list[Entry]):
        self.entries = entries


def _cond(self: "Evaluation", values: list[Any], params: dict[str, Any]) -> list[Any]:
    index, *operands = values
    branches = params["branches"]
    (which,) = objects(index).ravel()
    if isinstance(which, np.generic):
        return self.closed(branches[int(np.clip(which, 0, len(branches) - 1))], operands)
    if len(branches) != 2:
        raise UnsupportedError("a branch among many")
    loops = len(self.region.loops)
    first, second = (self.closed(branch, operands) for branch in branches)
    if len(self.region.loops) > loops:
        raise UnsupportedError("a loop in a branch")
    graph = self.graph
    zero = scalar(0, which.dtype)
    on = graph.number(lax.ne_p, (which, zero), {}, np.bool_)
    return [
        array_of(
            (graph.chosen(on, *pair) for pair in zip(a.ravel(), b.ravel(), strict=True)),
            aval.shape,
            aval.dtype,
        )
        for a, b, aval in (
            (objects(a), objects(b), aval)
            for a, b, aval in zip(first, second, branches[0].out_avals, strict=True)
        )
    ]


class _Held:
    """Which entries of a carry are replaced in a pass; all others keep their values."""

    def __init__(self, before: list[Number]):
        self.before = before
        self.moves = [isinstance(x, Entry) for x in before]
        self._settled = False

    def settles(self, carry: list[Number], results: list[Number]) -> bool:
        """Whether a pass from `carry` to `results` changes just the entries that move."""
        same = list(map(is_same, carry, results))
        changed = any(not on and not eq for on, eq in zip(self.moves, same, strict=True))
        kept = any(on and eq for on, eq in zip(self.moves, same, strict=True))
        # A number that changes after all moves from now on; what stays is held once.
        if changed:
            self.moves = [on or not eq for on, eq in zip(self.moves, same, strict=True)]
        elif kept:
            self.moves = [on and not eq for on, eq in zip(self.moves, same, strict=True)]
        return not (changed or kept)


def _flat(arrays: list[np.ndarray]) -> list[Number]:
    return [x for array in arrays for x in objects(array).ravel()]


def _shaped(numbers: list[Number], avals: Any) -> list[np.ndarray]:
    remaining = iter(numbers)
    return [
        array_of(itertools.islice(remaining, aval.size), aval.shape, aval.dtype)
        for aval in avals
    ]


def _carry(loop: Any, held: _Held) -> list[Number]:
    """The numbers of a carry at the beginning of a pass; those that move are new."""
    carry = [
        Entry(x.dtype, loop.region) if moves else x
        for x, moves in zip(held.before, held.moves, strict=True)
    ]
    loop.carry = _moving(held, carry)
    loop.before = _moving(held, held.before)
    return carry


def _moving(held: _Held, numbers: list[Any]) -> list[Any]:
    return [x for x, moves in zip(numbers, held.moves, strict=True) if moves]


def _after(self: "Evaluation", loop: Any, held: _Held) -> list[Number]:
    """The carry after a loop, which becomes a loop of the region."""
    self.region.loops.append(loop)
    level = len(self.region.loops)
    loop.after = [Entry(x.dtype, self.region, level) for x in loop.carry]
    new = iter(loop.after)
    return [
        next(new) if moves else x for x, moves in zip(held.before, held.moves, strict=True)
    ]


def _while(self: "Evaluation", values: list[Any], params: dict[str, Any]) -> list[Any]:
    first, second = params["cond_nconsts"], params["body_nconsts"]
    outer, inner = values[:first], values[first : first + second]
    avals = params["body_jaxpr"].out_avals
    goes_on = lambda inside, carry: _flat(
        inside.closed(params["cond_jaxpr"], [*outer, *_shaped(carry, avals)])
    )[0]
    held = _Held(_flat(values[first + second :]))
    while True:
        loop = While(Region(self.region))
        inside = self.within(loop.region, loop.active)
        carry = _carry(loop, held)
        closed = params["body_jaxpr"]
        new = _flat(inside.closed(closed, [*inner, *_shaped(carry, avals)]))
        if held.settles(carry, new):
            break
    choose = lambda old, new: self.graph.chosen(loop.active, old, new)
    loop.results = list(map(choose, loop.carry, _moving(held, new)))
    remaining = iter(loop.results)
    later = [next(remaining) if on else x for x, on in zip(carry, held.moves, strict=True)]
    loop.remains = self.graph.both(loop.active, goes_on(inside, later))
    loop.first = self.graph.both(self.mask, goes_on(self, held.before))
    return _shaped(_after(self, loop, held), avals)


def _scan(self: "Evaluation", values: list[Any], params: dict[str, Any]) -> list[Any]:
    closed, length = params["jaxpr"], params["length"]
    count, first = params["num_carry"], params["num_consts"]
    consts, rows = values[:first], values[first + count :]
    carry = values[first : first + count]
    if self.region.depth == 0 and length > 1:
        return _long_scan(self, closed, consts, carry, rows, params)
    if length > _UNROLLED:
        raise UnsupportedError("a long loop in a step")
    stacked = []
    order = range(length)[:: -1 if params["reverse"] else 1]
    for k in order:
        own = [_row_of(x, k) for x in rows]
        out = self.closed(closed, [*consts, *carry, *own])
        carry = out[:count]
        stacked.append(out[count:])
    stacked = stacked[:: -1 if params["reverse"] else 1]
    avals = closed.out_avals[count:]
    joined = [
        array_of(
            (x for row in stacked for x in objects(row[k]).ravel()),
            (length, *aval.shape),
            aval.dtype,
        )
        for k, aval in enumerate(avals)
    ]
    return [*carry, *joined]


def _row_of(x: Any, k: int) -> np.ndarray:
    """Row `k` of an array of numbers."""
    x = np.asarray(x)
    if x.dtype != object:
        return np.asarray(x[k])
    numbers = x[k : k + 1].ravel()
    return array_of(numbers, x.shape[1:], numbers[0].dtype) if numbers.size else x[k]


def _long_scan(
    self: "Evaluation",
    closed: Any,
    consts: list[Any],
    carry_before: list[Any],
    rows: list[Any],
    params: dict[str, Any],
) -> list[Any]:
    length, count = params["length"], params["num_carry"]
    avals = closed.out_avals
    held = _Held(_flat(carry_before))
    while True:
        loop = Scan(Region(self.region), length, params["reverse"])
        inside = self.within(loop.region, self.mask)
        carry = _carry(loop, held)
        loop.rows = []
        own = [_row(loop, x) for x in rows]
        out = inside.closed(closed, [*consts, *_shaped(carry, avals[:count]), *own])
        new = _flat(out[:count])
        if held.settles(carry, new):
            break
    loop.results = _moving(held, new)
    loop.stacked = _flat(out[count:])
    after = _shaped(_after(self, loop, held), avals[:count])
    return [*after, *_stacks(self, loop, avals[count:])]


def _row(loop: Scan, x: Any) -> np.ndarray:
    """The row of a pass."""
    x = objects(x)
    columns = x.reshape(loop.length, -1).T
    entries = []
    for column in columns:
        if all(is_same(column[0], other) for other in column):
            entries.append(column[0])
            continue
        entry = Entry(column[0].dtype, loop.region)
        loop.rows.append((entry, list(column)))
        entries.append(entry)
    dtype = entries[0].dtype if entries else float
    return array_of(entries, x.shape[1:], dtype)


def _stacks(self: "Evaluation", loop: Scan, avals: Any) -> list[Any]:
    level = len(self.region.loops)
    entries = [Entry(x.dtype, self.region, level) for x in loop.stacked]
    loop.after.extend(entries)
    remaining, out = iter(entries), []
    for aval in avals:
        boxed = np.empty((), object)
        boxed[()] = Stack(list(itertools.islice(remaining, aval.size)))
        out.append(boxed)
    return out


LOOPS: dict[str, Callable[[Any, list[Any], dict[str, Any]], list[Any]]] = {
    "cond": _cond,
    "scan": _scan,
    "while": _while,
}
