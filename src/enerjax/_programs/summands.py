"""The terms of a sum, found in its program.

The energy of many springs is a sum over springs, also where it is written for all of them
at once: `jnp.sum(0.5 * k * (jnp.diff(q) - l) ** 2)`, `k @ strain**2`. A walk over the
program of a scalar function finds the arrays whose entries it sums.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .jaxprs import evaluate, interpret_within_jit
from .primitives import CONTRACTION


def summands_of(
    fn: Callable[[Array], Array],
) -> Callable[[Array], Float[Array, " terms"]]:
    """A function whose entries add up to the scalar `fn(x)`.

    Terms that do not depend on `x` are left out.
    """

    def terms(x: Array) -> Array:
        closed = jax.make_jaxpr(fn)(x)
        inputs = [_Known(x, True)]
        (out,) = interpret_within_jit(closed.jaxpr, closed.consts, inputs, _equation)
        parts = [part.ravel() for part in _as_known(out).terms]
        return jnp.concatenate([*parts, jnp.zeros((0,), x.dtype)])

    return terms


class _Known(NamedTuple):
    """What is known of an array.

    - `varies`: whether it depends on the argument of the function.
    - `summed`: for a number that varies, the arrays whose entries it is the sum of, up to a
      constant; `None` if it is no sum.
    """

    value: Any
    varies: bool
    summed: tuple[Any, ...] | None = None

    @property
    def terms(self) -> tuple[Any, ...]:
        if not self.varies:
            return ()
        return (self.value,) if self.summed is None else self.summed


def _as_known(x: Any) -> _Known:
    return x if isinstance(x, _Known) else _Known(x, False)


def _equation(equation: Any, inputs: list[Any]) -> list[_Known]:
    inputs = list(map(_as_known, inputs))
    outs = evaluate(equation.primitive, [x.value for x in inputs], equation.params)
    varies = any(x.varies for x in inputs)
    rule = _RULES.get(equation.primitive.name)
    if rule is None or len(outs) != 1 or not varies or jnp.ndim(outs[0]) > 0:
        return [_Known(out, varies) for out in outs]
    return [_Known(outs[0], True, rule(inputs))]


def _scaled(x: _Known, factor: Any) -> tuple[Any, ...]:
    return tuple(factor * term for term in x.terms)


def _difference(inputs: list[_Known]) -> tuple[Any, ...]:
    first, second = inputs
    return (*first.terms, *_scaled(second, -1.0))


def _product(inputs: list[_Known]) -> tuple[Any, ...] | None:
    one, other = inputs
    if one.varies and other.varies:
        return None
    return _scaled(one, other.value) if one.varies else _scaled(other, one.value)


def _quotient(inputs: list[_Known]) -> tuple[Any, ...] | None:
    above, below = inputs
    # Quotients of whole numbers are rounded.
    if below.varies or not jnp.issubdtype(jnp.result_type(below.value), jnp.inexact):
        return None
    return _scaled(above, 1.0 / below.value)


def _contraction(inputs: list[_Known]) -> tuple[Any, ...] | None:
    """The dot product of two vectors. (That of matrices is no number.)"""
    one, other = (x.value for x in inputs)
    return (one * other,) if jnp.ndim(one) == jnp.ndim(other) == 1 else None


_RULES: dict[str, Callable[[list[_Known]], tuple[Any, ...] | None]] = {
    "add": lambda inputs: (*inputs[0].terms, *inputs[1].terms),
    "add_any": lambda inputs: (*inputs[0].terms, *inputs[1].terms),
    "sub": _difference,
    "neg": lambda inputs: _scaled(inputs[0], -1.0),
    "mul": _product,
    "div": _quotient,
    "reduce_sum": lambda inputs: (inputs[0].value,),
    "squeeze": lambda inputs: inputs[0].terms,
    "reshape": lambda inputs: inputs[0].terms,
    CONTRACTION: _contraction,
}
