"""The graph of a program as code for LLVM: its kernels, and a function that calls them."""

from collections.abc import Sequence

import numpy as np

from . import scheduling
from .graph import Node, NOT_COMPUTED, Number, Region
from .kernels import Kernel, Recurrence, recurrences, WIDTH
from .loops import Scan, While
from .scheduling import all_regions, kernels_of
from .values import Cellar, CONSTANTS


# Branches of more operations are compiled when one is first taken. Most runs never need
# Newton's method or a division of a step, which are more than half of their program.
_LARGE_BRANCH = 1_000


class Emission:
    """The code of a program, whose results are in the cells `outputs`.

    - `functions`: the kernels, and `@main`, which has the loops and branches, by name.
    - `late`: for each branch that is compiled when it is first taken, its kernels and
      `@branch`, which calls them.
    - `declared`: the functions that these call: declarations, and the text of some.
    - `length`: the number of operations.
    """

    def __init__(self, cellar: Cellar, outputs: Sequence[np.ndarray]):
        self.cellar, self._root = cellar, cellar.graph.root
        self.functions: dict[str, str] = {}
        self.late: list[dict[str, str]] = []
        self.declared: set[str] = {
            f"declare i1 @llvm.vector.reduce.or.v{WIDTH}i1(<{WIDTH} x i1>)"
        }
        regions = list(all_regions(self._root))
        self._uniform: dict[Node, bool] = {}
        self._counters = {
            item.counter
            for region in regions
            for item in region.items
            if isinstance(item, Scan) and not item.is_wide
        }
        self.has_passes = any(region.is_wide for region in regions)
        kernels = kernels_of(cellar, regions, outputs)
        self.length = sum(map(len, kernels.values()))
        loops = recurrences(regions, kernels, scheduling.LONGEST)
        self._make_places(kernels, loops)
        # The cells behind the constants begin with a line of the cache, too.
        cellar.align_constants()
        self._recurrences = {}
        self._texts: dict[Region, dict[str, str]] = {region: {} for region in regions}
        self._sizes: dict[Region, int] = dict.fromkeys(regions, 0)
        for region, (item, nodes) in loops.items():
            name = self._recurrences[region] = f"@r{len(self._recurrences)}"
            self._texts[region][name] = Recurrence(self, nodes, item).text(name)
        self._by_region: dict[Region, dict[int, list[str]]] = {}
        for number, ((region, level, lanes, _), nodes) in enumerate(kernels.items()):
            self._sizes[region] += len(nodes)
            if region not in loops:
                name = f"@k{number}"
                self._texts[region][name] = Kernel(self, nodes, lanes).text(name)
                levels = self._by_region.setdefault(region, {})
                levels.setdefault(level, []).append(name)
        self._lines: list[str] = []
        self._labels = 0
        self._block = "entry"
        self._function("internal", "@main", "ptr %frame, ptr %m, ptr %w", self._root)

    def address(self, place: int) -> int:
        """The number of a cell in the memory: constants come first."""
        if place >= CONSTANTS:
            return place - CONSTANTS
        return place + self.cellar.num_constants

    def addresses(self, places: np.ndarray) -> np.ndarray:
        shifted = places + self.cellar.num_constants
        return np.where(places >= CONSTANTS, places - CONSTANTS, shifted)

    def is_uniform(self, x: Number) -> bool:
        """Whether a number is the same for all passes that are taken at a time."""
        if not isinstance(x, Node) or not x.region.is_wide:
            return True
        if x not in self._uniform:
            if x.op == "load":
                self._uniform[x] = not x.lanes and x.extra in self._counters
            else:
                of_passes = x.op == "dynamic" and x.extra[0] < CONSTANTS
                known = not of_passes and not x.op.startswith("reduce")
                self._uniform[x] = known and all(map(self.is_uniform, x.operands))
        return self._uniform[x]

    def _make_places(
        self, kernels: dict[tuple, list[Node]], loops: dict[Region, tuple]
    ) -> None:
        """Cells for results that other kernels read."""
        kernel_of = {x: key for key, nodes in kernels.items() for x in nodes}
        for key, nodes in kernels.items():
            for node in nodes:
                for x in node.operands:
                    if not isinstance(x, Node) or x.op in NOT_COMPUTED:
                        continue
                    if x.region is node.region and x.region in loops:
                        continue
                    is_offset = node.op == "dynamic" and node.lanes and not x.lanes
                    if kernel_of[x] != key or x.is_reduced or is_offset:
                        self.cellar.place_of(x, x.dtype)

    # The function for the whole -----------------------------------------------------------

    def _function(
        self,
        linkage: str,
        name: str,
        parameters: str,
        region: Region,
        first: Sequence[str] = (),
    ) -> None:
        """A function that runs a region, after some lines."""
        outside = self._lines, self._block
        self._lines, self._block = list(first), "entry"
        self._run(region)
        body = "\n".join(self._lines)
        head = f"define {linkage} void {name}({parameters}) #3 {{\nentry:"
        self.functions[name] = f"{head}\n{body}\n  ret void\n}}\n"
        self._lines, self._block = outside

    def _label(self) -> str:
        self._labels += 1
        return f"b{self._labels}"

    def _say(self, line: str) -> None:
        self._lines.append("  " + line)

    def _name(self, text: str) -> str:
        name = f"%{self._label()}"
        self._say(f"{name} = {text}")
        return name

    def _start(self, label: str) -> None:
        self._lines.append(f"{label}:")
        self._block = label

    def _run(self, region: Region) -> None:
        self.functions |= self._texts[region]
        kernels = self._by_region.get(region, {})
        items: dict[int, list] = {}
        for item in region.items:
            items.setdefault(item.level, []).append(item)
        for level in sorted({*kernels, *items}):
            for name in kernels.get(level, []):
                self._say(f"call void {name}(ptr %m, ptr %w)")
            for item in items.get(level, []):
                if isinstance(item, Scan):
                    self._scan(item)
                elif isinstance(item, While):
                    self._while(item, region)
                else:
                    self._branch(item, region)

    def _cell(self, place: int, is_wide: bool) -> str:
        if is_wide:
            kind = f"<{WIDTH} x double>"
            return self._name(f"getelementptr {kind}, ptr %w, i64 {self.address(place)}")
        return self._name(f"getelementptr double, ptr %m, i64 {self.address(place)}")

    def _scan(self, item: Scan) -> None:
        if item.is_wide:
            self._side_by_side(item)
            return
        if item.body in self._recurrences:
            self.functions |= self._texts[item.body]
            self._say(f"call void {self._recurrences[item.body]}(ptr %m, ptr %w)")
            return
        loop, end = self._label(), self._label()
        begin = self._block
        self._say(f"br label %{loop}")
        self._start(loop)
        k, after = f"%{loop}k", f"%{loop}n"
        placeholder = len(self._lines)
        self._lines.append("")
        number = k
        if item.reverse:
            number = self._name(f"sub i64 {item.length - 1}, {k}")
        cell = self._cell(item.counter, item.body.is_wide)
        if item.body.is_wide:
            number = self._of_all_passes(number)
            self._say(f"store <{WIDTH} x i64> {number}, ptr {cell}, align 8")
        else:
            self._say(f"store i64 {number}, ptr {cell}")
        self._run(item.body)
        self._say(f"{after} = add i64 {k}, 1")
        more = self._name(f"icmp ult i64 {after}, {item.length}")
        self._say(f"br i1 {more}, label %{loop}, label %{end}")
        self._lines[placeholder] = (
            f"  {k} = phi i64 [ 0, %{begin} ], [ {after}, %{self._block} ]"
        )
        self._start(end)

    def _side_by_side(self, item: Scan) -> None:
        """Passes that do not depend on one another: a function for several from `%k` on."""
        vector = f"<{WIDTH} x i64>"
        numbers = ", ".join(f"i64 {x}" for x in range(WIDTH))
        outside, self._lines = self._lines, []
        number = self._name(f"add {vector} {self._of_all_passes('%k')}, <{numbers}>")
        cell = self._cell(item.counter, True)
        self._say(f"store {vector} {number}, ptr {cell}, align 8")
        first, self._lines = self._lines, outside
        name = f"@p{self._label()}"
        self._function("internal", name, "ptr %m, ptr %w, i64 %k", item.body, first)
        given = f"ptr %frame, ptr %m, ptr %w, ptr {name}, i64 {item.length}"
        self._say(f"call void @passes({given})")

    def _of_all_passes(self, number: str) -> str:
        """A whole number, for each pass that is made at a time."""
        vector, zeros = f"<{WIDTH} x i64>", f"<{WIDTH} x i32> zeroinitializer"
        one = self._name(f"insertelement {vector} poison, i64 {number}, i64 0")
        return self._name(f"shufflevector {vector} {one}, {vector} poison, {zeros}")

    def _while(self, item: While, region: Region) -> None:
        before, body, end = self._label(), self._label(), self._label()
        if item.body.is_wide:
            # Passes that are not active around the loop are not active in it.
            cell = self._cell(item.flag, True)
            active = self._active(region)
            self._say(f"store <{WIDTH} x i64> {active}, ptr {cell}, align 8")
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

    def _active(self, region: Region) -> str:
        """Which passes are active in a region, as numbers."""
        if region.mask is None:
            return "splat (i64 1)"
        return self._name(
            f"load <{WIDTH} x i64>, ptr {self._cell(region.mask, True)}, align 8"
        )

    def _decide(self, item: While, on: str, off: str) -> None:
        is_wide = item.body.is_wide
        cell = self._cell(item.flag, is_wide)
        kind = f"<{WIDTH} x i64>" if is_wide else "i64"
        flag = self._name(f"load {kind}, ptr {cell}, align 8")
        flag = self._name(f"icmp ne {kind} {flag}, {'splat (i64 0)' if is_wide else '0'}")
        flag = self._any(flag) if is_wide else flag
        self._say(f"br i1 {flag}, label %{on}, label %{off}")

    def _any(self, flag: str) -> str:
        kind = f"<{WIDTH} x i1>"
        return self._name(f"call i1 @llvm.vector.reduce.or.v{WIDTH}i1({kind} {flag})")

    def _branch(self, item, region: Region) -> None:
        if region.is_wide:
            self._branch_of_passes(item, region)
            return
        end = self._label()
        labels = [self._label() for _ in item.branches]
        which = self._name(f"load i64, ptr {self._cell(item.which, False)}")
        cases = " ".join(f"i64 {k}, label %{x}" for k, x in enumerate(labels))
        self._say(f"switch i64 {which}, label %{labels[-1]} [ {cases} ]")
        for label, inner in zip(labels, item.branches, strict=True):
            self._start(label)
            self._run_branch(inner)
            self._say(f"br label %{end}")
        self._start(end)

    def _run_branch(self, region: Region) -> None:
        """Runs a branch, as a function of its own if it is large."""
        within = list(all_regions(region))
        # Passes on all cores are called from `@main`.
        has_passes = not region.is_wide and any(x.is_wide for x in within)
        if has_passes or sum(self._sizes[x] for x in within) <= _LARGE_BRANCH:
            self._run(region)
            return
        outside, self.functions = self.functions, {}
        number = len(self.late)
        self.late.append(self.functions)
        self._function("", "@branch", "ptr %m, ptr %w", region)
        self.functions = outside
        branch = self._name(f"call ptr @late(i64 {number})")
        self._say(f"call void {branch}(ptr %m, ptr %w)")

    def _branch_of_passes(self, item, region: Region) -> None:
        """Every branch that a pass takes, for the passes that take it."""
        vector, flags = f"<{WIDTH} x i64>", f"<{WIDTH} x i1>"
        is_wide = self.cellar.is_wide(item.which)
        cell = self._cell(item.which, is_wide)
        if is_wide:
            which = self._name(f"load {vector}, ptr {cell}, align 8")
        else:
            which = self._of_all_passes(self._name(f"load i64, ptr {cell}"))
        active = self._active(region)
        active = self._name(f"icmp ne {vector} {active}, splat (i64 0)")
        for k, inner in enumerate(item.branches):
            on, off = self._label(), self._label()
            taken = self._name(f"icmp eq {vector} {which}, splat (i64 {k})")
            taken = self._name(f"and {flags} {taken}, {active}")
            wide = self._name(f"zext {flags} {taken} to {vector}")
            self._say(f"store {vector} {wide}, ptr {self._cell(inner.mask, True)}, align 8")
            self._say(f"br i1 {self._any(taken)}, label %{on}, label %{off}")
            self._start(on)
            self._run_branch(inner)
            self._say(f"br label %{off}")
            self._start(off)
