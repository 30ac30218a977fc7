"""The graph of a program as code for LLVM.

Operations of one region, level and number of lanes are a kernel: a function that reads its
operands from the memory and writes what others need. A kernel of lanes is a loop that takes
four lanes at a time. A function for the whole calls the kernels and has the loops and
branches.
"""

import struct
from collections.abc import Callable, Iterable

import numpy as np

from .graph import Node, Number, Region
from .loops import Branch, Scan, While
from .values import Cellar, CONSTANTS


# The number of lanes that a kernel takes at a time.
WIDTH = 4
# Kernels of single numbers with more operations are divided: the time of compilation grows
# faster than their length.
_LONGEST = 2_500

_TYPES = {
    "f8": "double",
    "f4": "float",
    "b1": "i1",
    **{f"{kind}{n}": f"i{8 * n}" for kind in "iu" for n in (1, 2, 4, 8)},
}
_LAYOUT = {"f8": "double", "f4": "float", "b1": "i8"} | {
    f"{kind}{n}": f"i{8 * n}" for kind in "iu" for n in (1, 2, 4, 8)
}


class Emission:
    """The code of a program."""

    def __init__(self, cellar: Cellar):
        self.cellar, self.root = cellar, cellar.graph.root
        self.functions: list[str] = []
        self.declared: set[str] = set()
        self.length = 0
        regions = list(_all_regions(self.root))
        self.kernels = _kernels(regions)
        self._kernel_of = {
            x: number for number, nodes in enumerate(self.kernels.values()) for x in nodes
        }
        self._recurrences = _recurrences(regions, self.kernels)
        self._make_places()
        self._by_region: dict[Region, dict[int, list[str]]] = {}
        for item, nodes in self._recurrences.values():
            kernel = _Recurrence(self, self._kernel_of[nodes[0]], nodes, item)
            self.functions.append(kernel.text(f"@r{item.counter}"))
            self.length += len(nodes)
        for number, ((region, level, lanes, _), nodes) in enumerate(self.kernels.items()):
            if region in self._recurrences:
                continue
            name = f"@k{number}"
            kernel = _Kernel(self, number, nodes, lanes)
            self.functions.append(kernel.text(name))
            self.length += len(nodes)
            levels = self._by_region.setdefault(region, {})
            levels.setdefault(level, []).append(name)

    def address(self, place: int) -> int:
        """The number of a cell in the memory: constants come first."""
        if place >= CONSTANTS:
            return place - CONSTANTS
        return place + self.cellar.num_constants

    def addresses(self, places: np.ndarray) -> np.ndarray:
        shifted = places + self.cellar.num_constants
        return np.where(places >= CONSTANTS, places - CONSTANTS, shifted)

    def kernel_of(self, node: Node) -> int:
        return self._kernel_of[node]

    def _make_places(self) -> None:
        """Cells for results that other kernels read."""
        for number, nodes in enumerate(self.kernels.values()):
            for node in nodes:
                for x in node.operands:
                    if not isinstance(x, Node) or x.op in ("load", "marker"):
                        continue
                    if x.region is node.region and x.region in self._recurrences:
                        continue
                    if self._kernel_of[x] != number or x.is_reduced:
                        self.cellar.place_of(x, x.dtype)

    # The function for the whole -----------------------------------------------------------

    def main(self) -> str:
        self._lines: list[str] = []
        self._labels = 0
        self._block = "entry"
        self._run(self.root)
        body = "\n".join(self._lines)
        return f"define internal void @main(ptr %m) {{\nentry:\n{body}\n  ret void\n}}\n"

    def _label(self) -> str:
        self._labels += 1
        return f"b{self._labels}"

    def _say(self, line: str) -> None:
        self._lines.append("  " + line)

    def _start(self, label: str) -> None:
        self._lines.append(f"{label}:")
        self._block = label

    def _run(self, region: Region) -> None:
        kernels = self._by_region.get(region, {})
        items: dict[int, list] = {}
        for item in region.items:
            items.setdefault(item.level, []).append(item)
        for level in sorted({*kernels, *items}):
            for name in kernels.get(level, []):
                self._say(f"call void {name}(ptr %m)")
            for item in items.get(level, []):
                if isinstance(item, Scan):
                    self._scan(item)
                elif isinstance(item, While):
                    self._while(item)
                else:
                    self._branch(item)

    def _cell(self, place: int) -> str:
        self._labels += 1
        name = f"%c{self._labels}"
        self._say(f"{name} = getelementptr double, ptr %m, i64 {self.address(place)}")
        return name

    def _scan(self, item: Scan) -> None:
        if item.body in self._recurrences:
            self._say(f"call void @r{item.counter}(ptr %m)")
            return
        loop, end = self._label(), self._label()
        begin = self._block
        self._say(f"br label %{loop}")
        self._start(loop)
        k, after, more = (f"%{loop}{x}" for x in ("k", "n", "c"))
        placeholder = len(self._lines)
        self._lines.append("")
        number = k
        if item.reverse:
            number = f"%{loop}r"
            self._say(f"{number} = sub i64 {item.length - 1}, {k}")
        self._say(f"store i64 {number}, ptr {self._cell(item.counter)}")
        self._run(item.body)
        self._say(f"{after} = add i64 {k}, 1")
        self._say(f"{more} = icmp ult i64 {after}, {item.length}")
        self._say(f"br i1 {more}, label %{loop}, label %{end}")
        self._lines[placeholder] = (
            f"  {k} = phi i64 [ 0, %{begin} ], [ {after}, %{self._block} ]"
        )
        self._start(end)

    def _while(self, item: While) -> None:
        before, body, end = self._label(), self._label(), self._label()
        self._run(item.head)
        self._decide(item, before, end)
        self._start(before)
        self._run(item.before)
        self._say(f"br label %{body}")
        self._start(body)
        self._run(item.body)
        self._run(item.head)
        self._decide(item, body, end)
        self._start(end)

    def _decide(self, item: While, on: str, off: str) -> None:
        cell = self._cell(item.flag)
        name = f"%f{self._label()}"
        self._say(f"{name}l = load i64, ptr {cell}")
        self._say(f"{name} = icmp ne i64 {name}l, 0")
        self._say(f"br i1 {name}, label %{on}, label %{off}")

    def _branch(self, item: Branch) -> None:
        end = self._label()
        labels = [self._label() for _ in item.branches]
        cell = self._cell(item.which)
        which = f"%w{end}"
        self._say(f"{which} = load i64, ptr {cell}")
        cases = " ".join(f"i64 {k}, label %{x}" for k, x in enumerate(labels))
        self._say(f"switch i64 {which}, label %{labels[-1]} [ {cases} ]")
        for label, region in zip(labels, item.branches, strict=True):
            self._start(label)
            self._run(region)
            self._say(f"br label %{end}")
        self._start(end)


