"""The Schur complement `G = B W B^T` of sparse rows `B` and a block-diagonal `W`.

It is the matrix of the equations for the multipliers of constraints with gradients `B`,
where `W` is the inverse inertia. Two constraints are coupled in `G` only if they act on a
common body, so `G` is as sparse as the graph of the mechanism. Rows that act on the same
bodies, such as those of a joint, are one node of the graph by which it is eliminated. `G`
is symmetric and positive definite, or is made so by a regularisation where constraints are
redundant, so the elimination needs no pivoting.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from ..._programs import (
    at_places,
    call_traced_once,
    Indices,
    jacobian_pattern,
    shape_of,
    with_any,
)
from .block_diagonal import BlockDiagonal, Symmetric
from .colours import coloured_products, column_colours
from .graph_elimination import elimination_order, Factors, GraphElimination, Order


# The number of unknowns up to which `B` is treated as dense.
_FEW = 8
# The largest number of rows of a block. Larger blocks would be eliminated too slowly.
_WIDEST = 64


class Bounds(NamedTuple):
    """Largest numbers: of blocks of `W` in which a row has entries, of rows that have
    entries in the same block, and of rounds of the elimination."""

    blocks: int
    rows: int
    rounds: int


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
    - `elimination`: the nodes of `G`, its entries, and the order of their elimination.
    - `shared`: the segments of the two rows of each entry in the blocks of `W` that they
      have in common, shape `(2, entries, common)` for each number of these; `order`: the
      places of the entries in all of them.
    - `diagonal`: the places of the diagonal entries.
    """

    def __init__(
        self,
        pattern: "scipy.sparse.csr_array",
        segments: "_Segments",
        order: Order,
        colours: np.ndarray,
    ):
        self.num_rows, size = shape_of(pattern)
        rows, columns = pattern.nonzero()
        blocks = segments.blocks
        # Equal rows can have other colours, or another order of elimination.
        eliminated = [node for of in order.rounds for node in (*of.nodes, -1)]
        content = rows, columns, blocks.ravel(), blocks.shape, colours, eliminated
        super().__init__(np.concatenate(content).astype(int))
        self.colours = colours
        self.touched = segments.touched
        none = np.full((1, blocks.shape[1]), size)
        self.columns = np.concatenate([blocks, none])[self.touched]
        self.read = with_any(self.columns, size)
        self._find_entries(rows, columns, size)
        self.elimination = GraphElimination(order)
        self._find_shared()

    @property
    def description(self) -> str:
        return f"{self.num_rows} rows, {self.elimination.description}"

    def products(
        self, fn: Callable[[Array], Array], at: Float[Array, " n"]
    ) -> Float[Array, "rows colours"]:
        """For each colour, the sum of the columns of `B`, the Jacobian of `fn`."""
        return coloured_products(fn, at, self.colours)

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

    def _find_shared(self) -> None:
        """Which segments the rows of each entry of `G` have in common."""
        rows, columns = self.elimination.entries.T
        is_there = np.any(self.columns < self.transposed.shape[0], axis=-1)
        common = self.touched[rows][:, :, None] == self.touched[columns][:, None]
        entry, one, other = np.nonzero(common & is_there[rows][:, :, None])
        counts = np.bincount(entry, minlength=rows.size)
        num_segments = self.touched.shape[1]
        numbers = np.stack(
            [rows[entry] * num_segments + one, columns[entry] * num_segments + other]
        )
        starts = np.cumsum(counts) - counts
        self.shared, order = [], []
        for count in np.unique(counts):
            of = np.flatnonzero(counts == count)
            self.shared.append(numbers[:, starts[of][:, None] + np.arange(count)])
            order.append(of)
        self.order = np.argsort(np.concatenate(order))
        diagonal = np.flatnonzero(rows == columns)
        self.diagonal = diagonal[np.argsort(rows[diagonal])]


class _Segments:
    """The segments of the rows of `B`, and the orders in which they can be eliminated.

    - `blocks`: the unknowns of each block of `W`; `touched`: see `SchurTables`.
    """

    def __init__(self, pattern: "scipy.sparse.csr_array", weight: Symmetric):
        num_rows, size = shape_of(pattern)
        is_blocks = isinstance(weight, BlockDiagonal)
        self.blocks = weight.places.rows if is_blocks else np.arange(size)[None]
        rows, columns = pattern.nonzero()
        count = len(self.blocks)
        label = np.zeros(size + 1, int)
        label[self.blocks.ravel()] = np.repeat(np.arange(count), self.blocks.shape[1])
        incidence = scipy.sparse.csr_array(
            (np.ones(rows.size), (rows, label[columns])), shape=(num_rows, count)
        )
        counts = np.diff(incidence.indptr)
        within = np.arange(incidence.nnz) - np.repeat(incidence.indptr[:-1], counts)
        self.touched = np.full((num_rows, max(counts.max(initial=0), 1)), count)
        self.touched[np.repeat(np.arange(num_rows), counts), within] = incidence.indices
        self._incidence = incidence

    def are_within(self, bounds: Bounds) -> bool:
        """Whether the numbers of blocks and of rows are; the rounds are not known yet."""
        most_rows = np.bincount(self._incidence.indices).max(initial=0)
        return self.touched.shape[1] <= bounds.blocks and most_rows <= bounds.rows

    def orders(self, most_rounds: float) -> Iterator[Order | None]:
        """By the nodes of rows that act on the same bodies, and by the blocks of a band.

        The graph of a net has no small separators, but it is a band. Its blocks are large,
        so this is not an order with few rounds.
        """
        coupling = scipy.sparse.csr_array(self._incidence @ self._incidence.T)
        labels = np.unique(self.touched, axis=0, return_inverse=True)[1]
        yield _order(labels, coupling, most_rounds)
        if most_rounds < np.inf:
            return
        order = scipy.sparse.csgraph.reverse_cuthill_mckee(coupling, symmetric_mode=True)
        sizes = _block_sizes(scipy.sparse.csr_array(coupling[order][:, order]))
        labels = np.empty(order.size, int)
        labels[order] = np.repeat(np.arange(sizes.size), sizes)
        yield _order(labels, coupling)


