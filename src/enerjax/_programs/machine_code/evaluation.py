"""Programs of JAX, evaluated with nodes of the graph in place of numbers."""

import collections
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import Literal, Var

from ..jaxprs import programs_within, solution_program, wrapped_program
from ..numpy_primitives import BY_NUMPY, evaluated, moved, MOVES
from ..primitives import FACTORS, LINEAR_SOLVE
from .computed_places import dynamic_slice, dynamic_update_slice, gather, JOINS, scatter
from .contraction import contraction
from .dense import by_loops, can_be_loops
from .elementwise import ELEMENTWISE
from .graph import as_number, Graph, Node, Number
from .small_matrices import in_plain_operations, is_small
from .values import (
    Cellar,
    Cells,
    columns_along,
    CONSTANTS,
    dtype_of,
    lane_of,
    Memory,
    MOST_CELLS,
    objects,
    shared,
    type_name,
    Unsupported,
    Value,
)


# The name of the primitive that runs a program as one function.
NAME = "enerjax_one_function"

_SAME = frozenset(
    """
    copy copy_p name optimization_barrier stop_gradient xla_metadata_value
    """.split()
)


class Evaluation:
    """Evaluates programs in the current region of a graph."""

    def __init__(self, rows_of: dict[int, tuple[int, int]] | None = None):
        self.graph = Graph()
        self.cellar = Cellar(self.graph)
        # The rows in which vectors of some lengths are read.
        self.rows_of = rows_of or {}
        # The axes along which an array is summed that is not used otherwise.
        self._sums: dict[Any, Sequence[int]] = {}

    def outputs(
        self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]
    ) -> list[Value]:
        """The values of the outputs of a program."""
        known: dict[Any, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
        known.update(zip(jaxpr.invars, args, strict=True))
        uses = collections.Counter(
            x
            for atoms in (*(eqn.invars for eqn in jaxpr.eqns), jaxpr.outvars)
            for x in atoms
            if not isinstance(x, Literal)
        )

        for eqn in jaxpr.eqns:
            summed = eqn.invars[0] if eqn.primitive.name == "reduce_sum" else None
            if isinstance(summed, Var) and uses[summed] == 1:
                self._sums[summed] = eqn.params["axes"]

        def read(atom: Any) -> Value:
            if isinstance(atom, Literal):
                return np.asarray(atom.val, atom.aval.dtype)  # pyright: ignore
            return shared(known[atom]) if uses[atom] > 1 else known[atom]

        for eqn in jaxpr.eqns:
            try:
                if eqn.effects:
                    raise Unsupported(f"`{eqn.primitive.name}`, which has effects")
                outs = self._equation(eqn, list(map(read, eqn.invars)))
            except Unsupported as reason:
                reason.equations.append(eqn)
                raise
            known.update(zip(eqn.outvars, outs, strict=True))
        return list(map(read, jaxpr.outvars))

    def joined(self, parts: list[Value]) -> Value:
        """Arrays one after the other, along the first axis."""
        known = [x for x in parts if isinstance(x, np.ndarray)]
        if len(known) == len(parts):
            return np.concatenate(known)
        return self.move(jax.lax.concatenate_p, parts, dict(dimension=0))[0]

    def closed(self, closed: Any, args: Sequence[Any]) -> list[Value]:
        return self.program(closed.jaxpr, closed.consts, args)

    def program(
        self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]
    ) -> list[Value]:
        """The outputs of a program with these constants."""
        return self.outputs(jaxpr, list(map(known_constant, consts)), args)

    def function(self, fn: Callable, *values: Value) -> list[Value]:
        """The outputs of a function of JAX, traced for these arguments."""
        like = [jax.ShapeDtypeStruct(x.shape, _numpy_type(x)) for x in values]
        return self.closed(jax.make_jaxpr(fn)(*like), values)

    def _equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        name, params = eqn.primitive.name, eqn.params
        if name in _SAME:
            return list(values)
        if name == "platform_index":
            return [np.asarray(_place_of_cpu(params["platforms"]), np.int32)]
        if name == "custom_vmap_call":
            return self.closed(params["call"], values)
        inner = wrapped_program(eqn)
        if inner is not None:
            jaxpr, consts = inner
            return self.outputs(jaxpr, list(map(known_constant, consts)), values)
        if name == NAME:
            program = params["program"]
            values = values[: len(program.known)]
            pairs = zip(values, program.known, strict=True)
            own = [x if known is None else known for x, known in pairs]
            return self.outputs(program.jaxpr, [], own)
        from .loops import LOOPS

        if name in LOOPS:
            return LOOPS[name](self, eqn, values)
        if all(isinstance(x, np.ndarray) for x in values):
            # JAX would compile a program for each shape.
            is_slow = name in _SLOW_BY_JAX and eqn.outvars[0].aval.size <= MOST_CELLS
            if not is_slow:
                return _known(eqn, values)
        if name in ELEMENTWISE:
            return [self._elementwise(eqn, values)]
        if name in MOVES:
            return self.move(eqn.primitive, values, params)
        rule = _RULES.get(name)
        if rule is None:
            raise Unsupported(f"`{name}`")
        return rule(self, eqn, values)

    # Entry by entry -----------------------------------------------------------------------

    def _elementwise(self, eqn: Any, values: list[Value]) -> Value:
        shape, dtype = eqn.outvars[0].aval.shape, type_name(eqn.outvars[0].aval.dtype)
        of = [dtype_of(x) for x in values]
        rule = functools.partial(
            ELEMENTWISE[eqn.primitive.name], self.graph, eqn.params, dtype, of
        )
        summed = self._sums.get(eqn.outvars[0], ())
        return self.map(rule, values, shape, dtype, summed)

    def map(
        self,
        rule: Callable[..., Number],
        values: list[Value],
        shape: tuple[int, ...],
        dtype: str,
        summed: Sequence[int] = (),
    ) -> Value:
        """An operation on numbers, for each entry of arrays of one shape, or of none.

        `summed` are the axes along which the result will be summed.
        """
        size = math.prod(shape)
        if size == 0:
            return np.zeros(shape, dtype)
        values = [self.spread(x, shape) if x.shape else x for x in values]
        rows = self.rows_of.get(size) if len(shape) == 1 else None
        if rows is not None:
            values = [self.reshaped(x, rows) if x.shape else x for x in values]
            return self.reshaped(self.map(rule, values, rows, dtype), shape)
        lane = lane_of(values, shape, summed)
        if lane is not None and size // shape[lane] > MOST_CELLS:
            return self._as_one_axis(rule, values, shape, dtype)
        if lane is None and size > MOST_CELLS:
            return self._as_one_axis(rule, values, shape, dtype)
        if lane is not None and not any(map(_is_laned, values)):
            found = self._by_columns(rule, values, shape, dtype)
            if found is not None:
                return found
        columns, kept = [], list(shape)
        if lane is not None:
            kept[lane] = 1
        count = math.prod(kept)
        for x in values:
            if x.shape != shape:
                columns.append([self.cellar.unlaned(x).item()] * count)
            elif lane is None:
                columns.append(self.cellar.unlaned(x).ravel().tolist())
            else:
                columns.append(self.cellar.laned(x, lane).ravel().tolist())
        cells = objects([rule(*xs) for xs in zip(*columns, strict=True)], tuple(kept))
        return self.cells(dtype, cells, lane, 1 if lane is None else shape[lane])

    def _by_columns(self, rule, values, shape, dtype) -> Value | None:
        """The same by the columns in which operands are stored, if they are."""
        own = [x for x in values if isinstance(x, Memory) and x.shape == shape]
        leader = next((x for x in own if x.places.min() < CONSTANTS), None)
        if leader is None:
            return None
        found = self.cellar.columns(leader.places.ravel())
        if found is None:
            return None
        parts, others = found
        flat: list[Any] = []
        for x in values:
            if x.shape != shape:
                flat.append(self.cellar.unlaned(x).item())
            else:
                memory = self.cellar.memory(x)
                flat.append((memory.places.ravel(), memory.dtype))
        places = np.zeros(leader.places.size, np.int64)
        for part in parts:
            xs = [
                self.cellar.lanes_at(x[0][part], x[1]) if isinstance(x, tuple) else x
                for x in flat
            ]
            places[part] = self.cellar.places_of_lanes(rule(*xs), dtype, part.size)
        for k in others.tolist():
            xs = [
                self.cellar.number_at(int(x[0][k]), x[1]) if isinstance(x, tuple) else x
                for x in flat
            ]
            places[k] = self.cellar.place_of(rule(*xs), dtype)
        return Memory(dtype, places.reshape(shape))

    def spread(self, x: Value, shape: tuple[int, ...]) -> Value:
        """An operand whose axes of length 1 stand for longer ones."""
        if x.shape == shape:
            return x
        if isinstance(x, np.ndarray):
            return np.broadcast_to(x, shape)
        numbers = np.arange(math.prod(x.shape)).reshape(x.shape)
        firsts = np.array([0, numbers.size])
        return self.taken([x], firsts, np.broadcast_to(numbers, shape), x.dtype)

    def cells(self, dtype: str, cells: np.ndarray, lane: int | None, n: int) -> Value:
        """An array of numbers; a plain one if all are known."""
        if any(isinstance(x, Node) for x in cells.ravel()):
            return Cells(dtype, cells, lane, n)
        known = np.array(cells.ravel().tolist(), dtype).reshape(cells.shape)
        return known if lane is None else np.repeat(known, n, lane)

    def _as_one_axis(self, rule, values, shape, dtype) -> Value:
        """An array with very many entries beside its longest axis."""
        size = math.prod(shape)
        flat = []
        for x in values:
            if x.shape != shape:
                flat.append(x)
            elif isinstance(x, np.ndarray):
                flat.append(np.ravel(x))
            else:
                memory = self.cellar.memory(x)
                flat.append(Memory(memory.dtype, memory.places.ravel()))
        out = self.map(rule, flat, (size,), dtype)
        if isinstance(out, np.ndarray):
            return out.reshape(shape)
        return Memory(dtype, self.cellar.memory(out).places.reshape(shape))

    # Moving entries -----------------------------------------------------------------------

    def move(self, primitive: Any, values: list[Value], params: Any) -> list[Value]:
        """The outputs of a primitive that moves entries of its operands."""
        if primitive.name in ("pad", "concatenate", "stack"):
            dtype = next(dtype_of(x) for x in values)
        else:
            dtype = dtype_of(values[0])
        sizes = [math.prod(x.shape) for x in values]
        firsts = np.cumsum([0, *sizes])
        numbers = [
            np.arange(first, first + size).reshape(x.shape)
            for first, size, x in zip(firsts, sizes, values, strict=False)
        ]
        outs = moved(primitive, numbers, params)
        return [self.taken(values, firsts, np.asarray(x), dtype) for x in outs]

    def taken(
        self, values: list[Value], firsts: np.ndarray, numbers: np.ndarray, dtype: str
    ) -> Value:
        """Entries of arrays, counted through all of them; `numbers` says which."""
        if numbers.size == 0:
            return np.zeros(numbers.shape, dtype)
        laned = [x for x in values if isinstance(x, Cells) and x.lane is not None]
        if laned:
            found = self._with_lanes(values, laned[0], firsts, numbers, dtype)
            if found is not None:
                return found
        is_small = all(isinstance(x, np.ndarray) or _is_unlaned(x) for x in values)
        if is_small and numbers.size <= 4 * MOST_CELLS:
            flat = np.concatenate([self.cellar.unlaned(x).ravel() for x in values])
            cells = flat[numbers.ravel()].reshape(numbers.shape)
            return self.cells(dtype, cells, None, 1)
        places = [self.cellar.memory(x).places.ravel() for x in values]
        return Memory(dtype, np.concatenate(places)[numbers])

    def _with_lanes(self, values, one, firsts, numbers, dtype) -> Value | None:
        """The same, if an axis of the result runs through the lanes of an operand."""
        n = one.n
        cell = np.full(int(firsts[-1]), -1)
        lane = np.full(int(firsts[-1]), -1)
        pool: list[Number] = []
        for first, x in zip(firsts, values, strict=False):
            if not (isinstance(x, Cells) and x.lane is not None and x.n == n):
                continue
            flat = x.cells.ravel()
            own = np.arange(flat.size).reshape(x.cells.shape) + len(pool)
            size = flat.size * n
            cell[first : first + size] = np.repeat(own, n, x.lane).ravel()
            along = np.arange(n).reshape(
                [-1 if k == x.lane else 1 for k in range(own.ndim)]
            )
            lane[first : first + size] = np.broadcast_to(along, x.shape).ravel()
            pool.extend(flat)
        for axis in range(numbers.ndim):
            if numbers.shape[axis] != n:
                continue
            columns = columns_along(numbers, axis)
            in_order = np.all(lane[columns] == np.arange(n), axis=1)
            same = np.all(cell[columns] == cell[columns[:, :1]], axis=1)
            whole = in_order & same
            # Most of the result must be whole columns, or it is another axis.
            if 2 * np.count_nonzero(whole) < whole.size:
                continue
            kept = list(numbers.shape)
            kept[axis] = 1
            rest = None
            flat = []
            for is_whole, column in zip(whole, columns, strict=True):
                if is_whole:
                    flat.append(pool[cell[column[0]]])
                    continue
                if rest is None:
                    flats = (self.cellar.memory(x).places.ravel() for x in values)
                    rest = np.concatenate([*flats])
                flat.append(self.cellar.lanes_at(rest[column], dtype))
            return self.cells(dtype, objects(flat, tuple(kept)), axis, n)
        return None

    # Reductions ---------------------------------------------------------------------------

    def reduced(self, op: str, value: Value, axes: tuple[int, ...]) -> Value:
        """The entries along some axes, joined by an operation."""
        dtype, shape = dtype_of(value), value.shape
        kept_shape = tuple(n for k, n in enumerate(shape) if k not in axes)
        if math.prod(shape) == 0:
            raise Unsupported("a reduction of no numbers")
        if not kept_shape and isinstance(value, Memory):
            found = self._reduced_by_columns(op, value)
            if found is not None:
                return found
        lane = lane_of([value], shape)
        cells_beside = math.prod(shape) // (1 if lane is None else shape[lane])
        if cells_beside > MOST_CELLS:
            return self._reduced_of_many(op, value, axes)
        if lane is None:
            cells = self.cellar.unlaned(value)
        else:
            cells = self.cellar.laned(value, lane)
        order = [k for k in range(len(shape)) if k not in axes]
        moved_cells = np.transpose(cells, [*order, *axes])
        first = [cells.shape[k] for k in order]
        rows = moved_cells.reshape(math.prod(first), -1)
        fold = lambda row: functools.reduce(
            lambda a, b: self.graph.op(op, dtype, (a, b)), row
        )
        flat = [fold(row) for row in rows.tolist()]
        if lane is not None and lane in axes:
            flat = [self._over_lanes(op, dtype, x, shape[lane]) for x in flat]
            return self.cells(dtype, objects(flat, kept_shape), None, 1)
        at = None if lane is None else order.index(lane)
        n = 1 if lane is None else shape[lane]
        return self.cells(dtype, objects(flat, tuple(first)), at, n)

    def _reduced_by_columns(self, op: str, value: Memory) -> Value | None:
        places, dtype = value.places.ravel(), value.dtype
        found = None if places.size < 12 else self.cellar.columns(places)
        if found is None:
            return None
        join = lambda a, b: self.graph.op(op, dtype, (a, b))
        by_length: dict[int, list[Number]] = {}
        for part in found[0]:
            x = self.cellar.lanes_at(places[part], dtype)
            by_length.setdefault(part.size, []).append(x)
        totals = [
            self._over_lanes(op, dtype, functools.reduce(join, xs), n)
            for n, xs in by_length.items()
        ]
        totals += [self.cellar.number_at(int(p), dtype) for p in places[found[1]]]
        total = functools.reduce(join, totals)
        return self.cells(dtype, objects([total], ()), None, 1)

    def _over_lanes(self, op: str, dtype: str, x: Number, n: int) -> Number:
        if isinstance(x, Node) and x.lanes and not x.is_reduced:
            return self.graph.reduce(op, dtype, x)
        if op == "xor":
            return x if n % 2 else as_number(0, dtype)
        if op == "add":
            factor = n if dtype[0] != "f" else float(n)
            return self.graph.op("mul", dtype, (x, factor))
        if op == "mul":
            return functools.reduce(
                lambda a, b: self.graph.op("mul", dtype, (a, b)), [x] * n
            )
        return x

    def _reduced_of_many(self, op: str, value: Value, axes: tuple[int, ...]) -> Value:
        """A reduction of a large array, one row after the other."""
        memory = self.cellar.memory(value)
        order = [k for k in range(memory.places.ndim) if k not in axes]
        kept = [memory.shape[k] for k in order]
        rows = np.transpose(memory.places, [*order, *axes]).reshape(math.prod(kept), -1)
        if rows.shape[0] > rows.shape[1]:
            # The terms one after the other, for all results as lanes.
            terms = [self.cellar.lanes_at(x, memory.dtype) for x in rows.T]
            if len(terms) > MOST_CELLS:
                raise Unsupported("a reduction of a very large array")
            total = functools.reduce(
                lambda a, b: self.graph.op(op, memory.dtype, (a, b)), terms
            )
            flat = Cells(memory.dtype, objects([total], (1,)), 0, rows.shape[0])
            places = self.cellar.memory(flat).places.reshape(kept)
            return Memory(memory.dtype, places)
        if rows.shape[0] > MOST_CELLS:
            raise Unsupported("a reduction of a very large array")
        flat = [
            self._over_lanes(
                op, memory.dtype, self.cellar.lanes_at(x, memory.dtype), x.size
            )
            for x in rows
        ]
        return self.cells(memory.dtype, objects(flat, tuple(kept)), None, 1)

    def dynamic(
        self, first: int, stride: int, offset: Node, dtype: str, n: int, of: Memory
    ) -> Node:
        """The number at a cell of `of` that is `offset` behind the first."""
        region, level, markers = self.cellar.readable(of.places)
        markers = (*markers, self.cellar.marker(region, level))
        extra = int(first), stride
        return self.graph.node("dynamic", dtype, (offset, *markers), extra, lanes=n)

    def subarray(self, value: Value, index: Any) -> Value:
        numbers = np.arange(math.prod(value.shape)).reshape(value.shape)[index]
        if isinstance(value, np.ndarray):
            return value[index]
        firsts = np.array([0, math.prod(value.shape)])
        return self.taken([value], firsts, numbers, dtype_of(value))

    def reshaped(self, value: Value, shape: tuple[int, ...]) -> Value:
        if isinstance(value, np.ndarray):
            return value.reshape(shape)
        if isinstance(value, Memory):
            return Memory(value.dtype, value.places.reshape(shape))
        numbers = np.arange(math.prod(value.shape)).reshape(shape)
        firsts = np.array([0, math.prod(value.shape)])
        return self.taken([value], firsts, numbers, value.dtype)

    def moved_to_known(self, primitive, x, indices, params) -> list[Value]:
        """A move to places that are known."""
        numbers = np.arange(math.prod(x.shape)).reshape(x.shape)
        (out,) = moved(primitive, [numbers, indices], params)
        firsts = np.array([0, numbers.size])
        return [self.taken([x], firsts, np.asarray(out), dtype_of(x))]

    def total(self, op: str, value: Value, axes: Any) -> Value:
        if isinstance(value, np.ndarray):
            join = {"add": np.sum, "mul": np.prod, "max": np.max, "min": np.min}[op]
            return np.asarray(join(value, axis=axes), value.dtype)
        return self.reduced(op, value, axes)


