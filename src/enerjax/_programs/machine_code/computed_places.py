"""Entries at places that are computed while a program runs, and at known places."""

import math
from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

import jax
import numpy as np

from ..numpy_primitives import is_inside
from .graph import Node, Number
from .values import (
    columns_along,
    dtype_of,
    lane_of,
    Memory,
    MOST_CELLS,
    objects,
    Unsupported,
    Value,
)


if TYPE_CHECKING:
    from .evaluation import Evaluation

_FILLS = jax.lax.GatherScatterMode.FILL_OR_DROP


def _whole_number(self: "Evaluation", x: Number, of: str) -> Number:
    return self.graph.op("convert", "i8", (x,), of)


def _clamped(self: "Evaluation", x: Number, high: int) -> Number:
    x = self.graph.op("max", "i8", (x, 0))
    return self.graph.op("min", "i8", (x, high))


def _at_computed(
    self: "Evaluation", value: Value, starts: list[Number], sizes: Sequence[int]
) -> Value:
    """A slice of an array that begins at a computed place of each axis."""
    if math.prod(sizes) == 0:
        return np.zeros(tuple(sizes), dtype_of(value))
    memory, strides = self.cellar.regular(value)
    graph, dtype = self.graph, memory.dtype
    offset: Number = 0
    for start, stride in zip(starts, strides, strict=True):
        offset = graph.add("i8", offset, graph.multiply("i8", start, stride))
    first = memory.places[tuple(slice(0, n) for n in sizes)]
    if not isinstance(offset, Node):
        return Memory(dtype, first + offset)
    lane = None if offset.lanes else lane_of([], tuple(sizes))
    if lane is None:
        flat = [self.dynamic(x, 0, offset, dtype, 0, memory) for x in first.ravel()]
        return self.cells(dtype, objects(flat, tuple(sizes)), None, 1)
    n = sizes[lane]
    kept = list(sizes)
    kept[lane] = 1
    columns = columns_along(first, lane)
    flat = [self.dynamic(x[0], int(x[1] - x[0]), offset, dtype, n, memory) for x in columns]
    return self.cells(dtype, objects(flat, tuple(kept)), lane, n)


def starts_of_slice(
    self: "Evaluation", starts: list[Value], shape: Sequence[int], sizes: Sequence[int]
) -> list[Number]:
    """Where a slice begins, moved such that it lies inside."""
    numbers = (
        _whole_number(self, self.cellar.unlaned(x).item(), dtype_of(x)) for x in starts
    )
    triples = zip(numbers, shape, sizes, strict=True)
    return [_clamped(self, x, length - size) for x, length, size in triples]