def _block_sizes(pattern: "scipy.sparse.csr_array") -> np.ndarray:
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


def _order(
    labels: Int[np.ndarray, " rows"],
    coupling: "scipy.sparse.csr_array",
    most_rounds: float = np.inf,
) -> Order | None:
    count = int(labels.max()) + 1
    nodes = [np.flatnonzero(labels == k) for k in range(count)]
    adjacent = [set[int]() for _ in nodes]
    for row, column in zip(*coupling.nonzero(), strict=True):
        if labels[row] != labels[column]:
            adjacent[labels[row]].add(int(labels[column]))
    return elimination_order(nodes, adjacent, most_rounds)


class Schur(eqx.Module):
    """`B`, and the block factorisation of `G = B W B^T`.

    - `rows`: the segments of the rows of `B`; see `SchurTables`.
    - `factors`: see `GraphElimination`.
    """

    tables: SchurTables = eqx.field(static=True)
    rows: Float[Array, "rows segments size"]
    factors: Factors

    def product(self, u: Float[Array, " n"]) -> Float[Array, " rows"]:
        """`B u`"""
        return jnp.sum(self.rows * at_places(u, self.tables.read), axis=(-2, -1))

    def transposed(self, x: Float[Array, " rows"]) -> Float[Array, " n"]:
        """`B^T x`"""
        entries = jnp.append((self.rows * x[:, None, None]).ravel(), 0)
        return jnp.sum(at_places(entries, self.tables.transposed), axis=-1)

    def solve(self, right: Float[Array, "k rows"]) -> Float[Array, "k rows"]:
        """`G^-1` times each of `k` vectors."""
        return call_traced_once(_solved, self.tables, self.factors, right)


def _solved(
    tables: SchurTables, factors: Factors, right: Float[Array, "k rows"]
) -> Float[Array, "k rows"]:
    return jax.vmap(lambda x: tables.elimination.solve(factors, x))(right)


def schur_tables(
    fn: Callable[[Array], Array],
    like: Float[Array, " n"],
    weight: Symmetric,
    colours: np.ndarray | None = None,
    bounds: Bounds | None = None,
) -> SchurTables | None:
    """The tables for the Jacobian of `fn`.

    The `colours` of its columns are found, unless those of a Jacobian with more rows are
    given. `None` if it has no rows or too large blocks, or is not within the `bounds`.
    """
    num_rows = jax.eval_shape(fn, like).shape[0]
    pattern = jacobian_pattern(fn, like) if like.size > _FEW else None
    if num_rows == 0:
        return None
    if pattern is None:
        pattern = np.ones((num_rows, like.size), bool)
    pattern = scipy.sparse.csr_array(pattern)
    segments = _Segments(pattern, weight)
    if bounds is not None and not segments.are_within(bounds):
        return None
    most_rounds = np.inf if bounds is None else bounds.rounds
    orders = (x for x in segments.orders(most_rounds) if x is not None)
    narrow = (x for x in orders if x.width <= _WIDEST)
    order = min(narrow, key=lambda x: x.cost, default=None)
    if order is None:
        return None
    if colours is None:
        colours = column_colours(pattern, np.arange(like.size))
    return SchurTables(pattern, segments, order, colours)


def schur(
    tables: SchurTables,
    products: Float[Array, "rows colours"],
    weight: Symmetric,
    regularisation: Float[Array, " rows"] | None = None,
) -> Schur:
    """The factorised `G`, from the `products` of its tables.

    With a `regularisation`, this is added to the diagonal of a `G` that may be singular.
    """
    rows, weighted = _weighted(tables, products, weight)
    entries = _entries(tables, rows, weighted)
    if regularisation is not None:
        entries = entries.at[tables.diagonal].add(regularisation)
    return Schur(tables, rows, call_traced_once(_factorised, tables, entries))


def _factorised(tables: SchurTables, entries: Float[Array, " entries"]) -> Factors:
    return tables.elimination.factorised(entries)


def _weighted(
    tables: SchurTables, products: Float[Array, "rows colours"], weight: Symmetric
) -> tuple[Array, Array]:
    """The segments of the rows of `B`, and of `B W`."""
    rows = at_places(jnp.append(products.ravel(), 0), tables.entries)
    if isinstance(weight, BlockDiagonal):
        none = jnp.zeros((1, *weight.blocks.shape[1:]), rows.dtype)
        blocks = at_places(jnp.concatenate([weight.blocks, none]), tables.touched)
        blocks = weight.with_known_zeros(blocks)
    else:
        blocks = weight[None, None]
    return rows, jnp.sum(blocks * rows[:, :, None, :], axis=-1)


def _entries(tables: SchurTables, rows: Array, weighted: Array) -> Float[Array, " entries"]:
    left, right = (x.reshape(-1, rows.shape[-1]) for x in (weighted, rows))
    found = [
        jnp.sum(at_places(left, one) * at_places(right, other), axis=(1, 2))
        for one, other in tables.shared
    ]
    return at_places(jnp.concatenate(found), tables.order)
