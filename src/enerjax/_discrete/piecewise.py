"""Rules of piecewise functions: comparisons, logic, selections, an angle's branch cut."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import elementary
from .arithmetic import both, linear
from .transform import (
    at_a,
    at_b,
    increment,
    Moving,
    NoRule,
    refuse_choices,
    Switching,
    Value,
)


def share(change: Array, squares: Array, decided: Array) -> Array:
    """`change`, as a linear function of the increments of the numbers that decided it."""
    # If none of these numbers has changed, the change of the output is round-off.
    happens = (change != 0) & (squares != 0)
    weight = jnp.where(happens, change.astype(float) / jnp.where(happens, squares, 1), 0)
    return (weight * decided).astype(change.dtype)


def compare(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """Comparisons, logic and roundings to integers: values without an increment."""
    outs = []
    for a, b in both(values, params):
        squares, decided = jnp.zeros(a.shape), jnp.zeros(a.shape)
        for value in values:
            if isinstance(value, Moving):
                change, d = (value.b - value.a).astype(float), value.d.astype(float)
                squares, decided = squares + change**2, decided + change * d
            elif isinstance(value, Switching):
                squares, decided = squares + value.squares, decided + value.decided
        outs.append(Switching(a, b, squares, decided))
    return outs


def piecewise_constant(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """`floor` and similar functions: zero, or the difference quotient across a step."""
    (x,) = values
    if not isinstance(x, Moving):
        raise NoRule
    ((a, b),) = both(values, params)
    change = x.b - x.a
    return [Moving(a, b, share(b - a, change.astype(float) ** 2, change * x.d))]


def sum_entries(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """Sums. A sum of choices is a choice that all of them decide."""
    choices = any(isinstance(v, Switching) for v in values)
    return compare(values, params) if choices else linear()(values, params)


def convert(values: list[Value], params: dict[str, Any]) -> list[Value]:
    (x,) = values
    if not jnp.issubdtype(params["new_dtype"], jnp.inexact):
        return compare(values, params)
    if isinstance(x, Switching):
        ((a, b),) = both(values, params)
        return [Moving(a, b, share(b - a, x.squares, x.decided))]
    return linear()(values, params)


def select(values: list[Value], params: dict[str, Any]) -> list[Value]:
    which, *cases = values
    if not isinstance(which, Switching):
        refuse_choices(cases)
        return linear(*range(1, len(values)))(values, params)
    refuse_choices(cases)
    ((a, b),) = both(values, params)
    if not jnp.issubdtype(a.dtype, jnp.inexact):
        raise NoRule
    increments = [increment(v) for v in cases]
    exact = jax.lax.select_n(which.a, *increments)
    mean = sum(increments[1:], increments[0]) / len(cases)
    explained = sum((at_b(v) - at_a(v) for v in cases), jnp.zeros_like(a)) / len(cases)
    same = which.a == which.b
    # The mean increment of the cases explains part of the change, unless one case is a
    # dummy value that stands where the other case is singular.
    rest = b - a - explained
    helps = jnp.abs(rest) <= jnp.abs(b - a)
    rest = jnp.where(same, 0, jnp.where(helps, rest, b - a))
    shared = jnp.where(helps, mean, 0) + share(rest, which.squares, which.decided)
    return [Moving(a, b, jnp.where(same, exact, shared))]


def reduce_logic(values: list[Value], params: dict[str, Any]) -> list[Value]:
    (x,) = values
    ((a, b),) = both(values, params)
    decided = [jnp.sum(v, axis=params["axes"]) for v in (x.squares, x.decided)]
    return [Switching(a, b, *decided)]


def atan2(values: list[Value], params: dict[str, Any]) -> list[Value]:
    refuse_choices(values)
    ((a, b),) = both(values, params)
    (ya, xa), (yb, xb) = map(at_a, values), map(at_b, values)
    dy, dx = map(increment, values)
    cross, dot = xa * yb - ya * xb, xa * xb + ya * yb
    mean_x, mean_y = 0.5 * (xa + xb), 0.5 * (ya + yb)
    # A segment through the origin does not turn by any particular angle.
    across = (cross == 0) & (dot < 0)
    ratio = elementary.angle_ratio(cross, jnp.where(across, 1, dot))
    turned = jnp.where(across, 0, ratio * (mean_x * dy - mean_y * dx))
    # Across the branch cut the value jumps by a whole turn, which no rotation explains.
    cut = jnp.round((b - a - jnp.arctan2(cross, dot)) / (2 * jnp.pi)) * (2 * jnp.pi)
    cut = jnp.where(across, b - a, cut)
    squares = ((yb - ya) ** 2 + (xb - xa) ** 2).astype(float)
    decided = ((yb - ya) * dy + (xb - xa) * dx).astype(float)
    return [Moving(a, b, turned + share(cut, squares, decided))]