def dynamic_slice(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    (x, *starts), sizes = values, eqn.params["slice_sizes"]
    return [_at_computed(self, x, starts_of_slice(self, starts, x.shape, sizes), sizes)]


def dynamic_update_slice(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    """Every place asks whether it lies in the slice, and then reads from the update."""
    x, update, *starts = values
    graph, dtype = self.graph, dtype_of(x)
    if math.prod(update.shape) == 0:
        return [x]
    begins = starts_of_slice(self, starts, x.shape, update.shape)
    memory, strides = self.cellar.regular(update)
    first = int(memory.places.ravel()[0])

    def rule(old: Number, *places: Number) -> Number:
        offset: Number = 0
        inside: Number = True
        axes = zip(places, begins, update.shape, strides, strict=True)
        for place, begin, size, stride in axes:
            within = graph.op("sub", "i8", (place, begin))
            for how, bound in (("ge", 0), ("lt", size)):
                now = graph.compare(how, "i8", within, bound)
                inside = graph.op("and", "b1", (inside, now))
            within = _clamped(self, within, size - 1)
            offset = graph.add("i8", offset, graph.multiply("i8", within, stride))
        if isinstance(offset, Node):
            new = self.dynamic(first, 0, offset, dtype, 0, memory)
        else:
            new = self.cellar.number_at(first + int(offset), dtype)
        return graph.select(dtype, inside, new, old)

    return [self.map(rule, [x, *np.indices(x.shape)], x.shape, dtype)]


def gather(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    x, indices = values
    params, dtype, out = eqn.params, dtype_of(x), eqn.outvars[0].aval
    if isinstance(indices, np.ndarray) and is_inside(x, indices, **_shape_only(params)):
        return self.moved_to_known(eqn.primitive, x, indices, params)
    if out.size == 0:
        return [np.zeros(out.shape, out.dtype)]
    numbers, sizes, graph = params["dimension_numbers"], params["slice_sizes"], self.graph
    joint = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    kept = [axis for axis in range(len(x.shape)) if axis not in joint]
    memory, strides = self.cellar.regular(x)
    fills = jax.lax.GatherScatterMode.from_any(params["mode"]) == _FILLS
    first, inside = _first_places(self, x, indices, params, strides, fills)
    window = np.zeros([sizes[k] for k in kept], np.int64)
    for k, axis in enumerate(kept):
        shape = [-1 if j == k else 1 for j in range(len(kept))]
        window = window + strides[axis] * np.arange(sizes[axis]).reshape(shape)
    others = tuple(k for k in range(out.ndim) if k not in numbers.offset_dims)
    spread = lambda value, dims: self.move(
        jax.lax.broadcast_in_dim_p,
        [value],
        dict(shape=out.shape, broadcast_dimensions=dims, sharding=None),
    )[0]
    start, filling = int(memory.places.ravel()[0]), _filling(params, dtype)

    def taken(first, within, on):
        offset = graph.add("i8", first, within)
        if isinstance(offset, Node):
            found = self.dynamic(start, 0, offset, dtype, 0, memory)
        else:
            found = self.cellar.number_at(start + int(offset), dtype)
        return graph.select(dtype, on, found, filling) if fills else found

    parts = [spread(first, others), spread(window, tuple(numbers.offset_dims))]
    return [self.map(taken, [*parts, spread(inside, others)], out.shape, dtype)]


def _first_places(
    self: "Evaluation",
    x: Value,
    indices: Value,
    params: Any,
    strides: list[int],
    fills: bool,
) -> tuple[Value, Value]:
    """The place of the first entry of each slice, and whether the slice lies inside."""
    numbers, sizes, graph = params["dimension_numbers"], params["slice_sizes"], self.graph
    before, of = indices.shape[:-1], dtype_of(indices)
    first: Value = np.zeros(before, np.int64)
    inside: Value = np.ones(before, bool)
    for axis, along in zip(
        numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True
    ):
        shape = [-1 if k == along else 1 for k in range(len(before))]
        first = first + strides[axis] * np.arange(x.shape[axis]).reshape(shape)
    for column, axis in enumerate(numbers.start_index_map):
        own = self.subarray(indices, (..., slice(column, column + 1)))
        own, high = self.reshaped(own, before), x.shape[axis] - sizes[axis]

        def place(index, sofar, high=high, stride=strides[axis]):
            index = _clamped(self, _whole_number(self, index, of), high)
            return graph.add("i8", sofar, graph.multiply("i8", index, stride))

        def is_in(index, sofar, high=high):
            index = _whole_number(self, index, of)
            for how, bound in (("ge", 0), ("le", high)):
                now = graph.compare(how, "i8", index, bound)
                sofar = graph.op("and", "b1", (sofar, now))
            return sofar

        first = self.map(place, [own, first], before, "i8")
        if fills:
            inside = self.map(is_in, [own, inside], before, "b1")
    return first, inside


def _shape_only(params: Any) -> Any:
    return dict(
        dimension_numbers=params["dimension_numbers"], slice_sizes=params["slice_sizes"]
    )


def _filling(params: Any, dtype: str) -> Number:
    """What is found outside of an array."""
    value = params.get("fill_value")
    if value is not None:
        return value
    if dtype[0] == "f":
        return float("nan")
    if dtype[0] == "i":
        return int(np.iinfo(dtype).min)
    return int(np.iinfo(dtype).max) if dtype[0] == "u" else True


# The operation of each kind of scatter between what is at a place and an update; `None` for
# the kind that writes updates. A difference is the sum with minus the update.
JOINS = {
    "scatter": None,
    "scatter-add": "add",
    "scatter-sub": "add",
    "scatter-mul": "mul",
    "scatter-min": "min",
    "scatter-max": "max",
}


def scatter(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    operand, index, updates = values
    dtype, join = dtype_of(operand), JOINS[eqn.primitive.name]
    if eqn.primitive.name == "scatter-sub":
        minus = lambda x: self.graph.multiply(dtype, -1, x)
        updates = self.map(minus, [updates], updates.shape, dtype)
    if join is None and not _replaces(eqn.params.get("update_jaxpr")):
        raise Unsupported("a function of what is at a place")
    size, count = math.prod(operand.shape), math.prod(updates.shape)
    if count == 0:
        return [operand]
    if not isinstance(index, np.ndarray):
        return [_scattered_to_computed(self, eqn, operand, index, updates)]
    places = _places_of_updates(operand.shape, index, updates.shape, eqn.params)
    if join is None:
        source, falls = np.arange(size), places >= 0
        source[places[falls]] = size + np.flatnonzero(falls)
        firsts = np.array([0, size, size + count])
        numbers = source.reshape(operand.shape)
        return [self.taken([operand, updates], firsts, numbers, dtype)]
    return [_joined_at(self, join, operand, updates, places, dtype)]


def _replaces(update: Any) -> bool:
    """Whether a scatter writes its updates, and not a function of what was there."""
    return update is None or (not update.eqns and update.outvars == update.invars[1:])


def _places_of_updates(
    shape: tuple[int, ...], index: np.ndarray, update_shape: tuple[int, ...], params: Any
) -> np.ndarray:
    """The place in the flat array of each flat update; negative if it is dropped."""
    dims, grid = params["dimension_numbers"], np.indices(update_shape)
    windows, shared = dims.update_window_dims, dims.operand_batching_dims
    at = [grid[k] for k in range(len(update_shape)) if k not in windows]
    starts = index[tuple(at)]
    skipped = (*dims.inserted_window_dims, *shared)
    inner = [k for k in range(len(shape)) if k not in skipped]
    first, within = np.zeros((2, len(shape), *update_shape), int)
    room = np.array(shape) - 1
    for axis, k in zip(inner, windows, strict=True):
        within[axis] = grid[k]
        room[axis] -= update_shape[k] - 1
    for k, axis in enumerate(dims.scatter_dims_to_operand_dims):
        first[axis] = starts[..., k]
    for axis, k in zip(shared, dims.scatter_indices_batching_dims, strict=True):
        first[axis] = at[k]
    room = room.reshape(-1, *[1] * len(update_shape))
    if params["mode"] == jax.lax.GatherScatterMode.CLIP:
        first = np.clip(first, 0, room)
    falls = np.all((first >= 0) & (first <= room), axis=0)
    strides = np.cumprod([1, *shape[:0:-1]])[::-1]
    places = np.tensordot(strides[: len(shape)], first + within, 1)
    return np.where(falls, places, -1).ravel()


# The part of all places that may be added up by themselves, and the least and the most
# passes over all places.
_FEW_PLACES, _PASSES = 8, (2, 8)


def _joined_at(self: "Evaluation", join: str, operand, updates, places, dtype) -> Value:
    """Updates added to the numbers at known places, or joined by another operation."""
    size, count = math.prod(operand.shape), math.prod(updates.shape)
    if size == 0:
        return operand
    order = np.argsort(places, kind="stable")
    order = order[places[order] >= 0]
    to = places[order]
    before = np.arange(to.size) - np.searchsorted(to, to)
    neutral = np.full((1,), _neutral(join, dtype), dtype)
    firsts = np.array([0, count, count + 1])
    # The few places with many updates, such as a body that many others are attached to, are
    # added up by themselves: passes over all places would be many.
    passes = np.sort(np.bincount(to, minlength=size))[-1 - size // _FEW_PLACES]
    often = np.unique(to[before >= np.clip(passes, *_PASSES)])
    is_often = np.isin(to, often)
    out = operand
    if often.size:
        sums = []
        for place in often:
            own = self.taken([updates, neutral], firsts, order[to == place], dtype)
            sums.append(self.reshaped(self.total(join, own, (0,)), (1,)))
        sums.append(neutral)
        total = self.move(jax.lax.concatenate_p, sums, dict(dimension=0))[0]
        numbers = np.full(size, often.size)
        numbers[often] = np.arange(often.size)
        spread = self.taken(
            [total], np.array([0, often.size + 1]), numbers.reshape(operand.shape), dtype
        )
        out = _joined_arrays(self, join, out, spread, dtype)
    before, to, order = (x[~is_often] for x in (before, to, order))
    for k in range(int(before.max(initial=-1)) + 1):
        numbers = np.full(size, count)
        numbers[to[before == k]] = order[before == k]
        row = self.taken([updates, neutral], firsts, numbers.reshape(operand.shape), dtype)
        out = _joined_arrays(self, join, out, row, dtype)
    return out


def _neutral(join: str, dtype: str) -> Any:
    """The number that an operation joins to any other without changing it."""
    if join in ("add", "mul"):
        return int(join == "mul")
    if dtype[0] == "f":
        return np.inf if join == "min" else -np.inf
    if dtype[0] not in "iu":
        raise Unsupported(f"a scatter of {dtype}")
    return np.iinfo(dtype).max if join == "min" else np.iinfo(dtype).min


def _joined_arrays(self: "Evaluation", join: str, a: Value, b: Value, dtype: str) -> Value:
    if join == "add" and isinstance(a, np.ndarray) and not np.any(a):
        return b
    rule = lambda x, y: _joined_numbers(self, join, dtype, x, y)
    return self.map(rule, [a, b], a.shape, dtype)


def _joined_numbers(
    self: "Evaluation", join: str, dtype: str, x: Number, y: Number
) -> Number:
    if join == "add":
        return self.graph.add(dtype, x, y)
    if join == "mul":
        return self.graph.multiply(dtype, x, y)
    return self.graph.op(join, dtype, (x, y))


def _scattered_to_computed(self: "Evaluation", eqn: Any, operand, index, updates) -> Value:
    """Updates at computed places: every place asks whether an update is its own."""
    params, graph, dtype = eqn.params, self.graph, dtype_of(operand)
    dims, join = params["dimension_numbers"], JOINS[eqn.primitive.name]
    count, size = math.prod(index.shape[:-1]), math.prod(operand.shape)
    kept = [k for k in range(len(operand.shape)) if k not in dims.inserted_window_dims]
    window = [updates.shape[k] for k in dims.update_window_dims]
    # An update covers an axis, or has one place along it.
    covered = dict(zip(kept, window, strict=True)) if not dims.operand_batching_dims else {}
    axes = dims.scatter_dims_to_operand_dims
    whole = [covered.get(axis, 1) for axis in range(len(operand.shape))]
    is_row = all(n in (1, m) for n, m in zip(whole, operand.shape, strict=True))
    if not is_row or dims.operand_batching_dims:
        raise Unsupported("a scatter of windows to computed places")
    if count * size > 8 * MOST_CELLS:
        raise Unsupported("many updates of computed places")
    batch = [k for k in range(len(updates.shape)) if k not in dims.update_window_dims]
    order = dict(permutation=(*batch, *dims.update_window_dims))
    turned = self.reshaped(
        self.move(jax.lax.transpose_p, [updates], order)[0], (count, *window)
    )
    starts, of = self.cellar.unlaned(index).reshape(count, -1), dtype_of(index)
    clips = params["mode"] == jax.lax.GatherScatterMode.CLIP
    # An update that covers an axis begins at its first place.
    coordinates, out = np.indices(operand.shape), operand
    coordinates[[axis for axis, n in enumerate(whole) if n > 1]] = 0
    for k in range(count):
        numbers = [_whole_number(self, x, of) for x in starts[k].tolist()]
        if clips:
            pairs = zip(numbers, axes, strict=True)
            room = np.array(operand.shape) - whole
            numbers = [_clamped(self, x, int(room[axis])) for x, axis in pairs]

        def rule(old, new, *places, numbers=numbers):
            on: Number = True
            for number, place in zip(numbers, places, strict=True):
                on = graph.op("and", "b1", (on, graph.compare("eq", "i8", number, place)))
            if join is not None:
                new = _joined_numbers(self, join, dtype, old, new)
            return graph.select(dtype, on, new, old)

        part = self.reshaped(self.subarray(turned, (slice(k, k + 1),)), tuple(whole))
        parts = [out, self.spread(part, operand.shape), *coordinates[[*axes]]]
        out = self.map(rule, parts, operand.shape, dtype)
    return out