def _is_laned(x: Value) -> bool:
    return isinstance(x, Cells) and x.lane is not None


def rows_of_vectors(jaxpr: Any) -> dict[int, tuple[int, int]]:
    """The rows in which most vectors of a length are read: `(rows, entries of each)`."""
    counts: dict[int, dict[tuple[int, int], int]] = {}

    def look(jaxpr: Any) -> None:
        for eqn in jaxpr.eqns:
            if eqn.primitive.name == "reshape":
                (before,), after = eqn.invars, eqn.outvars[0].aval.shape
                if before.aval.ndim == 1 and len(after) == 2 and after[0] > 4:
                    own = counts.setdefault(before.aval.size, {})
                    own[after] = own.get(after, 0) + 1
            if eqn.primitive.name == NAME:
                look(eqn.params["program"].jaxpr)
            else:
                for inner in programs_within(eqn):
                    look(inner)

    look(jaxpr)
    return {size: max(own, key=own.__getitem__) for size, own in counts.items()}


def _is_unlaned(x: Value) -> bool:
    return isinstance(x, Cells) and x.lane is None


def _numpy_type(x: Value) -> Any:
    return np.dtype("?" if dtype_of(x) == "b1" else dtype_of(x))


def known_constant(x: Any) -> Value:
    """A constant of a program, whose numbers are known."""
    if isinstance(x, Cells | Memory):
        return x
    if isinstance(x, Tracer):
        raise Unsupported("a constant that is not known")
    return np.asarray(x)


