"""Factors of matrices of any size, as loops over the columns, and sorting.

The forms for a few rows, without loops, are those of `small_matrices.py`.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._types import Count
from .factors import Forms, outputs
from .small_matrices import is_before, sorted_along


# Columns of a block of a large matrix, which are factored before the others change.
_BLOCK = 16
# The most comparisons of a sort: each entry is compared with all others of its row. Three
# hundred entries take 0.15 ms, six times as long as by XLA, but the program stays whole.
_MOST_COMPARED = 100_000


def _column(x: Array, k: Count) -> Array:
    return jax.lax.dynamic_index_in_dim(x, k, axis=1, keepdims=False)


def _row(x: Array, k: Count) -> Array:
    """A row of a matrix, or an entry of a vector."""
    return jax.lax.dynamic_index_in_dim(x, k, axis=0, keepdims=False)


class _Rows(NamedTuple):
    """Rows stay where they are until the end of a factorisation.

    A row has a `place`, and the row at each place is in `order`.
    """

    place: Int[Array, " m"]
    order: Int[Array, " m"]

    def exchanged(self, chosen: Count, k: Count) -> "_Rows":
        """With the chosen row at the place `k`."""
        place, order = self
        before, first = (_row(x, i) for x, i in ((place, chosen), (order, k)))
        numbers = jnp.arange(place.size, dtype=place.dtype)
        place = jnp.where(numbers == chosen, k, jnp.where(numbers == first, before, place))
        order = jnp.where(numbers == k, chosen, jnp.where(numbers == before, first, order))
        return _Rows(place, order)


def _factored(
    panel: Float[Array, "m w"], rows: _Rows, first: Count, size: int
) -> tuple[tuple[Float[Array, "m w"], _Rows], Int[Array, " w"]]:
    """The columns of the factors from a first one on, and the pivot of each.

    Rows from `size` on are the pivots of no other columns than those from `size` on.
    """
    columns = jnp.arange(panel.shape[1], dtype=jnp.int32)
    fills = jnp.arange(len(panel), dtype=jnp.int32) >= size

    def turn(carry: tuple[Array, _Rows], k: Count) -> tuple[tuple[Array, _Rows], Count]:
        panel, rows = carry
        column, at = _column(panel, k), first + k
        is_left = (rows.place >= at) & (~fills | (at >= size))
        sizes = jnp.where(is_left, jnp.abs(column), -1.0)
        chosen = jnp.argmax(sizes).astype(jnp.int32)
        pivot, rows = _row(rows.place, chosen), rows.exchanged(chosen, at)
        row = _row(panel, chosen)
        divisor = row[k]
        # A column of zeros is left as it is, as by LAPACK.
        divisor = jnp.where(divisor == 0, 1, divisor)
        factors = jnp.where(rows.place > at, column / divisor, 0)
        rest = jnp.where(columns > k, row, 0)
        panel = panel - factors[:, None] * rest[None]
        is_below = (rows.place > at)[:, None] & (columns == k)[None]
        return (jnp.where(is_below, factors[:, None], panel), rows), pivot

    return jax.lax.scan(turn, (panel, rows), columns[: panel.shape[0]])


def _lu(
    matrix: Float[Array, "m n"],
) -> tuple[Float[Array, "m n"], Int[Array, " k"], Int[Array, " m"]]:
    """The factors, the pivot of each column, and the order of the rows."""
    if matrix.shape[0] == matrix.shape[1] > 2 * _BLOCK:
        return _lu_by_blocks(matrix)
    numbers = jnp.arange(matrix.shape[0], dtype=jnp.int32)
    rows, first = _Rows(numbers, numbers), jnp.zeros((), jnp.int32)
    (matrix, rows), pivots = _factored(matrix, rows, first, len(matrix))
    return matrix.at[rows.order].get(mode="promise_in_bounds"), pivots, rows.order


def _lu_by_blocks(
    matrix: Float[Array, "n n"],
) -> tuple[Float[Array, "n n"], Int[Array, " n"], Int[Array, " n"]]:
    """`_lu`, such that all columns change once for a block of columns, by a product."""
    size = len(matrix)
    more = -size % _BLOCK
    # The rows and columns that fill the last block are those of a unit matrix.
    filling = np.eye(size + more, dtype=matrix.dtype)[:, size:]
    matrix = jnp.concatenate([jnp.pad(matrix, ((0, more), (0, 0))), filling], axis=1)
    numbers = jnp.arange(size + more, dtype=jnp.int32)

    def block(
        carry: tuple[Array, _Rows], first: Count
    ) -> tuple[tuple[Array, _Rows], Array]:
        matrix, rows = carry
        own = jax.lax.dynamic_slice_in_dim(matrix, first, _BLOCK, 1)
        (own, rows), pivots = _factored(own, rows, first, size)
        chosen = jax.lax.dynamic_slice_in_dim(rows.order, first, _BLOCK)
        taken = lambda x: x.at[chosen].get(mode="promise_in_bounds")
        is_after = (numbers >= first + _BLOCK)[None]
        upper = jnp.where(is_after, _substituted(taken(own), taken(matrix), True), 0)
        # The pivot rows are replaced, and the rows below them changed.
        place = rows.place[:, None] - first
        is_new = (place >= 0) & (place < _BLOCK)
        left = jnp.where(place >= _BLOCK, -own, 0)
        left = jnp.where(place == np.arange(_BLOCK, dtype=np.int32)[None], 1, left)
        kept = jnp.where(is_new & is_after, 0, matrix)
        is_own = (numbers >= first)[None] & ~is_after
        repeated = own[:, np.arange(size + more) % _BLOCK]
        return (jnp.where(is_own, repeated, kept + left @ upper), rows), pivots

    carry = matrix, _Rows(numbers, numbers)
    firsts = _BLOCK * jnp.arange(len(matrix) // _BLOCK, dtype=jnp.int32)
    (matrix, rows), pivots = jax.lax.scan(block, carry, firsts)
    order = rows.order[:size]
    out = matrix.at[order].get(mode="promise_in_bounds")[:, :size]
    return out, pivots.ravel()[:size], order


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
        key = _row(keys, k)
        # Equal entries keep their order.
        first = is_before(key, keys) | (~is_before(keys, key) & (k < numbers))
        return ranks + first.astype(ranks.dtype)

    def put(k: Count, source: Array) -> Array:
        return jnp.where(numbers == _row(ranks, k), k, source)

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
