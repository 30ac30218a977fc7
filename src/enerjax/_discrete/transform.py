"""Discrete differentiation by the chain rule, as a program transformation.

Difference quotients obey an exact chain rule: where every primitive `y = f(x)` of a
program has a linear map `D` with `y_b - y_a = D (x_b - x_a)`, the composition of these maps
takes the difference of the program's inputs to the difference of its outputs, exactly. So a
traced program is walked once with triples: the value at `a`, the value at `b`, and an
increment that enters linearly. With the increment `b - a` the output increment is
`f(b) - f(a)`; transposed, the map is a discrete gradient.

Nothing is divided by `|b - a|`: each rule in `rules.py` is a closed form, symmetric in `a`
and `b` and free of cancellation, so value and derivatives are right at any increment, zero
included. And because the map follows the user's own composition (differences of positions,
then dot products, then functions of distances), it inherits the symmetries that the program
shows: a discrete gradient of a function of distances exerts no net force and no torque.

**To add a rule:** write it with the helpers of `arithmetic.py`, and enter `rule(values,
params)` in the table of `rules.py` under the name that the primitive has in
`jax.make_jaxpr`. (A function under `jax.jit` can have a rule too, as `"jit name"`.)
`values` has one entry for each operand: a plain array if the operand is the same at `a` and
`b`, else a `Moving`. Return the same for each output. `params` are those of the primitive,
together with the `primitive` itself and the `walk`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array

from .._programs import (
    computed_indices,
    evaluate,
    function_with_own_derivative,
    interpret,
    is_index,
    name_of,
    programs_within,
    wrapped_program,
)


class Moving(NamedTuple):
    """A number that differs between the two points."""

    a: Array
    b: Array
    d: Array  # increment, linear in that of the input; b - a where the input's is


class Switching(NamedTuple):
    """A truth value or integer that may differ between the two points.

    It has no increment. Instead it keeps two sums over the numbers that decided it:
    `squares`, of their squared changes, and `decided`, of the products of their changes and
    increments. If the value changes by `change`, then `change * decided / squares` is an
    increment with the right total.
    """

    a: Array
    b: Array
    squares: Array
    decided: Array


# Larger tables of indices are not computed while the program is traced.
_MANY = 4096

Value: TypeAlias = Any  # an array, a Moving or a Switching
Rule: TypeAlias = Callable[[list[Value], dict[str, Any]], list[Value]]


def at_a(value: Value) -> Array:
    return value.a if isinstance(value, Moving | Switching) else value


def at_b(value: Value) -> Array:
    return value.b if isinstance(value, Moving | Switching) else value


def increment(value: Value) -> Array:
    return value.d if isinstance(value, Moving) else jnp.zeros_like(value)


def moves(value: Value) -> bool:
    return isinstance(value, Moving | Switching)


class NoRule(Exception):
    """Raised by a rule that does not cover its operands; the fallback does."""


def refuse_choices(values: list[Value]) -> None:
    """Raises `NoRule` if a truth value or an integer among the operands may change."""
    if any(isinstance(v, Switching) for v in values):
        raise NoRule


class Walk:
    """One pass over a program. `fallbacks` collects the primitives without a rule."""

    def __init__(self, rules: dict[str, Rule], fallback: Callable):
        self._rules = rules
        self._fallback = fallback
        self.fallbacks: list[str] = []

    def closed(self, jaxpr: ClosedJaxpr, inputs: list[Value]) -> list[Value]:
        return self.open(jaxpr.jaxpr, jaxpr.consts, inputs)

    def open(self, jaxpr: Any, consts: list[Value], inputs: list[Value]) -> list[Value]:
        """The outputs of a program for inputs that may differ between the two points."""
        constants = [c if moves(c) or is_index(c) else jnp.asarray(c) for c in consts]
        return interpret(jaxpr, constants, inputs, self._equation)

    def _equation(self, equation: Any, values: list[Value]) -> list[Value]:
        primitive, params = equation.primitive, equation.params
        if not any(moves(value) for value in values):
            # Under `jit` JAX would return traced numbers here, of known ones too. Indices
            # stay known numbers, because they tell which entries are angles.
            indices = computed_indices(equation, values, _MANY)
            return evaluate(primitive, values, params) if indices is None else indices
        rule = self._rules.get(name_of(equation))
        inner = wrapped_program(equation)
        if rule is None and inner is not None and self._is_smooth(equation, inner[0]):
            return self.open(*inner, values)
        try:
            if rule is None:
                raise NoRule
            return rule(values, dict(params, walk=self, primitive=primitive))
        except NoRule:
            outs = self._fallback(primitive, values, params)
            if any(isinstance(out, Moving) for out in outs):
                name, given = primitive.name, function_with_own_derivative(equation)
                self.fallbacks.append(f"{name} {given[0]}" if given else name)
            return outs

    def _is_smooth(self, equation: Any, inner: Any) -> bool:
        """Whether the derivative of a wrapped program is that of its equations.

        Users may define another derivative, such as a slope for a look-up in a table.
        Functions of JAX and of this library have the derivative of their equations, except
        those that operate on the bits of a number, whose primitives have no rules.
        """
        given = function_with_own_derivative(equation)
        return given is None or (given[1] and self._has_rules(inner))

    def _has_rules(self, jaxpr: Any) -> bool:
        return all(
            name_of(eqn) in self._rules
            or not any(map(_is_real, (*eqn.invars, *eqn.outvars)))
            or any(map(self._has_rules, programs_within(eqn)))
            for eqn in jaxpr.eqns
        )


def _is_real(atom: Any) -> bool:
    return jnp.issubdtype(atom.aval.dtype, jnp.inexact)