def _all_regions(region: Region) -> Iterable[Region]:
    yield region
    for item in region.items:
        for inner in item.regions:
            yield from _all_regions(inner)


def _kernels(regions: list[Region]) -> dict[tuple, list[Node]]:
    """The operations that are needed, by kernel."""
    live: set[Node] = set()
    stack = [
        x
        for region in regions
        for x in region.nodes
        if x.op == "store" or (x.place is not None)
    ]
    while stack:
        node = stack.pop()
        if node in live:
            continue
        live.add(node)
        stack.extend(x for x in node.operands if isinstance(x, Node) and x not in live)
    order = {region: k for k, region in enumerate(regions)}
    needed = [x for x in live if x.op not in ("load", "marker") and x.region in order]
    needed.sort(key=lambda x: (order[x.region], x.level, x.lanes, x.number))
    kernels: dict[tuple, list[Node]] = {}
    for node in needed:
        key = node.region, node.level, node.lanes
        part = 0
        while len(kernels.get((*key, part), ())) >= _LONGEST and not node.lanes:
            part += 1
        kernels.setdefault((*key, part), []).append(node)
    return kernels


def _recurrences(
    regions: list[Region], kernels: dict[tuple, list[Node]]
) -> dict[Region, tuple[Scan, list[Node]]]:
    """The loops over single numbers, such as the elimination along a chain.

    Their carry stays in registers.
    """
    of_region: dict[Region, list[Node]] = {}
    for (region, *_), nodes in kernels.items():
        of_region.setdefault(region, []).extend(nodes)
    found = {}
    for region in regions:
        for item in region.items:
            if not isinstance(item, Scan):
                continue
            body, nodes = item.body, of_region.get(item.body, [])
            if body.items or not nodes or len(nodes) > _LONGEST:
                continue
            if any(x.lanes or _reads_cells_of(body, x) for x in nodes):
                continue
            found[body] = item, sorted(nodes, key=lambda x: (x.level, x.number))
    return found


