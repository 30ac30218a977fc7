"""The squares in a sum, found in its program.

Energies of springs are mostly written as `k x^2 / 2`, in some form: `0.5 * k * x**2`,
`k * jnp.sum(x * x) / 2`, `x @ x`. A walk over the program of a scalar function finds all
terms `c x^2` of its sum in which `c` does not depend on the argument.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .jaxprs import evaluate, interpret_within_jit
from .primitives import CONTRACTION
from .simplification import simplified


class Squares(NamedTuple):
    """Terms of a sum: `coefficient * value**2` for all entries of two arrays."""

    coefficient: Array
    value: Array


def squares_in(fn: Callable[[Array], Array], x: Array) -> list[Squares]:
    """The squares that `fn(x)` sums, beside other terms."""
    # Equal operations must be one, or factors of a square would not be the same array.
    closed = jax.make_jaxpr(simplified(fn))(x)
    inputs = [_Known(x, True)]
    (out,) = interpret_within_jit(closed.jaxpr, closed.consts, inputs, _equation)
    return [
        Squares(jnp.broadcast_to(term.coefficient, jnp.shape(term.value)), term.value)
        for term in _as_known(out).terms
    ]


class _Term(NamedTuple):
    """`coefficient * value**2`, summed over all axes of `value` but the axes `kept`."""

    coefficient: Any
    value: Any
    kept: tuple[int, ...]


class _Known(NamedTuple):
    """What is known of an array.

    - `varies`: whether it depends on the argument of the function.
    - `multiple`: a factor that does not, and the array of which it is a multiple.
    - `terms`: the squares of which it is the sum, entry by entry, up to some rest.
    """

    value: Any
    varies: bool
    multiple: tuple[Any, Any] | None = None
    terms: tuple[_Term, ...] = ()

    @property
    def factors(self) -> tuple[Any, Any]:
        return (1.0, self.value) if self.multiple is None else self.multiple


def _as_known(x: Any) -> _Known:
    return x if isinstance(x, _Known) else _Known(x, False)


def _equation(equation: Any, inputs: list[Any]) -> list[_Known]:
    inputs = list(map(_as_known, inputs))
    values = [x.value for x in inputs]
    outs = evaluate(equation.primitive, values, equation.params)
    if not any(x.varies for x in inputs):
        return [_Known(out, False) for out in outs]
    rule = _RULES.get(equation.primitive.name)
    if rule is None or len(outs) != 1:
        return [_Known(out, True) for out in outs]
    multiple, terms = rule(inputs, equation.params, outs[0])
    return [_Known(outs[0], True, multiple, tuple(terms))]


# What a rule returns: the factor and the array of a multiple, and the squares.
_Found = tuple[tuple[Any, Any] | None, list[_Term]]


def _scaled(x: _Known, factor: Any) -> _Found:
    """`factor * x`, where the factor does not vary and has the shape of `x`, or none."""
    shape = jnp.shape(x.value)

    def along(term: _Term) -> Any:
        if np.ndim(factor) == 0:
            return factor
        within = jnp.broadcast_to(factor, shape)
        return jax.lax.broadcast_in_dim(within, jnp.shape(term.value), term.kept)

    own, base = x.factors
    terms = [t._replace(coefficient=along(t) * t.coefficient) for t in x.terms]
    return (factor * own, base), terms


def _sum(inputs: list[_Known], params: dict[str, Any], out: Any) -> _Found:
    shape = jnp.shape(out)
    return None, [t for x in inputs if jnp.shape(x.value) == shape for t in x.terms]


def _difference(inputs: list[_Known], params: dict[str, Any], out: Any) -> _Found:
    first, second = inputs
    negative = second._replace(terms=tuple(_scaled(second, -1.0)[1]))
    return _sum([first, negative], params, out)


def _product(inputs: list[_Known], params: dict[str, Any], out: Any) -> _Found:
    one, other = inputs
    if not (one.varies and other.varies):
        moving, factor = (one, other) if one.varies else (other, one)
        same = jnp.shape(moving.value) == jnp.shape(out)
        return _scaled(moving, factor.value) if same else (None, [])
    (a, base), (b, other_base) = one.factors, other.factors
    if base is not other_base:
        return None, []
    return None, [_Term(a * b, base, tuple(range(jnp.ndim(base))))]


def _quotient(inputs: list[_Known], params: dict[str, Any], out: Any) -> _Found:
    above, below = inputs
    if below.varies or jnp.shape(above.value) != jnp.shape(out):
        return None, []
    return _scaled(above, 1.0 / below.value)


def _power(inputs: list[_Known], params: dict[str, Any], out: Any) -> _Found:
    if params.get("y", 2) != 2:
        return None, []
    return _product([inputs[0], inputs[0]], params, out)


def _contraction(inputs: list[_Known], params: dict[str, Any], out: Any) -> _Found:
    """The dot product of a vector with itself, or of many vectors; and that of a vector
    with weights."""
    one, other = inputs
    if not (one.varies and other.varies):
        moving, weights = (one, other) if one.varies else (other, one)
        if not jnp.ndim(moving.value) == jnp.ndim(weights.value) == 1:
            return None, []
        _, terms = _scaled(moving, weights.value)
        return None, [term._replace(kept=()) for term in terms]
    (a, base), (b, other_base) = (x.factors for x in inputs)
    (summed, also_summed), (batch, also_batch) = params["dimension_numbers"]
    same = tuple(summed) == tuple(also_summed) and tuple(batch) == tuple(also_batch)
    if base is not other_base or not same or len(summed) + len(batch) < jnp.ndim(base):
        return None, []
    return None, [_Term(a * b, base, tuple(batch))]


def _reduction(inputs: list[_Known], params: dict[str, Any], out: Any) -> _Found:
    axes = params["axes"]
    left = lambda kept: tuple(axis for k, axis in enumerate(kept) if k not in axes)
    return None, [term._replace(kept=left(term.kept)) for term in inputs[0].terms]


def _reshape(inputs: list[_Known], params: dict[str, Any], out: Any) -> _Found:
    if jnp.size(out) > 1 or jnp.ndim(out) > 0:
        return None, []
    return None, [term._replace(kept=()) for term in inputs[0].terms]


_RULES: dict[str, Callable[[list[_Known], dict[str, Any], Any], _Found]] = {
    "add": _sum,
    "add_any": _sum,
    "sub": _difference,
    "neg": lambda inputs, params, out: _scaled(inputs[0], -1.0),
    "mul": _product,
    "div": _quotient,
    "square": _power,
    "integer_pow": _power,
    "reduce_sum": _reduction,
    "squeeze": _reshape,
    "reshape": _reshape,
    CONTRACTION: _contraction,
}
