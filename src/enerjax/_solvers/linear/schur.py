"""The Schur complement `G = B W B^T` of sparse rows `B` and a block-diagonal `W`.

It is the matrix of the multipliers of constraints with the gradients `B`, where `W` is the
inverse inertia. Rows meet where they touch the same body, so `G` is as sparse as the graph
of the mechanism. Its rows are numbered by reverse Cuthill-McKee and cut into blocks that
meet only their neighbours. The elimination goes from block to block. `G` is symmetric and
positive definite, so the order of the blocks needs no pivoting.
"""

from collections.abc import Callable
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ..._programs import Indices, jacobian_pattern, shape_of
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
    - `diagonal`, `below`: for each entry of the blocks of `G` the pairs of parts whose
      products are summed up, `(2, blocks, width, width, pairs)`.
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
        self.diagonal = self._pairs([(rows, rows) for rows in along])
        self.below = self._pairs([(after, rows) for rows, after in pairwise(along)])

    def _pairs(self, blocks: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """The parts that pairs of rows share, as numbers among all parts."""
        num_parts = self.touched.shape[1]
        none = self.touched.size
        touched = [*map(list, self.touched), []]
        places: list[dict[int, int]] = [
            {block: i * num_parts + k for k, block in enumerate(row)}
            for i, row in enumerate(touched)
        ]
        shared = [
            [
                [(places[i][x], places[j][x]) for x in places[i] if x in places[j]]
                for j in columns
            ]
            for rows, columns in blocks
            for i in rows
        ]
        most = max((len(x) for row in shared for x in row), default=1)
        shape = (len(blocks), self.width, self.width)
        table = np.full((2, len(blocks) * self.width, self.width, most), none)
        for i, row in enumerate(shared):
            for j, pairs in enumerate(row):
                table[:, i, j, : len(pairs)] = np.array(pairs, int).reshape(-1, 2).T
        return table.reshape(2, *shape, most)


class Schur(eqx.Module):
    """`B`, and `G = B W B^T` eliminated."""

    tables: SchurTables = eqx.field(static=True)
    rows: Float[Array, "rows parts size"]
    factors: Float[Array, "below width width"]
    inverses: Float[Array, "blocks width width"]

    def product(self, u: Float[Array, " n"]) -> Float[Array, " rows"]:
        """`B u`"""
        return jnp.sum(self.rows * jnp.append(u, 0)[self.tables.columns], axis=(1, 2))

    def transposed(self, x: Float[Array, " rows"]) -> Float[Array, " n"]:
        """`B^T x`"""
        entries = jnp.append((self.rows * x[:, None, None]).ravel(), 0)
        return jnp.sum(entries[self.tables.transposed], axis=1)

    def solve(self, right: Float[Array, "k rows"]) -> Float[Array, "k rows"]:
        """`G^-1` times some vectors."""
        tables = self.tables
        count = right.shape[0]
        padded = jnp.concatenate([right, jnp.zeros((count, 1), right.dtype)], axis=1)
        along = padded[:, tables.order].reshape(count, tables.num_blocks, tables.width)
        along = jnp.moveaxis(along, 1, 0)
        times = lambda matrix, x: jnp.sum(matrix * x[..., None, :], axis=-1)

        def forward(before, item):
            factor, value = item
            value = value - times(factor, before)
            return value, value

        def backward(after, item):
            factor, value = item
            value = value - jnp.sum(factor * after[..., :, None], axis=-2)
            return value, value

        if tables.num_blocks > 1:
            first = along[0]
            _, rest = jax.lax.scan(forward, first, (self.factors, along[1:]))
            along = jnp.concatenate([first[None], rest])
        along = times(self.inverses[:, None], along)
        if tables.num_blocks > 1:
            last = along[-1]
            _, rest = jax.lax.scan(backward, last, (self.factors, along[:-1]), reverse=True)
            along = jnp.concatenate([rest, last[None]])
        return jnp.moveaxis(along, 0, 1).reshape(count, -1)[:, tables.back]


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
    rows = jnp.append(products.ravel(), 0)[tables.entries]
    if isinstance(weight, BlockDiagonal):
        none = jnp.zeros((1, *weight.blocks.shape[1:]), at.dtype)
        blocks = jnp.concatenate([weight.blocks, none])[tables.touched]
    else:
        blocks = weight[None, None]
    weighted = jnp.sum(blocks * rows[:, :, None, :], axis=-1)
    flat = lambda x: jnp.concatenate(
        [x.reshape(-1, x.shape[-1]), jnp.zeros((1, x.shape[-1]), x.dtype)]
    )
    left, right = flat(rows), flat(weighted)
    entries = lambda table: jnp.sum(left[table[0]] * right[table[1]], axis=(-1, -2))
    diagonal = entries(tables.diagonal) + jnp.asarray(tables.filling, at.dtype)
    if tables.num_blocks == 1:
        none = jnp.zeros((0, tables.width, tables.width), at.dtype)
        return Schur(tables, rows, none, _inverse(diagonal[0])[None])

    def eliminate(before, item):
        own, below = item
        factor = _times(below, before)
        found = _inverse(own - _times(factor, below.T))
        return found, (factor, found)

    first = _inverse(diagonal[0])
    below = entries(tables.below)
    _, (factors, inverses) = jax.lax.scan(eliminate, first, (diagonal[1:], below))
    return Schur(tables, rows, factors, jnp.concatenate([first[None], inverses]))


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
    return jnp.sum(a[:, :, None] * b[None], axis=1)
