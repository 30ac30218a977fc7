"""The numbers of a program, one by one, as a graph of scalar operations.

An entry stands for one number of each lane. A number that is known while the program is
traced is a NumPy scalar instead, and operations with zeros, ones and known numbers are left
out, which removes most operations of a sparse system. So is a product with zero whose other
factor might be infinite or NaN: what multiplies a structural zero has no influence.
"""

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
from jax import lax

from ..compiled import is_hashable
from ..numpy_primitives import evaluated


# The most operations of a program that is evaluated entry by entry, which takes about 20
# microseconds for each.
_MOST = 100_000


class UnsupportedError(Exception):
    """A program that is not evaluated entry by entry: for an operation, or its size."""


class Region:
    """A program without loops but for those in `loops`, such as the body of a loop.

    Entries of a region depend on its inputs, on the results of its loops, and on entries of
    the regions around it.
    """

    def __init__(self, parent: "Region | None" = None):
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.loops: list[Any] = []


class Entry:
    """One number of each lane.

    - `primitive`, `params`, `operands`: how it is computed; `primitive` is `None` for an
      input of the region and for a result of a loop.
    - `region`: the innermost region on whose inputs and loops it depends.
    - `level`: the number of loops of the region that must have run before.
    """

    __slots__ = ("dtype", "level", "operands", "params", "primitive", "region")

    def __init__(
        self,
        dtype: Any,
        region: Region,
        level: int = 0,
        primitive: Any = None,
        params: dict[str, Any] | None = None,
        operands: tuple["Number", ...] = (),
    ):
        self.dtype, self.region, self.level = np.dtype(dtype), region, level
        self.primitive, self.params, self.operands = primitive, params or {}, operands


Number: TypeAlias = Entry | np.generic


def scalar(value: Any, dtype: Any) -> np.generic:
    """A known number."""
    return np.asarray(value).astype(dtype).reshape(1)[0]


class Graph:
    """Creates entries; equal operations on equal operands are one entry."""

    def __init__(self):
        self._found: dict[Any, Entry] = {}

    def number(
        self, primitive: Any, operands: Sequence[Number], params: dict[str, Any], dtype: Any
    ) -> Number:
        """The result of an operation on scalars."""
        if all(isinstance(x, np.generic) for x in operands):
            with jax.ensure_compile_time_eval():
                (value,) = evaluated(primitive, list(operands), params)
            return scalar(value, dtype)
        simplify = _SIMPLER.get(primitive.name)
        if simplify is not None:
            simple = simplify(self, operands, params, np.dtype(dtype))
            if simple is not None:
                return simple
        return self._entry(primitive, tuple(operands), params, dtype)

    def add(self, a: Number, b: Number) -> Number:
        return self.number(lax.add_p, (a, b), {}, a.dtype)

    def multiply(self, a: Number, b: Number) -> Number:
        return self.number(lax.mul_p, (a, b), {}, a.dtype)

    def negative(self, a: Number) -> Number:
        return self.number(lax.neg_p, (a,), {}, a.dtype)

    def both(self, a: Number, b: Number) -> Number:
        return self.number(lax.and_p, (a, b), {}, a.dtype)

    def chosen(self, which: Number, *cases: Number) -> Number:
        """The case with the number `which`."""
        return self.number(lax.select_n_p, (which, *cases), {}, cases[0].dtype)

    def _entry(
        self, primitive: Any, operands: tuple[Number, ...], params: Any, dtype: Any
    ) -> Entry:
        entries = [x for x in operands if isinstance(x, Entry)]
        region = max((x.region for x in entries), key=lambda region: region.depth)
        level = max(x.level for x in entries if x.region is region)
        key = primitive, tuple(params.items()), tuple(map(_identity, operands))
        if not is_hashable(key):
            return Entry(dtype, region, level, primitive, params, operands)
        if key not in self._found:
            if len(self._found) >= _MOST:
                raise UnsupportedError("too many operations")
            self._found[key] = Entry(dtype, region, level, primitive, params, operands)
        return self._found[key]


