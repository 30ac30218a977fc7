"""The scalar operations of a program, as a graph.

A node stands for one number, or for one number of each of `n` lanes (the entries of an
array along its longest axis). A number that is known while the program is traced is a
Python number instead, and operations with zeros, ones and known numbers are left out. So is
a product with zero whose other factor might be infinite or NaN: what multiplies a
structural zero has no influence. Equal operations on equal operands are one node.
"""

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np


# These are no operations of a kernel, but read by each that needs them.
NOT_COMPUTED = frozenset(("lane", "load", "marker"))


class Region:
    """A part of a program that is run as a whole: a body, a branch, or what is around.

    - `floor`: the outermost region to which operations are moved that do not depend on
      anything in this one. A branch keeps its operations: it may not be taken.
    - `is_wide`: whether it is run for several passes of a loop at a time.
    - `mask`: the cell that tells which of these passes are active; `None` if all are.
    - `nodes`, `items`: its operations, and its loops and branches.
    """

    def __init__(
        self,
        parent: "Region | None" = None,
        is_branch: bool = False,
        is_wide: bool = False,
        mask: int | None = None,
    ):
        self.parent = parent
        self.is_wide: bool = is_wide or (parent is not None and parent.is_wide)
        self.mask: int | None = mask
        if mask is None and parent is not None:
            self.mask = parent.mask
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.floor: Region = self if parent is None or is_branch else parent.floor
        self.nodes: list[Node] = []
        self.items: list[Any] = []
        self.found: dict[Any, Node] = {}

    def last_level(self) -> int:
        levels = [x.level for x in self.nodes] + [x.level for x in self.items]
        return max(levels, default=0)


class Node:
    """An operation.

    - `op`, `operands`, `extra`: what it does; see `emission.py` for the operations.
    - `dtype`: the type of its result, such as `"f8"`.
    - `lanes`: the number of lanes; 0 for a single number.
    - `is_reduced`: whether the result is a single number, computed from all lanes.
    - `region`, `level`: it runs in the kernel of its region with this level: after those of
      lower levels, which have written what it reads.
    - `place`: the cell of the memory where the result is stored (of the first lane), if it
      is read by other kernels.
    """

    __slots__ = (
        "dtype",
        "extra",
        "is_reduced",
        "lanes",
        "level",
        "number",
        "op",
        "operands",
        "place",
        "region",
    )

    def __init__(
        self,
        op: str,
        dtype: str,
        operands: tuple["Number", ...],
        extra: Any,
        lanes: int,
        region: Region,
        level: int,
        number: int,
        is_reduced: bool = False,
    ):
        self.op, self.dtype, self.operands, self.extra = op, dtype, operands, extra
        self.lanes, self.region, self.level, self.number = lanes, region, level, number
        self.is_reduced = is_reduced
        self.place: int | None = None

    @property
    def ready(self) -> int:
        """The level from which kernels of lanes can read the result from the memory."""
        return self.level + 1 if self.lanes else self.level


Number: TypeAlias = Node | float | int | bool


class Graph:
    """Creates nodes in the region `current`."""

    def __init__(self):
        self.root = Region()
        self.current = self.root
        self.count = 0

    def op(
        self, op: str, dtype: str, operands: tuple[Number, ...], extra: Any = None
    ) -> Number:
        """The result of an operation on numbers."""
        if not any(isinstance(x, Node) for x in operands):
            return _folded(op, dtype, operands, extra)
        simplify = _SIMPLER.get(op)
        if simplify is not None:
            simple = simplify(self, dtype, operands, extra)
            if simple is not None:
                return simple
        return self.node(op, dtype, operands, extra)

    def node(
        self,
        op: str,
        dtype: str,
        operands: tuple[Number, ...],
        extra: Any = None,
        lanes: int = 0,
        is_reduced: bool = False,
    ) -> Node:
        region = self.current.floor
        for x in operands:
            if isinstance(x, Node):
                if x.region.depth > region.depth:
                    region = x.region
                if x.lanes and not x.is_reduced:
                    lanes = x.lanes
        level = 0
        for x in operands:
            if isinstance(x, Node) and x.region is region:
                level = max(level, x.level + 1 if x.is_reduced else x.level)
        return self.at(region, level, op, dtype, operands, extra, lanes, is_reduced)

    def at(
        self,
        region: Region,
        level: int,
        op: str,
        dtype: str,
        operands: tuple[Number, ...] = (),
        extra: Any = None,
        lanes: int = 0,
        is_reduced: bool = False,
    ) -> Node:
        """A node of a region, not before a level."""
        key = op, dtype, tuple(map(_identity, operands)), extra, lanes, is_reduced
        found = region.found.get(key)
        # One may be found that uses fewer of its cells, and does not wait for the others.
        if found is None or found.level < level:
            self.count += 1
            found = Node(
                op, dtype, operands, extra, lanes, region, level, self.count, is_reduced
            )
            region.found[key] = found
            region.nodes.append(found)
        return found

    # Operations by name -------------------------------------------------------------------

    def add(self, dtype: str, a: Number, b: Number) -> Number:
        return self.op("add", dtype, (a, b))

    def multiply(self, dtype: str, a: Number, b: Number) -> Number:
        return self.op("mul", dtype, (a, b))

    def compare(self, how: str, of: str, a: Number, b: Number) -> Number:
        return self.op("cmp", "b1", (a, b), (how, of))

    def select(self, dtype: str, which: Number, a: Number, b: Number) -> Number:
        """`a` where `which` holds, else `b`."""
        return self.op("select", dtype, (which, a, b))

    def reduce(self, op: str, dtype: str, x: Node) -> Number:
        """The numbers of all lanes, joined by an operation."""
        return self.node(f"reduce {op}", dtype, (x,), is_reduced=True)


