"""One rule for each primitive: the table of the chain rule for difference quotients.

| primitives | increment of the output |
|---|---|
| linear and structural | the same operation on the increments |
| `mul`, `dot_general` | `du mean(v) + mean(u) dv` |
| `div` | `(du mean(v) - mean(u) dv) / (v_a v_b)` |
| elementary functions | their quotient in `elementary.py` times the increment |
| `pow` | of `exp(y log x)`; of `sqrt(x)**n` for a fixed half-integer power |
| `atan2` | angle turned, from the cross and dot products of the two points |
| `max`, `min`, `clamp` | from that of `abs` |
| comparisons, `select_n`, `cond` | exact where the choice is the same at both points; else the true difference quotient with respect to what decided |
| `reduce_prod` | telescoping product, in both orders |
| `cholesky`, `triangular_solve`, `custom_linear_solve`, `lu` | `linalg.py` |
| `scan` | the rule of its body, with the increment in the carry |
| `jit`, `custom_jvp`, `custom_vjp`, `remat` | of the program inside |
| all others | `fallback.py` |
"""  # noqa: E501

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import elementary, linalg, loops
from .transform import (
    at_a,
    at_b,
    evaluate,
    increment,
    moves,
    Moving,
    NoRule,
    Rule,
    Switching,
    Value,
)


def _both(values: list[Value], params: dict[str, Any]) -> list[tuple[Array, Array]]:
    """The outputs of a primitive at `a` and at `b`."""
    params = dict(params)
    primitive = params.pop("primitive")
    params.pop("walk")
    ends = [evaluate(primitive, list(map(at, values)), params) for at in (at_a, at_b)]
    return list(zip(*ends, strict=True))


def _linear(*positions: int) -> Rule:
    """Linear in the operands at `positions` together (in all, if none is named)."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        linear = positions or range(len(values))
        if any(moves(v) for k, v in enumerate(values) if k not in linear):
            raise NoRule
        params = dict(params)
        primitive = params.pop("primitive")
        params.pop("walk")

        def push(part: Callable[[Value], Array]) -> list[Array]:
            chosen = [part(v) if k in linear else v for k, v in enumerate(values)]
            return evaluate(primitive, chosen, params)

        ends = push(at_a), push(at_b)
        if not any(isinstance(v, Switching) for v in values):
            return list(map(Moving, *ends, push(increment)))
        # Choices that are only moved about take along what decided them.
        zero = lambda v: jnp.zeros(jnp.shape(v))
        squares = push(lambda v: v.squares if isinstance(v, Switching) else zero(v))
        decided = push(lambda v: v.decided if isinstance(v, Switching) else zero(v))
        return list(map(Switching, *ends, squares, decided))

    return rule


def _sum(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """Entry by entry: a sum of choices is decided by all of them."""
    choices = any(isinstance(v, Switching) for v in values)
    return _compare(values, params) if choices else _linear()(values, params)


def _unary(quotient: elementary.Quotient) -> Rule:
    """An elementary function of one operand."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        (x,) = values
        if not isinstance(x, Moving):
            raise NoRule
        ((a, b),) = _both(values, params)
        return [Moving(a, b, quotient(x.a, x.b) * x.d)]

    return rule


