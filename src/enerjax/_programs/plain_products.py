"""Small products as plain arithmetic, which XLA compiles into the loop around them."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array, PyTree

from .one_function.products import written_out
from .tracing import evaluate, interpret


# Multiplications in a product that is written out.
_SMALL = 4096


def plain_products(
    fn: Callable[[Array, PyTree], Array], like: Array, args: PyTree
) -> Callable[[Array], Array]:
    """`fn(x, args)` as a function of `x`, with small `dot_general`s as sums of products.

    As a matrix product it would be a call of its own in every pass of a loop, and keep the
    loop from being compiled into one function; a Jacobian makes such products from every
    `matrix @ vector`. What `fn` depends on must be in `args`, not closed over.
    """
    arrays, static = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def flat_fn(x: Array, *leaves: Array) -> Array:
        return fn(x, eqx.combine(jax.tree.unflatten(structure, leaves), static))

    program = jax.make_jaxpr(flat_fn)(like, *leaves)
    return lambda x: interpret(program.jaxpr, program.consts, [x, *leaves], _equation)[0]


def _equation(equation: Any, values: list[Any]) -> list[Any]:
    primitive, params = equation.primitive, equation.params
    if primitive.name in ("jit", "pjit"):
        inner: ClosedJaxpr = params["jaxpr"]
        return interpret(inner.jaxpr, inner.consts, values, _equation)
    if primitive.name == "dot_general":
        left, right = values
        numbers = params["dimension_numbers"]
        count = math.prod(left.shape[k] for k in numbers[0][0])
        if equation.outvars[0].aval.size * count <= _SMALL:
            return [written_out(left, right, numbers)]
    return evaluate(primitive, values, params)
