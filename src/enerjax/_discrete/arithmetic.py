"""Rules of sums, products, quotients, powers and elementary functions."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._programs import evaluate, is_known
from . import elementary
from .transform import (
    at_a,
    at_b,
    increment,
    moves,
    Moving,
    NoRule,
    refuse_choices,
    Rule,
    Switching,
    Value,
)


# The limits up to which operations are written out, so that programs stay small. An extreme
# over more entries is left to the fallback. A power with an exponent that is larger than
# twice the second limit is computed as `exp(y log x)`.
_LONGEST_CHAIN = 64
_LARGEST_EXPONENT = 64


def apply(operands: list[Array], params: dict[str, Any]) -> list[Array]:
    """The outputs of the primitive that a rule is called for."""
    own = {key: x for key, x in params.items() if key not in ("walk", "primitive")}
    return evaluate(params["primitive"], operands, own)


def both(values: list[Value], params: dict[str, Any]) -> list[tuple[Array, Array]]:
    """The outputs of a primitive at `a` and at `b`."""
    ends = [apply(list(map(at, values)), params) for at in (at_a, at_b)]
    return list(zip(*ends, strict=True))


def linear(*positions: int) -> Rule:
    """A primitive that is linear in the operands at `positions` together (default: all)."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        linear = positions or range(len(values))
        if any(moves(v) for k, v in enumerate(values) if k not in linear):
            raise NoRule

        def push(part: Callable[[Value], Array]) -> list[Array]:
            chosen = [part(v) if k in linear else v for k, v in enumerate(values)]
            return apply(chosen, params)

        ends = push(at_a), push(at_b)
        if not any(isinstance(v, Switching) for v in values):
            return list(map(Moving, *ends, push(increment)))
        # The same numbers decide a choice that is only moved to another place.
        zero = lambda v: jnp.zeros(jnp.shape(v))
        squares = push(lambda v: v.squares if isinstance(v, Switching) else zero(v))
        decided = push(lambda v: v.decided if isinstance(v, Switching) else zero(v))
        return list(map(Switching, *ends, squares, decided))

    return rule


def unary(quotient: elementary.Quotient) -> Rule:
    """An elementary function of one operand."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        (x,) = values
        if not isinstance(x, Moving):
            raise NoRule
        ((a, b),) = both(values, params)
        return [Moving(a, b, quotient(x.a, x.b) * x.d)]

    return rule


def rewritten(function: Callable[..., Array]) -> Rule:
    """A function that is a composition of others with rules."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        refuse_choices(values)
        program = jax.make_jaxpr(function)(*map(at_a, values))
        (out,) = params["walk"].closed(program, values)
        ((a, b),) = both(values, params)
        return [Moving(a, b, out.d)]

    return rule


def product(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """Any bilinear operation: `mul` and `dot_general`."""
    refuse_choices(values)
    product = lambda x, y: apply([x, y], params)[0]
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


def div(values: list[Value], params: dict[str, Any]) -> list[Value]:
    refuse_choices(values)
    ((a, b),) = both(values, params)
    u, v = values
    if not moves(v):
        return [Moving(a, b, u.d / v)]
    change = increment(u) * _mean(v) - _mean(u) * v.d
    return [Moving(a, b, change / (v.a * v.b))]


def integer_pow(values: list[Value], params: dict[str, Any]) -> list[Value]:
    n = params["y"]
    return unary(lambda a, b: elementary.integer_pow(a, b, n))(values, params)


def power(values: list[Value], params: dict[str, Any]) -> list[Value]:
    x, y = values
    refuse_choices(values)
    if moves(y):
        return _moving_exponent(values, params)
    quotient = lambda a, b: elementary.pow(a, b, jnp.asarray(y, a.dtype))
    if jnp.ndim(y) == 0 and is_known(y):
        twice = 2 * float(y)
        if twice.is_integer() and abs(twice) <= _LARGEST_EXPONENT:
            n = int(twice)
            quotient = lambda a, b: (
                elementary.integer_pow(a, b, n // 2)
                if n % 2 == 0
                else elementary.half_integer_pow(a, b, n)
            )
    ((a, b),) = both(values, params)
    return [Moving(a, b, quotient(x.a, x.b) * x.d)]


def _moving_exponent(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """`exp(y log x)`; its values are those of the power itself, which are more accurate."""
    x, y = values
    ((a, b),) = both(values, params)
    (xa, ya), (xb, yb) = map(at_a, values), map(at_b, values)
    rate, mean_log = elementary.log(xa, xb), 0.5 * (jnp.log(xa) + jnp.log(xb))
    logarithm = lambda dx, dy: 0.5 * (ya + yb) * rate * dx + mean_log * dy
    quotient = elementary.exp_of(logarithm(xb - xa, yb - ya), a, b)
    return [Moving(a, b, quotient * logarithm(increment(x), increment(y)))]


def absolute(values: list[Value], params: dict[str, Any]) -> list[Value]:
    (x,) = values
    if not jnp.iscomplexobj(at_a(x)):
        return unary(elementary.absolute)(values, params)
    size = lambda x: jnp.sqrt(jnp.real(x) ** 2 + jnp.imag(x) ** 2)
    return rewritten(size)(values, params)


def extreme(sign: int) -> Rule:
    """`max` (sign 1) and `min` (sign -1), as `(x + y + sign |x - y|) / 2`."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        refuse_choices(values)
        ((a, b),) = both(values, params)
        x, y = values
        quotient = elementary.absolute(at_a(x) - at_a(y), at_b(x) - at_b(y))
        dx, dy = increment(x), increment(y)
        return [Moving(a, b, 0.5 * (dx + dy) + 0.5 * sign * quotient * (dx - dy))]

    return rule


def reduce_extreme(pair: Callable[[Array, Array], Array]) -> Rule:
    """The extreme over short axes, as a chain of extremes of pairs."""

    def rule(values: list[Value], params: dict[str, Any]) -> list[Value]:
        (x,) = values
        axes = params["axes"]
        if math.prod(x.a.shape[k] for k in axes) > _LONGEST_CHAIN:
            raise NoRule

        def reduce(v: Array) -> Array:
            rows = jnp.moveaxis(v, axes, range(len(axes)))
            rows = rows.reshape(-1, *rows.shape[len(axes) :])
            return functools.reduce(pair, list(rows))

        return rewritten(reduce)(values, params)

    return rule


def reduce_prod(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """The telescoping product: factors before the one that changes are those of `b`, and
    factors after it those of `a`; then averaged with the opposite order."""
    (x,) = values
    ((a, b),) = both(values, params)
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
