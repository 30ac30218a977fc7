"""Programs of JAX evaluated entry by entry."""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from ..jaxprs import has_numbers, interpret, solution_program, wrapped_program
from ..numpy_primitives import as_rows, evaluated, is_inside, moved
from ..one_function.possible import FACTORS, NAME
from ..one_function.rewriting import places_of_updates
from ..one_function.small_matrices import in_plain_operations, is_small
from ..primitives import (
    COMPONENTS,
    CONTRACTION,
    DATA_MOVEMENT,
    ELEMENTWISE,
    LINEAR_SOLVE,
    PLACES_OF_EXTREMES,
    SCATTERS,
)
from .entries import (
    array_of,
    Entry,
    Graph,
    Number,
    objects,
    Region,
    scalar,
    UnsupportedError,
)
from .loops import LOOPS, Stack


# The number of places up to which an entry at a place that differs from lane to lane is
# chosen among all of them.
_FEW = 8

_SAME = frozenset(
    "copy copy_p name optimization_barrier stop_gradient xla_metadata_value".split()
)
_OF_PAIRS = {
    "reduce_sum": lax.add_p,
    "reduce_prod": lax.mul_p,
    "reduce_max": lax.max_p,
    "reduce_min": lax.min_p,
    "reduce_and": lax.and_p,
    "reduce_or": lax.or_p,
}
_RUNNING = {
    "cumsum": lax.add_p,
    "cumprod": lax.mul_p,
    "cummax": lax.max_p,
    "cummin": lax.min_p,
}


