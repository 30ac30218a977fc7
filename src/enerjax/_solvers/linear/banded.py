"""Large sparse Jacobians: coloured columns, a narrow band, a block elimination.

The unknowns are numbered by reverse Cuthill-McKee (E. Cuthill and J. McKee, 1969), which
makes the Jacobian of chains, trees and most mechanisms a narrow band. Cut into blocks it
is block tridiagonal, and is eliminated block by block, with row pivoting over each pair of
neighbours, which is all that the blocks leave to choose from. All of it is written in JAX,
so batches, accelerators and derivatives work.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ..._programs import columns_along, in_one_function, shape_of
from .dense import AbstractFactors
from .elimination import LIBRARY, pivot_rows_first, reduced


class Band:
    """How a sparse matrix is stored as a band of blocks. Made while a program is traced.

    All blocks have the `width` of the largest; what the others lack are unknowns of no
    other row, which are zero.

    - `colours`: of each column; columns of a colour share no row.
    - `places`: for the entries `(block, row, 3 * width)` of the band, where they stand in
      the coloured products; beyond the last of them where they are zero.
    - `order`: the numbers of the unknowns along the band; the size where one is lacking.
    - `back`: where each unknown stands along the band.
    - `filling`: the ones on the diagonal where one is lacking.
    """

    def __init__(self, pattern: csr_array):
        size, _ = shape_of(pattern)
        both = (pattern + pattern.T).tocsr()
        order = reverse_cuthill_mckee(both, symmetric_mode=True)
        sizes = block_sizes(both[order][:, order])
        self.width = width = int(sizes.max(initial=1))
        self.num_blocks = blocks = sizes.size
        self.size = size
        # What stands where along the band.
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
        self.filling = np.zeros(self.places.shape)
        block, row = np.divmod(np.flatnonzero(self.order == size), width)
        self.filling[block, row, width + row] = 1

    def worth_it(self) -> bool:
        """Whether its elimination is less work than that of the dense matrix."""
        part = 40 if self.width < LIBRARY else 8
        return part * self.num_blocks * self.width**3 < self.size**3

    def empty(self, size: int, dtype: Any) -> "BandFactors":
        """Factors of no matrix yet."""
        del size
        blocks, width = self.num_blocks, self.width
        shapes = (2 * width, width), (width, 2 * width)
        turns, upper = (jnp.zeros((blocks, *shape), dtype) for shape in shapes)
        return BandFactors(self, turns, jnp.zeros((blocks, 2 * width), int), upper)

    def evaluate(
        self, fn: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, "blocks width three_widths"]:
        """The band of the Jacobian of `fn` at `x`."""
        products = coloured_products(fn, x, self.colours)
        entries = jnp.append(products.ravel(), 0)
        return entries[self.places] + jnp.asarray(self.filling, x.dtype)


def block_sizes(pattern: csr_array) -> np.ndarray:
    """Sizes of blocks along a symmetric band, such that only neighbours touch.

    From that of the first one follow all others, at their smallest; together, up to the
    largest of them, they are fewer. Those with the least work.
    """
    size, _ = shape_of(pattern)
    rows, columns = pattern.nonzero()
    reach = np.arange(size)
    np.maximum.at(reach, rows, columns)
    # Behind the last unknown that one up to here touches.
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

    - `turns`, `orders`: for each block, what takes the rows left over and those of the next
      block to the pivot rows, solved for their own unknowns, and to those left over; see
      `pivot_rows_first`.
    - `upper`: the pivot rows in the unknowns of the next two blocks.
    """

    band: Band = eqx.field(static=True)
    turns: Float[Array, "blocks two_widths width"]
    orders: Int[Array, "blocks two_widths"]
    upper: Float[Array, "blocks width two_widths"]

    def renewed(self, matrix: Float[Array, "blocks width three_widths"]) -> "BandFactors":
        return BandFactors(self.band, *in_one_function(_eliminated)(matrix))

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        band = self.band
        filled = jnp.append(right, 0)[band.order].reshape(band.num_blocks, band.width)
        substituted = in_one_function(_substituted)
        x = substituted(self.turns, self.orders, self.upper, filled)
        return x.ravel()[band.back]


def _eliminated(
    matrix: Float[Array, "blocks width three_widths"],
) -> tuple[Array, Array, Array]:
    """The `turns`, the `orders` and the `upper` rows of `BandFactors`."""
    width = matrix.shape[1]
    none = jnp.zeros((width, width), matrix.dtype)
    # Beyond the last block: rows of no other unknown.
    beyond = jnp.concatenate([none, jnp.eye(width, dtype=matrix.dtype), none], axis=1)
    following = jnp.concatenate([matrix[1:], beyond[None]])

    def eliminate(left, rows):
        whole = jnp.concatenate(
            [jnp.concatenate([left, none], axis=1), rows]
        )  # two_widths, three_widths
        turn, order = pivot_rows_first(whole[:, :width])
        upper, left = reduced(turn, order, whole[:, width:])
        return left, (turn, order, upper)

    return jax.lax.scan(eliminate, matrix[0, :, width:], following)[1]


def _substituted(
    turns: Float[Array, "blocks two_widths width"],
    orders: Int[Array, "blocks two_widths"],
    upper: Float[Array, "blocks width two_widths"],
    right: Float[Array, "blocks width"],
) -> Float[Array, "blocks width"]:
    none = jnp.zeros_like(right[0])
    width = none.size

    def forward(left, item):
        turn, order, rows = item
        rows = jnp.concatenate([left, rows])[order]
        turned = _times(turn, rows[:width])
        return rows[width:] + turned[width:], turned[:width]

    following = jnp.concatenate([right[1:], none[None]])
    _, solved = jax.lax.scan(forward, right[0], (turns, orders, following))

    def backward(after, item):
        rows, value = item
        x = value - _times(rows, after)
        return jnp.concatenate([x, after[:width]]), x

    after = jnp.concatenate([none, none])
    return jax.lax.scan(backward, after, (upper, solved), reverse=True)[1]


def _times(matrix: Float[Array, "m n"], x: Float[Array, " n"]) -> Float[Array, " m"]:
    if matrix.shape[1] >= 2 * LIBRARY:
        return matrix @ x
    # Rows side by side, by vector instructions.
    return jnp.sum(matrix * x[None], axis=1)
