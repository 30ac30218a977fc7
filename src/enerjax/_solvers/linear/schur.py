"""The Schur complement `G = B W B^T` of sparse rows `B` and a block-diagonal `W`.

It is the matrix of the multipliers of constraints with the gradients `B`, where `W` is the
inverse inertia. Rows meet where they touch the same body, so `G` is as sparse as the graph
of the mechanism. Its rows are numbered by reverse Cuthill-McKee and cut into blocks that
meet only their neighbours. The elimination goes from block to block. `G` is symmetric and
positive definite, so the order of the blocks needs no pivoting.
"""

import functools
from collections.abc import Callable
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ..._programs import Indices, jacobian_pattern, shape_of, summed, unmerged
from .banded import block_sizes, coloured_products, column_colours
from .blocks import BlockDiagonal, Symmetric
from .dense import inverse


# Unknowns up to which each row is taken to depend on all of them.
_FEW = 8
# Rows of the largest block. Beyond this the elimination is no longer small work.
_WIDEST = 32
# Rows of blocks whose elimination is written out.
_UNROLLED = 16


class SchurTables(Indices):
    """Where the entries of `B` and of `G` stand. Made while a program is traced.

    A row of `B` is stored as its parts in the blocks of `W` that it touches.

    - `colours`: of the columns of `B`; columns of a colour share no row.
    - `touched`: the blocks that each row touches, `(rows, parts)`; the number of blocks
      stands where there are fewer.
    - `columns`: the unknowns of each part, `(rows, parts, size)`; the number of unknowns
      stands where there is none.
    - `entries`: where each entry stands in the coloured products, and `transposed`: where
      the entries of each unknown stand among those of `B`; beyond the last for zeros.
    - `diagonal`, `below`: for each block of `G`, on the diagonal and below, where its rows
      and those of its columns stand among the entries of `B`; see `_shared`.
    - `order`: the numbers of the rows along the blocks, `back`: where each row stands.
    - `filling`: ones on the diagonal where a block is smaller than the largest.
    """

    def __init__(self, pattern: csr_array, weight: Symmetric):
        super().__init__(pattern.toarray().astype(bool))
        self.num_rows, size = shape_of(pattern)
        is_blocks = isinstance(weight, BlockDiagonal)
        blocks = weight.places.rows if is_blocks else np.arange(size)[None]
        self.colours = column_colours(pattern, np.arange(size))
        rows, columns = pattern.nonzero()
        incidence = np.zeros((self.num_rows, len(blocks)), bool)
        label = np.zeros(size + 1, int)
        label[blocks.ravel()] = np.repeat(np.arange(len(blocks)), blocks.shape[1])
        incidence[rows, label[columns]] = True
        parts = max(int(incidence.sum(axis=1).max(initial=0)), 1)
        self.touched = np.full((self.num_rows, parts), len(blocks))
        for row, touched in zip(self.touched, incidence, strict=True):
            row[: touched.sum()] = np.flatnonzero(touched)
        none = np.full((1, blocks.shape[1]), size)
        self.columns = np.concatenate([blocks, none])[self.touched]
        self._find_entries(pattern, size)
        self._cut(csr_array(incidence.astype(float)))

    def _find_entries(self, pattern: csr_array, size: int) -> None:
        num_colours = int(self.colours.max(initial=0)) + 1
        filled = np.zeros((self.num_rows, size + 1), bool)
        filled[pattern.nonzero()] = True
        row = np.arange(self.num_rows)[:, None, None]
        known = filled[row, self.columns]
        place = row * num_colours + np.append(self.colours, 0)[self.columns]
        self.entries = np.where(known, place, self.num_rows * num_colours)
        places, columns = np.flatnonzero(known), self.columns[known]
        order = np.argsort(columns, kind="stable")
        counts = np.bincount(columns, minlength=size)
        within = np.arange(order.size) - np.repeat(np.cumsum(counts) - counts, counts)
        self.transposed = np.full((size, counts.max(initial=1)), known.size)
        self.transposed[columns[order], within] = places[order]

    def _cut(self, incidence: csr_array) -> None:
        meeting = csr_array(incidence @ incidence.T)
        order = reverse_cuthill_mckee(meeting, symmetric_mode=True)
        sizes = block_sizes(csr_array(meeting[order][:, order]))
        self.width, self.num_blocks = int(sizes.max(initial=1)), sizes.size
        number = np.repeat(np.arange(sizes.size), sizes)
        within = np.arange(self.num_rows) - (np.cumsum(sizes) - sizes)[number]
        self.back = np.empty(self.num_rows, int)
        self.back[order] = number * self.width + within
        self.order = np.full(sizes.size * self.width, self.num_rows)
        self.order[self.back] = np.arange(self.num_rows)
        along = self.order.reshape(self.num_blocks, self.width)
        self.filling = (along == self.num_rows)[:, :, None] * np.eye(self.width)
        self.diagonal = self._shared([(rows, rows) for rows in along])
        self.below = self._shared([(after, rows) for rows, after in pairwise(along)])

    def _shared(self, pairs: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Where two blocks of rows stand in the unknowns that both touch.

        For each pair the entries of the rows of either block among those of `B`, of shape
        `(2, pairs, width, unknowns)`; beyond the last for zeros.
        """
        size, none = self.transposed.shape[0], self.columns.size
        places = np.full((self.num_rows + 1, size + 1), none)
        places[np.arange(self.num_rows)[:, None, None], self.columns] = np.arange(
            none
        ).reshape(self.columns.shape)
        places[:, size] = none
        touched = places < none
        shared = [
            np.flatnonzero(touched[a].any(axis=0) & touched[b].any(axis=0))
            for a, b in pairs
        ]
        most = max(map(len, shared), default=0)
        table = np.full((2, len(pairs), self.width, most), none)
        for k, (sides, columns) in enumerate(zip(pairs, shared, strict=True)):
            for side, rows in enumerate(sides):
                table[side, k, :, : columns.size] = places[rows][:, columns]
        return table


class Schur(eqx.Module):
    """`B`, and `G = B W B^T` eliminated."""

    tables: SchurTables = eqx.field(static=True)
    rows: Float[Array, "rows parts size"]
    factors: Float[Array, "below width width"]
    inverses: Float[Array, "blocks width width"]

    def product(self, u: Float[Array, " n"]) -> Float[Array, " rows"]:
        """`B u`"""
        return summed(self.rows * jnp.append(u, 0)[self.tables.columns], 2)

    def transposed(self, x: Float[Array, " rows"]) -> Float[Array, " n"]:
        """`B^T x`"""
        entries = jnp.append((self.rows * x[:, None, None]).ravel(), 0)
        return summed(entries[self.tables.transposed])

    def solve(self, right: Float[Array, "k rows"]) -> Float[Array, "k rows"]:
        """`G^-1` times some vectors."""
        tables = self.tables
        count = right.shape[0]
        padded = jnp.concatenate([right, jnp.zeros((count, 1), right.dtype)], axis=1)
        along = padded[:, tables.order].reshape(count, tables.num_blocks, tables.width)
        along = jnp.moveaxis(along, 1, 0)
        if tables.num_blocks == 1:
            along = _products(self.inverses, along)
        else:
            along = self._substituted(along)
        return jnp.moveaxis(along, 0, 1).reshape(count, -1)[:, tables.back]

    def _substituted(
        self, along: Float[Array, "blocks k width"]
    ) -> Float[Array, "blocks k width"]:
        """Down along the blocks, and up."""

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
    return summed(matrices[:, None] * x[:, :, None])


def schur_tables(
    fn: Callable[[Array], Array], like: Float[Array, " n"], weight: Symmetric
) -> SchurTables | None:
    """The tables for the Jacobian of `fn`; `None` where no narrow blocks are found."""
    num_rows = jax.eval_shape(fn, like).shape[0]
    pattern = jacobian_pattern(fn, like) if like.size > _FEW else None
    if num_rows == 0:
        return None
    if pattern is None:
        pattern = csr_array(np.ones((num_rows, like.size), bool))
    tables = SchurTables(csr_array(pattern), weight)
    return tables if tables.width <= _WIDEST else None


def schur(
    tables: SchurTables,
    fn: Callable[[Array], Array],
    at: Float[Array, " n"],
    weight: Symmetric,
) -> Schur:
    """`G` of the Jacobian of `fn` at a point."""
    products = coloured_products(fn, at, tables.colours)
    # The tables are read many times over: each of their entries is computed once.
    rows, weighted = unmerged(functools.partial(_weighted, tables))(products, weight)
    diagonal, below = _blocks(tables, rows, weighted)
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
    return Schur(tables, rows, factors, jnp.concatenate([first[None], inverses]))


def _weighted(
    tables: SchurTables, products: Float[Array, "rows colours"], weight: Symmetric
) -> tuple[Array, Array]:
    """The parts of `B`, and of `B W`."""
    rows = jnp.append(products.ravel(), 0)[tables.entries]
    if isinstance(weight, BlockDiagonal):
        none = jnp.zeros((1, *weight.blocks.shape[1:]), rows.dtype)
        blocks = jnp.concatenate([weight.blocks, none])[tables.touched]
    else:
        blocks = weight[None, None]
    return rows, summed(blocks * rows[:, :, None, :])


def _blocks(tables: SchurTables, rows: Array, weighted: Array) -> tuple[Array, Array]:
    """The blocks of `G` on its diagonal and below."""
    left, right = (jnp.append(x.ravel(), 0) for x in (weighted, rows))

    def blocks(table: np.ndarray) -> Array:
        one, other = unmerged(lambda x, y: (x[table[0]], y[table[1]]))(left, right)
        terms = (one[:, :, None, k] * other[:, None, :, k] for k in range(table.shape[-1]))
        shape = (table.shape[1], tables.width, tables.width)
        return functools.reduce(jnp.add, terms, jnp.zeros(shape, rows.dtype))

    filling = jnp.asarray(tables.filling, rows.dtype)
    return blocks(tables.diagonal) + filling, blocks(tables.below)


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Of a positive definite matrix, by elimination in place. No row has to be found."""
    size = matrix.shape[0]
    if size > _UNROLLED:
        return inverse(matrix)
    for k in range(size):
        pivot = 1 / matrix[k, k]
        row, column = matrix[k] * pivot, matrix[:, k]
        own = np.arange(size) == k
        row, column = jnp.where(own, pivot, row), jnp.where(own, -1, column)
        left = jnp.where(own[None] | own[:, None], 0, matrix)
        matrix = left - column[:, None] * row[None]
    return matrix


def _times(a: Float[Array, "m n"], b: Float[Array, "n k"]) -> Float[Array, "m k"]:
    return summed(a[:, None] * b.T[None])