def _rewritten(function: Callable[..., Array]) -> Rule:
    """A function that is a composition of others with rules."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        if any(isinstance(v, Switching) for v in values):
            raise NoRule
        program = jax.make_jaxpr(function)(*map(at_a, values))
        (out,) = params["walk"].closed(program, values)
        ((a, b),) = _both(values, params)
        return [Moving(a, b, out.d)]

    return rule


def _product(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """Any bilinear operation: `mul` and `dot_general`."""
    if any(isinstance(v, Switching) for v in values):
        raise NoRule
    params = dict(params)
    primitive = params.pop("primitive")
    params.pop("walk")
    product = lambda x, y: evaluate(primitive, [x, y], params)[0]
    u, v = values
    a, b = product(at_a(u), at_a(v)), product(at_b(u), at_b(v))
    terms = []
    if moves(u):
        terms.append(product(u.d, _mean(v)))
    if moves(v):
        terms.append(product(_mean(u), v.d))
    return [Moving(a, b, sum(terms[1:], terms[0]))]


def _mean(value: Value) -> Array:
    return 0.5 * (value.a + value.b) if moves(value) else value


def _div(values: list[Value], params: dict[str, Any]) -> list[Value]:
    if any(isinstance(v, Switching) for v in values):
        raise NoRule
    ((a, b),) = _both(values, params)
    u, v = values
    if not moves(v):
        return [Moving(a, b, u.d / v)]
    change = increment(u) * _mean(v) - _mean(u) * v.d
    return [Moving(a, b, change / (v.a * v.b))]


def _integer_pow(values: list[Value], params: dict[str, Any]) -> list[Value]:
    n = params["y"]
    return _unary(lambda a, b: elementary.integer_pow(a, b, n))(values, params)


def _pow(values: list[Value], params: dict[str, Any]) -> list[Value]:
    x, y = values
    if not moves(y) and jnp.ndim(y) == 0 and not isinstance(y, jax.core.Tracer):
        twice = 2 * float(y)
        if twice.is_integer() and abs(twice) <= 64:
            n = int(twice)
            root = lambda x, y: (
                jax.lax.integer_pow(x, n // 2)
                if n % 2 == 0
                else (jax.lax.integer_pow(jnp.sqrt(x), n))
            )
            return _rewritten(root)(values, params)
    return _rewritten(lambda x, y: jnp.exp(y * jnp.log(x)))(values, params)


def _atan2(values: list[Value], params: dict[str, Any]) -> list[Value]:
    if any(isinstance(v, Switching) for v in values):
        raise NoRule
    ((a, b),) = _both(values, params)
    (ya, xa), (yb, xb) = map(at_a, values), map(at_b, values)
    dy, dx = map(increment, values)
    cross, dot = xa * yb - ya * xb, xa * xb + ya * yb
    mean_x, mean_y = 0.5 * (xa + xb), 0.5 * (ya + yb)
    turned = elementary.angle_ratio(cross, dot) * (mean_x * dy - mean_y * dx)
    # Across the branch cut the value jumps by a whole turn that no rotation explains.
    cut = jnp.round((b - a - jnp.arctan2(cross, dot)) / (2 * jnp.pi)) * (2 * jnp.pi)
    squares = ((yb - ya) ** 2 + (xb - xa) ** 2).astype(float)
    decided = ((yb - ya) * dy + (xb - xa) * dx).astype(float)
    return [Moving(a, b, turned + _share(cut, squares, decided))]


def _share(change: Array, squares: Array, decided: Array) -> Array:
    """`change`, as a linear function of the increments of what decided it."""
    happens = change != 0
    weight = jnp.where(happens, change.astype(float) / jnp.where(happens, squares, 1), 0)
    return (weight * decided).astype(change.dtype)


def _compare(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """Comparisons, logic and roundings to integers: values without an increment."""
    outs = []
    for a, b in _both(values, params):
        squares, decided = jnp.zeros(a.shape), jnp.zeros(a.shape)
        for value in values:
            if isinstance(value, Moving):
                change, d = (value.b - value.a).astype(float), value.d.astype(float)
                squares, decided = squares + change**2, decided + change * d
            elif isinstance(value, Switching):
                squares, decided = squares + value.squares, decided + value.decided
        outs.append(Switching(a, b, squares, decided))
    return outs


def _convert(values: list[Value], params: dict[str, Any]) -> list[Value]:
    (x,) = values
    if not jnp.issubdtype(params["new_dtype"], jnp.inexact):
        return _compare(values, params)
    if isinstance(x, Switching):
        ((a, b),) = _both(values, params)
        return [Moving(a, b, _share(b - a, x.squares, x.decided))]
    return _linear()(values, params)


def _select(values: list[Value], params: dict[str, Any]) -> list[Value]:
    which, *cases = values
    if not isinstance(which, Switching):
        if any(isinstance(v, Switching) for v in cases):
            raise NoRule
        return _linear(*range(1, len(values)))(values, params)
    if any(isinstance(v, Switching) for v in cases):
        raise NoRule
    ((a, b),) = _both(values, params)
    if not jnp.issubdtype(a.dtype, jnp.inexact):
        raise NoRule
    increments = [increment(v) for v in cases]
    exact = jax.lax.select_n(which.a, *increments)
    mean = sum(increments[1:], increments[0]) / len(cases)
    explained = sum((at_b(v) - at_a(v) for v in cases), jnp.zeros_like(a)) / len(cases)
    same = which.a == which.b
    rest = jnp.where(same, 0, b - a - explained)
    shared = mean + _share(rest, which.squares, which.decided)
    return [Moving(a, b, jnp.where(same, exact, shared))]


def _reduce_prod(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """A product over axes, factor by factor: `b` before the factor, `a` after it, and back."""
    (x,) = values
    ((a, b),) = _both(values, params)
    kept = [k for k in range(x.a.ndim) if k not in params["axes"]]
    shape = [x.a.shape[k] for k in kept]
    order = (*kept, *params["axes"])
    xa, xb, d = (jnp.transpose(v, order).reshape(*shape, -1) for v in x)

    def before(v: Array) -> Array:
        return jnp.cumprod(
            jnp.concatenate([jnp.ones_like(v[..., :1]), v[..., :-1]], -1), -1
        )

    def after(v: Array) -> Array:
        return jnp.flip(before(jnp.flip(v, -1)), -1)

    weights = 0.5 * (before(xb) * after(xa) + before(xa) * after(xb))
    return [Moving(a, b, jnp.sum(weights * d, -1))]


def _extreme(sign: int) -> Rule:
    """`max` (sign 1) and `min` (sign -1): the mean, and half the difference's `abs`."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        if any(isinstance(v, Switching) for v in values):
            return _compare(values, params)
        ((a, b),) = _both(values, params)
        x, y = values
        lead = elementary.absolute(at_a(x) - at_a(y), at_b(x) - at_b(y))
        dx, dy = increment(x), increment(y)
        return [Moving(a, b, 0.5 * (dx + dy) + 0.5 * sign * lead * (dx - dy))]

    return rule


