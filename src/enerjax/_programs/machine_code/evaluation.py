"""Programs of JAX, evaluated with nodes of the graph in place of numbers."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal

from ..jaxprs import programs_within, solution_program, wrapped_program
from ..numpy_primitives import (
    evaluated,
    FUNCTIONS as FUNCTIONS_OF_NUMPY,
    is_inside,
    moved,
    MOVES,
)
from ..primitives import FACTORS, LINEAR_SOLVE
from .dense import BY_LOOPS, factors_by_loops
from .elementwise import ELEMENTWISE
from .graph import Graph, Node, Number
from .small_matrices import in_plain_operations, is_small
from .values import (
    Cellar,
    Cells,
    CONSTANTS,
    dtype_of,
    lane_of,
    Memory,
    MOST_CELLS,
    number_at,
    objects,
    type_name,
    Unsupported,
    Value,
)


# The name of the primitive that runs a program as one function.
NAME = "enerjax_one_function"
# The most products of numbers that a contraction is written out for.
_MOST_PRODUCTS = 2_000

_SAME = frozenset(
    """
    copy copy_p name optimization_barrier reduce_precision stop_gradient xla_metadata_value
    """.split()
)


class Evaluation:
    """Evaluates programs in the current region of a graph."""

    def __init__(
        self, rows_of: dict[int, tuple[int, int]] | None = None, may_be_wide: bool = True
    ):
        self.may_be_wide = may_be_wide
        self.graph = Graph()
        self.cellar = Cellar(self.graph)
        # The rows in which vectors of some lengths are read.
        self.rows_of = rows_of or {}

    def outputs(self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]) -> list[Value]:
        """The values of the outputs of a program."""
        known: dict[Any, Value] = dict(zip(jaxpr.constvars, consts, strict=True))
        known.update(zip(jaxpr.invars, args, strict=True))

        def read(atom: Any) -> Value:
            if isinstance(atom, Literal):
                return np.asarray(atom.val, atom.aval.dtype)  # pyright: ignore
            return known[atom]

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
        if all(isinstance(x, np.ndarray) for x in parts):
            return np.concatenate(parts)
        return self.move(jax.lax.concatenate_p, parts, dict(dimension=0))[0]

    def closed(self, closed: Any, args: Sequence[Any]) -> list[Value]:
        return self.outputs(closed.jaxpr, list(map(known_constant, closed.consts)), args)

    def function(self, fn: Callable, *values: Value) -> list[Value]:
        """The outputs of a function of JAX, traced for these arguments."""
        like = [jax.ShapeDtypeStruct(x.shape, _numpy_type(x)) for x in values]
        return self.closed(jax.make_jaxpr(fn)(*like), values)

    def _equation(self, eqn: Any, values: list[Value]) -> list[Value]:
        name, params = eqn.primitive.name, eqn.params
        if name in _SAME:
            return list(values)
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
            count = len(program.jaxpr.constvars)
            return self.outputs(program.jaxpr, own[:count], own[count:])
        from .loops import LOOPS

        if name in LOOPS:
            return LOOPS[name](self, eqn, values)
        if all(isinstance(x, np.ndarray) for x in values):
            is_slow = name in ELEMENTWISE and name not in FUNCTIONS_OF_NUMPY
            if not (is_slow and eqn.outvars[0].aval.size <= MOST_CELLS):
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
        return self.map(rule, values, shape, dtype)

    def map(
        self,
        rule: Callable[..., Number],
        values: list[Value],
        shape: tuple[int, ...],
        dtype: str,
    ) -> Value:
        """An operation on numbers, for each entry of arrays of one shape, or of none."""
        size = math.prod(shape)
        if size == 0:
            return np.zeros(shape, dtype)
        values = [self._spread(x, shape) if x.shape else x for x in values]
        lane = lane_of(values, shape)
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

    def _spread(self, x: Value, shape: tuple[int, ...]) -> Value:
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
            along = np.arange(n).reshape([-1 if k == x.lane else 1 for k in range(own.ndim)])
            lane[first : first + size] = np.broadcast_to(along, x.shape).ravel()
            pool.extend(flat)
        for axis in range(numbers.ndim):
            if numbers.shape[axis] != n:
                continue
            columns = np.moveaxis(numbers, axis, -1).reshape(-1, n)
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
                    rest = self._flat_values(values)
                flat.append(self._column(rest, column))
            return self.cells(dtype, objects(flat, tuple(kept)), axis, n)
        return None

    def _flat_values(self, values: list[Value]) -> np.ndarray:
        places = [self.cellar.memory(x).places.ravel() for x in values]
        dtype = next(dtype_of(x) for x in values)
        return dtype, np.concatenate(places)  # type: ignore

    def _column(self, rest: Any, column: np.ndarray) -> Number:
        dtype, places = rest
        return self.cellar.lanes_at(places[column], dtype)

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
        fold = lambda row: functools.reduce(lambda a, b: self.graph.op(op, dtype, (a, b)), row)
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
    if isinstance(x, jax.core.Tracer):
        raise Unsupported("a constant that is not known")
    return np.asarray(x)


def _known(eqn: Any, values: list[Any]) -> list[Value]:
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        outs = evaluated(eqn.primitive, values, eqn.params)
    avals = [x.aval for x in eqn.outvars]
    for aval in avals:
        type_name(aval.dtype)
    return [np.asarray(x, aval.dtype) for x, aval in zip(outs, avals, strict=True)]


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
        neutral = {"reduce_sum": 0, "reduce_prod": 1, "reduce_and": 1, "reduce_or": 0}
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
            turn = lambda c, row: (of_two(c, row),) * 2
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


def _contraction(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    """A product of arrays: products of entries, and their sums."""
    (contracted_left, contracted_right), (batch_left, batch_right) = eqn.params[
        "dimension_numbers"
    ]
    left, right = values
    out = eqn.outvars[0].aval
    terms = math.prod(left.shape[k] for k in contracted_left)
    if out.size == 0 or terms == 0:
        return [np.zeros(out.shape, out.dtype)]
    dtype = type_name(out.dtype)
    free = lambda x, a, b: [k for k in range(len(x.shape)) if k not in (*a, *b)]
    free_left = free(left, contracted_left, batch_left)
    free_right = free(right, contracted_right, batch_right)
    shape = [
        *(left.shape[k] for k in batch_left),
        *(left.shape[k] for k in free_left),
        *(right.shape[k] for k in free_right),
        *(left.shape[k] for k in contracted_left),
    ]
    size = math.prod(shape)
    lanes = [
        x.n if isinstance(x, Cells) and x.lane is not None else 1 for x in (left, right)
    ]
    longest = max(max(shape), *lanes)
    if size // longest > _MOST_PRODUCTS:
        return [_large_product(self, eqn, values)]
    nb, nl, nr, nc = map(len, (batch_left, free_left, free_right, contracted_left))
    turn = lambda x, order: self.move(
        jax.lax.transpose_p, [x], dict(permutation=tuple(order))
    )[0]
    left = turn(left, [*batch_left, *free_left, *contracted_left])
    right = turn(right, [*batch_right, *free_right, *contracted_right])
    spread = lambda x, dims: self.move(
        jax.lax.broadcast_in_dim_p,
        [x],
        dict(shape=tuple(shape), broadcast_dimensions=tuple(dims), sharding=None),
    )[0]
    at = list(range(len(shape)))
    left = spread(left, [*at[: nb + nl], *at[nb + nl + nr :]])
    right = spread(right, [*at[:nb], *at[nb + nl : nb + nl + nr], *at[nb + nl + nr :]])
    of = [dtype_of(left), dtype_of(right)]
    rule = lambda a, b: self.graph.op(
        "mul",
        dtype,
        (
            self.graph.op("convert", dtype, (a,), of[0]),
            self.graph.op("convert", dtype, (b,), of[1]),
        ),
    )
    product = self.map(rule, [left, right], tuple(shape), dtype)
    if nc == 0:
        return [product]
    return [self.reduced_known("add", product, tuple(at[nb + nl + nr :]))]


def _large_product(self: Evaluation, eqn: Any, values: list[Value]) -> Value:
    """A product of large arrays, row by row in a loop."""
    numbers = eqn.params["dimension_numbers"]
    left, right = values
    (contracted_left, _), (batch_left, _) = numbers
    free = [k for k in range(len(left.shape)) if k not in (*contracted_left, *batch_left)]
    if batch_left or not free:
        if batch_left:
            by_row = lambda a, b: jax.lax.map(
                lambda x: jax.lax.dot_general(*x, _without_batch(numbers)),
                (jnp.moveaxis(a, batch_left[0], 0), jnp.moveaxis(b, numbers[1][1][0], 0)),
            )
            if len(batch_left) > 1:
                raise Unsupported("a product of large arrays with several batch axes")
            return self.function(by_row, left, right)[0]
        raise Unsupported("a product of very large arrays")
    axis = free[0]
    dims = tuple(k - (k > axis) for k in contracted_left)
    inner = ((dims, numbers[0][1]), ((), ()))
    place = 0

    def by_row(a, b):
        rows = jnp.moveaxis(a, axis, 0)
        out = jax.lax.map(lambda row: jax.lax.dot_general(row, b, inner), rows)
        return jnp.moveaxis(out, 0, place)

    return self.function(by_row, left, right)[0]


def _without_batch(numbers: Any) -> Any:
    (left, right), (batch_left, batch_right) = numbers
    less = lambda axes, batch: tuple(k - (k > batch[0]) for k in axes)
    return (less(left, batch_left), less(right, batch_right)), ((), ())


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
    if is_small(eqn):
        fn = lambda *xs: in_plain_operations(name, list(xs), eqn.params)
    elif name in BY_LOOPS and eqn.outvars[0].aval.size:
        fn = lambda *xs: factors_by_loops(name, list(xs), eqn.params)
    else:
        raise Unsupported(f"`{name}` of a large array")
    return self.function(fn, *values)


# Places that are computed while the program runs ------------------------------------------


def _whole_number(self: Evaluation, x: Number, of: str) -> Number:
    return self.graph.op("convert", "i8", (x,), of)


def _clamped(self: Evaluation, x: Number, high: int) -> Number:
    x = self.graph.op("max", "i8", (x, 0))
    return self.graph.op("min", "i8", (x, high))


def _at_computed(
    self: Evaluation, value: Value, starts: list[Number], sizes: Sequence[int]
) -> Value:
    """A slice of an array that begins at a computed place of each axis."""
    memory = self.cellar.contiguous(value)
    if math.prod(sizes) == 0:
        return np.zeros(tuple(sizes), memory.dtype)
    strides = np.cumprod([1, *memory.shape[:0:-1]])[::-1]
    graph, dtype = self.graph, memory.dtype
    offset: Number = 0
    for start, stride in zip(starts, strides.tolist(), strict=True):
        offset = graph.add("i8", offset, graph.multiply("i8", start, stride))
    first = memory.places[tuple(slice(0, n) for n in sizes)]
    if not isinstance(offset, Node):
        return Memory(dtype, first + offset)
    lane = None if offset.lanes else lane_of([], tuple(sizes))
    if lane is None:
        flat = [self._dynamic(x, 0, offset, dtype, 0, memory) for x in first.ravel()]
        return self.cells(dtype, objects(flat, tuple(sizes)), None, 1)
    n = sizes[lane]
    kept = list(sizes)
    kept[lane] = 1
    columns = np.moveaxis(first, lane, -1).reshape(-1, n)
    flat = [
        self._dynamic(x[0], int(x[1] - x[0]), offset, dtype, n, memory)
        for x in columns
    ]
    return self.cells(dtype, objects(flat, tuple(kept)), lane, n)


def _dynamic(
    self: Evaluation, first: int, stride: int, offset: Node, dtype: str, n: int, of: Memory
) -> Node:
    """The number at a cell of `of` that is `offset` behind the first."""
    region, level, markers = self.cellar.readable(of.places)
    markers = (*markers, self.cellar.marker(region, level))
    extra = int(first), stride
    return self.graph.node("dynamic", dtype, (offset, *markers), extra, lanes=n)


Evaluation._dynamic = _dynamic  # type: ignore


def _dynamic_slice(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    x, *starts = values
    sizes = eqn.params["slice_sizes"]
    numbers = [
        _clamped(self, _whole_number(self, self.cellar.unlaned(s).item(), dtype_of(s)), n - k)
        for s, n, k in zip(starts, x.shape, sizes, strict=True)
    ]
    return [_at_computed(self, x, numbers, sizes)]


def _dynamic_update_slice(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    x, update, *starts = values
    graph, dtype = self.graph, dtype_of(x)
    if math.prod(update.shape) == 0:
        return [x]
    numbers = [
        _clamped(self, _whole_number(self, self.cellar.unlaned(s).item(), dtype_of(s)), n - k)
        for s, n, k in zip(starts, x.shape, update.shape, strict=True)
    ]
    if not any(isinstance(k, Node) for k in numbers):
        flat = np.arange(math.prod(x.shape)).reshape(x.shape)
        at = tuple(slice(k, k + n) for k, n in zip(numbers, update.shape, strict=True))
        flat[at] = flat.size + np.arange(math.prod(update.shape)).reshape(update.shape)
        firsts = np.array([0, math.prod(x.shape), math.prod(x.shape) + math.prod(update.shape)])
        return [self.taken([x, update], firsts, flat, dtype)]
    moving = [k for k, number in enumerate(numbers) if isinstance(number, Node)]
    out = x
    wide = [update.shape[k] for k in moving]
    if math.prod(wide) > 64:
        raise Unsupported("a slice that is written to computed places")
    for within in np.ndindex(*wide):
        # One place along each computed axis; the others are known.
        index = [slice(None)] * len(x.shape)
        at = [slice(k, k + n) if not isinstance(k, Node) else slice(None)
              for k, n in zip(numbers, update.shape, strict=True)]
        for axis, k in zip(moving, within, strict=True):
            index[axis] = slice(k, k + 1)
        part = self._subarray(update, tuple(index))
        target = list(x.shape)
        for axis, k in enumerate(numbers):
            if axis not in moving:
                target[axis] = update.shape[axis]
        spread = self.move(
            jax.lax.broadcast_in_dim_p,
            [part],
            dict(
                shape=tuple(target),
                broadcast_dimensions=tuple(range(len(target))),
                sharding=None,
            ),
        )[0]
        masks = []
        for axis, k in zip(moving, within, strict=True):
            place = np.arange(x.shape[axis]).reshape(
                [-1 if j == axis else 1 for j in range(len(target))]
            )
            masks.append(np.broadcast_to(place - k, tuple(target)))
        starts_here = [numbers[axis] for axis in moving]

        def rule(old, new, *places, starts_here=starts_here):
            on: Number = True
            for start, place in zip(starts_here, places, strict=True):
                on = graph.op("and", "b1", (on, graph.compare("eq", "i8", start, place)))
            return graph.select(dtype, on, new, old)

        old = self._subarray(out, tuple(at))
        new = self.map(rule, [old, spread, *masks], tuple(target), dtype)
        out = new if tuple(target) == x.shape else self._replaced(out, new, tuple(at))
    return [out]


def _subarray(self: Evaluation, value: Value, index: Any) -> Value:
    numbers = np.arange(math.prod(value.shape)).reshape(value.shape)[index]
    if isinstance(value, np.ndarray):
        return value[index]
    firsts = np.array([0, math.prod(value.shape)])
    return self.taken([value], firsts, numbers, dtype_of(value))


def _replaced(self: Evaluation, value: Value, part: Value, index: Any) -> Value:
    size = math.prod(value.shape)
    numbers = np.arange(size).reshape(value.shape)
    numbers[index] = size + np.arange(math.prod(part.shape)).reshape(part.shape)
    firsts = np.array([0, size, size + math.prod(part.shape)])
    return self.taken([value, part], firsts, numbers, dtype_of(value))


Evaluation._subarray = _subarray  # type: ignore
Evaluation._replaced = _replaced  # type: ignore


def _gather(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    x, indices = values
    params, dtype, out = eqn.params, dtype_of(x), eqn.outvars[0].aval
    if isinstance(indices, np.ndarray) and is_inside(x, indices, **_shape_only(params)):
        return self.move_from(eqn.primitive, x, indices, params)
    numbers, sizes, graph = params["dimension_numbers"], params["slice_sizes"], self.graph
    joint = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    kept = [axis for axis in range(len(x.shape)) if axis not in joint]
    if out.size == 0:
        return [np.zeros(out.shape, out.dtype)]
    memory = self.cellar.contiguous(x)
    strides = np.cumprod([1, *x.shape[:0:-1]])[::-1].tolist()
    before, of = indices.shape[:-1], dtype_of(indices)
    first: Value = np.zeros(before, np.int64)
    inside: Value = np.ones(before, bool)
    fills = jax.lax.GatherScatterMode.from_any(params["mode"]) == _FILLS
    for axis, along in zip(
        numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True
    ):
        shape = [-1 if k == along else 1 for k in range(len(before))]
        first = first + strides[axis] * np.arange(x.shape[axis]).reshape(shape)
    for column, axis in enumerate(numbers.start_index_map):
        own = self._subarray(indices, (..., slice(column, column + 1)))
        own, high = self._reshaped(own, before), x.shape[axis] - sizes[axis]

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
    start = int(memory.places.ravel()[0])
    filling = _filling(params, dtype)

    def taken(first, within, on):
        offset = graph.add("i8", first, within)
        if isinstance(offset, Node):
            found = self._dynamic(start, 0, offset, dtype, 0, memory)
        else:
            found = self.cellar.number_at(start + offset, dtype)
        return graph.select(dtype, on, found, filling) if fills else found

    parts = [spread(first, others), spread(window, tuple(numbers.offset_dims))]
    return [self.map(taken, [*parts, spread(inside, others)], out.shape, dtype)]


_FILLS = jax.lax.GatherScatterMode.FILL_OR_DROP


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


def _shape_only(params: Any) -> Any:
    return dict(
        dimension_numbers=params["dimension_numbers"], slice_sizes=params["slice_sizes"]
    )


def _reshaped(self: Evaluation, value: Value, shape: tuple[int, ...]) -> Value:
    if isinstance(value, np.ndarray):
        return value.reshape(shape)
    if isinstance(value, Memory):
        return Memory(value.dtype, value.places.reshape(shape))
    numbers = np.arange(math.prod(value.shape)).reshape(shape)
    firsts = np.array([0, math.prod(value.shape)])
    return self.taken([value], firsts, numbers, value.dtype)


Evaluation._reshaped = _reshaped  # type: ignore


def _move_from(self: Evaluation, primitive, x, indices, params) -> list[Value]:
    """A move to places that are known."""
    numbers = np.arange(math.prod(x.shape)).reshape(x.shape)
    (out,) = moved(primitive, [numbers, indices], params)
    firsts = np.array([0, numbers.size])
    return [self.taken([x], firsts, np.asarray(out), dtype_of(x))]


Evaluation.move_from = _move_from  # type: ignore


def _scatter(self: Evaluation, eqn: Any, values: list[Value]) -> list[Value]:
    operand, index, updates = values
    dtype, adds = dtype_of(operand), eqn.primitive.name == "scatter-add"
    if eqn.params.get("update_jaxpr") is not None and not adds:
        pass
    size, count = math.prod(operand.shape), math.prod(updates.shape)
    if count == 0:
        return [operand]
    if not isinstance(index, np.ndarray):
        return [_scattered_to_computed(self, eqn, values)]
    places = _places_of_updates(operand.shape, index, updates.shape, eqn.params)
    if not adds:
        source, falls = np.arange(size), places >= 0
        source[places[falls]] = size + np.flatnonzero(falls)
        firsts = np.array([0, size, size + count])
        numbers = source.reshape(operand.shape)
        return [self.taken([operand, updates], firsts, numbers, dtype)]
    return [_added(self, operand, updates, places, dtype)]


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


def _added(self: Evaluation, operand, updates, places, dtype) -> Value:
    """Updates added to known places."""
    size, count = math.prod(operand.shape), math.prod(updates.shape)
    order = np.argsort(places, kind="stable")
    order = order[places[order] >= 0]
    to = places[order]
    before = np.arange(to.size) - np.searchsorted(to, to)
    repeats = int(before.max(initial=-1)) + 1
    zero = np.zeros((1,), dtype)
    firsts = np.array([0, count, count + 1])
    # The few places with many updates, such as a body that all others are attached to, are
    # added up by themselves: passes over all places would be many.
    often = np.unique(to[before >= 8]) if repeats > 8 else to[:0]
    is_often = np.isin(to, often)
    out = operand
    if often.size:
        sums = []
        for place in often:
            own = self.taken([updates, zero], firsts, order[to == place], dtype)
            sums.append(self._reshaped(self.reduced_known("add", own, (0,)), (1,)))
        sums.append(zero)
        total = self.move(jax.lax.concatenate_p, sums, dict(dimension=0))[0]
        numbers = np.full(size, often.size)
        numbers[often] = np.arange(often.size)
        spread = self.taken(
            [total], np.array([0, often.size + 1]), numbers.reshape(operand.shape), dtype
        )
        out = _sum(self, out, spread, dtype)
    before, to, order = (x[~is_often] for x in (before, to, order))
    for k in range(int(before.max(initial=-1)) + 1):
        numbers = np.full(size, count)
        numbers[to[before == k]] = order[before == k]
        row = self.taken([updates, zero], firsts, numbers.reshape(operand.shape), dtype)
        out = _sum(self, out, row, dtype)
    return out


def _sum(self: Evaluation, a: Value, b: Value, dtype: str) -> Value:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a + b
    if isinstance(a, np.ndarray) and not np.any(a):
        return b
    return self.map(lambda x, y: self.graph.add(dtype, x, y), [a, b], a.shape, dtype)


def _reduced_known(self: Evaluation, op: str, value: Value, axes: Any) -> Value:
    if isinstance(value, np.ndarray):
        join = {"add": np.sum, "mul": np.prod, "max": np.max, "min": np.min}[op]
        return np.asarray(join(value, axis=axes), value.dtype)
    return self.reduced(op, value, axes)


Evaluation.reduced_known = _reduced_known  # type: ignore


def _scattered_to_computed(self: Evaluation, eqn: Any, values: list[Value]) -> Value:
    """Updates at computed places: every place asks whether an update is its own."""
    operand, index, updates = values
    params, graph, dtype = eqn.params, self.graph, dtype_of(operand)
    dims = params["dimension_numbers"]
    adds = eqn.primitive.name == "scatter-add"
    if dims.operand_batching_dims:
        raise Unsupported("a scatter with batch axes at computed places")
    rows = index.shape[:-1]
    count = math.prod(rows)
    size = math.prod(operand.shape)
    kept = [k for k in range(len(operand.shape)) if k not in dims.inserted_window_dims]
    window = [updates.shape[k] for k in dims.update_window_dims]
    mapped = dims.scatter_dims_to_operand_dims
    if count * size > 8 * MOST_CELLS or any(
        window[kept.index(axis)] != 1 for axis in mapped if axis in kept
    ):
        raise Unsupported("a scatter to computed places")
    batch = [k for k in range(len(updates.shape)) if k not in dims.update_window_dims]
    turned = self.move(
        jax.lax.transpose_p,
        [updates],
        dict(permutation=(*batch, *dims.update_window_dims)),
    )[0]
    turned = self._reshaped(turned, (count, *window))
    starts = self.cellar.unlaned(index).reshape(count, -1)
    of, out = dtype_of(index), operand
    clips = params["mode"] == jax.lax.GatherScatterMode.CLIP
    for k in range(count):
        part = self._subarray(turned, (slice(k, k + 1),))
        full = [1 if a in dims.inserted_window_dims else window[kept.index(a)]
                for a in range(len(operand.shape))]
        if any(n not in (1, m) for n, m in zip(full, operand.shape, strict=True)):
            raise Unsupported("a scatter of windows to computed places")
        part = self._reshaped(part, tuple(full))
        part = self.move(
            jax.lax.broadcast_in_dim_p,
            [part],
            dict(
                shape=operand.shape,
                broadcast_dimensions=tuple(range(len(full))),
                sharding=None,
            ),
        )[0]
        masks, numbers = [], []
        for axis, entry in zip(mapped, starts[k].tolist(), strict=True):
            entry = _whole_number(self, entry, of)
            if clips:
                entry = _clamped(self, entry, operand.shape[axis] - 1)
            numbers.append(entry)
            place = np.arange(operand.shape[axis]).reshape(
                [-1 if j == axis else 1 for j in range(len(full))]
            )
            masks.append(np.broadcast_to(place, operand.shape))

        def rule(old, new, *places, numbers=numbers):
            on: Number = True
            for number, place in zip(numbers, places, strict=True):
                on = graph.op("and", "b1", (on, graph.compare("eq", "i8", number, place)))
            new = graph.add(dtype, old, new) if adds else new
            return graph.select(dtype, on, new, old)

        out = self.map(rule, [out, part, *masks], operand.shape, dtype)
    return out


_RULES: dict[str, Callable[[Evaluation, Any, list[Value]], list[Value]]] = {
    **dict.fromkeys(_OPS, _reduction),
    **dict.fromkeys("cumsum cumprod cummax cummin".split(), _running),
    **dict.fromkeys(("argmax", "argmin"), _extreme_place),
    **dict.fromkeys(("scatter", "scatter-add"), _scatter),
    **dict.fromkeys(FACTORS, _factors),
    "dot_general": _contraction,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "iota": _iota,
    LINEAR_SOLVE: _linear_solve,
}
