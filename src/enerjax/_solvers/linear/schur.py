"""The Schur complement `G = B W B^T` of sparse rows `B` and a block-diagonal `W`.

It is the matrix of the equations for the multipliers of constraints with gradients `B`,
where `W` is the inverse inertia. Two constraints are coupled in `G` only if they act on a
common body, so `G` is as sparse as the graph of the mechanism. Its rows are numbered by the
reverse Cuthill-McKee algorithm and divided into blocks, so that `G` is block tridiagonal,
and it is eliminated block by block. `G` is symmetric and positive definite, or is made so
by a regularisation where constraints are redundant, so the elimination needs no pivoting.
"""

import functools
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from ..._programs import (
    at_places,
    Indices,
    jacobian_pattern,
    shape_of,
    with_any,
)
from .block_diagonal import BlockDiagonal, Symmetric
from .block_tridiagonal import block_sizes, coloured_products, column_colours


# The number of unknowns up to which `B` is treated as dense.
_FEW = 8
# The largest number of rows of a block. Larger blocks would be eliminated too slowly.
_WIDEST = 32
# The number of rows up to which the loop that inverts a block is unrolled.
_UNROLLED = 16


class SchurTables(Indices):
    """The index tables by which the entries of `B` and `G` are found.

    They are constructed at trace time. A row of `B` is stored as segments, one for each
    block of `W` in which it has entries. Indices of absent entries are one past the end,
    except where what is read is multiplied by zero or not used; then they are any index.

    - `colours`: the colours of the columns of `B`. Columns of equal colour share no row.
    - `touched`: the block of `W` of each segment, shape `(rows, segments)`.
    - `columns`: the unknowns of each segment, shape `(rows, segments, size)`; `read`: the
      same with any unknown for absent ones.
    - `entries`: the index of each entry of the segments in the coloured products.
    - `transposed`: the indices of the entries of each column of `B` in the segments.
    - `diagonal`, `below`: for each block of `G`, on and below the diagonal, the indices in
      the segments of the entries that it is computed from; see `_shared`.
    - `order`: the row of `G` at each position of its blocks, or any row beyond the end of
      a short block.
    - `back`: the position of each row of `G` in its blocks.
    - `padding`: ones on the diagonal where a block is smaller than the largest one.
    """

    def __init__(self, pattern: "scipy.sparse.csr_array", weight: Symmetric):
        self.num_rows, size = shape_of(pattern)
        is_blocks = isinstance(weight, BlockDiagonal)
        blocks = weight.places.rows if is_blocks else np.arange(size)[None]
        rows, columns = pattern.nonzero()
        super().__init__(np.concatenate([rows, columns, blocks.ravel(), blocks.shape]))
        self.colours = column_colours(pattern, np.arange(size))
        label = np.zeros(size + 1, int)
        label[blocks.ravel()] = np.repeat(np.arange(len(blocks)), blocks.shape[1])
        shape = self.num_rows, len(blocks)
        incidence = scipy.sparse.csr_array(
            (np.ones(rows.size), (rows, label[columns])), shape=shape
        )
        counts = np.diff(incidence.indptr)
        within = np.arange(incidence.nnz) - np.repeat(incidence.indptr[:-1], counts)
        self.touched = np.full((self.num_rows, max(counts.max(initial=0), 1)), len(blocks))
        self.touched[np.repeat(np.arange(self.num_rows), counts), within] = (
            incidence.indices
        )
        none = np.full((1, blocks.shape[1]), size)
        self.columns = np.concatenate([blocks, none])[self.touched]
        self.read = with_any(self.columns, size)
        self._find_entries(rows, columns, size)
        self._cut(incidence)

    @property
    def description(self) -> str:
        stored = self.num_blocks * self.width**2 + (self.num_blocks - 1) * self.width**2
        return (
            f"{self.num_rows} rows, block tridiagonal, {self.num_blocks} blocks of "
            f"{self.width}, {stored / self.num_rows**2:.0%} of a full matrix"
        )

    def _find_entries(self, rows: np.ndarray, columns: np.ndarray, size: int) -> None:
        num_colours = int(self.colours.max(initial=0)) + 1
        row = np.arange(self.num_rows)[:, None, None]
        number = lambda row, column: row * (size + 1) + column
        known = np.isin(number(row, self.columns), number(rows, columns))
        place = row * num_colours + np.append(self.colours, 0)[self.columns]
        self.entries = np.where(known, place, self.num_rows * num_colours)
        places, columns = np.flatnonzero(known), self.columns[known]
        order = np.argsort(columns, kind="stable")
        counts = np.bincount(columns, minlength=size)
        within = np.arange(order.size) - np.repeat(np.cumsum(counts) - counts, counts)
        self.transposed = np.full((size, counts.max(initial=1)), known.size)
        self.transposed[columns[order], within] = places[order]

    def _cut(self, incidence: "scipy.sparse.csr_array") -> None:
        coupling = scipy.sparse.csr_array(incidence @ incidence.T)
        order = scipy.sparse.csgraph.reverse_cuthill_mckee(coupling, symmetric_mode=True)
        sizes = block_sizes(scipy.sparse.csr_array(coupling[order][:, order]))
        self.width, self.num_blocks = int(sizes.max(initial=1)), sizes.size
        number = np.repeat(np.arange(sizes.size), sizes)
        within = np.arange(self.num_rows) - (np.cumsum(sizes) - sizes)[number]
        self.back = np.empty(self.num_rows, int)
        self.back[order] = number * self.width + within
        order = np.full(sizes.size * self.width, self.num_rows)
        order[self.back] = np.arange(self.num_rows)
        self.order = with_any(order, self.num_rows)
        along = order.reshape(self.num_blocks, self.width)
        self.padding = (along == self.num_rows)[:, :, None] * np.eye(self.width)
        self.diagonal = self._shared([(rows, rows) for rows in along])
        self.below = self._shared([(after, rows) for rows, after in pairwise(along)])

    def _shared(self, pairs: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """The entries of `B` in the columns that two blocks of rows have in common.

        Returns the indices of the entries of the rows of both blocks of each pair, shape
        `(2, pairs, columns, width)`. Indices of absent entries are one past the end.
        """
        size, none = self.transposed.shape[0], self.columns.size
        # One more row for the absent rows of short blocks.
        columns = self.columns.reshape(self.num_rows, -1)
        columns = np.pad(columns, ((0, 1), (0, 0)), constant_values=size)
        in_both = lambda a, b: np.intersect1d(columns[a], columns[b])
        shared = [found[found < size] for found in (in_both(*pair) for pair in pairs)]
        max_shared = max(map(len, shared), default=0)
        table = np.full((2, len(pairs), max_shared, self.width), none)
        for k, (sides, found) in enumerate(zip(pairs, shared, strict=True)):
            for side, rows in enumerate(sides):
                row, entry = np.nonzero(np.isin(columns[rows], found))
                at = np.searchsorted(found, columns[rows][row, entry])
                table[side, k, at, row] = rows[row] * columns.shape[1] + entry
        return table


class Schur(eqx.Module):
    """`B`, and the block factorisation of `G = B W B^T`.

    - `rows`: the segments of the rows of `B`; see `SchurTables`.
    - `factors`: the blocks below the diagonal of the unit lower triangular factor.
    - `inverses`: the inverses of the diagonal blocks.
    """

    tables: SchurTables = eqx.field(static=True)
    rows: Float[Array, "rows segments size"]
    factors: Float[Array, "below width width"]
    inverses: Float[Array, "blocks width width"]

    def product(self, u: Float[Array, " n"]) -> Float[Array, " rows"]:
        """`B u`"""
        return jnp.sum(self.rows * at_places(u, self.tables.read), axis=(-2, -1))

    def transposed(self, x: Float[Array, " rows"]) -> Float[Array, " n"]:
        """`B^T x`"""
        entries = jnp.append((self.rows * x[:, None, None]).ravel(), 0)
        return jnp.sum(at_places(entries, self.tables.transposed), axis=-1)

    def solve(self, right: Float[Array, "k rows"]) -> Float[Array, "k rows"]:
        """`G^-1` times each of `k` vectors."""
        tables = self.tables
        count = right.shape[0]
        along = at_places(right.T, tables.order)
        along = along.reshape(tables.num_blocks, tables.width, count)
        along = jnp.swapaxes(along, 1, 2)
        if tables.num_blocks == 1:
            along = _products(self.inverses, along)
        else:
            along = self._substituted(along)
        return at_places(jnp.swapaxes(along, 1, 2).reshape(-1, count), tables.back).T

    def _substituted(
        self, along: Float[Array, "blocks k width"]
    ) -> Float[Array, "blocks k width"]:
        """The forward and the backward substitution along the blocks."""

        def forward(before, item):
            factor, value = item
            value = value - _products(factor[None], before[None])[0]
            return value, value

        def backward(after, item):
            factor, value = item
            value = value - _products(factor.T[None], after[None])[0]
            return value, value

        first = along[0]
        _, rest = jax.lax.scan(forward, first, (self.factors, along[1:]))
        along = jnp.concatenate([first[None], rest])
        along = _products(self.inverses, along)
        last = along[-1]
        _, rest = jax.lax.scan(backward, last, (self.factors, along[:-1]), reverse=True)
        return jnp.concatenate([rest, last[None]])


def _products(
    matrices: Float[Array, "n width width"], x: Float[Array, "n k width"]
) -> Float[Array, "n k width"]:
    return jnp.sum(matrices[:, None] * x[:, :, None], axis=-1)


def schur_tables(
    fn: Callable[[Array], Array], like: Float[Array, " n"], weight: Symmetric
) -> SchurTables | None:
    """The tables for the Jacobian of `fn`; `None` if it has no rows or too wide blocks."""
    num_rows = jax.eval_shape(fn, like).shape[0]
    pattern = jacobian_pattern(fn, like) if like.size > _FEW else None
    if num_rows == 0:
        return None
    if pattern is None:
        pattern = scipy.sparse.csr_array(np.ones((num_rows, like.size), bool))
    tables = SchurTables(scipy.sparse.csr_array(pattern), weight)
    return tables if tables.width <= _WIDEST else None


def schur(
    tables: SchurTables,
    fn: Callable[[Array], Array],
    at: Float[Array, " n"],
    weight: Symmetric,
    regularisation: Float[Array, " rows"] | None = None,
) -> Schur:
    """The factorised `G`, where `B` is the Jacobian of `fn` at a point.

    With a `regularisation`, this is added to the diagonal of a `G` that may be singular.
    """
    products = coloured_products(fn, at, tables.colours)
    rows, weighted = _weighted(tables, products, weight)
    diagonal, below = _blocks(tables, rows, weighted)
    if regularisation is not None:
        added = at_places(regularisation, tables.order).reshape(-1, tables.width, 1)
        diagonal = diagonal + added * jnp.eye(tables.width, dtype=added.dtype)[None]
    if tables.num_blocks == 1:
        none = jnp.zeros((0, tables.width, tables.width), at.dtype)
        return Schur(tables, rows, none, _inverse(diagonal[0])[None])

    def eliminate(before, item):
        own, below = item
        factor = _times(below, before)
        found = _inverse(own - _times(factor, below.T))
        return found, (factor, found)

    first = _inverse(diagonal[0])
    _, (factors, inverses) = jax.lax.scan(eliminate, first, (diagonal[1:], below))
    inverses = jnp.concatenate([first[None], inverses])
    return Schur(tables, rows, factors, inverses)


def _weighted(
    tables: SchurTables, products: Float[Array, "rows colours"], weight: Symmetric
) -> tuple[Array, Array]:
    """The segments of the rows of `B`, and of `B W`."""
    rows = at_places(jnp.append(products.ravel(), 0), tables.entries)
    if isinstance(weight, BlockDiagonal):
        none = jnp.zeros((1, *weight.blocks.shape[1:]), rows.dtype)
        blocks = at_places(jnp.concatenate([weight.blocks, none]), tables.touched)
    else:
        blocks = weight[None, None]
    return rows, jnp.sum(blocks * rows[:, :, None, :], axis=-1)


def _blocks(tables: SchurTables, rows: Array, weighted: Array) -> tuple[Array, Array]:
    """The blocks of `G` on and below its diagonal."""
    left, right = (jnp.append(x.ravel(), 0) for x in (weighted, rows))

    def blocks(table: np.ndarray) -> Array:
        one, other = at_places(left, table[0]), at_places(right, table[1])
        return jnp.sum(one[..., None] * other[:, :, None], axis=1)

    padding = jnp.asarray(tables.padding, rows.dtype)
    return blocks(tables.diagonal) + padding, blocks(tables.below)


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a positive definite matrix, by in-place elimination; no pivoting."""
    order = np.arange(matrix.shape[0])

    def column(k: Any, matrix: Array) -> Array:
        pivot = 1 / matrix[k, k]
        own = order == k
        row = jnp.where(own, pivot, matrix[k] * pivot)
        factors = jnp.where(own, -1, matrix[:, k])
        left = jnp.where(own[None] | own[:, None], 0, matrix)
        return left - factors[:, None] * row[None]

    if order.size > _UNROLLED:
        return jax.lax.fori_loop(0, order.size, column, matrix)
    return functools.reduce(lambda matrix, k: column(k, matrix), order, matrix)


def _times(a: Float[Array, "m n"], b: Float[Array, "n k"]) -> Float[Array, "m k"]:
    return jnp.sum(a[:, :, None] * b[None], axis=1)
