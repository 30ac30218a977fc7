"""Kernels: operations of one region, level and number of lanes, as a function.

A kernel of lanes is a loop over them, which takes several at a time. In a region whose
passes are independent, such as the lanes of a batch, every number is a vector over several
passes, in a memory of its own.
"""

import functools
from collections.abc import Callable
from typing import Any, TYPE_CHECKING

from . import addresses, trigonometry
from .graph import Node, Number, Region
from .instructions import Instructions, TYPES
from .loops import Scan, WIDTH
from .values import CONSTANTS, Unsupported


if TYPE_CHECKING:
    from .emission import Emission

# Such as the rows of a run: what is computed for each of them counts.
_MANY_LANES = 64


class Kernel(Instructions):
    """The function of a kernel."""

    def __init__(self, emission: "Emission", nodes: list[Node], lanes: int):
        region = nodes[0].region
        self.is_wide = region.is_wide
        # What runs once is compiled quickly, and takes one lane at a time. The passes of a
        # batch compute once what is around their own loops.
        is_of_batch = self.is_wide and region.depth == 1 and bool(region.items)
        is_once = (region.depth == 0 or is_of_batch) and lanes < _MANY_LANES
        self.step = WIDTH if lanes and not is_once and not self.is_wide else 1
        vector = WIDTH if self.is_wide else self.step
        super().__init__(vector, emission.declared)
        self.emission, self.nodes, self.lanes = emission, nodes, lanes
        self.attributes = "#2" if is_once else "#0"
        self.before: list[str] = []
        self.names: dict[Node, str] = {}
        self._found: dict[tuple, str] = {}
        # Sine and cosine of the angles of which one has been computed.
        self._angles: dict[str, list[str]] = {}

    def text(self, name: str) -> str:
        return self._loop(name) if self.lanes else self._single(name)

    def _single(self, name: str) -> str:
        stores = [node for node in self.nodes if node.op == "store"]
        for node in self.nodes:
            if node.op == "store":
                self._value(node.operands[0], node.dtype)
            else:
                self.names[node] = self._compute(node)
        for node in self.nodes:
            if node.place is not None and node.op != "store":
                self._write(self.names[node], node.dtype, node.place)
        for node in stores:
            self._store(node)
        lines = [*self.before, *self.lines, "  ret void", "}", ""]
        return "\n".join([self._head(name), *lines])

    def _head(self, name: str) -> str:
        return f"define internal void {name}(ptr %m, ptr %w) {self.attributes} {{"

    def _loop(self, name: str) -> str:
        n, step = self.lanes, self.step
        reductions: list[tuple[Node, str, str]] = []
        for node in self.nodes:
            if node.op == "store":
                self._store(node)
            elif node.is_reduced:
                reductions.append(self._reduction(node))
            else:
                self.names[node] = self._compute(node)
                if node.place is not None:
                    self._write(self.names[node], node.dtype, node.place)
        head = [self._head(name), "entry:", *self.before, "  br label %loop", "loop:"]
        head += ["  %j = phi i64 [ 0, %entry ], [ %next, %loop ]"]
        head += [
            f"  {acc} = phi {self._t(node.dtype)} [ {self._neutral(node)}, %entry ], "
            f"[ {after}, %loop ]"
            for node, acc, after in reductions
        ]
        # The last lanes may overlap those before them, which are computed again.
        head += [
            f"  %short = icmp ult i64 {n - step}, %j",
            f"  %i = select i1 %short, i64 {n - step}, i64 %j",
        ]
        if reductions and n % step:
            head += self._mask()
        tail = [
            f"  %next = add i64 %j, {step}",
            f"  %more = icmp ult i64 %next, {n}",
            "  br i1 %more, label %loop, label %end",
            "end:",
        ]
        body, self.lines = self.lines, []
        for node, _, after in reductions:
            self._reduced(node, after)
        return "\n".join([*head, *body, *tail, *self.lines, "  ret void", "}", ""])

    def _mask(self) -> list[str]:
        """Which lanes of those that are taken have not been computed before."""
        vector = f"<{self.vector} x i64>"
        numbers = ", ".join(f"i64 {k}" for k in range(self.vector))
        return [
            "  %behind = sub i64 %j, %i",
            f"  %mask0 = insertelement {vector} poison, i64 %behind, i64 0",
            f"  %mask1 = shufflevector {vector} %mask0, {vector} poison, "
            f"<{self.vector} x i32> zeroinitializer",
            f"  %mask = icmp uge {vector} <{numbers}>, %mask1",
        ]

    # Numbers in memory --------------------------------------------------------------------

    def _cell_kind(self, dtype: str) -> str:
        return "double" if dtype[0] == "f" else "i64"

    def _pointer(self, index: str | int, memory: str = "%m") -> str:
        return self._say(f"getelementptr double, ptr {memory}, i64 {index}")

    def _wide_pointer(self, index: str | int) -> str:
        """The numbers of all passes in a cell."""
        kind = f"<{WIDTH} x double>"
        return self._say(f"getelementptr {kind}, ptr %w, i64 {index}")

    def _load_single(self, pointer: str, dtype: str) -> str:
        """A single number, in every entry of a vector."""
        kind = self._cell_kind(dtype)
        one = self._say(f"load {kind}, ptr {pointer}, align 8")
        return self._narrowed(self._spread(one, kind), dtype)

    def _load_vector(self, pointer: str, dtype: str) -> str:
        vector = f"<{self.vector} x {self._cell_kind(dtype)}>"
        return self._narrowed(self._say(f"load {vector}, ptr {pointer}, align 8"), dtype)

    def _load_each(self, pointers: list[str], dtype: str) -> str:
        kind = self._cell_kind(dtype)
        ones = [self._say(f"load {kind}, ptr {x}, align 8") for x in pointers]
        return self._narrowed(self._joined(ones, kind), dtype)

    def _cells_type(self, dtype: str) -> str:
        kind = self._cell_kind(dtype)
        return f"<{self.vector} x {kind}>" if self.vector > 1 else kind

    def _narrowed(self, x: str, dtype: str) -> str:
        """What is in a cell, as a number of its type."""
        if dtype in ("f8", "i8", "u8"):
            return x
        how = "fptrunc" if dtype == "f4" else "trunc"
        return self._say(f"{how} {self._cells_type(dtype)} {x} to {self._t(dtype)}")

    def _widened(self, x: str, dtype: str) -> str:
        if dtype in ("f8", "i8", "u8"):
            return x
        how = "fpext" if dtype == "f4" else "sext" if dtype[0] == "i" else "zext"
        return self._say(f"{how} {self._t(dtype)} {x} to {self._cells_type(dtype)}")

    def _index(self, place: int) -> int:
        return self.emission.address(place)

    def _has_passes(self, place: int) -> bool:
        """Whether a cell has a number for each pass."""
        return self.is_wide and self.emission.cellar.is_wide(place)

    def _once(self, key: tuple, text: str) -> str:
        if key not in self._found:
            self._found[key] = self._say(text)
        return self._found[key]

    def _before(self, make: Callable[[], str]) -> str:
        """What is computed before the loop over lanes."""
        lines, self.lines = self.lines, self.before
        name = make()
        self.before, self.lines = self.lines, lines
        return name

    # What is read -------------------------------------------------------------------------

    def _value(self, x: Number, dtype: str) -> str:
        """The name of an operand, or the text of a known number."""
        if not isinstance(x, Node):
            return self._known(x, dtype)
        if x not in self.names:
            self.names[x] = self._read(x)
        return self.names[x]

    def _read(self, x: Node) -> str:
        if x.op == "lane":
            return self._lane_numbers()
        if x.lanes and not x.is_reduced:
            assert x.lanes == self.lanes
            assert x.op == "load" or x.place is not None
            extra: Any = x.extra if x.op == "load" else (x.place, 1, None)
            return self._lanes_at(x.dtype, *extra)
        place = x.extra if x.op == "load" else x.place
        assert place is not None
        return self._before(lambda: self._number_at(place, x.dtype))

    def _lane_numbers(self) -> str:
        """The numbers of the lanes that are taken."""
        if self.step == 1:
            return self._spread("%i", "i64")
        numbers = ", ".join(f"i64 {k}" for k in range(self.vector))
        return self._say(f"add {self._t('i8')} {self._spread('%i', 'i64')}, <{numbers}>")

    def _number_at(self, place: int, dtype: str) -> str:
        if self._has_passes(place):
            return self._load_vector(self._wide_pointer(self._index(place)), dtype)
        return self._load_single(self._pointer(self._index(place)), dtype)

    def _lanes_at(
        self, dtype: str, first: int | None, stride: int, table: int | None
    ) -> str:
        if self.step > 1 and stride == 1 and table is None:
            return self._load_vector(self._pointer(self._lane_index(first, 1, None)), dtype)
        if self.step > 1:
            pointers = [
                self._lane_pointer(k, first, stride, table) for k in range(self.step)
            ]
            return self._load_each(pointers, dtype)
        if not self._lanes_have_passes(first, stride, table):
            return self._load_single(self._lane_pointer(0, first, stride, table), dtype)
        index = self._lane_index(first, stride, table)
        return self._load_vector(self._wide_pointer(index), dtype)

    def _lanes_have_passes(self, first: int | None, stride: int, table: int | None) -> bool:
        if first is not None:
            # The cell of the first lane may belong to another number, whose value is not
            # used; see `Cellar._shifted`.
            return self._has_passes(first + stride)
        if not self.is_wide:
            return False
        assert table is not None
        places = self.emission.cellar.tables[table]
        own = [self.emission.cellar.is_wide(int(p)) for p in places[places < CONSTANTS]]
        if any(own) and not all(own):
            raise Unsupported("an array of which passes share only some numbers")
        return any(own)

    def _lane_index(self, first: int | None, stride: int, table: int | None) -> str:
        """The number of the cell of the first lane of those that are taken."""
        if table is not None:
            index = self._in_table(table, 0)
        elif stride == 1:
            index = "%i"
        else:
            index = self._once(("offset", stride, 0), f"mul i64 %i, {stride}")
        if first is None:
            return index
        return self._say(f"add i64 {index}, {self._index(first)}")

    def _table(self, number: int) -> str:
        load = addresses.loaded(addresses.table(number))
        return self._before(lambda: self._once(("address", number), load))

    def _in_table(self, table: int, k: int) -> str:
        lane = "%i" if k == 0 else self._once(("lane", k), f"add i64 %i, {k}")
        at = self._once(
            ("table", table, k),
            f"getelementptr i64, ptr {self._table(table)}, i64 {lane}",
        )
        return self._once(("index", table, k), f"load i64, ptr {at}")

    def _lane_pointer(
        self, k: int, first: int | None, stride: int, table: int | None
    ) -> str:
        if table is not None:
            index = self._in_table(table, k)
        else:
            lane = "%i" if k == 0 else self._once(("lane", k), f"add i64 %i, {k}")
            index = self._once(("offset", stride, k), f"mul i64 {lane}, {stride}")
        row = self._once(
            ("row", table, stride, k), f"getelementptr double, ptr %m, i64 {index}"
        )
        return row if first is None else self._pointer(self._index(first), row)

    # What is written ----------------------------------------------------------------------

    def _write(self, x: str, dtype: str, place: int) -> None:
        index: Any = self._index(place)
        if self.lanes and self.step * self._has_lanes:
            index = self._say(f"add i64 %i, {index}")
        pointer = self._wide_pointer(index) if self.is_wide else self._pointer(index)
        self._put(x, dtype, pointer)

    # After a loop over lanes, single numbers are written.
    _has_lanes = True

    def _put(self, x: str, dtype: str, pointer: str) -> None:
        x = self._widened(x, dtype)
        self.lines.append(f"  store {self._cells_type(dtype)} {x}, ptr {pointer}, align 8")

    def _put_each(self, x: str, dtype: str, pointers: list[str]) -> None:
        x, kind = self._widened(x, dtype), self._cell_kind(dtype)
        for k, pointer in enumerate(pointers):
            one = self._element(x, kind, k)
            self.lines.append(f"  store {kind} {one}, ptr {pointer}, align 8")

    def _store(self, node: Node) -> None:
        (x, *rest), dtype = node.operands, node.dtype
        counter = [x for x in rest if isinstance(x, Node)]
        first, stride, table, row, mask = node.extra
        value = self._value(x, dtype)
        if self.is_wide:
            self._store_passes(value, node, counter)
            return
        offset = self._row_offset(counter[0], row) if counter else None
        moved = lambda p: p if offset is None else self._pointer(offset, p)
        if not self.lanes:
            self._put(value, dtype, moved(self._pointer(self._index(first))))
        elif self.step == 1 or (stride == 1 and table is None):
            index = self._lane_index(first, stride, table)
            self._put(value, dtype, moved(self._pointer(index)))
        else:
            pointers = [
                moved(self._lane_pointer(k, first, stride, table)) for k in range(self.step)
            ]
            self._put_each(value, dtype, pointers)

    def _store_passes(self, value: str, node: Node, counter: list[Any]) -> None:
        """Writes the numbers of all passes."""
        (first, stride, table, row, mask), dtype = node.extra, node.dtype
        index: Any = self._index(first) if first is not None else 0
        if self.lanes:
            index = self._lane_index(first, stride, table)
        if not self._lanes_have_passes(first, stride, table):
            # A row of each pass, in the memory outside.
            numbers = self._value(counter[0], "i8")
            pointers = []
            for k in range(WIDTH):
                one = self._element(numbers, "i64", k)
                one = self._say(f"mul i64 {one}, {row}")
                pointers.append(self._pointer(self._say(f"add i64 {one}, {index}")))
            self._put_each(value, dtype, pointers)
            return
        if counter and not self.emission.is_uniform(counter[0]):
            pointers = self._pointers_of_passes(counter[0], row, index)
            if mask is not None:
                value = self._where(mask, dtype, value, self._load_each(pointers, dtype))
            self._put_each(value, dtype, pointers)
            return
        if counter:
            index = self._say(f"add i64 {self._row_offset(counter[0], row)}, {index}")
        pointer = self._wide_pointer(index)
        if mask is not None:
            value = self._where(mask, dtype, value, self._load_vector(pointer, dtype))
        self._put(value, dtype, pointer)

    def _where(self, mask: int, dtype: str, new: str, old: str) -> str:
        """The new numbers of the passes of a mask, and the old ones of others."""
        on, t = self._number_at(mask, "b1"), self._t(dtype)
        return self._say(f"select {self._t('b1')} {on}, {t} {new}, {t} {old}")

    def _pointers_of_passes(self, offset: Node, row: int, index: str | int) -> list[str]:
        """Where each pass keeps its own number, in a row of its own."""
        numbers, pointers = self._value(offset, "i8"), []
        for k in range(WIDTH):
            one = self._say(f"mul i64 {self._element(numbers, 'i64', k)}, {row}")
            one = self._say(f"mul i64 {self._say(f'add i64 {one}, {index}')}, {WIDTH}")
            pointers.append(self._pointer(self._say(f"add i64 {one}, {k}"), "%w"))
        return pointers

    def _row_offset(self, counter: Node, row: int) -> str:
        """The offset of the row of a pass, a single number."""
        key = "row of", counter.number, row
        if key not in self._found:
            self._found[key] = self._before(lambda: self._scaled(counter, row))
        return self._found[key]

    def _scaled(self, x: Node, factor: int) -> str:
        """A whole number that is the same for all lanes and passes, and its multiple."""
        place = x.extra if x.op == "load" else x.place
        if place is None:
            raise Unsupported("an offset that is not in memory")
        if self._has_passes(place):
            pointer = self._wide_pointer(self._index(place))
        else:
            pointer = self._pointer(self._index(place))
        name = self._say(f"load i64, ptr {pointer}")
        return name if factor == 1 else self._say(f"mul i64 {name}, {factor}")

    # Operations ---------------------------------------------------------------------------

    def _compute(self, node: Node) -> str:
        op, dtype = node.op, node.dtype
        if op == "dynamic":
            return self._dynamic(node)
        of = node.extra if op == "convert" else node.extra[1] if op == "cmp" else dtype
        types = ("b1", dtype, dtype) if op == "select" else (of,) * len(node.operands)
        xs = [self._value(x, t) for x, t in zip(node.operands, types, strict=True)]
        return xs[0] if op == "copy" else self._operation(node, xs)

    def _call(self, dtype: str, node: Node, *xs: str) -> str:
        if dtype != "f8" or node.extra not in ("sin", "cos", "atan"):
            return super()._call(dtype, node, *xs)
        self.declared.update(trigonometry.functions(self.vector))
        (x,), t = xs, self._t(dtype)
        if node.extra == "atan":
            return self._say(f"call {t} @arctangent{self.vector}({t} {x})")
        if x not in self._angles:
            pair = f"{{ {t}, {t} }}"
            both = self._say(f"call {pair} @sincos{self.vector}({t} {x})")
            self._angles[x] = [
                self._say(f"extractvalue {pair} {both}, {k}") for k in range(2)
            ]
        return self._angles[x][node.extra == "cos"]

    def _dynamic(self, node: Node) -> str:
        """Numbers at computed cells."""
        (offset, *_), (first, stride), dtype = node.operands, node.extra, node.dtype
        assert isinstance(offset, Node)
        has_lanes = bool(node.lanes) and bool(stride)
        is_same = self.emission.is_uniform(offset) and not (
            offset.lanes and not offset.is_reduced
        )
        if self.vector > 1 and not is_same:
            return self._dynamic_each(node, offset, first, stride)
        if self.vector == 1 and not (self.lanes and is_same):
            number = self._value(offset, "i8")
        else:
            number = self._single_number(offset)
        index = self._say(f"add i64 {number}, {self._index(first)}")
        if has_lanes and self.step > 1:
            pointers = []
            for k in range(self.step):
                row = self._lane_pointer(k, first, stride, None)
                pointers.append(self._pointer(number, row))
            if stride == 1:
                return self._load_vector(pointers[0], dtype)
            return self._load_each(pointers, dtype)
        if has_lanes:
            lane = self._once(("offset", stride, 0), f"mul i64 %i, {stride}")
            index = self._say(f"add i64 {index}, {lane}")
        if self._has_passes(first):
            return self._load_vector(self._wide_pointer(index), dtype)
        return self._load_single(self._pointer(index), dtype)

    def _single_number(self, x: Node) -> str:
        """A number that is the same in all entries of a vector."""
        if x in self.names or self._is_here(x):
            return self._element(self._value(x, "i8"), "i64", 0)
        return self._row_offset(x, 1)

    def _is_here(self, x: Node) -> bool:
        return not self.lanes and x.op != "load" and x.place is None

    def _dynamic_each(self, node: Node, offset: Node, first: int, stride: int) -> str:
        numbers, pointers = self._value(offset, "i8"), []
        has_passes = self._has_passes(first)
        for k in range(self.vector):
            index = self._element(numbers, "i64", k)
            index = self._say(f"add i64 {index}, {self._index(first)}")
            if node.lanes and stride:
                at = k if self.step > 1 else 0
                lane = "%i" if at == 0 else self._once(("lane", at), f"add i64 %i, {at}")
                lane = self._once(("offset", stride, at), f"mul i64 {lane}, {stride}")
                index = self._say(f"add i64 {index}, {lane}")
            if has_passes:
                index = self._say(f"mul i64 {index}, {WIDTH}")
                index = self._say(f"add i64 {index}, {k}")
            pointers.append(self._pointer(index, "%w" if has_passes else "%m"))
        return self._load_each(pointers, node.dtype)

    # Reductions over lanes ----------------------------------------------------------------

    def _reduction(self, node: Node) -> tuple[Node, str, str]:
        """The sum over lanes, or the like, as it grows in the loop."""
        acc, (x,) = self._new(), node.operands
        dtype, op = node.dtype, node.op.split()[1]
        value = self._value(x, dtype)
        if self.lanes % self.step:
            t = self._t(dtype)
            value = self._say(
                f"select {self._t('b1')} %mask, {t} {value}, {t} {self._neutral(node)}"
            )
        return node, acc, getattr(self, f"_{op}")(dtype, node, acc, value)

    def _reduced(self, node: Node, total: str) -> None:
        dtype, op = node.dtype, node.op.split()[1]
        vector = self.vector
        if self.step > 1:
            # The sums of every fourth lane are added.
            ones = [self._element(total, TYPES[dtype], k) for k in range(vector)]
            self.vector = 1
            join = getattr(self, f"_{op}")
            while len(ones) > 1:
                half = len(ones) // 2
                pairs = zip(ones[:half], ones[half:], strict=True)
                ones = [join(dtype, node, a, b) for a, b in pairs]
            (total,) = ones
        if node.place is not None:
            self._has_lanes = False
            self._write(total, dtype, node.place)
            self._has_lanes = True
        self.vector = vector


