"""Products of small matrices as plain arithmetic, which XLA fuses into a loop."""

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array, PyTree

from ..jaxprs import evaluate, interpret
from ..primitives import CONTRACTION, JIT
from .possible import LARGEST_SUM


# A sum of more products than this is left to `jnp.sum`.
_MAX_TERMS = 32
# `plain_products` leaves products with more multiplications than this as they are.
_MAX_MULTIPLICATIONS = 4096


def written_out(left: Array, right: Array, dimension_numbers: Any) -> Array:
    """`dot_general` as a sum of products, which XLA fuses with the operations around it."""
    contracted, batch = dimension_numbers
    one, shape = _as_rows(left, contracted[0], batch[0])
    other, last = _as_rows(right, contracted[1], batch[1])
    count = one.shape[-1]
    shape = (*(left.shape[k] for k in batch[0]), *shape, *last)
    if one.size * other.shape[1] <= LARGEST_SUM or not 0 < count <= _MAX_TERMS:
        out = jnp.sum(one[:, :, None] * other[:, None], axis=-1)
    else:
        terms = (one[:, :, None, k] * other[:, None, :, k] for k in range(count))
        out = functools.reduce(jnp.add, terms)
    return out.reshape(shape)


def summed(x: Array, axes: int = 1) -> Array:
    """The sum over the last axes, which stays possible in one function where it is long."""
    flat = x.reshape(*x.shape[: x.ndim - axes], -1)
    if flat.size <= LARGEST_SUM or flat.shape[-1] > 2 * _MAX_TERMS:
        return jnp.sum(flat, axis=-1)
    return functools.reduce(jnp.add, (flat[..., k] for k in range(flat.shape[-1])))


def _as_rows(
    x: Array, contracted: tuple[int, ...], batch: tuple[int, ...]
) -> tuple[Array, tuple[int, ...]]:
    """An operand as (batch, free, contracted), and the shape of its free axes."""
    free = [k for k in range(x.ndim) if k not in (*contracted, *batch)]
    sizes = [math.prod(x.shape[k] for k in axes) for axes in (batch, free, contracted)]
    moved = jnp.transpose(x, (*batch, *free, *contracted)).reshape(sizes)
    return moved, tuple(x.shape[k] for k in free)


def plain_products(
    fn: Callable[[Array, PyTree], Array], like: Array, args: PyTree
) -> Callable[[Array], Array]:
    """`fn(x, args)` as a function of `x`, with small `dot_general`s as sums of products.

    A matrix product would be a call of a library in every pass of a loop, and would keep
    the loop from being compiled into one function. The Jacobian of `matrix @ vector` has
    such products. All arrays that `fn` depends on must be in `args`, not closed over.
    """
    arrays, static = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def fn_of_leaves(x: Array, *leaves: Array) -> Array:
        return fn(x, eqx.combine(jax.tree.unflatten(structure, leaves), static))

    program = jax.make_jaxpr(fn_of_leaves)(like, *leaves)
    return lambda x: interpret(program.jaxpr, program.consts, [x, *leaves], _equation)[0]


def _equation(equation: Any, values: list[Any]) -> list[Any]:
    primitive, params = equation.primitive, equation.params
    if primitive.name in JIT:
        inner: ClosedJaxpr = params["jaxpr"]
        return interpret(inner.jaxpr, inner.consts, values, _equation)
    if primitive.name == CONTRACTION:
        left, right = values
        numbers = params["dimension_numbers"]
        count = math.prod(left.shape[k] for k in numbers[0][0])
        if equation.outvars[0].aval.size * count <= _MAX_MULTIPLICATIONS:
            return [written_out(left, right, numbers)]
    return evaluate(primitive, values, params)
