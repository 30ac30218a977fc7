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


class Bundle(NamedTuple):
    """`n` sets of `r` rows of `B` each; the rows of a set have entries in the same blocks.

    A row is stored as segments, one for each block of `W` in which it has entries. Indices
    of absent entries are one past the end.

    - `rows`: the rows of each set, shape `(n, r)`.
    - `touched`: the block of `W` of each segment, shape `(n, segments)`.
    - `columns`: the unknowns of each segment, shape `(n, segments, size)`; `read`: the same
      with some unknown in place of absent ones, whose entries are zero.
    - `entries`: the index of each entry in the coloured products, shape
      `(n, r, segments, size)`.
    """

    rows: np.ndarray
    touched: np.ndarray
    columns: np.ndarray
    read: np.ndarray
    entries: np.ndarray


class Pairs(NamedTuple):
    """`p` pairs of sets, each with `c` segments in blocks that both sets touch.

    - `bundles`: the two bundles of the sets.
    - `segments`: the segments that are paired, by their number in each bundle, shape
      `(2, p, c)`.
    - `is_own`: whether each set is paired with itself. Then only entries of the lower
      triangle are computed, else those of all rows of the one with all of the other.
    """

    bundles: tuple[int, int]
    segments: np.ndarray
    is_own: bool


class SchurTables(Indices):
    """The index tables by which the entries of `B` and `G` are found.

    They are constructed at trace time.

    - `colours`: the colours of the columns of `B`. Columns of equal colour share no row.
    - `bundles`: the rows; `back`: the place of each row among those of all bundles.
    - `transposed`: the places of each unknown in the segments of all bundles.
    - `elimination`: the nodes of `G`, its entries, and the order of their elimination.
    - `pairs`: the blocks of `G`; `order`: the place of each entry in these, or one past the
      end for an entry that is zero before the elimination.
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
        none = np.full((1, blocks.shape[1]), size)
        blocks = np.concatenate([blocks, none])
        self._find_bundles(rows * (size + 1) + columns, segments.touched, blocks, size)
        self._find_transposed(size)
        self.elimination = GraphElimination(order)
        self._find_pairs()

    @property
    def description(self) -> str:
        return f"{self.num_rows} rows, {self.elimination.description}"

    def products(
        self, fn: Callable[[Array], Array], at: Float[Array, " n"]
    ) -> Float[Array, "rows colours"]:
        """For each colour, the sum of the columns of `B`, the Jacobian of `fn`."""
        return coloured_products(fn, at, self.colours)

    def _find_bundles(
        self, numbers: np.ndarray, touched: np.ndarray, blocks: np.ndarray, size: int
    ) -> None:
        """Divides the rows by the blocks that they touch.

        `numbers` are `row * (size + 1) + column` for each entry of `B`.
        """
        num_colours = int(self.colours.max(initial=0)) + 1
        colours = np.append(self.colours, 0)
        _, labels = np.unique(touched, axis=0, return_inverse=True)
        labels = labels.ravel()
        of_label = np.split(
            np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))
        )
        by_size: dict[int, list[np.ndarray]] = {}
        for rows in of_label[:-1]:
            by_size.setdefault(rows.size, []).append(rows)
        self.bundles: list[Bundle] = []
        for sets in by_size.values():
            # In the order of the rows, which are often neighbours.
            rows = np.array(sorted(sets, key=lambda x: int(x[0])))
            columns = blocks[touched[rows[:, 0]]]
            number = rows[:, :, None, None] * (size + 1) + columns[:, None]
            place = rows[:, :, None, None] * num_colours + colours[columns][:, None]
            entries = np.where(np.isin(number, numbers), place, self.num_rows * num_colours)
            read = with_any(columns, size)
            bundle = Bundle(rows, touched[rows[:, 0]], columns, read, entries)
            self.bundles.append(bundle)
        self.back = np.argsort(np.concatenate([x.rows.ravel() for x in self.bundles]))

    def _find_transposed(self, size: int) -> None:
        absent = self.num_rows * (int(self.colours.max(initial=0)) + 1)
        columns = np.concatenate(
            [
                np.where(np.any(x.entries < absent, axis=1), x.columns, size).ravel()
                for x in self.bundles
            ]
        )
        places = np.flatnonzero(columns < size)
        columns, count = columns[places], columns.size
        order = np.argsort(columns, kind="stable")
        counts = np.bincount(columns, minlength=size)
        within = np.arange(order.size) - np.repeat(np.cumsum(counts) - counts, counts)
        self.transposed = np.full((size, counts.max(initial=1)), count)
        self.transposed[columns[order], within] = places[order]

    def _find_pairs(self) -> None:
        """Which segments two sets have in common, and where the entries are computed."""
        place_of_row: dict[int, tuple[int, int, int]] = {
            int(row): (number, k, r)
            for number, bundle in enumerate(self.bundles)
            for (k, r), row in np.ndenumerate(bundle.rows)
        }
        found: dict[tuple[int, int, int, bool], list[np.ndarray]] = {}
        known: dict[tuple, tuple[tuple, int] | None] = {}
        places: list[tuple[tuple, int, int, int] | None] = []
        for one, other in self.elimination.entries.tolist():
            a, b = sorted((place_of_row[one], place_of_row[other]), reverse=True)
            sets = a[:2], b[:2]
            if sets not in known:
                known[sets] = self._pair(*sets, found)
            pair = known[sets]
            places.append(None if pair is None else (*pair, a[2], b[2]))
        starts, total = {}, 0
        self.pairs = []
        for key, segments in found.items():
            one, other, _, is_own = key
            self.pairs.append(Pairs((one, other), np.stack(segments, axis=1), is_own))
            starts[key] = total
            total += len(segments) * self._entries_of_pair(key)
        self.order = np.array(
            [total if x is None else starts[x[0]] + self._place(*x) for x in places], int
        )
        rows, columns = self.elimination.entries.T
        diagonal = np.flatnonzero(rows == columns)
        self.diagonal = diagonal[np.argsort(rows[diagonal])]

    def _pair(
        self, one: tuple[int, int], other: tuple[int, int], found: dict[tuple, list]
    ) -> tuple[tuple, int] | None:
        """Adds a pair of sets to those that are `found`, and returns its place there."""
        (a, k), (b, j) = one, other
        touched = self.bundles[a].touched[k], self.bundles[b].touched[j]
        is_there = np.any(self.bundles[a].columns[k] < self.transposed.shape[0], axis=-1)
        common = (touched[0][:, None] == touched[1][None]) & is_there[:, None]
        segments = np.array(np.nonzero(common))
        if segments.shape[1] == 0:
            return None
        key = a, b, segments.shape[1], one == other
        numbers = segments + np.array([[k], [j]]) * common.shape[0]
        found.setdefault(key, []).append(numbers)
        return key, len(found[key]) - 1

    def _entries_of_pair(self, key: tuple[int, int, int, bool]) -> int:
        a, b, _, is_own = key
        one, other = (self.bundles[x].rows.shape[1] for x in (a, b))
        return one * (one + 1) // 2 if is_own else one * other

    def _place(self, key: tuple[int, int, int, bool], number: int, r: int, q: int) -> int:
        """The place of an entry among those of all pairs of one kind."""
        _, b, _, is_own = key
        within = r * (r + 1) // 2 + q if is_own else r * self.bundles[b].rows.shape[1] + q
        return number * self._entries_of_pair(key) + within


class _Segments:
    """The segments of the rows of `B`, and the orders in which they can be eliminated.

    - `blocks`: the unknowns of each block of `W`; `touched`: the blocks in which each row
      has entries, shape `(rows, segments)`.
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

    - `rows`: the segments of the rows of each bundle; see `SchurTables`.
    - `factors`: see `GraphElimination`.
    """

    tables: SchurTables = eqx.field(static=True)
    rows: list[Float[Array, "n r segments size"]]
    factors: Factors

    def product(self, u: Float[Array, " n"]) -> Float[Array, " rows"]:
        """`B u`"""
        found = [
            jnp.sum(rows * at_places(u, bundle.read)[:, None], axis=(-2, -1)).ravel()
            for rows, bundle in zip(self.rows, self.tables.bundles, strict=True)
        ]
        return at_places(jnp.concatenate(found), self.tables.back)

    def transposed(self, x: Float[Array, " rows"]) -> Float[Array, " n"]:
        """`B^T x`"""
        found = [
            jnp.sum(rows * at_places(x, bundle.rows)[:, :, None, None], axis=1).ravel()
            for rows, bundle in zip(self.rows, self.tables.bundles, strict=True)
        ]
        entries = jnp.concatenate([*found, jnp.zeros((1,), x.dtype)])
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
) -> tuple[list[Array], list[Array]]:
    """The segments of the rows of each bundle, those of `B` and those of `B W`."""
    numbers = jnp.append(products.ravel(), 0)
    all_rows, all_weighted = [], []
    blocks_of = _blocks_of(weight)
    for bundle in tables.bundles:
        rows, blocks = at_places(numbers, bundle.entries), blocks_of(bundle)
        all_rows.append(rows)
        all_weighted.append(jnp.sum(blocks[:, None] * rows[:, :, :, None, :], axis=-1))
    return all_rows, all_weighted


def _blocks_of(weight: Symmetric) -> Callable[[Bundle], Float[Array, "n segments b b"]]:
    """The blocks of `W` that the segments of a bundle are in."""
    if not isinstance(weight, BlockDiagonal):
        return lambda bundle: weight[None, None]
    none = jnp.zeros((1, *weight.blocks.shape[1:]), weight.blocks.dtype)
    blocks = jnp.concatenate([weight.blocks, none])
    return lambda bundle: weight.with_known_zeros(at_places(blocks, bundle.touched))


def _entries(
    tables: SchurTables, rows: list[Array], weighted: list[Array]
) -> Float[Array, " entries"]:
    found = []
    for pairs in tables.pairs:
        one, other = pairs.bundles
        left = at_places(_by_segments(weighted[one]), pairs.segments[0])
        right = at_places(_by_segments(rows[other]), pairs.segments[1])
        if pairs.is_own:
            below, beside = np.tril_indices(left.shape[2])
            product = left[:, :, below] * right[:, :, beside]
        else:
            product = left[:, :, :, None] * right[:, :, None]
        found.append(jnp.sum(product, axis=(1, -1)).ravel())
    zero = jnp.zeros((1,), rows[0].dtype)
    return at_places(jnp.concatenate([*found, zero]), tables.order)


def _by_segments(rows: Float[Array, "n r segments size"]) -> Float[Array, "m r size"]:
    """The rows of each segment, where `m` is `n` times the number of segments."""
    by_segment = jnp.moveaxis(rows, 2, 1)
    return by_segment.reshape(-1, *by_segment.shape[2:])
