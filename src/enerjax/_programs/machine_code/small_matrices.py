"""Sorting, and factors of small matrices, in operations that are possible in one function.

XLA calls a library for each of them. For a few rows the call takes longer than the plain
operations, and it keeps the program around it from being one function.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._types import Count
from .factors import Forms, of_each, outputs


# The number of rows up to which matrices are small, and that of entries to sort.
_MOST_ROWS, _MOST_SORTED = 16, 32


def _cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower factor, with zeros above the diagonal."""
    columns = []
    for k in range(matrix.shape[0]):
        column = matrix[:, 0] / jnp.sqrt(matrix[0, 0])
        columns.append(jnp.pad(column, (k, 0)))
        matrix = matrix[1:, 1:] - column[1:, None] * column[None, 1:]
    factor = jnp.stack(columns, axis=1)
    # As by LAPACK, nothing is left of the factor of a matrix that is not definite.
    return jnp.where(jnp.isfinite(factor[-1, -1]), factor, jnp.nan)


def _substituted(
    matrix: Float[Array, "n n"], right: Float[Array, "n k"], is_unit: bool
) -> Float[Array, "n k"]:
    """The solution for a lower triangular matrix."""
    rows = []
    for k in range(matrix.shape[0]):
        row = right[:1] if is_unit else right[:1] / matrix[k, k]
        rows.append(row)
        right = right[1:] - matrix[k + 1 :, k, None] * row
    return jnp.concatenate(rows)


def _lu(
    matrix: Float[Array, "m n"],
) -> tuple[Float[Array, "m n"], Int[Array, " k"], Int[Array, " m"]]:
    """The factors, the pivot of each column, and the order of the rows."""
    num_rows, num_columns = matrix.shape
    numbers = jnp.arange(num_rows, dtype=jnp.int32)
    pivots, order = [], numbers
    for k in range(min(num_rows, num_columns)):
        sizes = jnp.abs(matrix[k:, k])
        # The first of the largest; the last row where there is none, because of a NaN.
        least = jnp.min(jnp.where(sizes == jnp.max(sizes), numbers[k:], num_rows - 1))
        pivots.append(least)
        exchanged = jnp.where(numbers == least, k, numbers)
        exchanged = jnp.where(numbers == k, least, exchanged)
        matrix, order = (
            x.at[exchanged].get(mode="promise_in_bounds") for x in (matrix, order)
        )
        # A column of zeros is left as it is, as by LAPACK.
        pivot = matrix[k, k]
        factors = matrix[k + 1 :, k] / jnp.where(pivot == 0, 1, pivot)
        rest = matrix[k + 1 :, k + 1 :] - factors[:, None] * matrix[None, k, k + 1 :]
        below = jnp.concatenate([matrix[k + 1 :, :k], factors[:, None], rest], axis=1)
        matrix = jnp.concatenate([matrix[: k + 1], below])
    return matrix, jnp.stack(pivots), order


def _order_after(pivots: Int[Array, " w"], *, permutation_size: int) -> Int[Array, " m"]:
    """The order of rows after each of the first was exchanged with its pivot, in turn."""
    rows = numbers = jnp.arange(permutation_size, dtype=pivots.dtype)
    if permutation_size > _MOST_ROWS:
        return jax.lax.fori_loop(0, pivots.size, functools.partial(_exchange, pivots), rows)
    # Without a loop, as programs for lanes side by side need it.
    for k in range(pivots.shape[0]):
        exchanged = jnp.where(numbers == pivots[k], k, numbers)
        exchanged = jnp.where(numbers == k, pivots[k], exchanged)
        rows = rows.at[exchanged].get(mode="promise_in_bounds")
    return rows


def _exchange(pivots: Int[Array, " w"], k: Count, rows: Int[Array, " m"]) -> Array:
    entry = lambda x, k: jax.lax.dynamic_slice(x, (k,), (1,))
    put = jax.lax.dynamic_update_slice
    pivot = entry(pivots, k)[0]
    one, other = entry(rows, k), entry(rows, pivot)
    return put(put(rows, other, (k,)), one, (pivot,))


def _sorted(operands: list[Array]) -> list[Array]:
    """The operands in the order of the first, by the rank of each entry."""
    (keys, *_), count = operands, operands[0].shape[0]
    before = is_before(keys[:, None], keys[None])
    numbers = jnp.arange(count)
    # Equal entries keep their order.
    first = before | (~before.T & (numbers[:, None] < numbers[None]))
    ranks = jnp.sum(first.astype(numbers.dtype), axis=0)
    source = jnp.sum(jnp.where(ranks[None] == numbers[:, None], numbers[None], 0), axis=1)
    return [x.at[source].get(mode="promise_in_bounds") for x in operands]


def sorted_along(
    fn: Callable[[list[Array]], list[Array]], operands: list[Array], axis: int
) -> list[Array]:
    """The operands sorted along an axis, by a function for arrays of one axis."""
    moved = [jnp.moveaxis(x, axis, -1) for x in operands]
    out = of_each(lambda *xs: fn(list(xs)), 1, *moved)
    return [jnp.moveaxis(x, -1, axis) for x in out]


def is_before(a: Array, b: Array) -> Bool[Array, "..."]:
    """Whether `a` comes before `b`; NaN comes last."""
    if not jnp.issubdtype(a.dtype, jnp.inexact):
        return a < b
    return (a < b) | (jnp.isnan(b) & ~jnp.isnan(a))


_FORMS = Forms(_cholesky, _lu, _substituted)


def in_plain_operations(
    name: str, values: list[Array], params: dict[str, Any]
) -> list[Array]:
    """The outputs of one of `FACTORS`."""
    if name == "sort":
        return sorted_along(_sorted, values, params["dimension"])
    if name != "lu_pivots_to_permutation":
        return outputs(name, values, params, _FORMS)
    size = params["permutation_size"]
    return [of_each(functools.partial(_order_after, permutation_size=size), 1, *values)]


def is_small(eqn: Any) -> bool:
    """Whether the plain form of one of these primitives is the faster one."""
    name, params, x = eqn.primitive.name, eqn.params, eqn.invars[0].aval
    if name == "sort":
        return params["num_keys"] == 1 and 0 < x.shape[params["dimension"]] <= _MOST_SORTED
    if name == "lu_pivots_to_permutation":
        return 0 < x.shape[-1]
    is_real = jnp.issubdtype(x.dtype, jnp.floating)
    return is_real and 0 < min(x.shape) and max(x.shape[-2:]) <= _MOST_ROWS
