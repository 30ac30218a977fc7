"""Arrays of a program while it is compiled.

An array whose numbers are known is a NumPy array. Any other is one of two kinds:

- `Cells`: an array of numbers, each of them a node of the graph or known. One axis may be
  that of the lanes; its entries are one node, of as many lanes.
- `Memory`: an array of the cells of the memory where the numbers are. Moving entries, such
  as slicing, transposing, or looking up at known places, moves cells while the program is
  compiled and costs nothing when it runs.
"""

import bisect
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from jax.extend import source_info_util

from .graph import as_number, Graph, Node, Number, Region


# Arrays with no more entries are not computed lane by lane unless they are vectors of many,
# and neither are those whose longest axis is shorter.
_SMALL, _MANY, _FEWEST_LANES = 24, 8, 5
# The numbers of a vector of the processor: so many lanes are enough where none is put
# together from single numbers.
_VECTOR = 4
# The most nodes of one array; larger arrays are computed as one axis of lanes.
MOST_CELLS = 1_600
# Cells from this number on hold constants.
CONSTANTS = 1 << 40


class Unsupported(Exception):
    """A program that is not compiled here: the reason in words, and the operation.

    - `equations`: the operation, and those whose programs it is in, outermost last.
    """

    def __init__(self, reason: str):
        super().__init__(reason)
        self.reason = reason
        self.equations: list[Any] = []

    def __str__(self) -> str:
        infos = (x.source_info for x in self.equations)
        lines = [line for line in map(source_info_util.summarize, infos) if line]
        return f"{self.reason} in {lines[0]}" if lines else self.reason


class Cells:
    def __init__(self, dtype: str, cells: np.ndarray, lane: int | None = None, n: int = 1):
        self.dtype, self.cells, self.lane, self.n = dtype, cells, lane, n

    @property
    def shape(self) -> tuple[int, ...]:
        shape = list(self.cells.shape)
        if self.lane is not None:
            shape[self.lane] = self.n
        return tuple(shape)


class Memory:
    def __init__(self, dtype: str, places: np.ndarray):
        self.dtype, self.places = dtype, places

    @property
    def shape(self) -> tuple[int, ...]:
        return self.places.shape


class Carried(Memory):
    """The cells of a carry, which one other loop may take over.

    It must not be held in two places: a value with several readers is `shared`.

    - `owners`: who owns the cells.
    - `region`: where that loop may be.
    """

    def __init__(
        self, dtype: str, places: np.ndarray, owners: "list[Block]", region: Region
    ):
        super().__init__(dtype, places)
        self.owners, self.region = owners, region


Value: TypeAlias = np.ndarray | Cells | Memory


def shared(value: Value) -> Value:
    """A value that several operations can read."""
    return Memory(value.dtype, value.places) if isinstance(value, Carried) else value


def dtype_of(value: Any) -> str:
    return value.dtype if isinstance(value, Cells | Memory) else type_name(value.dtype)


def type_name(dtype: Any) -> str:
    """The name of a type of numbers, such as `"f8"`."""
    try:
        name = np.dtype(dtype).str[1:]
    except TypeError:  # random keys
        name = str(dtype)
    if name not in _TYPES:
        raise Unsupported(f"numbers of type `{dtype}`")
    return name


_TYPES = frozenset("f8 f4 i8 i4 i2 i1 u8 u4 u2 u1 b1".split())


class Block:
    """Cells that are written as a whole, by loops; they can be read from a level on.

    - `lanes`: the number of neighbouring cells that are lanes of one number.
    """

    def __init__(self, region: Region, ready: int, lanes: int = 1):
        self.region, self.ready, self.lanes = region, ready, lanes


# The cells of a line of the cache.
_LINE = 8
# The number of lanes from which on they start at an odd distance; see `_distance`.
_LONG = 64


