"""Factors of matrices of any size, as loops over the columns, and sorting.

The forms for a few rows, without loops, are those of `small_matrices.py`.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._types import Count
from .factors import Forms, outputs
from .small_matrices import is_before, sorted_along


# The most comparisons of a sort: each entry is compared with all others of its row. Three
# hundred entries take 0.15 ms, six times as long as by XLA, but the program stays whole.
_MOST_COMPARED = 100_000


def _column(x: Array, k: Count) -> Array:
    return jax.lax.dynamic_index_in_dim(x, k, axis=1, keepdims=False)


def _row(x: Array, k: Count) -> Array:
    return jax.lax.dynamic_index_in_dim(x, k, axis=0, keepdims=False)


def _lu(
    matrix: Float[Array, "m n"],
) -> tuple[Float[Array, "m n"], Int[Array, " k"], Int[Array, " m"]]:
    """The factors, the pivot of each column, and the order of the rows."""
    num_rows, num_columns = matrix.shape
    rows = jnp.arange(num_rows, dtype=jnp.int32)
    columns = jnp.arange(num_columns, dtype=jnp.int32)

    def turn(
        carry: tuple[Array, Array, Array], k: Count
    ) -> tuple[tuple[Array, Array, Array], Count]:
        # Rows stay where they are until the end. A row has a `place`, and the row at each
        # place is in `order`.
        matrix, place, order = carry
        column = _column(matrix, k)
        sizes = jnp.where(place >= k, jnp.abs(column), -1.0)
        chosen = jnp.argmax(sizes).astype(jnp.int32)
        pivot, first = (
            jax.lax.dynamic_index_in_dim(x, i, keepdims=False)
            for x, i in ((place, chosen), (order, k))
        )
        place = jnp.where(rows == chosen, k, jnp.where(rows == first, pivot, place))
        order = jnp.where(rows == k, chosen, jnp.where(rows == pivot, first, order))
        row = _row(matrix, chosen)
        divisor = row[k]
        # A column of zeros is left as it is, as by LAPACK.
        divisor = jnp.where(divisor == 0, 1, divisor)
        factors = jnp.where(place > k, column / divisor, 0)
        rest = jnp.where(columns > k, row, 0)
        matrix = matrix - factors[:, None] * rest[None]
        is_below = (place > k)[:, None] & (columns == k)[None]
        return (jnp.where(is_below, factors[:, None], matrix), place, order), pivot

    steps = jnp.arange(min(num_rows, num_columns), dtype=jnp.int32)
    (matrix, _, order), pivots = jax.lax.scan(turn, (matrix, rows, rows), steps)
    return matrix.at[order].get(mode="promise_in_bounds"), pivots, order


def _cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower factor, with zeros above the diagonal."""
    rows = jnp.arange(matrix.shape[0])

    def turn(matrix: Array, k: Count) -> tuple[Array, Array]:
        column = _column(matrix, k)
        column = jnp.where(rows >= k, column / jnp.sqrt(column[k]), 0)
        return matrix - column[:, None] * column[None], column

    _, columns = jax.lax.scan(turn, matrix, rows)
    # As by LAPACK, nothing is left of the factor of a matrix that is not definite.
    return jnp.where(jnp.isfinite(columns[-1, -1]), columns.T, jnp.nan)


def _substituted(
    matrix: Float[Array, "n n"], right: Float[Array, "n k"], is_unit: bool
) -> Float[Array, "n k"]:
    """The solution for a lower triangular matrix."""
    rows = jnp.arange(matrix.shape[0])

    def turn(right: Array, k: Count) -> tuple[Array, Array]:
        column, row = _column(matrix, k), _row(right, k)
        row = row if is_unit else row / column[k]
        return right - jnp.where(rows > k, column, 0)[:, None] * row[None], row

    return jax.lax.scan(turn, right, rows)[1]


def _sorted(operands: list[Array]) -> list[Array]:
    """The operands in the order of the first, by the rank of each entry."""
    keys = operands[0]
    numbers = jnp.arange(keys.size)

    def add(k: Count, ranks: Array) -> Array:
        key = jax.lax.dynamic_index_in_dim(keys, k, keepdims=False)
        # Equal entries keep their order.
        first = is_before(key, keys) | (~is_before(keys, key) & (k < numbers))
        return ranks + first.astype(ranks.dtype)

    def put(k: Count, source: Array) -> Array:
        rank = jax.lax.dynamic_index_in_dim(ranks, k, keepdims=False)
        return jnp.where(numbers == rank, k, source)

    ranks = jax.lax.fori_loop(0, keys.size, add, jnp.zeros_like(numbers))
    source = jax.lax.fori_loop(0, keys.size, put, jnp.zeros_like(numbers))
    return [x.at[source].get(mode="promise_in_bounds") for x in operands]


_FORMS = Forms(_cholesky, _lu, _substituted)


def by_loops(name: str, values: list[Array], params: dict[str, Any]) -> list[Array]:
    """The outputs of `lu`, `cholesky`, `triangular_solve` or `sort`."""
    if name == "sort":
        return sorted_along(_sorted, values, params["dimension"])
    return outputs(name, values, params, _FORMS)


def can_be_loops(eqn: Any) -> bool:
    """Whether there is a form of loops for one of these primitives."""
    name, params, x = eqn.primitive.name, eqn.params, eqn.invars[0].aval
    if name == "sort":
        compared = math.prod(x.shape) * x.shape[params["dimension"]]
        return params["num_keys"] == 1 and 0 < compared <= _MOST_COMPARED
    is_factor = name in ("cholesky", "lu", "triangular_solve")
    return is_factor and eqn.outvars[0].aval.size > 0