def _reads_cells_of(region: Region, node: Node) -> bool:
    """Whether a number is found at a computed cell that the region itself writes."""
    markers = (x for x in node.operands[1:] if isinstance(x, Node) and x.op == "marker")
    return node.op == "dynamic" and any(x.region is region for x in markers)


class _Kernel:
    """The function of a kernel."""

    def __init__(self, emission: Emission, number: int, nodes: list[Node], lanes: int):
        self.emission, self.number, self.nodes = emission, number, nodes
        self.lanes = lanes
        # What runs once is compiled quickly, and takes one lane at a time.
        self.once = not nodes[0].region.depth
        self.width = 1 if self.once else WIDTH
        self.attributes = "#2" if self.once else "#0"
        self.before: list[str] = []
        self.lines: list[str] = []
        self.count = 0
        self.names: dict[Node, str] = {}
        self._cells: dict[tuple, str] = {}
        self._found: dict[tuple, str] = {}

    def text(self, name: str) -> str:
        if not self.lanes:
            return self._single(name)
        return self._loop(name)

    def _new(self) -> str:
        self.count += 1
        return f"%v{self.count}"

    def _single(self, name: str) -> str:
        stores = []
        for node in self.nodes:
            if node.op == "store":
                stores.append(node)
                for x in node.operands:
                    self._value(x, node.dtype)
            else:
                self.names[node] = self._compute(node)
        for node in self.nodes:
            if node.place is not None and node.op != "store":
                self._write(self.names[node], node.dtype, node.place)
        for node in stores:
            self._store(node)
        body = "\n".join(self.lines)
        return f"define internal void {name}(ptr %m) {self.attributes} {{\n{body}\n  ret void\n}}\n"

    def _loop(self, name: str) -> str:
        n = self.lanes
        reductions: list[tuple[Node, str, str]] = []
        writes: list[Node] = []
        for node in self.nodes:
            if node.op == "store":
                self._store(node)
            elif node.is_reduced:
                reductions.append(self._reduction(node))
            else:
                self.names[node] = self._compute(node)
                if node.place is not None:
                    writes.append(node)
                    self._write(self.names[node], node.dtype, node.place)
        head = [f"define internal void {name}(ptr %m) {self.attributes} {{", "entry:", *self.before]
        head += ["  br label %loop", "loop:"]
        head += ["  %j = phi i64 [ 0, %entry ], [ %next, %loop ]"]
        head += [
            f"  {acc} = phi {self._t(node.dtype)} [ {self._neutral(node)}, %entry ], "
            f"[ {after}, %loop ]"
            for node, acc, after in reductions
        ]
        # The last four lanes may overlap those before them, which are computed again.
        head += [
            f"  %short = icmp ult i64 {n - self.width}, %j",
            f"  %i = select i1 %short, i64 {n - self.width}, i64 %j",
        ]
        if reductions and n % self.width:
            head += self._mask()
        tail = [
            f"  %next = add i64 %j, {self.width}",
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
        vector = f"<{self.width} x i64>"
        numbers = ", ".join(f"i64 {k}" for k in range(self.width))
        return [
            "  %behind = sub i64 %j, %i",
            f"  %mask0 = insertelement {vector} poison, i64 %behind, i64 0",
            f"  %mask1 = shufflevector {vector} %mask0, {vector} poison, "
            f"<{self.width} x i32> zeroinitializer",
            f"  %mask = icmp uge {vector} <{numbers}>, %mask1",
        ]

    # Values -------------------------------------------------------------------------------

    def _t(self, dtype: str) -> str:
        kind = _TYPES[dtype]
        return f"<{self.width} x {kind}>" if self._is_wide else kind

    @property
    def _is_wide(self) -> bool:
        """Whether numbers are vectors of several lanes."""
        return bool(self.lanes) and self.width > 1

    def _say(self, text: str) -> str:
        name = self._new()
        self.lines.append(f"  {name} = {text}")
        return name

    def _value(self, x: Number, dtype: str) -> str:
        """The name of an operand, or the text of a known number."""
        if not isinstance(x, Node):
            text = literal(x, dtype)
            return f"splat ({_TYPES[dtype]} {text})" if self._is_wide else text
        name = self.names.get(x)
        if name is not None:
            return name
        if x.op == "load":
            name = self._loaded(x)
        elif x.lanes and not x.is_reduced:
            assert x.place is not None and x.lanes == self.lanes
            name = self._read_lanes(x.dtype, x.place, 1, None)
        else:
            assert x.place is not None
            name = self._single_at(x.place, x.dtype)
        self.names[x] = name
        return name

    def _loaded(self, x: Node) -> str:
        if not x.lanes:
            return self._single_at(x.extra, x.dtype)
        return self._read_lanes(x.dtype, *x.extra)

    def _single_at(self, place: int, dtype: str) -> str:
        """A single number in memory, for all lanes."""
        if not self.lanes:
            return self._narrowed(self._load_cell(self._pointer(place), dtype), dtype)
        lines, self.lines = self.lines, self.before
        lanes, self.lanes = self.lanes, 0
        x = self._narrowed(self._load_cell(self._pointer(place), dtype), dtype)
        self.lanes = lanes
        x = self._spread(x, dtype)
        self.before, self.lines = self.lines, lines
        return x

    def _spread(self, x: str, dtype: str) -> str:
        kind = _TYPES[dtype]
        if self.width == 1:
            return x
        one = self._say(f"insertelement <{self.width} x {kind}> poison, {kind} {x}, i64 0")
        return self._say(
            f"shufflevector <{self.width} x {kind}> {one}, <{self.width} x {kind}> poison, "
            f"<{self.width} x i32> zeroinitializer"
        )

    def _pointer(self, place: int) -> str:
        return self._say(
            f"getelementptr double, ptr %m, i64 {self.emission.address(place)}"
        )

    def _load_cell(self, pointer: str, dtype: str) -> str:
        kind = "double" if dtype[0] == "f" else "i64"
        kind = f"<{self.width} x {kind}>" if self._is_wide else kind
        return self._say(f"load {kind}, ptr {pointer}, align 8")

    def _narrowed(self, x: str, dtype: str) -> str:
        """What is in a cell, as a number of its type."""
        if dtype in ("f8", "i8", "u8"):
            return x
        wide = "double" if dtype == "f4" else "i64"
        wide = f"<{self.width} x {wide}>" if self._is_wide else wide
        how = "fptrunc" if dtype == "f4" else "trunc"
        return self._say(f"{how} {wide} {x} to {self._t(dtype)}")

    def _widened(self, x: str, dtype: str) -> str:
        if dtype in ("f8", "i8", "u8"):
            return x
        wide = "double" if dtype == "f4" else "i64"
        wide = f"<{self.width} x {wide}>" if self._is_wide else wide
        how = "fpext" if dtype == "f4" else "sext" if dtype[0] == "i" else "zext"
        return self._say(f"{how} {self._t(dtype)} {x} to {wide}")

    def _cell_type(self, dtype: str) -> str:
        kind = "double" if dtype[0] == "f" else "i64"
        return f"<{self.width} x {kind}>" if self._is_wide else kind

    def _lane_pointers(self, first: int | None, stride: int, table: int | None) -> list[str]:
        """The cells of the four lanes."""
        out = []
        for k in range(self.width):
            lane = "%i" if k == 0 else self._once(("lane", k), f"add i64 %i, {k}")
            if table is not None:
                at = self._once(
                    ("table", table, k),
                    f"getelementptr i64, ptr inttoptr (i64 $T{table}$ to ptr), i64 {lane}",
                )
                index = self._once(("index", table, k), f"load i64, ptr {at}")
            else:
                index = self._once(("offset", stride, k), f"mul i64 {lane}, {stride}")
            row = self._once(
                ("row", table, stride, k), f"getelementptr double, ptr %m, i64 {index}"
            )
            address = 0 if first is None else self.emission.address(first)
            out.append(self._say(f"getelementptr double, ptr {row}, i64 {address}"))
        return out

    def _once(self, key: tuple, text: str) -> str:
        if key not in self._found:
            self._found[key] = self._say(text)
        return self._found[key]

    def _read_lanes(self, dtype: str, first: int | None, stride: int, table: int | None) -> str:
        if stride == 1 and table is None and first is not None:
            base = self._pointer_at_lane(first)
            return self._narrowed(self._load_cell(base, dtype), dtype)
        return self._gathered(self._lane_pointers(first, stride, table), dtype)

    def _pointer_at_lane(self, first: int) -> str:
        index = self._say(f"add i64 %i, {self.emission.address(first)}")
        return self._say(f"getelementptr double, ptr %m, i64 {index}")

    def _gathered(self, pointers: list[str], dtype: str) -> str:
        kind = "double" if dtype[0] == "f" else "i64"
        if self.width == 1:
            one = self._say(f"load {kind}, ptr {pointers[0]}, align 8")
            return self._narrowed(one, dtype)
        vector = f"<{self.width} x {kind}>"
        out = "poison"
        for k, pointer in enumerate(pointers):
            one = self._say(f"load {kind}, ptr {pointer}, align 8")
            out = self._say(f"insertelement {vector} {out}, {kind} {one}, i64 {k}")
        return self._narrowed(out, dtype)

    def _write(self, x: str, dtype: str, place: int) -> None:
        x = self._widened(x, dtype)
        pointer = self._pointer_at_lane(place) if self.lanes else self._pointer(place)
        self.lines.append(f"  store {self._cell_type(dtype)} {x}, ptr {pointer}, align 8")

    def _store(self, node: Node) -> None:
        x, *counter = node.operands
        dtype, (first, stride, table, row) = node.dtype, node.extra
        value = self._widened(self._value(x, dtype), dtype)
        offset = None
        if counter:
            offset = self._row_offset(counter[0], row)
        if not self.lanes:
            index = str(self.emission.address(first))
            if offset is not None:
                index = self._say(f"add i64 {offset}, {index}")
            pointer = self._say(f"getelementptr double, ptr %m, i64 {index}")
            self.lines.append(f"  store {self._cell_type(dtype)} {value}, ptr {pointer}")
            return
        if stride == 1 and table is None:
            pointer = self._pointer_at_lane(first)
            if offset is not None:
                pointer = self._say(f"getelementptr double, ptr {pointer}, i64 {offset}")
            self.lines.append(
                f"  store {self._cell_type(dtype)} {value}, ptr {pointer}, align 8"
            )
            return
        kind = "double" if dtype[0] == "f" else "i64"
        for k, pointer in enumerate(self._lane_pointers(first, stride, table)):
            if offset is not None:
                pointer = self._say(f"getelementptr double, ptr {pointer}, i64 {offset}")
            one = self._element(self._cell_type(dtype), value, k)
            self.lines.append(f"  store {kind} {one}, ptr {pointer}, align 8")

    def _row_offset(self, counter: Node, row: int) -> str:
        """The offset of the row of a pass: a single number, also among lanes."""
        key = ("row", counter.number, row)
        if key in self._found:
            return self._found[key]
        return self._single_number(key, counter, row)

    def _single_number(self, key: tuple, x: Node, factor: int) -> str:
        lanes, self.lanes = self.lanes, 0
        lines = self.lines
        if lanes:
            self.lines = self.before
        if lanes or x not in self.names:
            place = x.extra if x.op == "load" else x.place
            assert place is not None
            name = self._load_cell(self._pointer(place), "i8")
        else:
            name = self.names[x]
        if factor != 1:
            name = self._say(f"mul i64 {name}, {factor}")
        if lanes:
            self.before, self.lines = self.lines, lines
            self._found[key] = name
        self.lanes = lanes
        return name

    # Operations ---------------------------------------------------------------------------

    def _compute(self, node: Node) -> str:
        op, dtype = node.op, node.dtype
        if op == "dynamic":
            return self._dynamic(node)
        of = node.extra if op == "convert" else node.extra[1] if op == "cmp" else dtype
        if op == "select":
            types = ("b1", dtype, dtype)
        else:
            types = (of,) * len(node.operands)
        xs = [self._value(x, t) for x, t in zip(node.operands, types, strict=True)]
        if op == "copy":
            return xs[0]
        return getattr(self, f"_{op}")(dtype, node, *xs)

    def _element(self, vector: str, x: str, k: int) -> str:
        if self.width == 1:
            return x
        return self._say(f"extractelement {vector} {x}, i64 {k}")

    def _dynamic(self, node: Node) -> str:
        (offset, *_), (first, stride) = node.operands, node.extra
        dtype = node.dtype
        if not self.lanes:
            name = self._value(offset, "i8")
            index = self._say(f"add i64 {name}, {self.emission.address(first)}")
            pointer = self._say(f"getelementptr double, ptr %m, i64 {index}")
            return self._narrowed(self._load_cell(pointer, dtype), dtype)
        if isinstance(offset, Node) and offset.lanes and not offset.is_reduced:
            name = self._value(offset, "i8")
            pointers = []
            for k in range(self.width):
                one = self._element(f"<{self.width} x i64>", name, k)
                index = self._say(f"add i64 {one}, {self.emission.address(first)}")
                pointers.append(self._say(f"getelementptr double, ptr %m, i64 {index}"))
            return self._gathered(pointers, dtype)
        assert isinstance(offset, Node)
        single = self._row_offset(offset, 1)
        if stride == 1:
            pointer = self._pointer_at_lane(first)
            pointer = self._say(f"getelementptr double, ptr {pointer}, i64 {single}")
            return self._narrowed(self._load_cell(pointer, dtype), dtype)
        pointers = [
            self._say(f"getelementptr double, ptr {p}, i64 {single}")
            for p in self._lane_pointers(first, stride, None)
        ]
        return self._gathered(pointers, dtype)

    def _add(self, dtype, node, a, b):
        return self._arithmetic("add", dtype, a, b)

    def _sub(self, dtype, node, a, b):
        return self._arithmetic("sub", dtype, a, b)

    def _mul(self, dtype, node, a, b):
        return self._arithmetic("mul", dtype, a, b)

    def _arithmetic(self, op, dtype, a, b):
        if dtype == "b1":
            op = "and" if op == "mul" else "or" if op == "add" else "xor"
            return self._say(f"{op} {self._t(dtype)} {a}, {b}")
        name = f"f{op} contract" if dtype[0] == "f" else op
        return self._say(f"{name} {self._t(dtype)} {a}, {b}")

    def _div(self, dtype, node, a, b):
        if dtype[0] == "f":
            return self._say(f"fdiv {self._t(dtype)} {a}, {b}")
        return self._whole_division("div", dtype, a, b)

    def _rem(self, dtype, node, a, b):
        if dtype[0] == "f":
            return self._called("fmod", dtype, (a, b))
        return self._whole_division("rem", dtype, a, b)

    def _whole_division(self, op, dtype, a, b):
        """Division by zero would end the process."""
        t, sign = self._t(dtype), "s" if dtype[0] == "i" else "u"
        mask = self._t("b1")
        zero, one = self._value(0, dtype), self._value(1, dtype)
        is_zero = self._say(f"icmp eq {t} {b}, {zero}")
        b = self._say(f"select {mask} {is_zero}, {t} {one}, {t} {b}")
        out = self._say(f"{sign}{op} {t} {a}, {b}")
        other = self._value(-1, dtype) if op == "div" else a
        return self._say(f"select {mask} {is_zero}, {t} {other}, {t} {out}")

    def _neg(self, dtype, node, x):
        if dtype[0] == "f":
            return self._say(f"fneg {self._t(dtype)} {x}")
        return self._say(f"sub {self._t(dtype)} {self._value(0, dtype)}, {x}")

    def _abs(self, dtype, node, x):
        if dtype[0] == "f":
            return self._intrinsic("fabs", dtype, x)
        return self._intrinsic("abs", dtype, x, more=", i1 false")

    def _max(self, dtype, node, a, b):
        return self._extreme("max", dtype, a, b)

    def _min(self, dtype, node, a, b):
        return self._extreme("min", dtype, a, b)

    def _extreme(self, op, dtype, a, b):
        if dtype == "b1":
            return self._say(f"{'or' if op == 'max' else 'and'} {self._t(dtype)} {a}, {b}")
        if dtype[0] == "f":
            return self._intrinsic(f"{op}imum", dtype, a, b)
        return self._intrinsic(f"{'s' if dtype[0] == 'i' else 'u'}{op}", dtype, a, b)

    def _sqrt(self, dtype, node, x):
        return self._intrinsic("sqrt", dtype, x)

    def _floor(self, dtype, node, x):
        return self._intrinsic("floor", dtype, x)

    def _ceil(self, dtype, node, x):
        return self._intrinsic("ceil", dtype, x)

    def _rint(self, dtype, node, x):
        return self._intrinsic("roundeven", dtype, x)

    def _intrinsic(self, name, dtype, *xs, more=""):
        t = self._t(dtype)
        suffix = ("v4" if self._is_wide else "") + (
            {"f8": "f64", "f4": "f32"}.get(dtype) or _TYPES[dtype]
        )
        whole = f"@llvm.{name}.{suffix}"
        types = ", ".join([t] * len(xs)) + (", i1" if more else "")
        self.emission.declared.add(f"declare {t} {whole}({types})")
        given = ", ".join(f"{t} {x}" for x in xs) + more
        return self._say(f"call {t} {whole}({given})")

    def _and(self, dtype, node, a, b):
        return self._say(f"and {self._t(dtype)} {a}, {b}")

    def _or(self, dtype, node, a, b):
        return self._say(f"or {self._t(dtype)} {a}, {b}")

    def _xor(self, dtype, node, a, b):
        return self._say(f"xor {self._t(dtype)} {a}, {b}")

    def _not(self, dtype, node, x):
        ones = True if dtype == "b1" else -1
        return self._say(f"xor {self._t(dtype)} {x}, {self._value(ones, dtype)}")

    def _select(self, dtype, node, which, a, b):
        t, mask = self._t(dtype), self._t("b1")
        return self._say(f"select {mask} {which}, {t} {a}, {t} {b}")

    def _cmp(self, dtype, node, a, b):
        how, of = node.extra
        if of[0] == "f":
            text = f"fcmp {'une' if how == 'ne' else 'o' + how}"
        else:
            sign = "" if how in ("eq", "ne") else "s" if of[0] == "i" else "u"
            text = f"icmp {sign}{how}"
        return self._say(f"{text} {self._t(of)} {a}, {b}")

    def _convert(self, dtype, node, x):
        of = node.extra
        t, from_type = self._t(dtype), self._t(of)
        if of[0] == "f" and dtype[0] == "f":
            return self._say(f"{'fpext' if dtype == 'f8' else 'fptrunc'} {from_type} {x} to {t}")
        if of[0] == "f":
            if dtype == "b1":
                return self._say(f"fcmp une {from_type} {x}, {self._value(0.0, of)}")
            return self._saturated(dtype, of, x)
        if dtype[0] == "f":
            how = "sitofp" if of[0] == "i" else "uitofp"
            return self._say(f"{how} {from_type} {x} to {t}")
        if dtype == "b1":
            return self._say(f"icmp ne {from_type} {x}, {self._value(0, of)}")
        old, new = (1 if k == "b1" else 8 * int(k[1]) for k in (of, dtype))
        if old == new:
            return x
        how = "trunc" if new < old else "sext" if of[0] == "i" else "zext"
        return self._say(f"{how} {from_type} {x} to {t}")

    def _saturated(self, dtype, of, x):
        t, from_type = self._t(dtype), self._t(of)
        suffix = "v4" if self._is_wide else ""
        source = {"f8": "f64", "f4": "f32"}[of]
        sign = "s" if dtype[0] == "i" else "u"
        name = f"@llvm.fpto{sign}i.sat.{suffix}{_TYPES[dtype]}.{suffix}{source}"
        self.emission.declared.add(f"declare {t} {name}({from_type})")
        return self._say(f"call {t} {name}({from_type} {x})")

    def _call(self, dtype, node, *xs):
        return self._called(node.extra, dtype, xs)

    def _called(self, name, dtype, xs):
        """A function of the library of the machine."""
        kind = _TYPES[dtype]
        whole = f"@{name}" + ("f" if dtype == "f4" else "")
        types = ", ".join([kind] * len(xs))
        self.emission.declared.add(f"declare {kind} {whole}({types}) #1")
        if not self._is_wide:
            given = ", ".join(f"{kind} {x}" for x in xs)
            return self._say(f"call {kind} {whole}({given})")
        out = "poison"
        for k in range(self.width):
            ones = [
                self._say(f"extractelement <{self.width} x {kind}> {x}, i64 {k}") for x in xs
            ]
            given = ", ".join(f"{kind} {x}" for x in ones)
            one = self._say(f"call {kind} {whole}({given})")
            out = self._say(f"insertelement <{self.width} x {kind}> {out}, {kind} {one}, i64 {k}")
        return out

    # Reductions ---------------------------------------------------------------------------

    def _reduction(self, node: Node) -> tuple[Node, str, str]:
        """The sum of four partial sums, or the like, as it grows in the loop."""
        acc, (x,) = self._new(), node.operands
        dtype, op = node.dtype, node.op.split()[1]
        value = self._value(x, dtype)
        if self.lanes % self.width:
            t = self._t(dtype)
            value = self._say(
                f"select <{self.width} x i1> %mask, {t} {value}, {t} {self._neutral(node)}"
            )
        after = getattr(self, f"_{op}")(dtype, node, acc, value)
        return node, acc, after

    def _reduced(self, node: Node, total: str) -> None:
        dtype, op = node.dtype, node.op.split()[1]
        t = self._t(dtype)
        ones = [self._element(t, total, k) for k in range(self.width)]
        lanes, self.lanes = self.lanes, 0
        join = getattr(self, f"_{op}")
        while len(ones) > 1:
            half = len(ones) // 2
            pairs = zip(ones[:half], ones[half:], strict=True)
            ones = [join(dtype, node, a, b) for a, b in pairs]
        (out,) = ones
        if node.place is not None:
            self._write(out, dtype, node.place)
        self.lanes = lanes

    def _neutral(self, node: Node) -> str:
        dtype, op = node.dtype, node.op.split()[1]
        kind = _TYPES[dtype]
        if op in ("add", "or", "xor"):
            x = 0
        elif op == "mul":
            x = 1
        elif op == "and":
            x = True if dtype == "b1" else -1
        elif dtype[0] == "f":
            x = float("-inf") if op == "max" else float("inf")
        elif dtype == "b1":
            x = op == "min"
        else:
            info = np.iinfo(dtype)
            x = int(info.min if op == "max" else info.max)
        text = literal(x, dtype)
        return f"splat ({kind} {text})" if self.width > 1 else text



class _Recurrence(_Kernel):
    """The function of a loop over single numbers."""

    def __init__(self, emission: Emission, number: int, nodes: list[Node], item: Scan):
        super().__init__(emission, number, nodes, 0)
        self.item = item
        stores = [x for x in nodes if x.op == "store"]
        self.commits = {x.extra[0]: x for x in stores if len(x.operands) == 1}
        self.rows = [x for x in stores if len(x.operands) == 2]
        self.attributes = "#0"

    def text(self, name: str) -> str:
        item = self.item
        carry = {}
        for place, node in self.commits.items():
            first = self._before(lambda: self._single_at(place, node.dtype))
            carry[place] = self._new(), first
        self.carry = {place: phi for place, (phi, _) in carry.items()}
        for node in self.nodes:
            if node.op != "store":
                self.names[node] = self._compute(node)
        after = {
            place: self._value(node.operands[0], node.dtype)
            for place, node in self.commits.items()
        }
        for node in self.rows:
            self._store(node)
        head = [f"define internal void {name}(ptr %m) {self.attributes} {{", "entry:"]
        head += [*self.before, "  br label %loop", "loop:"]
        head += ["  %j = phi i64 [ 0, %entry ], [ %next, %loop ]"]
        head += [
            f"  {phi} = phi {self._t(self.commits[place].dtype)} "
            f"[ {first}, %entry ], [ {after[place]}, %loop ]"
            for place, (phi, first) in carry.items()
        ]
        number = "%j" if not item.reverse else f"sub i64 {item.length - 1}, %j"
        head += [f"  %count = {number}" if item.reverse else "  %count = add i64 %j, 0"]
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

    def _before(self, make: Callable[[], str]) -> str:
        """What is computed before the loop."""
        lines, self.lines = self.lines, self.before
        name = make()
        self.before, self.lines = self.lines, lines
        return name

    def _value(self, x: Number, dtype: str) -> str:
        if isinstance(x, Node) and x not in self.names:
            if x.op == "load" and x.extra == self.item.counter:
                return "%count"
            if x.op == "load" and x.extra in self.carry:
                return self.carry[x.extra]
            self.names[x] = self._before(lambda: super(_Recurrence, self)._value(x, dtype))
        return super()._value(x, dtype)

    def _row_offset(self, counter: Node, row: int) -> str:
        return self._once(("row", row), f"mul i64 {self._value(counter, 'i8')}, {row}")


def literal(x: Number, dtype: str) -> str:
    """A known number in the language of LLVM."""
    if dtype[0] == "f":
        number = float(x)
        if dtype == "f4":
            number = float(np.float32(number))
        if number != number:
            number = float("nan")
        bits = struct.unpack("<Q", struct.pack("<d", number))[0]
        return f"0x{bits:016X}"
    if dtype == "b1":
        return "true" if x else "false"
    return str(int(x))
