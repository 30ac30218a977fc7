"""Loops and branches while a program is compiled.

The body of a loop is a region of the graph of its own, whose carry has cells of its own.
Operations of a body that do not depend on the carry are moved out of it.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, TYPE_CHECKING

import numpy as np
from jax.extend.core import Literal

from .graph import Node, Number, Region
from .values import (
    Block,
    Cells,
    CONSTANTS,
    dtype_of,
    Memory,
    MOST_CELLS,
    objects,
    type_name,
    Unsupported,
    usual_lane,
    Value,
)


if TYPE_CHECKING:
    from .evaluation import Evaluation


# Loops with no more passes than this are written out.
_UNROLLED = 3


class Scan:
    """`length` passes of a body; `counter` is the cell that has the number of the pass."""

    def __init__(self, body: Region, length: int, reverse: bool, counter: int):
        self.body, self.length, self.reverse = body, length, reverse
        self.counter = counter
        self.level = 0

    @property
    def regions(self) -> list[Region]:
        return [self.body]


class While:
    """Passes of a body while a condition holds.

    - `head`: computes the condition, which is in the cell `flag`.
    - `before`: what the body needs and does not change; runs once if there is a pass.
    """

    def __init__(self, head: Region, before: Region, body: Region):
        self.head, self.before, self.body = head, before, body
        self.flag = 0
        self.level = 0

    @property
    def regions(self) -> list[Region]:
        return [self.head, self.before, self.body]


class Branch:
    """One of several regions, whose number is in the cell `which`."""

    def __init__(self, branches: list[Region], which: int):
        self.branches, self.which = branches, which
        self.level = 0

    @property
    def regions(self) -> list[Region]:
        return self.branches


def _finish(self: "Evaluation", item: Any, extra: Sequence[Node] = ()) -> None:
    """Puts an item into the current region, after all that it reads."""
    region = self.graph.current
    item.level = max(
        (x.level for x in [*_read_from(region, item), *extra] if x.region is region),
        default=0,
    )
    region.items.append(item)


def _read_from(region: Region, item: Any) -> list[Node]:
    """The nodes of a region that the regions of an item read."""
    found = []
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
) -> Node:
    """Writes a number, or one for each lane, to cells of its own."""
    operands = (x,) if counter is None else (x, counter)
    if isinstance(places, int):
        extra, lanes = (places, 0, None, stride), 0
    else:
        steps = np.diff(places)
        affine = steps.size == 0 or bool(np.all(steps == steps[0]))
        step = int(steps[0]) if steps.size else 1
        table = None if affine else self.cellar.table(places)
        extra, lanes = (int(places[0]), step, table, stride), places.size
    return self.graph.at(region, level, "store", dtype, operands, extra, lanes)


def _stores(
    self: "Evaluation",
    value: Value,
    places: np.ndarray,
    region: Region,
    level: int,
    counter: Node | None = None,
    stride: int = 0,
) -> list[Node]:
    """Writes an array to cells."""
    if math.prod(value.shape) == 0:
        return []
    dtype, lane = dtype_of(value), _lane(value)
    if lane is None:
        numbers = self.cellar.unlaned(value).ravel().tolist()
        cells = [int(p) for p in places.ravel()]
    else:
        n = value.shape[lane]
        numbers = self.cellar.laned(value, lane).ravel().tolist()
        cells = list(np.moveaxis(places, lane, -1).reshape(-1, n))
    out = []
    for x, at in zip(numbers, cells, strict=True):
        if isinstance(x, Node) and x.op == "load" and counter is None:
            if _is_in_place(self, x, at):
                continue
        now = level
        if isinstance(x, Node) and x.region is region:
            now = max(now, x.level + 1 if x.is_reduced else x.level)
        out.append(_store(self, x, dtype, at, region, now, counter, stride))
    return out


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


def _block_places(self: "Evaluation", value: Any, shape: tuple[int, ...], first: int):
    """Cells for an array; the entries of the lanes of each number are neighbours."""
    size = math.prod(shape)
    lane = value.lane if isinstance(value, Cells) else usual_lane(shape)
    if lane is None or size == 0:
        return first + np.arange(size).reshape(shape)
    turned = [n for k, n in enumerate(shape) if k != lane] + [shape[lane]]
    return np.moveaxis(first + np.arange(size).reshape(turned), -1, lane)


def _same_through(jaxpr: Any, count: int, first: int, offset: int = 0) -> list[bool]:
    """Which entries of a carry a body returns as they are."""
    inputs = jaxpr.invars[first : first + count]
    outs = jaxpr.outvars[offset : offset + count]
    return [a is b for a, b in zip(inputs, outs, strict=True)]


class _Carry:
    """The cells of a carry."""

    def __init__(self, self_: "Evaluation", values: list[Value], same: list[bool]):
        self.evaluation = self_
        self.values, self.same = values, same
        # The owner says in which region the cells are read; see `While`.
        self.owner = Block(self_.graph.current, 0)
        self.places = []
        for value, stays in zip(values, same, strict=True):
            if stays or math.prod(value.shape) == 0:
                self.places.append(None)
                continue
            first = self_.cellar.new(math.prod(value.shape), self.owner)
            self.places.append(_block_places(self_, value, value.shape, first))

    def begin(self) -> list[Node]:
        """Writes the values before the loop."""
        graph, out = self.evaluation.graph, []
        for value, places in zip(self.values, self.places, strict=True):
            if places is not None:
                region = graph.current
                out += _stores(self.evaluation, value, places, region, 0)
        return out

    def read(self, region: Region) -> list[Value]:
        self.owner.region, self.owner.ready = region, 0
        return [
            value if places is None else Memory(dtype_of(value), places)
            for value, places in zip(self.values, self.places, strict=True)
        ]

    def commit(self, region: Region, results: list[Value]) -> None:
        """Writes the values after a pass, after all else in it."""
        pairs = []
        for value, places in zip(results, self.places, strict=True):
            if places is not None:
                pairs.append((self._prepared(value, places), places))
        last = region.last_level() + 1
        for value, places in pairs:
            _stores(self.evaluation, value, places, region, last)

    def _prepared(self, value: Value, places: np.ndarray) -> Value:
        """The value with lanes that are not read from cells of the carry itself."""
        lane = _lane(value)
        if lane is None or isinstance(value, np.ndarray):
            return value
        cellar, graph = self.evaluation.cellar, self.evaluation.graph
        dtype, n = dtype_of(value), value.shape[lane]
        cells = cellar.laned(value, lane)
        columns = np.moveaxis(places, lane, -1).reshape(-1, n)

        def prepared(x: Number, at: np.ndarray) -> Number:
            if not isinstance(x, Node) or (x.lanes and x.op not in ("load", "dynamic")):
                return x
            if x.op == "load" and _is_in_place(self.evaluation, x, at):
                return x
            return graph.node("copy", dtype, (x,), lanes=n)

        flat = list(map(prepared, cells.ravel(), columns))
        return Cells(dtype, objects(flat, cells.shape), lane, n)

    def end(self, level: int) -> list[Value]:
        """The values after the loop."""
        self.owner.region, self.owner.ready = self.evaluation.graph.current, level + 1
        return self.read_again()

    def read_again(self) -> list[Value]:
        return [
            value if places is None else Memory(dtype_of(value), places)
            for value, places in zip(self.values, self.places, strict=True)
        ]


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
    first, count = params["num_consts"], params["num_carry"]
    consts, carry, rows = values[:first], values[first : first + count], values[first + count :]
    if length == 0:
        stacked = [np.zeros((0, *x.shape), x.dtype) for x in closed.out_avals[count:]]
        return [*carry, *stacked]
    if length <= _UNROLLED:
        return _written_out(self, closed, consts, carry, rows, length, reverse)
    jaxpr, graph, cellar = closed.jaxpr, self.graph, self.cellar
    carry = _as_types(carry, closed.out_avals[:count])
    body = Region(graph.current)
    counter_owner = Block(body, 0)
    counter_place = cellar.new(1, counter_owner)
    item = Scan(body, length, reverse, counter_place)
    cells = _Carry(self, carry, _same_through(jaxpr, count, first))
    written = cells.begin()
    rows = [_rows_in_order(self, x) for x in rows]
    ends: list[Value] = []
    with _within(self, body):
        counter = graph.at(body, 0, "load", "i8", extra=counter_place)
        own = [_row(self, x, counter) for x in rows]
        outs = self.closed(closed, [*consts, *cells.read(body), *own])
        wanted = eqn.outvars[count:]
        outs = _as_types(outs, closed.out_avals)
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
    """What all passes of a loop return, row by row."""

    def __init__(self, self_: "Evaluation", value: Value, length: int):
        self.evaluation, self.row, self.length = self_, value, length
        self.size = math.prod(value.shape)
        self.owner = Block(self_.graph.current, 0)
        self.first = self_.cellar.new(length * self.size, self.owner)
        self.places = _block_places(self_, value, value.shape, self.first)

    def write(self, region: Region, counter: Node) -> None:
        _stores(self.evaluation, self.row, self.places, region, 0, counter, self.size)

    def value(self, level: int) -> Value:
        self.owner.region, self.owner.ready = self.evaluation.graph.current, level + 1
        dtype = dtype_of(self.row)
        if self.size == 0:
            return np.zeros((self.length, *self.row.shape), dtype)
        rows = self.size * np.arange(self.length).reshape(-1, *[1] * self.places.ndim)
        return Memory(dtype, rows + self.places)


def _rows_in_order(self: "Evaluation", x: Value) -> Value:
    """An array in memory whose rows are at equal distances."""
    if isinstance(x, np.ndarray):
        return x
    memory = self.cellar.memory(x)
    flat = memory.places.reshape(len(memory.places), -1)
    steps = np.diff(flat, axis=0)
    if steps.size == 0 or np.all(steps == steps[0, 0]):
        return memory
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
    offset = self.graph.multiply("i8", counter, stride)
    assert isinstance(offset, Node)
    shape, first = x.shape[1:], x.places[0]
    lane = usual_lane(shape)
    if lane is None or math.prod(shape) // shape[lane] > MOST_CELLS:
        if math.prod(shape) > 4 * MOST_CELLS:
            raise Unsupported("a loop over rows of a very large array")
        flat_row = [
            self._dynamic(p, 0, offset, x.dtype, 0, x) for p in first.ravel()
        ]
        return self.cells(x.dtype, objects(flat_row, shape), None, 1)
    n = shape[lane]
    kept = list(shape)
    kept[lane] = 1
    columns = np.moveaxis(first, lane, -1).reshape(-1, n)
    steps = np.diff(columns, axis=1)
    if not np.all(steps == steps[:, :1]):
        flat_row = [
            self._dynamic(p, 0, offset, x.dtype, 0, x) for p in first.ravel()
        ]
        return self.cells(x.dtype, objects(flat_row, shape), None, 1)
    flat_row = [
        self._dynamic(c[0], int(c[1] - c[0]), offset, x.dtype, n, x)
        for c in columns
    ]
    return self.cells(x.dtype, objects(flat_row, tuple(kept)), lane, n)


def _written_out(self, closed, consts, carry, rows, length, reverse) -> list[Value]:
    count, stacked = len(carry), []
    for k in range(length)[:: -1 if reverse else 1]:
        own = [self._reshaped(self._subarray(x, (slice(k, k + 1),)), x.shape[1:]) for x in rows]
        out = self.closed(closed, [*consts, *carry, *own])
        carry = _as_types(out[:count], closed.out_avals[:count])
        stacked.append(_as_types(out[count:], closed.out_avals[count:]))
    if reverse:
        stacked.reverse()
    out = []
    for k, aval in enumerate(closed.out_avals[count:]):
        parts = [self._reshaped(row[k], (1, *aval.shape)) for row in stacked]
        out.append(self.joined(parts))
    return [*carry, *out]


def _while(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    params, graph = eqn.params, self.graph
    first, second = params["cond_nconsts"], params["body_nconsts"]
    outer, inner = values[:first], values[first : first + second]
    closed = params["body_jaxpr"]
    carry = _as_types(values[first + second :], closed.out_avals)
    head = Region(graph.current)
    before = Region(graph.current, is_branch=True)
    body = Region(before)
    item = While(head, before, body)
    count = len(carry)
    cells = _Carry(self, carry, _same_through(closed.jaxpr, count, second))
    written = cells.begin()
    with _within(self, head):
        (goes_on,) = self.closed(params["cond_jaxpr"], [*outer, *cells.read(head)])
        (flag,) = self.cellar.unlaned(goes_on).ravel()
        item.flag = self.cellar.new(1, Block(head, 0))
        _store(self, flag, "b1", item.flag, head, _level_of(flag, head))
    with _within(self, body):
        outs = self.closed(closed, [*inner, *cells.read(body)])
        cells.commit(body, _as_types(outs, closed.out_avals))
    _finish(self, item, written)
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
    regions = [Region(graph.current, is_branch=True) for _ in branches]
    item = Branch(regions, self.cellar.place_of(which, "i8"))
    marker = self.cellar.marker(which.region, _level_of(which, which.region))
    outs = []
    for region, branch in zip(regions, branches, strict=True):
        with _within(self, region):
            outs.append(_as_types(self.closed(branch, operands), branch.out_avals))
    owner = Block(graph.current, 0)
    results: list[Value] = []
    for k, aval in enumerate(branches[0].out_avals):
        of_branch = [out[k] for out in outs]
        if aval.size == 0:
            results.append(of_branch[0])
            continue
        dtype = type_name(aval.dtype)
        first = self.cellar.new(aval.size, owner)
        like = next((x for x in of_branch if isinstance(x, Cells)), of_branch[0])
        places = _block_places(self, like, aval.shape, first)
        for region, value in zip(regions, of_branch, strict=True):
            with _within(self, region):
                _stores(self, value, places, region, 0)
        results.append(Memory(dtype, places))
    _finish(self, item, [marker])
    owner.region, owner.ready = graph.current, item.level + 1
    return results


LOOPS: dict[str, Callable[["Evaluation", Any, list[Value]], list[Value]]] = {
    "cond": _cond,
    "scan": _scan,
    "while": _while,
}