class Evaluation:
    """Evaluates programs; their values are arrays of numbers, plain where all are known.

    `mask` says which lanes are active in the loop that is evaluated.
    """

    def __init__(self, graph: Graph, region: Region, mask: Number = np.True_):
        self.graph, self.region, self.mask = graph, region, mask

    def within(self, region: Region, mask: Number) -> "Evaluation":
        """The evaluation of the body of a loop."""
        return Evaluation(self.graph, region, mask)

    def outputs(self, jaxpr: Any, values: list[Any]) -> list[np.ndarray]:
        """The outputs of a program whose constants are the first values."""
        count = len(jaxpr.constvars)
        out = interpret(jaxpr, values[:count], values[count:], self._equation)
        return list(map(np.asarray, out))

    def closed(self, closed: Any, values: list[Any]) -> list[np.ndarray]:
        return self.outputs(closed.jaxpr, [*map(_plain, closed.consts), *values])

    def _equation(self, eqn: Any, values: list[Any]) -> list[Any]:
        name, params = eqn.primitive.name, eqn.params
        if name in _SAME:
            return list(values)
        inner = wrapped_program(eqn)
        if inner is not None:
            return self.outputs(inner[0], [*map(_plain, inner[1]), *values])
        if name == NAME:
            return self.outputs(params["program"].jaxpr, values)
        if name == "custom_vmap_call":
            return self.closed(params["call"], values)
        if name == LINEAR_SOLVE:
            return self.closed(*solution_program(values, params))
        if any(isinstance(x.flat[0], Stack) for x in values if _is_unknown(x) and x.size):
            raise UnsupportedError(f"{name} of all passes of a loop")
        if name in LOOPS:
            return LOOPS[name](self, values, params)
        if eqn.effects or not all(has_numbers(x.aval) for x in eqn.outvars):
            raise UnsupportedError(name)
        if all(x.dtype != object for x in map(np.asarray, values)):
            with jax.ensure_compile_time_eval():
                return list(map(np.asarray, evaluated(eqn.primitive, values, params)))
        if any(not _is_plain(x.aval) for x in eqn.outvars):
            raise UnsupportedError(name)
        return self._entries(eqn, values)

    def _entries(self, eqn: Any, values: list[Any]) -> list[np.ndarray]:
        name, params, primitive = eqn.primitive.name, eqn.params, eqn.primitive
        avals = [x.aval for x in eqn.outvars]
        if name in ELEMENTWISE - COMPONENTS:
            return [self._elementwise(primitive, values, params, avals[0])]
        if name in _OF_PAIRS:
            return [self._reduced(_OF_PAIRS[name], values[0], params["axes"], avals[0])]
        if name in FACTORS and is_small(eqn):
            plain = lambda *values: in_plain_operations(name, list(values), params)
            like = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in eqn.invars]
            return self.closed(jax.make_jaxpr(plain)(*like), values)
        if name in _RUNNING:
            return [self._running(_RUNNING[name], values[0], params, avals[0])]
        if name == CONTRACTION:
            return [self._contracted(values, params["dimension_numbers"], avals[0])]
        if name in PLACES_OF_EXTREMES:
            return [self._place(name, values[0], params["axes"], avals[0])]
        if name in SCATTERS:
            return [self._scattered(name, values, params, avals[0])]
        if name == "dynamic_slice" and any(_is_unknown(x) for x in values[1:]):
            return [self._chosen_slice(values, params, avals[0])]
        if name == "gather" and _is_unknown(values[1]):
            return [self._chosen_places(primitive, values, params, avals[0])]
        if name == "dynamic_update_slice":
            return [_updated(*values, aval=avals[0])]
        if name in DATA_MOVEMENT and name != "tile":
            return self._moved(primitive, values, params, avals)
        raise UnsupportedError(name)

    def _elementwise(
        self, primitive: Any, values: list[Any], params: Any, aval: Any
    ) -> Any:
        columns = [np.broadcast_to(objects(x), aval.shape).ravel() for x in values]
        number = lambda *xs: self.graph.number(primitive, xs, params, aval.dtype)
        return array_of(map(number, *columns), aval.shape, aval.dtype)

    def _reduced(self, primitive: Any, x: Any, axes: tuple[int, ...], aval: Any) -> Any:
        x = objects(x)
        kept = [k for k in range(x.ndim) if k not in axes]
        rows = np.transpose(x, (*kept, *axes)).reshape(aval.size, -1)
        if rows.shape[1] == 0:
            raise UnsupportedError("a reduction of nothing")
        pair = lambda a, b: self.graph.number(primitive, (a, b), {}, aval.dtype)
        return array_of(
            (functools.reduce(pair, row) for row in rows), aval.shape, aval.dtype
        )

    def _running(self, primitive: Any, x: Any, params: Any, aval: Any) -> np.ndarray:
        x = np.moveaxis(objects(x), params["axis"], -1)
        turn = slice(None, None, -1 if params["reverse"] else 1)
        pair = lambda a, b: self.graph.number(primitive, (a, b), {}, aval.dtype)
        rows = x.reshape(-1, x.shape[-1])[:, turn] if x.size else ()
        entries = [list(itertools.accumulate(row, pair))[turn] for row in rows]
        flat = array_of(itertools.chain(*entries), x.shape, aval.dtype)
        return np.moveaxis(flat, -1, params["axis"])

    def _contracted(self, values: list[Any], numbers: Any, aval: Any) -> np.ndarray:
        contracted, batch = numbers
        left, right = (
            as_rows(objects(x), *axes)
            for x, axes in zip(values, zip(contracted, batch, strict=True), strict=True)
        )
        zero = np.dtype(aval.dtype).type(0)

        def product(row: np.ndarray, column: np.ndarray) -> Number:
            terms = itertools.starmap(self.graph.multiply, zip(row, column, strict=True))
            return functools.reduce(self.graph.add, terms, zero)

        pairs = (
            product(row, column)
            for rows, columns in zip(left, right, strict=True)
            for row in rows
            for column in columns
        )
        return array_of(pairs, aval.shape, aval.dtype)

    def _place(self, name: str, x: Any, axes: tuple[int, ...], aval: Any) -> np.ndarray:
        """The first place of the largest or smallest entry along an axis."""
        if len(axes) != 1 or np.issubdtype(objects(x).flat[0].dtype, np.inexact):
            raise UnsupportedError(name)
        compare = lax.gt_p if name == "argmax" else lax.lt_p
        kind, graph = np.dtype(aval.dtype).type, self.graph

        def place(row: np.ndarray) -> Number:
            best, at = row[0], kind(0)
            for k, new in enumerate(row[1:], 1):
                better = graph.number(compare, (new, best), {}, np.bool_)
                best = graph.chosen(better, best, new)
                at = graph.chosen(better, at, kind(k))
            return at

        rows = np.moveaxis(objects(x), axes[0], -1).reshape(aval.size, -1)
        return array_of(map(place, rows), aval.shape, aval.dtype)

    def _scattered(
        self, name: str, values: list[Any], params: Any, aval: Any
    ) -> np.ndarray:
        operand, index, updates = values
        if _is_unknown(index):
            raise UnsupportedError(name)
        operand, updates = objects(operand), objects(updates)
        out = list(operand.ravel())
        to = places_of_updates(operand.shape, np.asarray(index), updates.shape, params)
        for place, update in zip(to, updates.ravel(), strict=True):
            if place >= 0:
                adds = name != "scatter"
                out[place] = self.graph.add(out[place], update) if adds else update
        return array_of(out, aval.shape, aval.dtype)

    def _chosen_slice(self, values: list[Any], params: Any, aval: Any) -> np.ndarray:
        """A slice from a place that differs from lane to lane."""
        x, *starts = values
        x, sizes = objects(x), params["slice_sizes"]
        rooms = [n - size + 1 for n, size in zip(x.shape, sizes, strict=True)]
        moving = [k for k, start in enumerate(starts) if _is_unknown(start)]
        axis = next((k for k in moving if rooms[k] > 1), moving[0])
        if any(rooms[k] > (_FEW if k == axis else 1) for k in moving):
            raise UnsupportedError("dynamic_slice")
        for k, start in enumerate(starts):
            if k not in moving:
                first = int(np.clip(start, 0, rooms[k] - 1))
                x = np.take(x, range(first, first + sizes[k]), k)
        (start,) = objects(starts[axis]).ravel()
        part = lambda k: np.take(x, range(k, k + sizes[axis]), axis).ravel()
        out = list(part(0))
        for k in range(1, rooms[axis]):
            least = scalar(k, start.dtype)
            beyond = self.graph.number(lax.ge_p, (start, least), {}, np.bool_)
            choose = lambda old, new, beyond=beyond: self.graph.chosen(beyond, old, new)
            out = list(map(choose, out, part(k)))
        return array_of(out, aval.shape, aval.dtype)

    def _chosen_places(
        self, primitive: Any, values: list[Any], params: Any, aval: Any
    ) -> np.ndarray:
        """A gather of places of which one coordinate differs from lane to lane."""
        x, index = map(objects, values)
        numbers, graph = params["dimension_numbers"], self.graph
        unknown = np.vectorize(lambda k: isinstance(k, Entry), otypes=[bool])(index)
        columns = np.flatnonzero(unknown.reshape(-1, index.shape[-1]).any(axis=0))
        if len(columns) != 1:
            raise UnsupportedError("gather")
        (column,) = columns
        axis = numbers.start_index_map[column]
        room = x.shape[axis] - params["slice_sizes"][axis] + 1
        if room > _FEW:
            raise UnsupportedError("gather")
        fills = params["mode"] == lax.GatherScatterMode.FILL_OR_DROP
        inner = [k for k in range(len(aval.shape)) if k in numbers.offset_dims]
        place = np.broadcast_to(np.expand_dims(index[..., column], inner), aval.shape)
        place, kind = objects(place).ravel(), index.ravel()[0].dtype.type
        out = [_missing(params, aval.dtype)] * aval.size if fills else None
        for k in range(room):
            known = np.array(index)
            known[..., column] = k
            (taken,) = _gathered(primitive, [x, known.astype(int)], params)
            taken = list(np.ravel(taken))
            compare = lax.eq_p if fills else lax.ge_p
            is_it = (graph.number(compare, (y, kind(k)), {}, np.bool_) for y in place)
            choices = zip(is_it, out or taken, taken, strict=True)
            out = list(itertools.starmap(graph.chosen, choices))
        return array_of(out or [], aval.shape, aval.dtype)

    def _moved(self, primitive: Any, values: list[Any], params: Any, avals: Any) -> Any:
        indices = DATA_MOVEMENT[primitive.name] == (0,)
        if indices and any(map(_is_unknown, values[1:])):
            raise UnsupportedError(primitive.name)
        own = [*map(objects, values[:1]), *values[1:]] if indices else map(objects, values)
        move = _gathered if primitive.name == "gather" else moved
        out = move(primitive, list(own), params)
        return [
            array_of(np.ravel(x), aval.shape, aval.dtype)
            for x, aval in zip(out, avals, strict=True)
        ]