def _identity(x: Number) -> Any:
    if isinstance(x, Node):
        return x.number
    # 0.0 and -0.0 are equal, NaN is not equal to itself.
    return (float.hex(x) if isinstance(x, float) else x), type(x).__name__


def same(a: Number, b: Number) -> bool:
    return a is b or _identity(a) == _identity(b)


# Known numbers ----------------------------------------------------------------------------


def number_type(dtype: str) -> type:
    kind = dtype[0]
    return float if kind == "f" else bool if kind == "b" else int


def _rem(a: Any, b: Any) -> Any:
    if isinstance(a, int):
        # The quotient is rounded towards zero.
        return a - b * _div(a, b) if b else a
    return np.fmod(a, b)


def _div(a: Any, b: Any) -> Any:
    if isinstance(a, int):
        if b == 0:
            return -1
        quotient = abs(a) // abs(b)
        return quotient if (a < 0) == (b < 0) else -quotient
    return np.divide(a, b)


def _shift_left(a: Any, b: Any, size: int) -> Any:
    return np.left_shift(a, b) if 0 <= b < size else a.dtype.type(0)


def _shift_right(a: Any, b: Any, size: int) -> Any:
    bits = a.view(f"u{size // 8}")
    shifted = bits >> bits.dtype.type(b) if 0 <= b < size else bits.dtype.type(0)
    return np.asarray(shifted).view(a.dtype)


def _shift_right_signed(a: Any, b: Any, size: int) -> Any:
    return np.right_shift(a, b if 0 <= b < size else size - 1)


_SHIFTS: dict[str, Callable[..., Any]] = {
    "shl": _shift_left,
    "lshr": _shift_right,
    "ashr": _shift_right_signed,
}
_COMPARE: dict[str, Callable[[Any, Any], Any]] = {
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "gt": lambda a, b: a > b,
    "ge": lambda a, b: a >= b,
}
_FOLD: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": _div,
    "rem": _rem,
    "neg": lambda a: -a,
    "abs": abs,
    "max": lambda a, b: np.maximum(a, b),
    "min": lambda a, b: np.minimum(a, b),
    "and": lambda a, b: a & b,
    "or": lambda a, b: a | b,
    "xor": lambda a, b: a ^ b,
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "rint": np.rint,
    "select": lambda which, a, b: a if which else b,
}
_CALLS: dict[str, Callable[..., Any]] = {
    "acos": np.arccos,
    "acosh": np.arccosh,
    "asin": np.arcsin,
    "asinh": np.arcsinh,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "atanh": np.arctanh,
    "cbrt": np.cbrt,
    "cos": np.cos,
    "cosh": np.cosh,
    "erf": np.vectorize(math.erf),
    "erfc": np.vectorize(math.erfc),
    "exp": np.exp,
    "exp2": np.exp2,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "nextafter": np.nextafter,
    "pow": np.power,
    "round": lambda x: np.sign(x) * np.floor(np.abs(x) + 0.5),
    "sin": np.sin,
    "sinh": np.sinh,
    "tan": np.tan,
    "tanh": np.tanh,
}
FUNCTIONS = frozenset(_CALLS)


