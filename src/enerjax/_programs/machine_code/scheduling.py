"""Which kernel computes which operations.

Operations of one region, level and number of lanes are a kernel. Operations move to later
kernels and reads to earlier ones where that makes less to write and to read.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from .graph import Graph, Node, NOT_COMPUTED, Region
from .loops import Branch, Scan, While
from .values import Block, Cellar


# Kernels of single numbers with more operations are divided: the time of compilation grows
# faster than their length. It grows most for loops over lanes. Those that run once and have
# few lanes are divided too; for the rows of a run it would take longer to write and read.
LONGEST, _LONGEST_OF_LANES, _FEW_LANES = 2_500, 300, 256
# The operands by which operations find cells.
_OFFSETS = {"dynamic": slice(0, 1), "store": slice(1, None)}
# The longest chain of operations that moves to a later kernel with the last of them.
_LONGEST_SUNK = 8


def all_regions(region: Region) -> Iterable[Region]:
    yield region
    for item in region.items:
        for inner in item.regions:
            yield from all_regions(inner)


def _longest(node: Node) -> float:
    """The most operations in a kernel of such a node."""
    if not node.lanes:
        return LONGEST
    is_divided = node.region.depth == 0 and node.lanes < _FEW_LANES
    return _LONGEST_OF_LANES if is_divided else math.inf


def kernels_of(
    cellar: Cellar, regions: list[Region], outputs: Sequence[np.ndarray]
) -> dict[tuple, list[Node]]:
    """The operations that are needed, by kernel, for the numbers in the cells `outputs`."""
    live = _live(cellar, regions, outputs)
    _sink(live)
    _copy_scattered(cellar.graph, live, regions)
    order = {region: k for k, region in enumerate(regions)}
    needed = [x for x in live if x.op not in NOT_COMPUTED and x.region in order]
    # Loops over lanes that are divided write last, when all that they read is read.
    is_late = lambda x: x.op == "store" and x.lanes > 0 and _longest(x) < math.inf
    needed.sort(key=lambda x: (order[x.region], x.level, x.lanes, is_late(x), x.number))
    kernels: dict[tuple, list[Node]] = {}
    parts: dict[tuple, int] = {}
    for node in needed:
        key = node.region, node.level, node.lanes
        part = parts.get(key, 0)
        # Numbers of a carry are all read before the first is written.
        is_full = len(kernels.get((*key, part), ())) >= _longest(node)
        if is_full and node.op != "store":
            part = parts[key] = part + 1
        kernels.setdefault((*key, part), []).append(node)
    return kernels


def _live(
    cellar: Cellar, regions: list[Region], outputs: Sequence[np.ndarray]
) -> set[Node]:
    """Takes the cells of results that nothing reads from the memory, and returns the
    operations whose results are needed.

    Arrays get cells as soon as they are joined to others, for example, whether anything
    reads them there or not.
    """
    live: set[Node] = set()
    read: set[Node | Block] = set(cellar.read_at_computed_places)
    for places in outputs:
        read.update(cellar.owners(places))
    for region in regions:
        for item in region.items:
            read.update(cellar.owners(np.array(item.places, np.int64)))
    stack = [x for region in regions for x in region.nodes if x.op == "store"]
    stack.extend(x for x in read if isinstance(x, Node))
    while stack:
        node = stack.pop()
        if node in live:
            continue
        live.add(node)
        stack.extend(x for x in node.operands if isinstance(x, Node) and x not in live)
        if node.op == "load":
            owners = cellar.owners(cellar.loaded_places(node))
        else:
            # Where an array begins is read from the memory.
            first = node.operands[_OFFSETS[node.op]] if node.op in _OFFSETS else ()
            owners = [x for x in first if isinstance(x, Node)]
        read.update(owners)
        stack.extend(x for x in owners if isinstance(x, Node))
    for region in regions:
        for node in region.nodes:
            if node.place is not None and node not in read:
                node.place = None
    return live


def _sink(live: set[Node]) -> None:
    """Moves operations into the kernels that use their results, which need no cells."""
    users: dict[Node, list[Node]] = {}
    for node in live:
        for x in node.operands:
            if isinstance(x, Node):
                users.setdefault(x, []).append(node)

    def is_movable(x: Node) -> bool:
        is_computed = x.op not in NOT_COMPUTED and x.op not in ("store", "copy", "dynamic")
        return is_computed and not x.is_reduced and x.place is None

    def is_stored(x: Node, apart_from: Node) -> bool:
        """Whether kernels other than that of `x` read it, apart from one operation."""
        others = (y for y in users[x] if y is not apart_from)
        key = x.region, x.level, x.lanes
        return not is_movable(x) or any((y.region, y.level, y.lanes) != key for y in others)

    def can_move(x: Node, depth: int) -> bool:
        """Whether no operand has to be stored instead."""
        for y in x.operands:
            if not isinstance(y, Node) or y.op in NOT_COMPUTED or y.lanes != x.lanes:
                continue
            if y.region is x.region and not is_stored(y, x):
                goes_along = len(users[y]) == 1 and depth > 0 and can_move(y, depth - 1)
                if not goes_along:
                    return False
        return True

    for x in sorted(live, key=lambda x: -x.number):
        if not is_movable(x):
            continue
        own = users.get(x, [])
        if any(y.region is not x.region or y.lanes != x.lanes for y in own):
            continue
        # At the level where a carry is written, it could be read after it was written.
        level = min((y.level for y in own if y.op != "store"), default=x.level)
        is_written = any(y.op == "store" for y in own)
        if level > x.level and not is_written and can_move(x, _LONGEST_SUNK):
            x.level = level


def _copy_scattered(graph: Graph, live: set[Node], regions: list[Region]) -> None:
    """Copies numbers of lanes from scattered cells to neighbouring ones.

    Scattered cells are read one by one. What a loop does not change is copied before the
    loop, and what several kernels of a loop read is copied by the first of them. Where
    several passes are made at a time, numbers of lanes are read as vectors anyway.
    """
    items = [item for region in regions for item in region.items]
    repeated = {x for item in items for x in _repeated_regions(item)}
    branches = {x for item in items if isinstance(item, Branch) for x in item.branches}
    readers: dict[tuple[Node, Region], list[Node]] = {}
    for node in live:
        if node.op in NOT_COMPUTED or node.region.is_wide:
            continue
        for x in node.operands:
            if isinstance(x, Node) and _is_scattered(x):
                region = _before_loops(node.region, x.region, repeated, branches)
                readers.setdefault((x, region), []).append(node)
    for (x, region), nodes in readers.items():
        level = x.level if region is x.region else 0
        own = region, level, x.lanes
        others = [y for y in nodes if (y.region, y.level, y.lanes) != own]
        is_before_loop = any(y.region is not region for y in others)
        kernels = {(y.region, y.level) for y in nodes}
        if not is_before_loop and (len(kernels) < 2 or region.depth == 0):
            continue
        copy = graph.at(region, level, "copy", x.dtype, (x,), lanes=x.lanes)
        live.add(copy)
        for node in others:
            node.operands = tuple(copy if y is x else y for y in node.operands)


def _is_scattered(x: Node) -> bool:
    if x.op != "load" or not x.lanes:
        return False
    _, stride, table = x.extra
    return stride != 1 or table is not None


def _repeated_regions(item: Scan | While | Branch) -> list[Region]:
    if isinstance(item, While):
        return [item.head, item.body]
    return [item.body] if isinstance(item, Scan) else []


def _before_loops(
    region: Region, outermost: Region, repeated: set[Region], branches: set[Region]
) -> Region:
    """The region around all loops of `region`, within `outermost` and the same branch."""
    found = region
    while region is not outermost and region not in branches:
        assert region.parent is not None
        if region in repeated:
            found = region.parent
        region = region.parent
    return found
