"""Discrete differentiation over a step that rotates bodies in the plane.

The increment of an angle is measured by Cayley's number `Theta = 2 t`, with
`theta_b - theta_a = 2 atan(t)`, instead of the angle itself. Then the increments of the
axes of a body are means of both ends times `Theta`,

    cos: -(sin_a + sin_b)/2 Theta        sin: (cos_a + cos_b)/2 Theta

which is how a rotation of all bodies together moves them, whatever its angle. The rules
below have the same property: with `Theta = 1` for all bodies, differences of angles do not
change, and a mean of two angles has `Theta = 1` itself,

    theta_1 - theta_2:    atan(u)/u (Theta_1 - Theta_2)/(1 + t_1 t_2)
    (theta_1 + theta_2)/2:     (c_1 Theta_1 + c_2 Theta_2)/(c_1 + c_2)

where `u = (t_1 - t_2)/(1 + t_1 t_2)` and `c = 1/sqrt(1 + t^2)`. All other functions of an
angle have the increment `atan(t)/t Theta`. So discrete gradients of functions that consist
of products of axes, differences and means of angles exert no torque in all.

The rate `omega` of an angle is a number of its own in such functions. The rates of an axis
`d`, with `J` the rotation by a right angle, change by

    omega_b J d_b - omega_a J d_a = Theta J Ym + (1 + t^2) (omega_b - omega_a) J dm

with their mean `Ym` and that of the axis, `dm`. The rule of products has the mean of
`omega` times that of `J d` in place of `Ym`. It becomes this formula with the increment

    (1 + t^2) d_omega - t/2 (omega_b - omega_a) Theta

of `omega`, which has the right value too. Differences of rates have the increments
`d_omega`, and means of rates are treated like rates.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._programs import evaluate, Indices, is_known, name_of, wrapped_program
from .._programs.numpy_primitives import moved
from .._programs.primitives import DATA_MOVEMENT, moved_operands
from .._types import Scalar
from . import elementary
from .chain_rule import valid_increment
from .fallback import fallback
from .rules import RULES
from .transform import increment, moves, Moving, Value, Walk


# Coordinates and the time; coordinates, their rates, and the time.
Position: TypeAlias = tuple[Array, Array | None]
Motion: TypeAlias = tuple[Array, Array, Array | None]

# What a number is. A constant may stand for an angle or a rate that does not change.
CONSTANT, OTHER, ANGLE, RATE = range(4)


class Turning(NamedTuple):
    """Numbers between two points, of which some are angles, or the rates of angles.

    - `a`, `b`: at the two points.
    - `d`: the increments, of angles `Theta`. Those of multiples are for the angle itself.
    - `half`: `t` of angles and of their rates, zero of other numbers.
    - `turn`: `Theta`, as an increment, of rates.
    - `whole`: the increments in any other function; see `as_moving`.
    - `kinds`: an array of `CONSTANT`, `OTHER`, `ANGLE` and `RATE`.
    - `factor`: the numbers are this multiple of angles or rates.
    """

    a: Array
    b: Array
    d: Array
    half: Array
    turn: Array
    whole: Array
    kinds: np.ndarray
    factor: float = 1.0

    def are(self, kind: int) -> bool:
        """Whether all numbers are of a kind, or constant."""
        return bool(np.all((self.kinds == kind) | (self.kinds == CONSTANT)))


class RotationRule(eqx.Module):
    """The chain rule over a step that rotates bodies.

    - `kinds`: of each coordinate, `OTHER` or `ANGLE`.
    - `half`: `t` of each angle, and zero for other coordinates.
    """

    kinds: Indices = eqx.field(static=True)
    half: Array

    def gradient(
        self, fn: Callable[[Motion], Scalar], a: Motion, b: Motion
    ) -> tuple[Array, Array, Array | None]:
        """The gradient of a function of `(coordinates, rates, time)`.

        The first part is the gradient with respect to the steps, with `Theta` in place of
        each angle. The products with the steps and with the changes of the rates and of the
        time add up to the change of the function. The time may be `None`.
        """
        program = jax.make_jaxpr(fn)(a)
        push = lambda d: valid_increment(self._output(program, a, b, d))
        value, pull = jax.vjp(push, jax.tree.map(jnp.zeros_like, a))
        return pull(jnp.ones_like(value))[0]

    def gradient_by_rates(
        self, fn: Callable[[Motion], Scalar], a: Position, b: Position
    ) -> Array:
        """The part of `gradient` for the rates, of a function that is linear in them.

        It does not depend on the rates. `a` and `b` are coordinates and times.
        """
        none = jnp.zeros_like(a[0])  # any rates will do
        ends = (a[0], none, a[1]), (b[0], none, b[1])
        program = jax.make_jaxpr(fn)(ends[0])
        rest = jax.tree.map(jnp.zeros_like, ends[0])
        push = lambda d: increment(self._output(program, *ends, (rest[0], d, rest[2])))
        value, pull = jax.vjp(push, none)
        return pull(jnp.ones_like(value))[0]

    def _output(self, program: Any, a: Motion, b: Motion, d: Motion) -> Value:
        (out,) = _Walk(RULES, fallback).closed(program, self._inputs(a, b, d))
        return as_moving(out) if isinstance(out, Turning) else out

    def _inputs(self, a: Motion, b: Motion, d: Motion) -> list[Value]:
        kinds = self.kinds.array
        of_rates = np.where(kinds == ANGLE, RATE, kinds)
        coordinates = turning(a[0], b[0], d[0], self.half, d[0], kinds)
        parts = [coordinates, turning(a[1], b[1], d[1], self.half, d[0], of_rates)]
        if a[2] is None or b[2] is None or d[2] is None:
            return parts
        return [*parts, Moving(a[2], b[2], d[2])]


class _Walk(Walk):
    """A pass over a program in which some numbers are angles or rates."""

    def _equation(self, equation: Any, values: list[Value]) -> list[Value]:
        if not any(isinstance(v, Turning) for v in values):
            return super()._equation(equation, values)
        primitive, params = equation.primitive, equation.params
        inner = wrapped_program(equation)
        has_rule = name_of(equation) in self._rules
        if inner is not None and not has_rule and self._is_smooth(equation, inner[0]):
            return self.open(*inner, values)
        rule = _moved if primitive.name in DATA_MOVEMENT else _RULES.get(primitive.name)
        outs = None if rule is None else rule(primitive, values, params)
        if outs is not None:
            return outs
        plain = [as_moving(v) if isinstance(v, Turning) else v for v in values]
        return super()._equation(equation, plain)


def as_moving(value: Turning) -> Moving:
    """The same numbers with the increments that they have in any other function."""
    whole = value.whole if value.factor == 1 else value.factor * value.whole
    return Moving(value.a, value.b, whole)


def turning(
    a: Array, b: Array, d: Array, half: Array, turn: Array, kinds: np.ndarray, factor=1.0
) -> Turning:
    """A `Turning` with its increments in any other function."""
    if np.any(kinds == RATE):
        whole = (1 + half * half) * d - 0.5 / factor * half * (b - a) * turn
    else:
        near = jnp.abs(half) < elementary.SMALL_RATIO
        whole = d * elementary.series_or_quotient(
            near, half, jnp.ones_like(half), elementary.atanc, 0.5 / factor * (b - a)
        )
    return Turning(a, b, d, half, turn, whole, kinds, factor)


def _moved(primitive: Any, values: list[Value], params: dict[str, Any]) -> list | None:
    where = moved_operands(primitive.name, len(values))
    others = [v for k, v in enumerate(values) if k not in where]
    factors = {values[k].factor for k in where if isinstance(values[k], Turning)}
    if len(factors) != 1 or any(map(_moves, others)) or not is_known(others):
        return None
    entries = [_entries(v) if k in where else v for k, v in enumerate(values)]

    def each(field: int, move: Callable) -> list[Any]:
        own = [v[field] if k in where else v for k, v in enumerate(entries)]
        return move(primitive, own, params)

    fields = [each(field, evaluate) for field in range(6)]
    kinds = [np.asarray(x).astype(int) for x in each(6, moved)]
    (factor,) = factors
    joined = [Turning(*out, factor=factor) for out in zip(*fields, kinds, strict=True)]
    return list(map(_joined, joined))


def _moves(value: Value) -> bool:
    return isinstance(value, Turning) or moves(value)


def _entries(value: Value) -> Turning:
    if isinstance(value, Turning):
        return value
    if moves(value):
        none = jnp.zeros_like(value.a)
        kinds = np.full(jnp.shape(value.a), OTHER)
        return Turning(value.a, value.b, value.d, none, none, value.d, kinds)
    none = jnp.zeros(jnp.shape(value), jnp.result_type(value))
    kinds = np.full(jnp.shape(value), CONSTANT)
    return Turning(value, value, none, none, none, none, kinds)


def _joined(value: Turning) -> Value:
    """The same numbers as a `Moving`, if there is no angle or rate among them."""
    has_any = np.any((value.kinds == ANGLE) | (value.kinds == RATE))
    return value if has_any else Moving(value.a, value.b, value.d)


def _cosine(primitive: Any, values: list[Value], params: dict[str, Any]) -> list | None:
    (x,) = values
    return _of_axis(x, jnp.cos, jnp.sin, jnp.negative)


def _sine(primitive: Any, values: list[Value], params: dict[str, Any]) -> list | None:
    (x,) = values
    return _of_axis(x, jnp.sin, jnp.cos, lambda d: d)


def _of_axis(
    x: Turning, component: Callable, other: Callable, sign: Callable
) -> list | None:
    if not x.are(ANGLE) or x.factor != 1:
        return None
    # The mean is written as in the rule of products, which needs it too.
    mean = 0.5 * (other(x.a) + other(x.b))
    return [Moving(component(x.a), component(x.b), sign(x.d * mean))]


def _sum(primitive: Any, values: list[Value], params: dict[str, Any]) -> list | None:
    """Sums and differences."""
    x, y = values
    is_sum = primitive.name == "add"
    ends = lambda k: evaluate(primitive, [_end(x, k), _end(y, k)], params)[0]
    a, b = ends(0), ends(1)
    # A constant is another reference for angles, and does not change their increments.
    first, constant = (x, y) if isinstance(x, Turning) else (y, x)
    if not _moves(constant):
        if jnp.shape(first.a) != jnp.shape(a):
            return None
        if is_sum or first is x:
            return [first._replace(a=a, b=b)]
        return _times(-1, y, a, b)
    if not all(isinstance(v, Turning) for v in values):
        return None
    if not any(x.are(kind) and y.are(kind) for kind in (ANGLE, RATE)):
        return None
    factor, other = x.factor, y.factor if is_sum else -y.factor
    if factor == other:
        return [_mean(x, y, a, b)]
    if factor != -other:
        return None
    if x.are(RATE) and y.are(RATE):
        return [Moving(a, b, factor * (x.d - y.d))]
    d, total = x.half - y.half, 1 + x.half * y.half
    near = jnp.abs(d) < elementary.SMALL_RATIO * total
    change = 0.5 / factor * (b - a)
    ratio = elementary.series_or_quotient(near, d, total, elementary.atanc, change)
    return [Moving(a, b, factor * ratio * (x.d - y.d))]


def _end(value: Value, k: int) -> Any:
    return value[k] if isinstance(value, Moving | Turning) else value


def _mean(x: Turning, y: Turning, a: Array, b: Array) -> Turning:
    """The sum of equal multiples of two angles or rates, as a multiple of their mean."""
    c, d = jax.lax.rsqrt(1 + x.half * x.half), jax.lax.rsqrt(1 + y.half * y.half)
    share = c / (c + d)
    mean = lambda u, v: share * u + (1 - share) * v
    turn = mean(x.turn, y.turn)
    change = mean(x.d, y.d) if x.are(ANGLE) and y.are(ANGLE) else 0.5 * (x.d + y.d)
    kinds = np.maximum(x.kinds, y.kinds)
    return turning(a, b, change, mean(x.half, y.half), turn, kinds, 2 * x.factor)


def _multiple(primitive: Any, values: list[Value], params: dict[str, Any]) -> list | None:
    """Products and quotients with a known number."""
    x, y = values if isinstance(values[0], Turning) else values[::-1]
    is_quotient = primitive.name == "div"
    if _moves(y) or not is_known(y) or np.ndim(y) > 0 or (is_quotient and y is values[0]):
        return None
    number = 1 / float(y) if is_quotient else float(y)
    a, b = (evaluate(primitive, [_end(v, k) for v in values], params)[0] for k in (0, 1))
    return _times(number, x, a, b)


def _negative(primitive: Any, values: list[Value], params: dict[str, Any]) -> list | None:
    (x,) = values
    return _times(-1, x, -x.a, -x.b)


def _times(number: float, x: Turning, a: Array, b: Array) -> list | None:
    """A multiple of angles or rates, perhaps plus a constant, with its values."""
    if number == 0 or np.any(x.kinds == OTHER):
        return None
    return [x._replace(a=a, b=b, factor=number * x.factor)]


_RULES: dict[str, Callable] = {
    "cos": _cosine,
    "sin": _sine,
    "add": _sum,
    "sub": _sum,
    "mul": _multiple,
    "div": _multiple,
    "neg": _negative,
}