def _folded(op: str, dtype: str, operands: tuple[Any, ...], extra: Any) -> Number:
    with np.errstate(all="ignore"):
        if op == "cmp":
            return bool(_COMPARE[extra[0]](*operands))
        if op == "convert":
            (x,) = operands
            return _converted(x, dtype)
        if op == "bits":
            (x,) = operands
            return as_number(np.array(x, extra).view(dtype), dtype)
        if op == "not":
            (x,) = operands
            return (not x) if dtype == "b1" else as_number(~x, dtype)
        if op == "call":
            values = (np.asarray(x, dtype) for x in operands)
            return as_number(_CALLS[extra](*values), dtype)
        if op in _SHIFTS:
            kind = np.dtype(dtype)
            size = 8 * kind.itemsize
            return as_number(
                _SHIFTS[op](*(np.array(x, kind) for x in operands), size), dtype
            )
        return as_number(_FOLD[op](*operands), dtype)


def _converted(x: Any, dtype: str) -> Number:
    """A number of another type; what does not fit is moved to the end of the range."""
    if dtype[0] in "iu" and isinstance(x, float):
        info = np.iinfo(dtype)
        if x != x:
            return 0
        return (
            int(min(max(x, float(info.min)), float(info.max)))
            if abs(x) < 1e18
            else (int(info.max) if x > 0 else int(info.min))
        )
    return as_number(x, dtype)


def as_number(x: Any, dtype: str) -> Number:
    """A number of Python, rounded to its type."""
    if dtype == "f4":
        return float(np.float32(x))
    kind = dtype[0]
    if kind not in "iu":
        return number_type(dtype)(x)
    size = 1 << (8 * int(dtype[1]))
    number = int(x) % size
    return number - size if kind == "i" and number >= size // 2 else number


# Simpler forms ----------------------------------------------------------------------------


def _is(x: Number, value: float) -> bool:
    return not isinstance(x, Node) and x == value


def _simpler_add(graph, dtype, operands, extra):
    a, b = operands
    if _is(a, 0):
        return b
    if _is(b, 0):
        return a
    if isinstance(b, Node) and b.op == "neg":
        return graph.op("sub", dtype, (a, b.operands[0]))
    if isinstance(a, Node) and a.op == "neg":
        return graph.op("sub", dtype, (b, a.operands[0]))
    return None


def _simpler_sub(graph, dtype, operands, extra):
    a, b = operands
    if _is(b, 0):
        return a
    if isinstance(b, Node) and b.op == "neg":
        return graph.op("add", dtype, (a, b.operands[0]))
    return None


def _simpler_mul(graph, dtype, operands, extra):
    a, b = operands
    if not isinstance(a, Node):
        a, b = b, a
    if _is(b, 0):
        return number_type(dtype)(0)
    if _is(b, 1):
        return a
    if _is(b, -1):
        return graph.op("neg", dtype, (a,))
    return None


def _simpler_div(graph, dtype, operands, extra):
    a, b = operands
    if _is(b, 1):
        return a
    if _is(a, 0):
        return number_type(dtype)(0)
    if not isinstance(b, Node) and dtype[0] == "f" and b:
        mantissa, _ = math.frexp(b)
        # The inverse of a power of two is exact.
        if abs(mantissa) == 0.5 and 1e-30 < abs(b) < 1e30:
            return graph.op("mul", dtype, (a, 1.0 / b))
    return None


def _simpler_neg(graph, dtype, operands, extra):
    (a,) = operands
    if a.op == "neg":
        return a.operands[0]
    return None


def _simpler_not(graph, dtype, operands, extra):
    (a,) = operands
    return a.operands[0] if a.op == "not" else None


def _simpler_logical(decisive: bool) -> Callable[..., Number | None]:
    """Of `and`, which one False decides, or of `or`, which one True decides."""

    def simpler(graph, dtype, operands, extra):
        a, b = operands
        if a is b:
            return a
        if dtype == "b1":
            for x, y in ((a, b), (b, a)):
                if not isinstance(x, Node):
                    return decisive if x == decisive else y
        return None

    return simpler


def _simpler_extreme(graph, dtype, operands, extra):
    a, b = operands
    return a if same(a, b) else None


def _simpler_select(graph, dtype, operands, extra):
    which, a, b = operands
    if not isinstance(which, Node):
        return a if which else b
    return a if same(a, b) else None


def _simpler_convert(graph, dtype, operands, extra):
    return operands[0] if dtype == extra else None


_SIMPLER: dict[str, Callable[[Graph, str, Any, Any], Number | None]] = {
    "add": _simpler_add,
    "and": _simpler_logical(False),
    "convert": _simpler_convert,
    "div": _simpler_div,
    "max": _simpler_extreme,
    "min": _simpler_extreme,
    "mul": _simpler_mul,
    "neg": _simpler_neg,
    "not": _simpler_not,
    "or": _simpler_logical(True),
    "select": _simpler_select,
    "sub": _simpler_sub,
}
