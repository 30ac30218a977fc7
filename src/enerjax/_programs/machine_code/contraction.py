"""Products of arrays: products of their entries, and sums of these."""

import math
from typing import Any, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .values import Cells, dtype_of, MOST_CELLS, type_name, Unsupported, Value


if TYPE_CHECKING:
    from .evaluation import Evaluation

# The most products of two matrices that are written out. A loop over the rows has less
# code, and reads its numbers in vectors.
_MOST_PRODUCTS = 8_000


def contraction(self: "Evaluation", eqn: Any, values: list[Value]) -> list[Value]:
    """A product of arrays: products of entries, and their sums."""
    (contracted_left, contracted_right), (batch_left, batch_right) = eqn.params[
        "dimension_numbers"
    ]
    left, right = values
    out = eqn.outvars[0].aval
    terms = math.prod(left.shape[k] for k in contracted_left)
    if out.size == 0 or terms == 0:
        return [np.zeros(out.shape, out.dtype)]
    dtype = type_name(out.dtype)
    free = lambda x, a, b: [k for k in range(len(x.shape)) if k not in (*a, *b)]
    free_left = free(left, contracted_left, batch_left)
    free_right = free(right, contracted_right, batch_right)
    shape = [
        *(left.shape[k] for k in batch_left),
        *(left.shape[k] for k in free_left),
        *(right.shape[k] for k in free_right),
        *(left.shape[k] for k in contracted_left),
    ]
    size = math.prod(shape)
    lanes = [
        x.n if isinstance(x, Cells) and x.lane is not None else 1 for x in (left, right)
    ]
    longest = max(max(shape), *lanes)
    # More of them would be kept in memory, all at the same time.
    is_matrix = not batch_left and free_left and free_right
    if size // longest > MOST_CELLS or (is_matrix and size > _MOST_PRODUCTS):
        return [_large_product(self, eqn, values)]
    nb, nl, nr, nc = map(len, (batch_left, free_left, free_right, contracted_left))
    turn = lambda x, order: self.move(
        jax.lax.transpose_p, [x], dict(permutation=tuple(order))
    )[0]
    left = turn(left, [*batch_left, *free_left, *contracted_left])
    right = turn(right, [*batch_right, *free_right, *contracted_right])
    spread = lambda x, dims: self.move(
        jax.lax.broadcast_in_dim_p,
        [x],
        dict(shape=tuple(shape), broadcast_dimensions=tuple(dims), sharding=None),
    )[0]
    at = list(range(len(shape)))
    kept = nb + nl + nr
    left = spread(left, [*at[: nb + nl], *at[kept:]])
    right = spread(right, [*at[:nb], *at[nb + nl : kept], *at[kept:]])
    of = [dtype_of(left), dtype_of(right)]
    rule = lambda a, b: self.graph.op(
        "mul",
        dtype,
        (
            self.graph.op("convert", dtype, (a,), of[0]),
            self.graph.op("convert", dtype, (b,), of[1]),
        ),
    )
    product = self.map(rule, [left, right], tuple(shape), dtype, at[kept:])
    if nc == 0:
        return [product]
    return [self.total("add", product, tuple(at[kept:]))]


def _large_product(self: "Evaluation", eqn: Any, values: list[Value]) -> Value:
    """A product of large arrays, row by row in a loop."""
    numbers = eqn.params["dimension_numbers"]
    (contracted, of_right), (batch, right_batch) = numbers
    (left, _), dtype = values, eqn.outvars[0].aval.dtype
    free = [k for k in range(len(left.shape)) if k not in (*contracted, *batch)]
    if len(batch) > 1 or not (batch or free):
        raise Unsupported("a product of large arrays")

    def by_batch(a: Array, b: Array) -> Array:
        product = lambda x: jax.lax.dot_general(
            x[0], x[1], _without_batch(numbers), preferred_element_type=dtype
        )
        first = jnp.moveaxis(a, batch[0], 0), jnp.moveaxis(b, right_batch[0], 0)
        return jax.lax.map(product, first)

    def by_row(a: Array, b: Array) -> Array:
        axes = tuple(k - (k > free[0]) for k in contracted)
        product = lambda row: jax.lax.dot_general(
            row, b, ((axes, of_right), ((), ())), preferred_element_type=dtype
        )
        return jax.lax.map(product, jnp.moveaxis(a, free[0], 0))

    return self.function(by_batch if batch else by_row, *values)[0]


def _without_batch(numbers: Any) -> Any:
    (left, right), (batch_left, batch_right) = numbers
    less = lambda axes, batch: tuple(k - (k > batch[0]) for k in axes)
    return (less(left, batch_left), less(right, batch_right)), ((), ())
