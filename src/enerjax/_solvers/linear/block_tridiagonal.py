"""Large sparse Jacobians as block tridiagonal matrices, and their elimination.

The unknowns are numbered by the reverse Cuthill-McKee algorithm (E. Cuthill and J. McKee,
1969), which makes the Jacobian of chains, trees and typical mechanisms a narrow band.
Divided into blocks it is block tridiagonal. It is eliminated block by block, with row
pivoting among the rows of two neighbouring blocks; the other rows are zero there. Columns
of the Jacobian that share no row have the same colour and are evaluated in one product.
Everything is written in JAX, so it works in batches, on accelerators and with derivatives.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from ..._programs import batched_columns, columns_along, in_one_function, shape_of
from .dense import AbstractFactors, eliminated, product


# Columns from which a product of matrices is faster than sums that XLA fuses.
_MANY = 16
# The multiplications of an elimination of blocks, relative to those of `width^3`. Measured
# as machine code: three blocks of any width up to 32 take less time than the whole matrix.
_COST = 6


class Band:
    """The index tables by which a sparse matrix is stored as a block tridiagonal one.

    The tables are constructed at trace time. All blocks have the `width` of the largest
    one. Smaller blocks are padded with decoupled unknowns, whose equation is `x = 0`.

    - `colours`: the colour of each column. Columns of equal colour share no row.
    - `places`: the index of each entry `(block, row, 3 * width)` of the band in the
      coloured products; for entries that are zero, the number of these products.
    - `order`: the number of the unknown at each position of the band; the size of the
      matrix at padded positions.
    - `back`: the position of each unknown in the band.
    - `padding`: ones on the diagonal at padded positions, shape as `places`.
    """

    def __init__(self, pattern: "scipy.sparse.csr_array", rarely: bool = False):
        self._rarely = rarely
        size, _ = shape_of(pattern)
        both = (pattern + pattern.T).tocsr()
        order = scipy.sparse.csgraph.reverse_cuthill_mckee(both, symmetric_mode=True)
        sizes = block_sizes(both[order][:, order])
        self.width = width = int(sizes.max(initial=1))
        self.num_blocks = blocks = sizes.size
        self.size = size
        # The positions of the unknowns in the band.
        starts = np.cumsum(sizes) - sizes
        number = np.repeat(np.arange(blocks), sizes)
        self.back = back = np.empty(size, int)
        back[order] = number * width + np.arange(size) - starts[number]
        self.order = np.full(blocks * width, size)
        self.order[back] = np.arange(size)
        rows, columns = pattern.nonzero()
        self.colours = column_colours(pattern, order)
        self.num_colours = int(self.colours.max(initial=0)) + 1
        block, row = np.divmod(back[rows], width)
        column = back[columns] - (block - 1) * width
        nowhere = self.num_colours * size
        self.places = np.full((blocks, width, 3 * width), nowhere)
        self.places[block, row, column] = rows * self.num_colours + self.colours[columns]
        self.padding = np.zeros(self.places.shape)
        block, row = np.divmod(np.flatnonzero(self.order == size), width)
        self.padding[block, row, width + row] = 1

    def description(self, size: int) -> str:
        return (
            f"block tridiagonal, {self.num_blocks} blocks of {self.width}, "
            f"{self.num_colours} columns evaluated together"
        )

    def is_cheaper_than_dense(self) -> bool:
        """Whether the block elimination needs less work than that of the dense matrix."""
        return _COST * self.num_blocks * self.width**3 < self.size**3

    def empty(self, size: int, dtype: Any) -> "BandFactors":
        """Placeholder factors, of the shapes that `renewed` returns."""
        del size
        blocks, width = self.num_blocks, self.width
        shapes = (2 * width, width), (width, 2 * width)
        reductions, upper = (jnp.zeros((blocks, *shape), dtype) for shape in shapes)
        return BandFactors(self, reductions, jnp.zeros((blocks, 2 * width), int), upper)

    def evaluate(
        self, fn: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, "blocks width three_widths"]:
        """The band of the Jacobian of `fn` at `x`."""
        products = coloured_products(fn, x, self.colours, self._rarely)
        entries = jnp.append(products.ravel(), 0)
        return entries[self.places] + jnp.asarray(self.padding, x.dtype)


def block_sizes(pattern: "scipy.sparse.csr_array") -> np.ndarray:
    """The sizes of blocks that make a symmetric banded matrix block tridiagonal.

    The size of the first block determines the smallest possible sizes of all others.
    Consecutive blocks are merged while they do not exceed the largest block. Of all sizes
    of the first block, the one with the least work is chosen.
    """
    size, _ = shape_of(pattern)
    rows, columns = pattern.nonzero()
    reach = np.arange(size)
    np.maximum.at(reach, rows, columns)
    # One more than the last unknown that is coupled to this or an earlier unknown.
    ends = np.maximum.accumulate(reach) + 1
    candidates = []
    for first in range(1, int(ends[:1].max(initial=1)) + 1):
        sizes, end = [first], first
        while end < size:
            end, before = max(int(ends[end - 1]), end + 1), end
            sizes.append(end - before)
        width, merged = max(sizes), [0]
        for each in sizes:
            if merged[-1] + each <= width:
                merged[-1] += each
            else:
                merged.append(each)
        candidates.append(np.array(merged))
    return min(candidates, key=lambda sizes: sizes.size * int(sizes.max()) ** 3)


def coloured_products(
    fn: Callable[[Array], Array],
    x: Float[Array, " n"],
    colours: np.ndarray,
    rarely: bool = False,
) -> Float[Array, "m ... colours"]:
    """For each colour, the sum of the columns of the Jacobian that have this colour.

    If they are needed `rarely`, a program is chosen that compiles quickly.
    """
    numbers = np.arange(int(colours.max(initial=0)) + 1)
    columns = batched_columns if rarely else columns_along
    return columns(fn, x, colours[:, None] == numbers)


def column_colours(pattern: "scipy.sparse.csr_array", order: np.ndarray) -> np.ndarray:
    """Colours of the columns, such that columns of equal colour share no row.

    Greedy: in the given `order`, each column gets the first colour that is still free.
    """
    by_column = pattern.tocsc()
    num_rows, num_columns = shape_of(pattern)
    seen: list[set[int]] = [set() for _ in range(num_rows)]
    colours = np.zeros(num_columns, int)
    for column in order:
        rows = by_column.indices[by_column.indptr[column] : by_column.indptr[column + 1]]
        taken = set().union(*(seen[row] for row in rows))
        colour = next(c for c in range(len(taken) + 1) if c not in taken)
        colours[column] = colour
        for row in rows:
            seen[row].add(colour)
    return colours


class BandFactors(AbstractFactors):
    """The factors of a block tridiagonal matrix.

    - `reductions`, `orders`: for each block, the elimination of its unknowns from the rows
      that remain of the block before and from the rows of the next block; see `eliminated`.
    - `upper`: the entries of the pivot rows of each block in the next two blocks.
    """

    band: Band = eqx.field(static=True)
    reductions: Float[Array, "blocks two_widths width"]
    orders: Int[Array, "blocks two_widths"]
    upper: Float[Array, "blocks width two_widths"]

    def renewed(self, matrix: Float[Array, "blocks width three_widths"]) -> "BandFactors":
        return BandFactors(self.band, *in_one_function(_eliminated)(matrix))

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        band = self.band
        padded = jnp.append(right, 0)[band.order].reshape(band.num_blocks, band.width)
        substituted = in_one_function(_substituted)
        x = substituted(self.reductions, self.orders, self.upper, padded)
        return x.ravel()[band.back]


def _eliminated(
    matrix: Float[Array, "blocks width three_widths"],
) -> tuple[Array, Array, Array]:
    """The `reductions`, the `orders` and the `upper` rows of `BandFactors`."""
    width = matrix.shape[1]
    none = jnp.zeros((width, width), matrix.dtype)
    # An identity block after the last block, which is decoupled from it.
    beyond = jnp.concatenate([none, jnp.eye(width, dtype=matrix.dtype), none], axis=1)
    following = jnp.concatenate([matrix[1:], beyond[None]])

    def eliminate(left, rows):
        whole = jnp.concatenate(
            [jnp.concatenate([left, none], axis=1), rows]
        )  # two_widths, three_widths
        table, _, order = eliminated(whole[:, :width])
        reduction, rows = table[order], whole[order, width:]
        products = _product(reduction, rows[:width])
        return rows[width:] + products[width:], (reduction, order, products[:width])

    return jax.lax.scan(eliminate, matrix[0, :, width:], following)[1]


def _substituted(
    reductions: Float[Array, "blocks two_widths width"],
    orders: Int[Array, "blocks two_widths"],
    upper: Float[Array, "blocks width two_widths"],
    right: Float[Array, "blocks width"],
) -> Float[Array, "blocks width"]:
    none = jnp.zeros_like(right[0])
    width = none.size

    def forward(left, item):
        reduction, order, rows = item
        rows = jnp.concatenate([left, rows])[order]
        products = _times(reduction, rows[:width])
        return rows[width:] + products[width:], products[:width]

    following = jnp.concatenate([right[1:], none[None]])
    _, solved = jax.lax.scan(forward, right[0], (reductions, orders, following))

    def backward(after, item):
        rows, value = item
        x = value - _times(rows, after)
        return jnp.concatenate([x, after[:width]]), x

    after = jnp.concatenate([none, none])
    return jax.lax.scan(backward, after, (upper, solved), reverse=True)[1]


def _product(a: Float[Array, "n k"], b: Float[Array, "k m"]) -> Float[Array, "n m"]:
    return product(a, b) if len(b) < _MANY else a @ b


def _times(matrix: Float[Array, "m n"], x: Float[Array, " n"]) -> Float[Array, " m"]:
    if matrix.shape[1] >= 2 * _MANY:
        return matrix @ x
    # XLA vectorises this sum over the rows.
    return jnp.sum(matrix * x[None], axis=1)
