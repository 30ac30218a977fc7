"""The primitives of JAX that compute each entry by itself, as operations of the graph."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from .graph import as_number, FUNCTIONS, Graph, Number
from .values import Unsupported


# Called with the graph, the parameters of the equation, the type of the result, those of
# the operands, and the operands.
Rule: TypeAlias = Callable[..., Number]


def _plain(op: str) -> Rule:
    return lambda graph, params, dtype, of, *xs: graph.op(op, dtype, xs)


def _function(name: str) -> Rule:
    return lambda graph, params, dtype, of, *xs: graph.op("call", dtype, xs, name)


def _comparison(how: str) -> Rule:
    return lambda graph, params, dtype, of, a, b: graph.compare(how, of[0], a, b)


def _ordered(how: str) -> Rule:
    """The total order of sorting: -0 comes before 0, and NaN last, whatever its sign."""

    def rule(graph, params, dtype, of, a, b):
        of = of[0]
        plain = graph.compare(how, of, a, b)
        if of[0] != "f":
            return plain
        signs = [graph.op("div", of, (1.0, x)) for x in (a, b)]
        zeros = [graph.compare("eq", of, x, 0.0) for x in (a, b)]
        both = graph.op("and", "b1", tuple(zeros))
        plain = graph.select("b1", both, graph.compare(how, of, *signs), plain)
        first, last = (graph.compare("ne", of, x, x) for x in (a, b))
        less = (
            last
            if how == "le"
            else graph.op("and", "b1", (last, graph.op("not", "b1", (first,))))
        )
        return graph.op("or", "b1", (plain, less))

    return rule


def _abs(graph, params, dtype, of, x):
    return x if dtype[0] == "u" else graph.op("abs", dtype, (x,))


def _clamp(graph, params, dtype, of, low, x, high):
    return graph.op("min", dtype, (graph.op("max", dtype, (low, x)), high))


def _convert(graph, params, dtype, of, x):
    return graph.op("convert", dtype, (x,), of[0])


def _bits(graph, params, dtype, of, x):
    if np.dtype(dtype).itemsize != np.dtype(of[0]).itemsize:
        raise Unsupported("a cast of bits to a type of another size")
    return graph.op("bits", dtype, (x,), of[0])


def _integer_pow(graph, params, dtype, of, x):
    return _power(graph, dtype, x, params["y"])


def _power(graph: Graph, dtype: str, x: Number, exponent: int) -> Number:
    one = as_number(1, dtype)
    if exponent < 0:
        return graph.op("div", dtype, (one, _power(graph, dtype, x, -exponent)))
    if exponent == 0:
        return one
    half = _power(graph, dtype, x, exponent // 2) if exponent > 1 else one
    square = graph.multiply(dtype, half, half)
    return graph.multiply(dtype, square, x) if exponent % 2 else square


def _is_finite(graph, params, dtype, of, x):
    if of[0][0] != "f":
        return True
    size = graph.op("abs", of[0], (x,))
    return graph.compare("lt", of[0], size, float("inf"))


def _logistic(graph, params, dtype, of, x):
    negative = graph.op("neg", dtype, (x,))
    power = graph.op("call", dtype, (negative,), "exp")
    return graph.op("div", dtype, (1.0, graph.add(dtype, 1.0, power)))


def _pow(graph, params, dtype, of, x, y):
    if of[1][0] in "iu":
        y = graph.op("convert", dtype, (y,), of[1])
    return graph.op("call", dtype, (x, y), "pow")


def _rsqrt(graph, params, dtype, of, x):
    return graph.op("div", dtype, (1.0, graph.op("sqrt", dtype, (x,))))


def _round(graph, params, dtype, of, x):
    to_even = int(params["rounding_method"]) == 1
    if to_even:
        return graph.op("rint", dtype, (x,))
    return graph.op("call", dtype, (x,), "round")


def _select(graph, params, dtype, of, which, *cases):
    if of[0] == "b1":
        first, *rest = cases
        return graph.select(dtype, which, rest[0], first) if rest else first
    out = cases[-1]
    for k in range(len(cases) - 2, -1, -1):
        is_this = graph.compare("le", of[0], which, k)
        out = graph.select(dtype, is_this, cases[k], out)
    return out


def _sign(graph, params, dtype, of, x):
    zero, one = as_number(0, dtype), as_number(1, dtype)
    if dtype[0] == "u":
        return graph.select(dtype, graph.compare("gt", dtype, x, zero), one, zero)
    minus = as_number(-1, dtype)
    # Zero and NaN are their own signs.
    below = graph.select(dtype, graph.compare("lt", dtype, x, zero), minus, x)
    return graph.select(dtype, graph.compare("gt", dtype, x, zero), one, below)


def _square(graph, params, dtype, of, x):
    return graph.multiply(dtype, x, x)


def _logical(op: str) -> Rule:
    return lambda graph, params, dtype, of, *xs: graph.op(op, dtype, xs)


ELEMENTWISE: dict[str, Rule] = {
    **{name: _plain(name) for name in "add ceil div floor mul neg rem sqrt sub".split()},
    **{name: _plain(name) for name in "max min".split()},
    **{name: _function(name) for name in FUNCTIONS - {"round", "pow"}},
    **{name: _comparison(name) for name in "eq ge gt le lt ne".split()},
    **{f"{how}_to": _ordered(how) for how in ("le", "lt")},
    **{name: _logical(name) for name in "and not or xor".split()},
    "abs": _abs,
    "add_any": _plain("add"),
    "bitcast_convert_type": _bits,
    "clamp": _clamp,
    "convert_element_type": _convert,
    "integer_pow": _integer_pow,
    "is_finite": _is_finite,
    "logistic": _logistic,
    "pow": _pow,
    "round": _round,
    "rsqrt": _rsqrt,
    "select_n": _select,
    "shift_left": _plain("shl"),
    "shift_right_arithmetic": _plain("ashr"),
    "shift_right_logical": _plain("lshr"),
    "sign": _sign,
    "square": _square,
}