def _next_line(place: int) -> int:
    """The next cell with which a line begins, from a cell on.

    Numbers of lanes begin there. Several of them are read at once, and a read of two lines
    takes longer: with lanes that begin anywhere a step of 64 points takes 1.2 times as
    long.
    """
    return -(-place // _LINE) * _LINE


def _distance(count: int) -> int:
    """The distance to the next lanes, in cells: an odd number of lines.

    A loop over lanes reads one line of each of many numbers. The lower bits of the address
    of a line determine the few places where the cache can keep it. If the distances were a
    power of two, all these lines would compete for the same places: a step of a beam of 512
    elements would take one and a half times as long.
    """
    return (-(-count // _LINE) | 1) * _LINE


class Cellar:
    """The memory of a program: who writes which cells, and what is read from them."""

    def __init__(self, graph: Graph):
        self.graph = graph
        # The first cell is not used: kernels may read the one before a number.
        self.size = 1
        self._starts: list[int] = []
        self._owners: list[Node | Block] = []
        # Neither is the first constant.
        self.constants = [np.zeros(1, np.int64)]
        self.num_constants = 1
        self._constant_starts = [0]
        self._constant_places: dict[Any, int] = {}
        # The first cells and the lanes of the owners, for many cells at once, with room for
        # more owners.
        self._owner_table = np.zeros((2, 64), np.int64)
        # The owners of arrays in which places are computed.
        self.read_at_computed_places: set[Node | Block] = set()
        # Whether some cells have a number for each of several passes.
        self.has_passes = False
        self._read_before: dict[tuple[bytes, str], Number] = {}
        # Tables of places that kernels read while they run.
        self.tables: list[np.ndarray] = []
        self._table_numbers: dict[bytes, int] = {}

    # Where numbers are --------------------------------------------------------------------

    def new(self, count: int, owner: Node | Block) -> int:
        """The first of so many new cells."""
        first = self.neighbours([count], [owner])
        if count >= _LONG:
            self.size = first + _distance(count)
        return first

    def neighbours(self, counts: Sequence[int], owners: Sequence[Node | Block]) -> int:
        """The first of new cells for several owners, one after the other without gaps."""
        if sum(counts) >= _FEWEST_LANES:
            self.size = _next_line(self.size)
        first = self.size
        for count, owner in zip(counts, owners, strict=True):
            last = len(self._owners)
            self._starts.append(self.size)
            self._owners.append(owner)
            if last == self._owner_table.shape[1]:
                table = self._owner_table
                self._owner_table = np.concatenate([table, np.zeros_like(table)], axis=1)
            is_reduced = isinstance(owner, Node) and owner.is_reduced
            self._owner_table[:, last] = self.size, 1 if is_reduced else owner.lanes or 1
            self.size += count
        return first

    def hand_over(self, owners: list["Block"], region: Region, ready: int) -> None:
        """Makes cells readable in another region, from a level on."""
        for owner in owners:
            owner.region, owner.ready = region, ready
        self._read_before.clear()

    def scattered(self, places: np.ndarray) -> tuple[int | None, int, int]:
        """Cells as a first one and a table of distances, which other columns share.

        The distance between constants and other cells is not known yet: with both, there
        is no first one.
        """
        is_constant = places >= CONSTANTS
        if np.any(is_constant != is_constant[0]):
            return None, 0, self.table(places)
        return int(places[0]), 0, self.table(places - places[0])

    def table(self, places: np.ndarray) -> int:
        """The number of a table."""
        places = np.ascontiguousarray(places, np.int64)
        key = places.tobytes()
        if key not in self._table_numbers:
            self._table_numbers[key] = len(self.tables)
            self.tables.append(places)
        return self._table_numbers[key]

    def place_of(self, x: Number, dtype: str) -> int:
        """The cell of a number (of its first lane)."""
        if not isinstance(x, Node):
            key = _bits(np.array([x], dtype))[0]
            if key not in self._constant_places:
                self._constant_places[key] = self._new_constants(np.array([key]))
            return self._constant_places[key]
        if x.op == "load" and not x.lanes:
            return x.extra
        if x.place is None:
            x.place = self.new(1 if x.is_reduced or not x.lanes else x.lanes, x)
        return x.place

    def places_of_lanes(self, x: Number, dtype: str, n: int) -> np.ndarray:
        if isinstance(x, Node) and x.lanes and not x.is_reduced:
            if x.op == "load":
                return self.loaded_places(x)
            return self.place_of(x, dtype) + np.arange(n)
        return np.full(n, self.place_of(x, dtype))

    def loaded_places(self, x: Node) -> np.ndarray:
        if not x.lanes:
            return np.array([x.extra])
        first, stride, table = x.extra
        if table is not None:
            return (first or 0) + self.tables[table]
        return first + stride * np.arange(x.lanes)

    def align_constants(self) -> None:
        """Adds cells up to the next line of the cache."""
        added = _next_line(self.num_constants) - self.num_constants
        self.constants.append(np.zeros(added, np.int64))
        self._constant_starts.append(self.num_constants)
        self.num_constants += added

    def _new_constants(self, cells: np.ndarray) -> int:
        if cells.size >= _FEWEST_LANES:
            self.align_constants()
        place = CONSTANTS + self.num_constants
        self._constant_starts.append(self.num_constants)
        self.constants.append(cells)
        self.num_constants += cells.size
        return place

    def memory(self, value: Value) -> Memory:
        """The array in memory."""
        if isinstance(value, Memory):
            return value
        if isinstance(value, Cells):
            return Memory(value.dtype, self._places(value))
        dtype = type_name(value.dtype)
        flat = _bits(np.ravel(value))
        if flat.size == 1:
            place = np.full(np.shape(value), self.place_of(number_at(value), dtype))
            return Memory(dtype, place)
        return Memory(dtype, self._constants_at(flat).reshape(np.shape(value)))

    def _constants_at(self, cells: np.ndarray) -> np.ndarray:
        """Neighbouring cells with these constants."""
        key = cells.tobytes()
        if key not in self._constant_places:
            self._constant_places[key] = self._new_constants(cells)
        return self._constant_places[key] + np.arange(cells.size)

    def _places(self, value: Cells) -> np.ndarray:
        dtype, cells = value.dtype, value.cells
        if value.lane is None:
            flat = [self.place_of(x, dtype) for x in cells.ravel()]
            return np.array(flat, np.int64).reshape(cells.shape)
        columns = [self.places_of_lanes(x, dtype, value.n) for x in cells.ravel()]
        moved = np.delete(np.array(cells.shape), value.lane)
        stacked = np.array(columns, np.int64).reshape(*moved, value.n)
        return np.moveaxis(stacked, -1, value.lane)

    def is_wide(self, place: int) -> bool:
        """Whether a cell has a number for each pass that is made at a time."""
        return place < CONSTANTS and self._owner(place).region.is_wide

    # What is read -------------------------------------------------------------------------

    def _owner(self, place: int) -> Node | Block:
        return self._owners[bisect.bisect_right(self._starts, place) - 1]

    def number_at(self, place: int, dtype: str) -> Number:
        """The number in a cell."""
        if place >= CONSTANTS:
            return self._constant_at(place, dtype)
        owner = self._owner(place)
        if isinstance(owner, Node) and (owner.is_reduced or not owner.lanes):
            return owner
        return self.graph.at(owner.region, owner.ready, "load", dtype, extra=place)

    def _constant_at(self, place: int, dtype: str) -> Number:
        return from_bits(self._cell_of_constant(place), dtype)

    def _cell_of_constant(self, place: int) -> Any:
        number = place - CONSTANTS
        block = bisect.bisect_right(self._constant_starts, number) - 1
        return self.constants[block][number - self._constant_starts[block]]

    def lanes_at(self, places: np.ndarray, dtype: str) -> Number:
        """The numbers in a cell for each lane."""
        places = self.of_one_memory(places, dtype)
        key = places.tobytes(), dtype
        if key not in self._read_before:
            x = self._lanes_at(places, dtype)
            if isinstance(x, Node) and x.op == "select":
                # It may have been computed in a branch, and other branches do not run that.
                return x
            self._read_before[key] = x
        return self._read_before[key]

    def _lanes_at(self, places: np.ndarray, dtype: str) -> Number:
        first, n = int(places[0]), places.size
        stride = int(places[1]) - first
        # This is much faster than the differences of so few numbers.
        is_affine = bool(stride) and places.tolist() == list(
            range(first, first + n * stride, stride)
        )
        if not stride and np.all(places == first):
            return self.number_at(first, dtype)
        if np.all(places >= CONSTANTS) and not (is_affine and stride == 1):
            cells = [self._cell_of_constant(int(p)) for p in places]
            places = self._constants_at(np.array(cells))
            first, stride, is_affine = int(places[0]), 1, True
        owners = self.owners(places)
        for owner in owners:
            if isinstance(owner, Node) and is_affine and stride == 1:
                if owner.place == first and owner.lanes == n and not owner.is_reduced:
                    return owner
        if not is_affine:
            shifted = self._shifted(places, dtype)
            if shifted is not None:
                return shifted
        region, level, markers = self._readable(owners)
        extra = (first, stride, None) if is_affine else self.scattered(places)
        return self.graph.at(region, level, "load", dtype, markers, extra, n)

    def _shifted(self, places: np.ndarray, dtype: str) -> Number | None:
        """Neighbouring cells but for the first lane or the last one, which are elsewhere.

        All are read at once, and those of the ends are replaced.
        """
        if places.size < _FEWEST_LANES or not np.all(np.diff(places[1:-1]) == 1):
            return None
        inner = places[1:-1]
        whole = np.arange(inner[0] - 1, inner[-1] + 2)
        # The cells of ends that are elsewhere belong to other numbers, which are not used.
        region, level, markers = self._readable(self.owners(places[places == whole]))
        extra = (int(whole[0]), 1, None)
        x: Number = self.graph.at(region, level, "load", dtype, markers, extra, places.size)
        lane = self.graph.at(self.graph.root, 0, "lane", "i8", lanes=places.size)
        for end in (0, places.size - 1):
            if places[end] != whole[end]:
                is_end = self.graph.compare("eq", "i8", lane, end)
                other = self.number_at(int(places[end]), dtype)
                x = self.graph.select(dtype, is_end, other, x)
        return x

    def of_one_memory(self, places: np.ndarray, dtype: str) -> np.ndarray:
        """The cells, or copies, such that all or none have a number for each pass."""
        if not self.has_passes:
            return places
        owners = self.owners(places.ravel())
        if len({x.region.is_wide for x in owners}) < 2:
            return places
        region = self._outermost_of_passes()
        copies = {}
        for place in np.unique(places).tolist():
            if place < CONSTANTS and not self.is_wide(place):
                x = self.number_at(place, dtype)
                copy = self.graph.at(region, 0, "copy", dtype, (x,))
                copies[place] = self.place_of(copy, dtype)
        flat = [copies.get(p, p) for p in places.ravel().tolist()]
        return np.array(flat).reshape(places.shape)

    def readable(self, places: np.ndarray) -> tuple[Region, int, tuple[Node, ...]]:
        """From where on all cells can be read: the region, the level in it, and markers.

        A marker stands for the level from which cells of a region around it can be read.
        """
        owners = self.owners(places.ravel())
        self.read_at_computed_places.update(owners)
        return self._readable(owners, by_lanes=False)

    def _readable(
        self, owners: list[Any], by_lanes: bool = True
    ) -> tuple[Region, int, tuple[Node, ...]]:
        levels: dict[Region, int] = {}
        for owner in owners:
            ready = owner.ready
            if isinstance(owner, Node) and (owner.is_reduced or not by_lanes):
                ready = owner.level + 1
            levels[owner.region] = max(levels.get(owner.region, 0), ready)
        if not levels:
            return self.graph.root, 0, ()
        region = max(levels, key=lambda x: x.depth)
        others = ((x, level) for x, level in levels.items() if x is not region and level)
        markers = tuple(self.marker(x, level) for x, level in others)
        return region, levels[region], markers

    def marker(self, region: Region, level: int) -> Node:
        return self.graph.at(region, level, "marker", "b1", extra=level)

    def columns(self, places: np.ndarray) -> tuple[list[np.ndarray], np.ndarray] | None:
        """The entries of an array by the columns that they are.

        A column is a number of many lanes, of which the array has all. Returned are the
        entries of each, in the order of the lanes, and the other entries; `None` if these
        are many.
        """
        is_constant = places >= CONSTANTS
        safe = np.where(is_constant, 0, places)
        starts, lanes = self._owner_table[:, : len(self._owners)]
        owner = np.searchsorted(starts, safe, side="right") - 1
        lanes = lanes[owner]
        offset = safe - starts[owner]
        column = np.where(
            lanes >= _FEWEST_LANES, starts[owner] + offset - offset % lanes, -1
        )
        column[is_constant] = -1
        order = np.lexsort((places, column))
        sorted_columns = column[order]
        cuts = np.flatnonzero(np.diff(sorted_columns)) + 1
        whole, rest = [], []
        for part in np.split(order, cuts):
            at = places[part]
            is_whole = (
                column[part[0]] >= 0
                and part.size == lanes[part[0]]
                and at[0] == column[part[0]]
                and at[-1] == at[0] + part.size - 1
            )
            (whole if is_whole else rest).append(part)
        others = np.sort(np.concatenate(rest)) if rest else np.zeros(0, int)
        if 16 * others.size > places.size:
            return None
        return whole, others

    def owners(self, places: np.ndarray) -> list[Node | Block]:
        """Who owns these cells, apart from constants."""
        last = int(places.max(initial=-1))
        if last >= CONSTANTS:
            places = places[places < CONSTANTS]
            last = int(places.max(initial=-1))
        if last < 0:
            return []
        low = bisect.bisect_right(self._starts, int(places.min())) - 1
        high = bisect.bisect_right(self._starts, last) - 1
        if high - low > 1:
            starts = self._owner_table[0, low : high + 1]
            is_owner = np.zeros(starts.size, bool)
            is_owner[np.searchsorted(starts, places, side="right") - 1] = True
            return [self._owners[low + k] for k in np.flatnonzero(is_owner)]
        return self._owners[low : high + 1]

    # Conversions --------------------------------------------------------------------------

    def unlaned(self, value: Value) -> np.ndarray:
        """The numbers of an array, one by one."""
        if isinstance(value, Cells):
            if value.lane is None:
                return value.cells
            value = self.memory(value)
        if isinstance(value, Memory):
            flat = [self.number_at(int(p), value.dtype) for p in value.places.ravel()]
            return objects(flat, value.shape)
        return objects(np.ravel(value).tolist(), np.shape(value))

    def laned(self, value: Value, lane: int) -> np.ndarray:
        """The numbers of an array with an axis of lanes, of which one entry remains."""
        if isinstance(value, Cells):
            if value.lane == lane:
                return value.cells
            value = self.memory(value)
        kept = list(value.shape)
        kept[lane] = 1
        if isinstance(value, Memory):
            columns = columns_along(value.places, lane)
            flat = [self.lanes_at(x, value.dtype) for x in columns]
            return objects(flat, tuple(kept))
        columns = columns_along(value, lane)
        flat = [self._known_lanes(x) for x in columns]
        return objects(flat, tuple(kept))

    def _known_lanes(self, x: np.ndarray) -> Number:
        bits = _bits(x)
        if np.all(bits == bits[0]):
            return number_at(x[:1])
        memory = self.memory(x)
        return self.lanes_at(memory.places, memory.dtype)

    def contiguous(self, value: Value) -> Memory:
        """The array in memory, in the order of its entries."""
        memory = self.memory(value)
        flat = self.of_one_memory(memory.places.ravel(), memory.dtype)
        if flat.size < 2 or np.all(np.diff(flat) == 1):
            return Memory(memory.dtype, flat.reshape(memory.shape))
        if flat.size < _FEWEST_LANES:
            has_passes = any(self.is_wide(int(p)) for p in flat)
            places = np.array(
                [
                    self._copied(int(p), memory.dtype, (k, self.size), has_passes)
                    for k, p in enumerate(flat)
                ]
            )
            return Memory(memory.dtype, places.reshape(memory.shape))
        x = self.lanes_at(flat, memory.dtype)
        copy = self.graph.node("copy", memory.dtype, (x,), lanes=flat.size)
        places = self.place_of(copy, memory.dtype) + np.arange(flat.size)
        return Memory(memory.dtype, places.reshape(memory.shape))

    def regular(self, value: Value) -> tuple[Memory, list[int]]:
        """The array in memory, and the distance between neighbours along each axis."""
        memory = self.memory(value)
        places = self.of_one_memory(memory.places, memory.dtype)
        memory, strides = Memory(memory.dtype, places), strides_of(places)
        if strides is None:
            memory = self.contiguous(memory)
            strides = np.cumprod([1, *memory.shape[:0:-1]])[::-1].tolist()
        return memory, strides

    def _copied(self, place: int, dtype: str, extra: Any, has_passes: bool) -> int:
        """The cell of a copy; of a known number, too, there is one for each pass."""
        x = self.number_at(place, dtype)
        if has_passes and not isinstance(x, Node):
            copy = self.graph.at(self._outermost_of_passes(), 0, "copy", dtype, (x,), extra)
        else:
            copy = self.graph.node("copy", dtype, (x,), extra)
        return self.place_of(copy, dtype)

    def _outermost_of_passes(self) -> Region:
        """The region that is run as a whole for several passes at a time."""
        region = self.graph.current
        while region.parent is not None and region.parent.is_wide:
            region = region.parent
        return region


def has_constants_among_others(places: np.ndarray) -> bool:
    """Whether some cells hold constants and others do not.

    Constants are far from other cells, but not by the distance of their numbers.
    """
    return bool(np.any(places >= CONSTANTS) and np.any(places < CONSTANTS))


def strides_of(places: np.ndarray) -> list[int] | None:
    """The distance between neighbours along each axis, where it is everywhere the same."""
    if places.size == 0:
        return [0] * places.ndim
    if has_constants_among_others(places):
        return None
    strides = []
    for axis in range(places.ndim):
        steps = np.diff(places, axis=axis)
        strides.append(int(steps.ravel()[0]) if steps.size else 0)
        if np.any(steps != strides[-1]):
            return None
    return strides


def lane_of(
    values: list[Value], shape: tuple[int, ...], summed: Sequence[int] = ()
) -> int | None:
    """The axis of the lanes of an array that is computed from others of its shape.

    If possible this is none of the axes along which the array is `summed`: a sum over lanes
    costs more than the sum of two numbers for each lane.
    """
    own = [n for k, n in enumerate(shape) if k not in summed]
    longest = max(own, default=0)
    if longest < max((shape[k] for k in summed), default=0):
        summed, longest = (), max(shape, default=0)
    for value in values:
        if isinstance(value, Cells) and value.lane is not None and value.shape == shape:
            # The few lanes of an operand that is the same along a long axis would be many
            # operations.
            if 2 * value.n > longest and value.lane not in summed:
                return value.lane
    # Numbers that were computed one by one would have to be put together first.
    is_single = all(isinstance(x, Cells) and x.lane is None for x in values)
    return usual_lane(shape, summed, _FEWEST_LANES if is_single else _VECTOR)


def usual_lane(
    shape: tuple[int, ...], summed: Sequence[int] = (), fewest: int = _FEWEST_LANES
) -> int | None:
    """The longest of the axes along which an array is not `summed`, if it has the `fewest`
    entries, or more."""
    lengths = [0 if k in summed else n for k, n in enumerate(shape)]
    size, longest = int(np.prod(shape)), max(lengths, default=0)
    if longest < fewest or (size <= _SMALL and longest < _MANY):
        return None
    return lengths.index(longest)


def columns_along(x: np.ndarray, axis: int) -> np.ndarray:
    """The entries of an array along an axis, shape `(columns, n)`.

    `np.moveaxis` takes four times as long, and a program asks for thousands of them.
    """
    last = [*range(axis), *range(axis + 1, x.ndim), axis]
    return x.transpose(last).reshape(-1, x.shape[axis])


def objects(flat: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    out = np.empty(len(flat), object)
    out[:] = flat
    return out.reshape(shape)


def number_at(value: Any) -> Number:
    """The only number of an array."""
    x = np.ravel(value)[0]
    return as_number(x, type_name(x.dtype))


def _bits(x: np.ndarray) -> np.ndarray:
    """Numbers as they are stored in cells."""
    kind = x.dtype.kind
    if kind == "f":
        return x.astype(np.float64).view(np.int64)
    return x.astype(np.int64)


def from_bits(cell: Any, dtype: str) -> Number:
    if dtype[0] == "f":
        return float(np.asarray(cell, np.int64).view(np.float64)[()])
    return as_number(int(cell), dtype)
