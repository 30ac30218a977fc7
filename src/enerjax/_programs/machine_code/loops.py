"""Loops and branches while a program is compiled.

The body of a loop is a region of the graph of its own, whose carry has cells of its own.
Operations of a body that do not depend on the carry are moved out of it.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TYPE_CHECKING, TypeGuard

import numpy as np
from jax.extend.core import Literal

from ..counting import num_equations
from ..jaxprs import parts_of_scan
from .computed_places import starts_of_slice
from .graph import Node, Number, Region
from .values import (
    Block,
    Carried,
    Cells,
    columns_along,
    dtype_of,
    has_constants_among_others,
    Memory,
    MOST_CELLS,
    objects,
    shared,
    strides_of,
    type_name,
    Unsupported,
    usual_lane,
    Value,
)


if TYPE_CHECKING:
    from .evaluation import Evaluation


# The number of passes that are made at a time, if they do not depend on one another.
WIDTH = 4
# With more numbers in a carry than this, its kernels may be divided.
_MANY = 500
# Loops with no more operations than this in all passes are written out.
_WRITTEN_OUT = 150


class Scan:
    """`length` passes of a body; `counter` is the cell that has the number of the pass.

    With `is_wide` several passes are made at a time.
    """

    def __init__(
        self, body: Region, length: int, reverse: bool, counter: int, is_wide: bool
    ):
        self.body, self.length, self.reverse = body, length, reverse
        self.is_wide = is_wide
        self.counter = counter
        self.level = 0

    @property
    def places(self) -> list[int]:
        """The cells that decide what is run."""
        return [self.counter]

    @property
    def regions(self) -> list[Region]:
        return [self.body]


class While:
    """Passes of a body while a condition holds.

    - `head`: computes the condition, which is in the cell `flag`.
    - `before`: what the body needs and does not change; runs once if there is a pass.
    """

    def __init__(self, head: Region, before: Region, body: Region, flag: int):
        self.head, self.before, self.body, self.flag = head, before, body, flag
        self.level = 0

    @property
    def places(self) -> list[int]:
        return [self.flag]

    @property
    def regions(self) -> list[Region]:
        return [self.head, self.before, self.body]


class Branch:
    """One of several regions, whose number is in the cell `which`.

    `marker` stands for the level from which the number can be read.
    """

    def __init__(self, branches: list[Region], which: int, marker: Node):
        self.branches, self.which, self.marker = branches, which, marker
        self.level = 0

    @property
    def places(self) -> list[int]:
        return [self.which]

    @property
    def regions(self) -> list[Region]:
        return self.branches


def _finish(
    self: "Evaluation", item: Any, extra: Sequence[Node] = (), least: int = 0
) -> None:
    """Puts an item into the current region, after all that it reads.

    Its level is `least` or more.
    """
    region = self.graph.current
    read = (x for x in [*_read_from(region, item), *extra] if x.region is region)
    item.level = max([least, *(x.level for x in read)])
    region.items.append(item)


def _read_from(region: Region, item: Any) -> list[Node]:
    """The nodes of a region that an item reads."""
    found = []
    if isinstance(item, Branch) and item.marker.region is region:
        found.append(item.marker)
    for inner in item.regions:
        for node in inner.nodes:
            if node.region is region:
                found.append(node)
            found.extend(
                x for x in node.operands if isinstance(x, Node) and x.region is region
            )
        for other in inner.items:
            found.extend(_read_from(region, other))
    return found


# Cells that are written -------------------------------------------------------------------


def _store(
    self: "Evaluation",
    x: Number,
    dtype: str,
    places: np.ndarray | int,
    region: Region,
    level: int,
    counter: Node | None = None,
    stride: int = 0,
    mask: int | None = None,
) -> Node:
    """Writes a number, or one for each lane, to cells of its own.

    Where several passes are made at a time, only those of the mask write.
    """
    operands = (x,) if counter is None else (x, counter)
    if isinstance(places, int):
        extra, lanes = (places, 0, None, stride, mask), 0
    else:
        steps = np.diff(places)
        affine = steps.size == 0 or bool(np.all(steps == steps[0]))
        step, lanes = int(steps[0]) if steps.size else 1, places.size
        first, step, table = (
            (int(places[0]), step, None) if affine else self.cellar.scattered(places)
        )
        extra = first, step, table, stride, mask
    return self.graph.at(region, level, "store", dtype, operands, extra, lanes)


def _stores(
    self: "Evaluation",
    value: Value,
    places: np.ndarray,
    region: Region,
    level: int,
    counter: Node | None = None,
    stride: int = 0,
    mask: int | None = None,
) -> list[Node]:
    """Writes an array to cells."""
    if math.prod(value.shape) == 0:
        return []
    dtype = dtype_of(value)
    numbers, cells = _numbers(self, value, places)
    out = []
    for x, at in zip(numbers, cells, strict=True):
        if isinstance(x, Node) and x.op == "load" and counter is None:
            if _is_in_place(self, x, at):
                continue
        now = level
        if isinstance(x, Node) and x.region is region:
            now = max(now, x.level + 1 if x.is_reduced else x.level)
        out.append(_store(self, x, dtype, at, region, now, counter, stride, mask))
    return out


def _numbers(
    self: "Evaluation", value: Value, places: np.ndarray
) -> tuple[list[Number], list[Any]]:
    """The numbers of an array, with the cells that they are written to."""
    if not isinstance(value, Cells):
        found = self.cellar.columns(places.ravel())
        if found is not None:
            memory, to = self.cellar.memory(value).places.ravel(), places.ravel()
            dtype, parts = dtype_of(value), found[0]
            numbers = [self.cellar.lanes_at(memory[x], dtype) for x in parts]
            numbers += [self.cellar.number_at(int(p), dtype) for p in memory[found[1]]]
            return numbers, [*(to[x] for x in parts), *to[found[1]].tolist()]
    lane = _lane(value)
    if lane is None:
        numbers = self.cellar.unlaned(value).ravel().tolist()
        return numbers, places.ravel().tolist()
    numbers = self.cellar.laned(value, lane).ravel().tolist()
    return numbers, list(columns_along(places, lane))


def _is_in_place(self: "Evaluation", x: Node, at: Any) -> bool:
    if isinstance(at, int):
        return not x.lanes and x.extra == at
    return bool(x.lanes) and np.array_equal(self.cellar.loaded_places(x), at)


def _lane(value: Value) -> int | None:
    if isinstance(value, Cells):
        return value.lane
    lane = usual_lane(value.shape)
    size = math.prod(value.shape)
    if lane is not None and size // value.shape[lane] > MOST_CELLS:
        return None if size <= 4 * MOST_CELLS else lane
    return lane


def _block(
    self: "Evaluation", value: Value, copies: int = 1, slices: Sequence[int] | None = None
) -> tuple[list[Block], np.ndarray]:
    """New cells for an array, and who owns them.

    The lanes of each number are neighbours. `copies` is the number of rows of such arrays.
    An array of which a loop changes slices of a given shape has the lanes of these.
    """
    shape, region = value.shape, self.graph.current
    size, places = math.prod(shape), np.zeros(math.prod(shape), np.int64)
    parts: list[np.ndarray] = []
    if isinstance(value, Cells) and value.lane is not None:
        parts = list(columns_along(np.arange(size).reshape(shape), value.lane))
    elif isinstance(value, Memory):
        found = self.cellar.columns(value.places.ravel())
        parts = [] if found is None else [*found[0], *([found[1]] if found[1].size else [])]
    if slices is not None:
        lane = usual_lane(tuple(slices))
        lane = len(shape) - 1 if lane is None else lane
        parts = [columns_along(np.arange(size).reshape(shape), lane).ravel()]
    if not parts:
        lane = usual_lane(shape)
        hint = self.rows_of.get(size) if len(shape) == 1 else None
        if hint is not None:
            parts = list(np.arange(size).reshape(hint).T)
        elif lane is None:
            parts = [np.arange(size)]
        else:
            parts = list(columns_along(np.arange(size).reshape(shape), lane))
    if copies > 1:
        sizes = {part.size for part in parts}
        owners = [Block(region, 0, sizes.pop() if len(sizes) == 1 else 1)]
        first = self.cellar.new(copies * size, owners[0])
    else:
        owners = [Block(region, 0, part.size) for part in parts]
        # Without gaps, because loops may change slices across several parts.
        first = self.cellar.neighbours([part.size for part in parts], owners)
    places[np.concatenate(parts)] = first + np.arange(size)
    return owners, places.reshape(shape)


def _same_through(jaxpr: Any, count: int, first: int, offset: int = 0) -> list[bool]:
    """Which entries of a carry a body returns as they are."""
    inputs = jaxpr.invars[first : first + count]
    outs = jaxpr.outvars[offset : offset + count]
    return [a is b for a, b in zip(inputs, outs, strict=True)]


class _Slice(NamedTuple):
    """What a pass writes into an array of its carry, and the entry where this begins."""

    value: Value
    starts: list[Value]

    def offset(
        self, evaluation: "Evaluation", places: np.ndarray
    ) -> tuple[Node | None, np.ndarray]:
        """The distance of the slice from the first slice of the array, and the cells of the
        first slice. The cells of the array are `places`."""
        graph, shape, offset = evaluation.graph, self.value.shape, 0
        strides = strides_of(places)
        assert strides is not None
        starts = starts_of_slice(evaluation, self.starts, places.shape, shape)
        for start, stride in zip(starts, strides, strict=True):
            offset = graph.add("i8", offset, graph.multiply("i8", start, stride))
        first = places[tuple(slice(0, n) for n in shape)]
        if isinstance(offset, Node):
            evaluation.cellar.place_of(offset, "i8")
            return offset, first
        return None, first + offset


class _Body:
    """The program of a pass, without its last operations on the carry.

    Where the last operation on an array of the carry is to change a slice of it, the pass
    only has to write the slice.

    - `jaxpr`: what the program is without these operations. In place of such arrays it
      returns their slices, and after all others, where the slices begin.
    - `changes`: these operations, by the number of the array in the carry.
    """

    def __init__(self, closed: Any, count: int, first: int):
        jaxpr = closed.jaxpr
        self._consts, self._count = closed.consts, len(jaxpr.outvars)
        inputs, outs = jaxpr.invars[first : first + count], list(jaxpr.outvars)
        updates = {
            eqn.outvars[0]: eqn
            for eqn in jaxpr.eqns
            if eqn.primitive.name == "dynamic_update_slice"
        }
        read = [*outs, *(x for eqn in jaxpr.eqns for x in eqn.invars)]
        self.changes: dict[int, Any] = {}
        for k, (before, after) in enumerate(zip(inputs, outs[:count], strict=True)):
            eqn = None if isinstance(after, Literal) else updates.get(after)
            if eqn is None or eqn.invars[0] is not before:
                continue
            is_array = bool(before.aval.shape) and eqn.invars[1].aval.size > 0
            if is_array and sum(x is after for x in read) == 1:
                self.changes[k] = eqn
        for k, eqn in self.changes.items():
            outs[k] = eqn.invars[1]
            outs += eqn.invars[2:]
        gone = {id(eqn) for eqn in self.changes.values()}
        left = [eqn for eqn in jaxpr.eqns if id(eqn) not in gone]
        self.jaxpr = _Program(jaxpr.constvars, jaxpr.invars, left, outs)

    def shape_of_slices(self, number: int) -> tuple[int, ...] | None:
        """The shape of the slices that passes change of an array of the carry."""
        eqn = self.changes.get(number)
        return None if eqn is None else eqn.invars[1].aval.shape

    def __call__(self, evaluation: "Evaluation", values: Sequence[Value]) -> list[Any]:
        """The outputs of a pass, with a `_Slice` for each array that it changes in part."""
        outs: list[Any] = evaluation.program(self.jaxpr, self._consts, values)
        outs = _as_types(outs, [x.aval for x in self.jaxpr.outvars])
        starts = iter(outs[self._count :])
        for k, eqn in self.changes.items():
            outs[k] = _Slice(outs[k], [next(starts) for _ in eqn.invars[2:]])
        return outs[: self._count]


class _Program(NamedTuple):
    """What is evaluated of a program of JAX."""

    constvars: Sequence[Any]
    invars: Sequence[Any]
    eqns: Sequence[Any]
    outvars: Sequence[Any]


class _Carry:
    """The cells of a carry.

    A loop in the body of another loop can take over the cells of the carry of that loop.
    Only a `while` does: a scan writes in lanes that have ended, too.
    """

    def __init__(
        self,
        self_: "Evaluation",
        values: list[Value],
        same: list[bool],
        body: _Body,
        takes_over: bool = False,
    ):
        self.evaluation = self_
        self.values, self.same = values, same
        # The owners say in which region the cells are read; see `While`.
        self.owners: list[list[Block]] = []
        self.places: list[np.ndarray | None] = []
        # The level from which the cells that are taken over can be read.
        self.ready = 0
        for k, (value, stays) in enumerate(zip(values, same, strict=True)):
            owners, places = [], None
            if takes_over and not stays and self._is_taken_over(value):
                owners, places = value.owners, value.places
                self.ready = max([self.ready, *(x.ready for x in owners)])
            elif not stays and math.prod(value.shape):
                owners, places = _block(self_, value, slices=body.shape_of_slices(k))
            self.owners.append(owners)
            self.places.append(places)

    def _is_taken_over(self, value: Value) -> TypeGuard[Carried]:
        current = self.evaluation.graph.current
        return isinstance(value, Carried) and value.region is current

    def begin(self) -> list[Node]:
        """Writes the values before the loop."""
        graph, out = self.evaluation.graph, []
        for value, places in zip(self.values, self.places, strict=True):
            if places is not None and not _is_at(value, places):
                region = graph.current
                out += _stores(self.evaluation, value, places, region, 0)
        return out

    def read(self, region: Region) -> list[Value]:
        """The values in a pass."""
        return self._in_cells(region, 0)

    def commit(
        self, region: Region, results: list["Value | _Slice"], mask: int | None = None
    ) -> None:
        """Writes the values after a pass, after all else in it."""
        writes = [
            self._prepared(value, places, mask)
            for value, places in zip(results, self.places, strict=True)
            if places is not None and not _is_at(value, places)
        ]
        last = region.last_level() + 1
        for write in writes:
            write(region, last)

    def _prepared(
        self, value: "Value | _Slice", places: np.ndarray, mask: int | None
    ) -> Callable[[Region, int], None]:
        """Writes a value from a level on, without lanes read from cells of the carry."""
        evaluation, offset = self.evaluation, None
        if isinstance(value, _Slice):
            offset, places = value.offset(evaluation, places)
            value = value.value
        graph, dtype = evaluation.graph, dtype_of(value)
        numbers, cells = _numbers(evaluation, value, places)
        pairs = []
        for x, at in zip(numbers, cells, strict=True):
            if isinstance(x, Node) and x.op == "load" and offset is None:
                if _is_in_place(evaluation, x, at):
                    continue
            is_read = isinstance(x, Node) and x.op in ("load", "dynamic")
            if isinstance(at, int):
                # Single numbers are all read before the first is written, but if they are
                # so many that their kernel is divided.
                if is_read and len(numbers) > _MANY:
                    x = graph.node("copy", dtype, (x,), at)
            elif is_read or (isinstance(x, Node) and not x.lanes):
                x = graph.node("copy", dtype, (x,), lanes=len(at))
            pairs.append((x, at))

        def write(region: Region, level: int) -> None:
            for x, at in pairs:
                at_least = max(level, _level_of(x, region))
                _store(evaluation, x, dtype, at, region, at_least, offset, 1, mask)

        return write

    def end(self, level: int) -> list[Value]:
        """The values after the loop, which other loops can change in their cells.

        A value that stays may have been read by this loop, which need not have run yet
        when another loop does.
        """
        values = self._in_cells(self.evaluation.graph.current, level + 1)
        return [
            shared(value) if places is None else value
            for value, places in zip(values, self.places, strict=True)
        ]

    def _in_cells(self, region: Region, ready: int) -> list[Value]:
        owners = [x for own in self.owners for x in own]
        self.evaluation.cellar.hand_over(owners, region, ready)
        return [
            value if places is None else Carried(dtype_of(value), places, own, region)
            for value, places, own in zip(
                self.values, self.places, self.owners, strict=True
            )
        ]


def _is_at(value: "Value | _Slice", places: np.ndarray) -> bool:
    """Whether an array is in these cells."""
    return isinstance(value, Memory) and np.array_equal(value.places, places)


def _within(self: "Evaluation", region: Region) -> "_Within":
    return _Within(self, region)


class _Within:
    def __init__(self, evaluation: "Evaluation", region: Region):
        self.evaluation, self.region = evaluation, region

    def __enter__(self):
        self.before = self.evaluation.graph.current
        self.evaluation.graph.current = self.region

    def __exit__(self, *_):
        self.evaluation.graph.current = self.before


def _as_types(values: list[Value], avals: Sequence[Any]) -> list[Value]:
    return [
        np.asarray(x, aval.dtype) if isinstance(x, np.ndarray) else x
        for x, aval in zip(values, avals, strict=True)
    ]


# Loops ------------------------------------------------------------------------------------


def _scan(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    params = eqn.params
    closed, length, reverse = params["jaxpr"], params["length"], params["reverse"]
    first, count = parts_of_scan(params)
    consts, carry, rows = (
        values[:first],
        values[first : first + count],
        values[first + count :],
    )
    if length == 0:
        stacked = [np.zeros((0, *x.shape), x.dtype) for x in closed.out_avals[count:]]
        return [*carry, *stacked]
    if length == 1 or length * num_equations(closed.jaxpr) <= _WRITTEN_OUT:
        return _written_out(self, closed, consts, carry, rows, length, reverse)
    jaxpr, graph, cellar = closed.jaxpr, self.graph, self.cellar
    carry = _as_types(carry, closed.out_avals[:count])
    is_wide = graph.current is graph.root and count == 0 and length >= WIDTH
    cellar.has_passes |= is_wide
    body = Region(graph.current, is_wide=is_wide)
    counter_place = cellar.new(1, Block(body, 0))
    item = Scan(body, length, reverse, counter_place, is_wide)
    program = _Body(closed, count, first)
    cells = _Carry(self, carry, _same_through(jaxpr, count, first), program)
    written = cells.begin()
    rows = [_rows_in_order(self, x) for x in rows]
    ends: list[Value] = []
    with _within(self, body):
        counter = graph.at(body, 0, "load", "i8", extra=counter_place)
        own = [_row(self, x, counter) for x in rows]
        outs = program(self, [*consts, *cells.read(body), *own])
        wanted = eqn.outvars[count:]
        stacks = [
            None if type(var).__name__ == "DropVar" else _Stack(self, x, length)
            for x, var in zip(outs[count:], wanted, strict=True)
        ]
        for stack in stacks:
            if stack is not None:
                stack.write(body, counter)
        cells.commit(body, outs[:count])
    _finish(self, item, written)
    ends = cells.end(item.level)
    stacked = []
    for stack, aval in zip(stacks, closed.out_avals[count:], strict=True):
        if stack is None:
            stacked.append(np.zeros((length, *aval.shape), aval.dtype))
        else:
            stacked.append(stack.value(item.level))
    return [*ends, *stacked]


class _Stack:
    """What all passes of a loop return.

    The numbers of rows without lanes are stored as one lane for each pass, and rows with
    lanes one after the other.
    """

    def __init__(self, self_: "Evaluation", value: Value, length: int):
        self.evaluation, self.row, self.length = self_, value, length
        size = math.prod(value.shape)
        if size == 0:
            return
        if _has_lanes(self_, value):
            self.stride = size
            self.owners, self.places = _block(self_, value, length)
        else:
            self.stride = 1
            self.owners = [Block(self_.graph.current, 0, length)]
            first = self_.cellar.new(length * size, self.owners[0])
            self.places = first + length * np.arange(size).reshape(value.shape)

    def write(self, region: Region, counter: Node) -> None:
        if math.prod(self.row.shape):
            evaluation = self.evaluation
            _stores(evaluation, self.row, self.places, region, 0, counter, self.stride)

    def value(self, level: int) -> Value:
        dtype = dtype_of(self.row)
        if math.prod(self.row.shape) == 0:
            return np.zeros((self.length, *self.row.shape), dtype)
        graph = self.evaluation.graph
        self.evaluation.cellar.hand_over(self.owners, graph.current, level + 1)
        rows = self.stride * np.arange(self.length).reshape(-1, *[1] * self.places.ndim)
        return Memory(dtype, rows + self.places)


def _has_lanes(self: "Evaluation", value: Value) -> bool:
    """Whether an array consists of numbers of many lanes."""
    if isinstance(value, Memory):
        found = self.cellar.columns(value.places.ravel())
        return found is not None and found[1].size == 0
    return isinstance(value, Cells) and value.lane is not None


def _rows_in_order(self: "Evaluation", x: Value) -> Value:
    """An array in memory whose rows are at equal distances."""
    if isinstance(x, np.ndarray):
        return x
    memory = self.cellar.memory(x)
    places = self.cellar.of_one_memory(memory.places, memory.dtype)
    flat = places.reshape(len(places), -1)
    steps = np.diff(flat, axis=0)
    is_mixed = has_constants_among_others(places)
    if steps.size == 0 or (np.all(steps == steps[0, 0]) and not is_mixed):
        return Memory(memory.dtype, places)
    return self.cellar.contiguous(memory)


def _row(self: "Evaluation", x: Value, counter: Node) -> Value:
    """The row of the pass whose number is in `counter`."""
    if isinstance(x, np.ndarray):
        if x.size == 0 or np.all(x == x[:1]):
            return x[0]
        x = self.cellar.memory(x)
    assert isinstance(x, Memory)
    if x.places.size == 0:
        return np.zeros(x.shape[1:], x.dtype)
    flat = x.places.reshape(len(x.places), -1)
    stride = int(flat[1, 0] - flat[0, 0])
    if stride == 0:
        return Memory(x.dtype, x.places[0])
    offset = self.graph.multiply("i8", counter, stride)
    assert isinstance(offset, Node)
    shape, first = x.shape[1:], x.places[0]
    lane = usual_lane(shape)
    if lane is None or math.prod(shape) // shape[lane] > MOST_CELLS:
        if math.prod(shape) > 4 * MOST_CELLS:
            raise Unsupported("a loop over rows of a very large array")
        flat_row = [self.dynamic(p, 0, offset, x.dtype, 0, x) for p in first.ravel()]
        return self.cells(x.dtype, objects(flat_row, shape), None, 1)
    n = shape[lane]
    kept = list(shape)
    kept[lane] = 1
    columns = columns_along(first, lane)
    steps = np.diff(columns, axis=1)
    if not np.all(steps == steps[:, :1]):
        flat_row = [self.dynamic(p, 0, offset, x.dtype, 0, x) for p in first.ravel()]
        return self.cells(x.dtype, objects(flat_row, shape), None, 1)
    flat_row = [
        self.dynamic(c[0], int(c[1] - c[0]), offset, x.dtype, n, x) for c in columns
    ]
    return self.cells(x.dtype, objects(flat_row, tuple(kept)), lane, n)


def _written_out(self, closed, consts, carry, rows, length, reverse) -> list[Value]:
    # Every pass reads the constants.
    count, stacked, consts = len(carry), [], [*map(shared, consts)]
    for k in range(length)[:: -1 if reverse else 1]:
        own = [
            self.reshaped(self.subarray(x, (slice(k, k + 1),)), x.shape[1:]) for x in rows
        ]
        out = self.closed(closed, [*consts, *carry, *own])
        carry = _as_types(out[:count], closed.out_avals[:count])
        stacked.append(_as_types(out[count:], closed.out_avals[count:]))
    if reverse:
        stacked.reverse()
    out = []
    for k, aval in enumerate(closed.out_avals[count:]):
        parts = [self.reshaped(row[k], (1, *aval.shape)) for row in stacked]
        out.append(self.joined(parts))
    return [*carry, *out]


def _while(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    params, graph = eqn.params, self.graph
    if params["cond_jaxpr"].out_avals[0].shape:
        raise Unsupported("a loop that a batch inside of a program ends together")
    first, second = params["cond_nconsts"], params["body_nconsts"]
    outer, inner = values[:first], values[first : first + second]
    closed = params["body_jaxpr"]
    carry = _as_types(values[first + second :], closed.out_avals)
    owner = Block(graph.current, 0)
    flag_place = self.cellar.new(1, owner)
    head = Region(graph.current, mask=flag_place)
    before = Region(graph.current, is_branch=True, mask=flag_place)
    body = Region(before)
    item = While(head, before, body, flag_place)
    count = len(carry)
    same = _same_through(closed.jaxpr, count, second)
    program = _Body(closed, count, second)
    cells = _Carry(self, carry, same, program, takes_over=True)
    written = cells.begin()
    with _within(self, head):
        # Loops in the condition must not change what the body reads.
        carry = map(shared, cells.read(head))
        (goes_on,) = self.closed(params["cond_jaxpr"], [*outer, *carry])
        (flag,) = self.cellar.unlaned(goes_on).ravel()
        self.cellar.hand_over([owner], head, 0)
        # Where several passes are made at a time, one that has ended does not begin again.
        level = _level_of(flag, head)
        _store(self, flag, "b1", flag_place, head, level, mask=flag_place)
    with _within(self, body):
        cells.commit(body, program(self, [*inner, *cells.read(body)]), flag_place)
    _finish(self, item, written, cells.ready)
    return cells.end(item.level)


def _level_of(x: Number, region: Region) -> int:
    if isinstance(x, Node) and x.region is region:
        return x.level + 1 if x.is_reduced else x.level
    return 0


def _cond(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    index, *operands = values
    branches, graph = eqn.params["branches"], self.graph
    (which,) = self.cellar.unlaned(index).ravel()
    if not isinstance(which, Node):
        chosen = int(np.clip(which, 0, len(branches) - 1))
        return self.closed(branches[chosen], operands)
    dtype = dtype_of(index)
    which = graph.op("convert", "i8", (which,), dtype)
    which = graph.op("max", "i8", (which, 0))
    which = graph.op("min", "i8", (which, len(branches) - 1))
    assert isinstance(which, Node)
    regions = [
        Region(
            graph.current,
            is_branch=True,
            mask=self.cellar.new(1, Block(graph.current, 0)),
        )
        for _ in branches
    ]
    marker = self.cellar.marker(which.region, _level_of(which, which.region))
    item = Branch(regions, self.cellar.place_of(which, "i8"), marker)
    outs = []
    for region, branch in zip(regions, branches, strict=True):
        with _within(self, region):
            outs.append(_as_types(self.closed(branch, operands), branch.out_avals))
    owners: list[Block] = []
    results: list[Value] = []
    for k, aval in enumerate(branches[0].out_avals):
        of_branch = [out[k] for out in outs]
        if aval.size == 0:
            results.append(of_branch[0])
            continue
        dtype = type_name(aval.dtype)
        like = next((x for x in of_branch if isinstance(x, Cells)), of_branch[0])
        own, places = _block(self, like)
        owners += own
        for region, value in zip(regions, of_branch, strict=True):
            with _within(self, region):
                _stores(self, value, places, region, 0, mask=region.mask)
        results.append(Memory(dtype, places))
    _finish(self, item)
    self.cellar.hand_over(owners, graph.current, item.level + 1)
    return results


LOOPS: dict[str, Callable[["Evaluation", Any, list[Value]], list[Value]]] = {
    "cond": _cond,
    "scan": _scan,
    "while": _while,
}