class Recurrence(Kernel):
    """The function of a loop over single numbers, whose carry stays in registers."""

    def __init__(self, emission: "Emission", nodes: list[Node], item: Scan):
        super().__init__(emission, nodes, 0)
        self.item = item
        stores = [x for x in nodes if x.op == "store"]
        self.commits = {x.extra[0]: x for x in stores if len(x.operands) == 1}
        self.rows = [x for x in stores if len(x.operands) == 2]
        self.attributes = "#0"
        self.carry: dict[int, str] = {}

    def text(self, name: str) -> str:
        item, firsts = self.item, {}
        for place, node in self.commits.items():
            first = functools.partial(self._number_at, place, node.dtype)
            firsts[place] = self._before(first)
            self.carry[place] = self._new()
        for node in self.nodes:
            if node.op != "store":
                self.names[node] = self._compute(node)
        after = {
            place: self._value(node.operands[0], node.dtype)
            for place, node in self.commits.items()
        }
        for node in self.rows:
            self._store(node)
        head = [self._head(name), "entry:", *self.before, "  br label %loop", "loop:"]
        head += ["  %j = phi i64 [ 0, %entry ], [ %next, %loop ]"]
        head += [
            f"  {phi} = phi {self._t(self.commits[place].dtype)} "
            f"[ {firsts[place]}, %entry ], [ {after[place]}, %loop ]"
            for place, phi in self.carry.items()
        ]
        last = f"sub i64 {item.length - 1}, %j" if item.reverse else "add i64 %j, 0"
        head += [f"  %count = {last}"]
        tail = [
            "  %next = add i64 %j, 1",
            f"  %more = icmp ult i64 %next, {item.length}",
            "  br i1 %more, label %loop, label %end",
            "end:",
        ]
        body, self.lines = self.lines, []
        for place, node in self.commits.items():
            self._write(after[place], node.dtype, place)
        return "\n".join([*head, *body, *tail, *self.lines, "  ret void", "}", ""])

    def _read(self, x: Node) -> str:
        if x.op == "load" and x.extra == self.item.counter:
            return self._spread("%count", "i64")
        if x.op == "load" and x.extra in self.carry:
            return self.carry[x.extra]
        return super()._read(x)

    def _scaled(self, x: Node, factor: int) -> str:
        raise NotImplementedError

    def _single_number(self, x: Node) -> str:
        return self._element(self._value(x, "i8"), "i64", 0)

    def _row_offset(self, counter: Node, row: int) -> str:
        number = self._single_number(counter)
        return self._once(("row of", counter.number, row), f"mul i64 {number}, {row}")


def recurrences(
    regions: list[Region], kernels: dict[tuple, list[Node]], longest: int
) -> dict[Region, tuple[Scan, list[Node]]]:
    """The loops over single numbers, such as the elimination along a chain."""
    of_region: dict[Region, list[Node]] = {}
    for (region, *_), nodes in kernels.items():
        of_region.setdefault(region, []).extend(nodes)
    found = {}
    for region in regions:
        for item in region.items:
            if not isinstance(item, Scan) or item.is_wide:
                continue
            body, nodes = item.body, of_region.get(item.body, [])
            if body.items or not nodes or len(nodes) > longest:
                continue
            if any(x.lanes or _reads_cells_of(body, x) for x in nodes):
                continue
            found[body] = item, sorted(nodes, key=lambda x: (x.level, x.number))
    return found


def _reads_cells_of(region: Region, node: Node) -> bool:
    """Whether a number is found at a computed cell that the region itself writes."""
    markers = (x for x in node.operands[1:] if isinstance(x, Node) and x.op == "marker")
    return node.op == "dynamic" and any(x.region is region for x in markers)