def _gathered(primitive: Any, values: list[Any], params: dict[str, Any]) -> list[Any]:
    if not is_inside(*values, **params):
        raise UnsupportedError("gather outside of an array")
    return moved(primitive, values, params)


def _missing(params: dict[str, Any], dtype: Any) -> np.generic:
    """What a gather returns for places outside of an array; see `jax.lax.gather`."""
    value = params["fill_value"]
    if value is None and np.issubdtype(dtype, np.signedinteger):
        value = np.iinfo(dtype).min
    elif value is None and np.issubdtype(dtype, np.unsignedinteger):
        value = np.iinfo(dtype).max
    elif value is None:
        value = True if np.dtype(dtype).kind == "b" else np.nan
    return scalar(value, dtype)


def _plain(x: Any) -> Any:
    """A constant of a program; constants that are traced are inputs of the program."""
    if isinstance(x, Tracer) or not has_numbers(x):
        raise UnsupportedError("a traced constant, or a random key")
    return np.asarray(x)


def _is_plain(aval: Any) -> bool:
    kind = aval.dtype
    return jnp.issubdtype(kind, jnp.floating) or getattr(kind, "kind", "key") in "iub"


def _is_unknown(x: Any) -> bool:
    return np.asarray(x).dtype == object


def _updated(x: Any, update: Any, *starts: Any, aval: Any) -> np.ndarray:
    if any(map(_is_unknown, starts)):
        raise UnsupportedError("dynamic_update_slice")
    x, update = objects(x).copy(), objects(update)
    ends = zip(starts, update.shape, x.shape, strict=True)
    first = [(int(np.clip(at, 0, n - size)), size) for at, size, n in ends]
    x[tuple(slice(at, at + size) for at, size in first)] = update
    return array_of(x.ravel(), aval.shape, aval.dtype)