def _reduce_extreme(pair: Callable[[Array, Array], Array]) -> Rule:
    """Over the entries of short axes in pairs."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        (x,) = values
        axes = params["axes"]
        if math.prod(x.a.shape[k] for k in axes) > 64:
            raise NoRule

        def reduce(v: Array) -> Array:
            rows = jnp.moveaxis(v, axes, range(len(axes)))
            rows = rows.reshape(-1, *rows.shape[len(axes) :])
            return functools.reduce(pair, list(rows))

        return _rewritten(reduce)(values, params)

    return rule


def _reduce_logic(values: list[Value], params: dict[str, Any]) -> list[Value]:
    (x,) = values
    ((a, b),) = _both(values, params)
    decided = [jnp.sum(v, axis=params["axes"]) for v in (x.squares, x.decided)]
    return [Switching(a, b, *decided)]


_STRUCTURAL = "concatenate stack pad".split()
_ONE_OPERAND = (
    "reshape broadcast_in_dim transpose squeeze expand_dims slice rev reduce_sum cumsum copy "
    "real imag split reduce_precision sharding_constraint"
).split()

RULES: dict[str, Rule] = {
    **dict.fromkeys([*_STRUCTURAL, *_ONE_OPERAND], _linear()),
    **dict.fromkeys("add sub neg add_any".split(), _sum),
    **dict.fromkeys(["gather", "dynamic_slice"], _linear(0)),
    # The value moves whether it is differentiated or not.
    **dict.fromkeys(
        ["stop_gradient", "optimization_barrier"], lambda values, params: values
    ),
    "dynamic_update_slice": _linear(0, 1),
    "scatter": _linear(0, 2),
    "scatter-add": _linear(0, 2),
    "mul": _product,
    "dot_general": _product,
    "div": _div,
    "integer_pow": _integer_pow,
    "pow": _pow,
    "square": _unary(lambda a, b: a + b),
    "sqrt": _unary(elementary.sqrt),
    "rsqrt": _unary(elementary.rsqrt),
    "cbrt": _unary(elementary.cbrt),
    "exp": _unary(elementary.exp),
    "exp2": _unary(elementary.exp2),
    "expm1": _unary(elementary.exp),
    "log": _unary(elementary.log),
    "log1p": _unary(elementary.log1p),
    "sin": _unary(elementary.sin),
    "cos": _unary(elementary.cos),
    "tan": _unary(elementary.tan),
    "sinh": _unary(elementary.sinh),
    "cosh": _unary(elementary.cosh),
    "tanh": _unary(elementary.tanh),
    "logistic": _unary(elementary.logistic),
    "atan": _unary(elementary.atan),
    "atanh": _unary(elementary.atanh),
    "asin": _rewritten(lambda x: 2 * jnp.arctan(x / (1 + jnp.sqrt((1 - x) * (1 + x))))),
    "acos": _rewritten(lambda x: -2 * jnp.arctan(x / (1 + jnp.sqrt((1 - x) * (1 + x))))),
    "asinh": _rewritten(lambda x: 2 * jnp.arctanh(x / (1 + jnp.sqrt(1 + x * x)))),
    "acosh": _rewritten(lambda x: jnp.log(x + jnp.sqrt((x - 1) * (x + 1)))),
    "erf": _unary(elementary.smooth(jax.scipy.special.erf, 0.4)),
    "erfc": _unary(elementary.smooth(jax.scipy.special.erfc, 0.4)),
    "abs": _unary(elementary.absolute),
    "sign": _unary(elementary.step(jnp.sign)),
    "floor": _unary(elementary.step(jnp.floor)),
    "ceil": _unary(elementary.step(jnp.ceil)),
    "round": _unary(elementary.step(jnp.round)),
    "atan2": _atan2,
    "max": _extreme(1),
    "min": _extreme(-1),
    "reduce_max": _reduce_extreme(jnp.maximum),
    "reduce_min": _reduce_extreme(jnp.minimum),
    **dict.fromkeys(["reduce_or", "reduce_and"], _reduce_logic),
    "clamp": _rewritten(lambda low, x, high: jnp.minimum(jnp.maximum(x, low), high)),
    **dict.fromkeys("gt lt ge le eq ne is_finite and or xor not".split(), _compare),
    "convert_element_type": _convert,
    "select_n": _select,
    "reduce_prod": _reduce_prod,
    "cholesky": linalg.cholesky,
    "triangular_solve": linalg.triangular_solve,
    "custom_linear_solve": linalg.linear_solve,
    "lu": linalg.lu,
    "scan": loops.scan,
    "cond": loops.cond,
}
