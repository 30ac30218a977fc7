"""Large sparse Jacobians: coloured columns, a narrow band, a block elimination.

The unknowns are numbered by reverse Cuthill-McKee (E. Cuthill and J. McKee, 1969), which
makes the Jacobian of chains, trees and most mechanisms a narrow band: block tridiagonal
with blocks as wide as the band. It is eliminated block by block, with row pivoting over
each pair of neighbours, which is all that the band leaves to choose from. All of it is
written in JAX, so batches, accelerators and derivatives work.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from .._one_function import in_one_function
from .columns import columns_along
from .dense import AbstractFactors
from .dependence import shape_of
from .elimination import LIBRARY, pivot_rows_first


class Band:
    """How a sparse matrix is stored as a band of blocks. Made while a program is traced.

    - `colours`: of each column; columns of a colour share no row.
    - `places`: for the entries `(block, row, 3 * width)` of the band, where they stand in
      the coloured products; beyond the last of them where they are zero.
    - `order`: the numbers of the unknowns along the band, filled up with the size.
    - `back`: where each unknown stands along the band.
    - `filling`: the ones on the diagonal of rows that only fill up the last block.
    """

    def __init__(self, pattern: csr_array):
        size, _ = shape_of(pattern)
        both = (pattern + pattern.T).tocsr()
        order = reverse_cuthill_mckee(both, symmetric_mode=True)
        back = np.argsort(order)
        rows, columns = pattern.nonzero()
        offsets = back[columns] - back[rows]
        self.width = width = max(int(np.max(np.abs(offsets), initial=1)), 1)
        self.num_blocks = blocks = -(-size // width)
        self.size = size
        self.back = back
        self.order = np.concatenate([order, np.full(blocks * width - size, size)])
        self.colours = column_colours(pattern, order)
        self.num_colours = int(self.colours.max(initial=0)) + 1
        block, row = np.divmod(back[rows], width)
        column = back[columns] - (block - 1) * width
        nowhere = self.num_colours * size
        self.places = np.full((blocks, width, 3 * width), nowhere)
        self.places[block, row, column] = rows * self.num_colours + self.colours[columns]
        self.filling = np.zeros(self.places.shape)
        short = np.arange(blocks * width - size)
        self.filling[-1, width - 1 - short, 2 * width - 1 - short] = 1

    def worth_it(self) -> bool:
        """Whether its elimination is less work than that of the dense matrix."""
        part = 40 if self.width < LIBRARY else 8
        return part * self.num_blocks * self.width**3 < self.size**3

    def empty(self, size: int, dtype: Any) -> "BandFactors":
        """Factors of no matrix yet."""
        del size
        blocks, width = self.num_blocks, self.width
        turns = jnp.zeros((blocks, 2 * width, 2 * width), dtype)
        return BandFactors(self, turns, jnp.zeros((blocks, width, 2 * width), dtype))

    def evaluate(
        self, fn: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, "blocks width three_widths"]:
        """The band of the Jacobian of `fn` at `x`."""
        products = coloured_products(fn, x, self.colours)
        entries = jnp.append(products.ravel(), 0)
        return entries[self.places] + jnp.asarray(self.filling, x.dtype)


def coloured_products(
    fn: Callable[[Array], Array], x: Float[Array, " n"], colours: np.ndarray
) -> Float[Array, "m ... colours"]:
    """For each colour the sum of the columns that have it."""
    numbers = np.arange(int(colours.max(initial=0)) + 1)
    return columns_along(fn, x, colours[:, None] == numbers)


def column_colours(pattern: csr_array, order: np.ndarray) -> np.ndarray:
    """Greedy, along the band: the first colour that no column of a shared row has."""
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
    """An eliminated band.

    - `turns`: for each block, what takes the rows left over and those of the next block to
      the pivot rows, solved for their own unknowns, and to those left over.
    - `upper`: the pivot rows in the unknowns of the next two blocks.
    """

    band: Band = eqx.field(static=True)
    turns: Float[Array, "blocks two_widths two_widths"]
    upper: Float[Array, "blocks width two_widths"]

    def renewed(self, matrix: Float[Array, "blocks width three_widths"]) -> "BandFactors":
        return BandFactors(self.band, *in_one_function(_eliminated)(matrix))

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        band = self.band
        filled = jnp.append(right, 0)[band.order].reshape(band.num_blocks, band.width)
        x = in_one_function(_substituted)(self.turns, self.upper, filled)
        return x.ravel()[band.back]


def _eliminated(matrix: Float[Array, "blocks width three_widths"]) -> tuple[Array, Array]:
    """The `turns` and the `upper` rows of `BandFactors`."""
    width = matrix.shape[1]
    none = jnp.zeros((width, width), matrix.dtype)
    # Beyond the last block: rows of no other unknown.
    beyond = jnp.concatenate([none, jnp.eye(width, dtype=matrix.dtype), none], axis=1)
    following = jnp.concatenate([matrix[1:], beyond[None]])

    def eliminate(left, rows):
        whole = jnp.concatenate(
            [jnp.concatenate([left, none], axis=1), rows]
        )  # two_widths, three_widths
        turned, turn = pivot_rows_first(whole, width)
        return turned[width:], (turn, turned[:width])

    return jax.lax.scan(eliminate, matrix[0, :, width:], following)[1]


def _substituted(
    turns: Float[Array, "blocks two_widths two_widths"],
    upper: Float[Array, "blocks width two_widths"],
    right: Float[Array, "blocks width"],
) -> Float[Array, "blocks width"]:
    none = jnp.zeros_like(right[0])
    width = none.size

    def forward(left, item):
        turn, rows = item
        turned = turn @ jnp.concatenate([left, rows])
        return turned[width:], turned[:width]

    following = jnp.concatenate([right[1:], none[None]])
    _, reduced = jax.lax.scan(forward, right[0], (turns, following))

    def backward(after, item):
        rows, value = item
        x = value - rows @ after
        return jnp.concatenate([x, after[:width]]), x

    after = jnp.concatenate([none, none])
    return jax.lax.scan(backward, after, (upper, reduced), reverse=True)[1]