def _place_of_cpu(platforms: Any) -> int:
    """The place of the platform that machine code is for; `None` stands for all."""
    is_ours = [names is None or "cpu" in names for names in platforms]
    return is_ours.index(True)


def _known(eqn: Any, values: list[Any]) -> list[Value]:
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        outs = evaluated(eqn.primitive, values, eqn.params)
    avals = [x.aval for x in eqn.outvars]
    for aval in avals:
        type_name(aval.dtype)
    return [np.asarray(x, aval.dtype) for x, aval in zip(outs, avals, strict=True)]


# What has a rule here, and would have to be compiled by JAX for known numbers.
_SLOW_BY_JAX = {*ELEMENTWISE, "scatter-add"} - BY_NUMPY


# Rules ------------------------------------------------------------------------------------

_OPS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
    "reduce_xor": "xor",
}


def _reduction(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    axes = tuple(eqn.params["axes"])
    if not axes:
        return values
    out = eqn.outvars[0].aval
    if math.prod(values[0].shape) == 0:
        every = True if out.dtype == bool else -1
        neutral = {"reduce_sum": 0, "reduce_prod": 1, "reduce_and": every, "reduce_or": 0}
        if eqn.primitive.name not in neutral:
            raise Unsupported("an extreme of no numbers")
        return [np.full(out.shape, neutral[eqn.primitive.name], out.dtype)]
    return [self.reduced(_OPS[eqn.primitive.name], values[0], axes)]


def _running(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    """Running sums: one entry after the other, or a loop."""
    (x,), axis, reverse = values, eqn.params["axis"], eqn.params["reverse"]
    op = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}[
        eqn.primitive.name
    ]
    dtype, count = dtype_of(x), x.shape[axis]
    beside = math.prod(x.shape) // max(count, 1)
    if count * beside > MOST_CELLS // 4:
        of_two = {"add": jnp.add, "mul": jnp.multiply, "max": jnp.maximum}.get(
            op, jnp.minimum
        )

        def by_loop(x):
            x = jnp.moveaxis(x, axis, 0)
            turn = lambda c, row: (of_two(c, row), of_two(c, row))
            first = x[-1] if reverse else x[0]
            rest = x[:-1] if reverse else x[1:]
            _, out = jax.lax.scan(turn, first, rest, reverse=reverse)
            parts = [out, first[None]] if reverse else [first[None], out]
            return jnp.moveaxis(jnp.concatenate(parts), 0, axis)

        return self.function(by_loop, x)
    cells = np.moveaxis(self.cellar.unlaned(x), axis, 0)
    rows = list(cells[::-1] if reverse else cells)
    join = np.frompyfunc(lambda a, b: self.graph.op(op, dtype, (a, b)), 2, 1)
    out = [rows[0]]
    for row in rows[1:]:
        out.append(join(out[-1], row))
    stacked = np.stack(out[::-1] if reverse else out).astype(object)
    return [self.cells(dtype, np.moveaxis(stacked, 0, axis), None, 1)]


def _iota(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    return _known(eqn, values)


def _extreme_place(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    """The place of the first extreme along an axis; that of a NaN, if there is one."""
    (x,), (axis,) = values, eqn.params["axes"]
    if math.prod(x.shape) > MOST_CELLS:
        raise Unsupported("the place of an extreme of a large array")
    of, dtype = dtype_of(x), type_name(eqn.params["index_dtype"])
    how = "gt" if eqn.primitive.name == "argmax" else "lt"
    rows = np.moveaxis(self.cellar.unlaned(x), axis, -1)
    flat, graph = [], self.graph
    for row in rows.reshape(-1, x.shape[axis]).tolist():
        best, place = row[0], 0
        for k, entry in enumerate(row[1:], 1):
            better = graph.compare(how, of, entry, best)
            if of[0] == "f":
                # A number is not equal to itself if it is NaN; the first NaN stays.
                is_nan = graph.compare("ne", of, entry, entry)
                was_nan = graph.compare("ne", of, best, best)
                better = graph.op("or", "b1", (better, is_nan))
                better = graph.op("and", "b1", (better, graph.op("not", "b1", (was_nan,))))
            best = graph.select(of, better, entry, best)
            place = graph.select(dtype, better, k, place)
        flat.append(place)
    return [self.cells(dtype, objects(flat, rows.shape[:-1]), None, 1)]


def _linear_solve(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    program, inputs = solution_program(values, eqn.params)
    return self.closed(program, inputs)


def _factors(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    name = eqn.primitive.name
    small = is_small(eqn)
    if not small and not can_be_loops(eqn):
        raise Unsupported(f"`{name}` of a large array")
    like = tuple(jax.ShapeDtypeStruct(x.shape, _numpy_type(x)) for x in values)
    return self.closed(_program_of_factors(name, small, like, _Params(eqn.params)), values)


class _Params(dict):
    """The parameters of an equation, as a key."""

    def __hash__(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return hash(tuple(sorted(map(str, self.items()))))


@functools.lru_cache(maxsize=256)
def _program_of_factors(name: str, small: bool, like: Any, params: dict[str, Any]) -> Any:
    """The plain operations that compute factors; they are traced once for each shape."""
    factors = in_plain_operations if small else by_loops
    return jax.make_jaxpr(lambda *xs: factors(name, list(xs), params))(*like)


_RULES: dict[str, Callable[[Evaluation, Any, list[Value]], list[Value]]] = {
    **dict.fromkeys(_OPS, _reduction),
    **dict.fromkeys("cumsum cumprod cummax cummin".split(), _running),
    **dict.fromkeys(("argmax", "argmin"), _extreme_place),
    **dict.fromkeys(JOINS, scatter),
    **dict.fromkeys(FACTORS, _factors),
    "dot_general": contraction,
    "dynamic_slice": dynamic_slice,
    "dynamic_update_slice": dynamic_update_slice,
    "gather": gather,
    "iota": _iota,
    LINEAR_SOLVE: _linear_solve,
}
