"""Which numbers are passed from one loop over lanes to the next, and which are repeated.

A number that a loop over lanes reads costs more than an addition: it is read, and because
XLA's operation has as many results as inputs, it is written too. What a loop reads, and
what it computes from that, is therefore a minimum cut in the graph of the operations.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import scipy

from .entries import Entry, Number, Region
from .loops import Scan, While


# The cost of an input, and of some operations, in units of an addition.
_INPUT = 5
_COSTS = {"div": 6, "max": 3, "min": 3, "rsqrt": 8, "sqrt": 8}
# The cost of the functions that are computed by many operations.
_FUNCTION = 40
_CHEAP = frozenset(
    """
    abs add add_any and convert_element_type eq ge gt integer_pow is_finite le lt mul ne neg
    not or select_n sign square sub xor
    """.split()
)
_NEVER = 1_000_000


class Kernel(NamedTuple):
    """Operations, operands first, of which some results are wanted."""

    entries: list[Entry]
    wanted: list[Entry]


class Plan(NamedTuple):
    """The kernels of a region, one before each loop and one after the last.

    - `loops`: the loops, with the plans of their bodies.
    - `inputs`: the entries from outside of the region, and its own inputs, that are read.
    """

    kernels: list[Kernel]
    loops: list[tuple[While | Scan, "Plan"]]
    inputs: list[Entry]


def plan_of(region: Region, numbers: Iterable[Number]) -> Plan:
    """The plan by which some numbers of a region are computed."""
    needed = dict.fromkeys(x for x in numbers if isinstance(x, Entry))
    kernels, loops = [], []
    for level in range(len(region.loops), -1, -1):
        if level < len(region.loops):
            loop = region.loops[level]
            body = plan_of(loop.region, loop.outputs)
            loops.append((loop, body))
            own = {*loop.carry, *(x for x, _ in _rows(loop))}
            own.update([loop.active] if isinstance(loop, While) else [])
            needed = dict.fromkeys(x for x in needed if x not in loop.after)
            needed |= dict.fromkeys(x for x in body.inputs if x not in own)
            needed |= dict.fromkeys(x for x in loop.inputs if isinstance(x, Entry))
        wanted = [x for x in needed if _is_new(x, region, level)]
        entries, inputs = _cut(region, level, wanted)
        kernels.append(Kernel(entries, wanted))
        here = set(wanted)
        needed = dict.fromkeys(x for x in needed if x not in here)
        needed |= dict.fromkeys(inputs)
    return Plan(kernels[::-1], loops[::-1], list(needed))


def num_operations(plan: Plan) -> int:
    """The operations of a plan, with one pass of each loop."""
    own = sum(len(kernel.entries) for kernel in plan.kernels)
    return own + sum(num_operations(body) for _, body in plan.loops)


def _rows(loop: While | Scan) -> list[tuple[Entry, list[Number]]]:
    return loop.rows if isinstance(loop, Scan) else []


def _cut(
    region: Region, level: int, wanted: list[Entry]
) -> tuple[list[Entry], list[Entry]]:
    """The operations by which the wanted entries are computed, and what they read.

    An entry has two nodes. The first is on the side of the source if the entry is used, the
    second if it is computed here; if it is only used, it is read.
    """
    order = _cone(wanted)
    number = {entry: k for k, entry in enumerate(order)}
    source, sink = 2 * len(order), 2 * len(order) + 1
    edges: list[tuple[int, int, int]] = []
    for entry, k in number.items():
        is_new = _is_new(entry, region, level)
        edges.append((2 * k, 2 * k + 1, _NEVER if is_new else _INPUT))
        edges.append((2 * k + 1, sink, _cost(entry)))
        for x in entry.operands:
            if isinstance(x, Entry):
                edges.append((2 * k + 1, 2 * number[x], _NEVER))
    edges.extend((source, 2 * number[x], _NEVER) for x in wanted)
    reached = _source_side(edges, source, sink)
    entries = [x for x, k in number.items() if 2 * k + 1 in reached]
    inputs = [x for x, k in number.items() if 2 * k in reached and 2 * k + 1 not in reached]
    return entries, inputs


def _is_new(entry: Entry, region: Region, level: int) -> bool:
    """Whether an entry cannot be computed before a kernel."""
    is_input = entry.primitive is None
    return not is_input and entry.region is region and entry.level == level


def _cost(entry: Entry) -> int:
    if entry.primitive is None:
        return _NEVER
    name = entry.primitive.name
    return _COSTS.get(name, 1 if name in _CHEAP else _FUNCTION)


def _source_side(edges: list[tuple[int, int, int]], source: int, sink: int) -> set[int]:
    """The nodes on the side of the source of a minimum cut."""
    if not edges:
        return set()
    rows, columns, capacities = np.array(edges).T
    shape = sink + 1, sink + 1
    graph = scipy.sparse.csr_array(
        (capacities.astype(np.int32), (rows, columns)), shape=shape
    )
    flow = scipy.sparse.csgraph.maximum_flow(scipy.sparse.csr_matrix(graph), source, sink)
    left = scipy.sparse.csr_array(graph - flow.flow)
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = scipy.sparse.csgraph.breadth_first_order(
        left, source, return_predecessors=False
    )
    return set(reached.tolist())


def _cone(wanted: Iterable[Entry]) -> list[Entry]:
    """The entries on which some depend, and these, operands first."""
    done: set[Entry] = set()
    order: list[Entry] = []
    for entry in wanted:
        stack = [(entry, False)]
        while stack:
            x, is_ready = stack.pop()
            if is_ready:
                order.append(x)
            elif x not in done:
                done.add(x)
                stack.append((x, True))
                operands = (y for y in reversed(x.operands) if isinstance(y, Entry))
                stack.extend((y, False) for y in operands)
    return order