def is_same(a: Number, b: Number) -> bool:
    """Whether two numbers are known to be equal."""
    return _identity(a) == _identity(b)


def _identity(x: Number) -> Any:
    return (x.tobytes(), x.dtype) if isinstance(x, np.generic) else id(x)


# Simpler forms --------------------------------------------------------------------------


def _is(x: Number, value: float) -> bool:
    return isinstance(x, np.generic) and bool(x == value)


def _add(graph, operands, params, dtype):
    a, b = operands
    return b if _is(a, 0) else a if _is(b, 0) else None


def _sub(graph, operands, params, dtype):
    a, b = operands
    return a if _is(b, 0) else graph.negative(b) if _is(a, 0) else None


def _mul(graph, operands, params, dtype):
    a, b = operands
    if _is(a, 0) or _is(b, 0):
        return dtype.type(0)
    if _is(a, -1) or _is(b, -1):
        return graph.negative(b if _is(a, -1) else a)
    return b if _is(a, 1) else a if _is(b, 1) else None


def _div(graph, operands, params, dtype):
    a, b = operands
    if _is(b, 1) or _is(a, 0):
        return a if _is(b, 1) else dtype.type(0)
    if not np.issubdtype(dtype, np.inexact) or _is(a, 1):
        return None
    # Products with an inverse, which is shared by all that is divided by the same number,
    # and which is computed before a loop where the number is.
    one = dtype.type(1)
    return graph.multiply(a, graph.number(lax.div_p, (one, b), params, dtype))


def _inverse_of_itself(name, graph, operands, params, dtype):
    """An operation which, made twice, changes nothing."""
    (a,) = operands
    return a.operands[0] if getattr(a.primitive, "name", "") == name else None


def _logical(decides, graph, operands, params, dtype):
    """`and`, which one operand `False` decides, and `or`, which `True` decides."""
    a, b = operands
    if dtype.kind != "b":
        return None
    if _is(a, decides) or _is(b, decides):
        return np.bool_(decides)
    other = not decides
    return b if _is(a, other) or is_same(a, b) else a if _is(b, other) else None


def _extreme(graph, operands, params, dtype):
    a, b = operands
    return a if is_same(a, b) else None


def _select(graph, operands, params, dtype):
    which, *cases = operands
    if isinstance(which, np.generic):
        return cases[int(which)]
    return cases[0] if all(is_same(cases[0], x) for x in cases) else None


def _convert(graph, operands, params, dtype):
    (a,) = operands
    return a if a.dtype == dtype else None


def _power(graph, operands, params, dtype):
    (a,) = operands
    return graph.multiply(a, a) if params["y"] == 2 else a if params["y"] == 1 else None


def _square(graph, operands, params, dtype):
    return graph.multiply(*operands, *operands)


_SIMPLER: dict[str, Callable[[Graph, Any, dict[str, Any], Any], Number | None]] = {
    "add": _add,
    "add_any": _add,
    "and": functools.partial(_logical, False),
    "convert_element_type": _convert,
    "div": _div,
    "integer_pow": _power,
    "max": _extreme,
    "min": _extreme,
    "mul": _mul,
    "neg": functools.partial(_inverse_of_itself, "neg"),
    "not": functools.partial(_inverse_of_itself, "not"),
    "or": functools.partial(_logical, True),
    "select_n": _select,
    "square": _square,
    "sub": _sub,
}


# Arrays of numbers ----------------------------------------------------------------------


def objects(x: Any) -> np.ndarray:
    """An array of numbers, each of them an object."""
    x = np.asarray(x)
    if x.dtype == object:
        return x
    out = np.empty(x.shape, object)
    for place in itertools.product(*map(range, x.shape)):
        out[place] = x[place]
    return out


def array_of(numbers: Iterable[Number], shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array of numbers; a plain array if all of them are known."""
    numbers = list(numbers)
    if not any(isinstance(x, Entry) for x in numbers):
        return np.array(numbers, dtype).reshape(shape)
    out = np.empty(len(numbers), object)
    out[:] = numbers
    return out.reshape(shape)
