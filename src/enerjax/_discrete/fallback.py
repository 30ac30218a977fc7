"""The rule of a primitive that has none: its own corrected mean derivative.

For this sub-function alone the increment is `J d + (change - J D) (D . d) / |D|^2`, with
the differences `D` of all its moving operands, `change` of the output, and the derivative
`J` averaged over the segment at two Gauss points. The bracket is dropped below the
round-off of the output: there it holds no digit (`corrected.py` states the bound).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._programs import evaluate
from .base import significant
from .piecewise import share
from .transform import at_a, at_b, Moving, Switching, Value


_GAUSS = (0.5 - 12**-0.5, 0.5 + 12**-0.5)


def fallback(primitive: Any, values: list[Value], params: dict[str, Any]) -> list[Value]:
    moving = [k for k, v in enumerate(values) if isinstance(v, Moving)]
    switching = [v for v in values if isinstance(v, Switching)]
    if not moving:
        return _shared(primitive, values, params)
    start, unravel = ravel_pytree([values[k].a for k in moving])
    end, _ = ravel_pytree([values[k].b for k in moving])
    d, _ = ravel_pytree([values[k].d for k in moving])

    def function(flat: Array, at: Callable[[Value], Array] = at_a) -> list[Array]:
        operands = [at(v) for v in values]
        for k, x in zip(moving, unravel(flat), strict=True):
            operands[k] = x
        return evaluate(primitive, operands, params)

    at_end = evaluate(primitive, list(map(at_b, values)), params)
    at_start = evaluate(primitive, list(map(at_a, values)), params)
    if any(map(jnp.iscomplexobj, [*at_start, *(values[k].a for k in moving)])):
        raise TypeError(
            f"The discrete derivative has no rule for `{primitive.name}` of complex "
            "numbers. Write the function with real numbers: cos and sin, real and "
            "imaginary parts."
        )
    # A `while` has only forward mode, and a `custom_vjp` only reverse mode. Choices are
    # taken once as at `a` and once as at `b`, which keeps the symmetry.
    is_reverse = primitive.name == "custom_vjp_call"
    jacobian = _reverse_jacobian if is_reverse else jax.jacfwd
    choices = (at_a, at_b) if switching else (at_a,)
    jacobians = [
        jacobian(lambda x, at=at: function(x, at))(start + c * (end - start))
        for c in _GAUSS
        for at in choices
    ]
    squares, decided = _totals(switching)
    squares = squares.astype(d.dtype) + jnp.sum((end - start) ** 2)
    decided = decided.astype(d.dtype) + (end - start) @ d
    outs = []
    for k, (a, b) in enumerate(zip(at_start, at_end, strict=True)):
        if not jnp.issubdtype(a.dtype, jnp.inexact):
            outs.append(_choice(a, b, squares, decided))
            continue
        mean = sum(j[k] for j in jacobians) / len(jacobians)
        defect = b - a - mean @ (end - start)
        size = jnp.abs(a) + jnp.abs(b) + jnp.abs(mean) @ (jnp.abs(start) + jnp.abs(end))
        rest = share(significant(defect, size), squares, decided)
        outs.append(Moving(a, b, mean @ d + rest))
    return outs


def _reverse_jacobian(fn: Callable[[Array], list[Array]]) -> Callable:
    """The Jacobian of each output; `None` for those that are not real."""

    def of(x: Array) -> list[Array | None]:
        real = [jnp.issubdtype(out.dtype, jnp.inexact) for out in jax.eval_shape(fn, x)]
        chosen = lambda x: [out for out, on in zip(fn(x), real, strict=True) if on]
        found = iter(jax.jacrev(chosen)(x))
        return [next(found) if on else None for on in real]

    return of


def _shared(primitive: Any, values: list[Value], params: dict[str, Any]) -> list[Value]:
    """The outputs, where only choices differ between the points.

    The difference is attributed to the numbers that decided the choices.
    """
    squares, decided = _totals([v for v in values if isinstance(v, Switching)])
    outs = []
    ends = [evaluate(primitive, list(map(at, values)), params) for at in (at_a, at_b)]
    for a, b in zip(*ends, strict=True):
        if jnp.issubdtype(a.dtype, jnp.inexact):
            outs.append(Moving(a, b, share(b - a, squares, decided)))
        else:
            outs.append(_choice(a, b, squares, decided))
    return outs


def _totals(choices: list[Switching]) -> tuple[Array, Array]:
    total = lambda arrays: sum(map(jnp.sum, arrays), jnp.zeros(()))
    return total([v.squares for v in choices]), total([v.decided for v in choices])


def _choice(a: Array, b: Array, squares: Array, decided: Array) -> Switching:
    spread = [jnp.broadcast_to(x, a.shape).astype(float) for x in (squares, decided)]
    return Switching(a, b, *spread)
