"""Sparse symmetric matrices, eliminated in rounds that are found from their graph.

The rows are divided into nodes, such as the rows of a joint. In each round, nodes that are
not coupled to one another are eliminated together, those first that cause the least fill.
Of a chain, that is every other node (cyclic reduction); of a tree, the leaves. A chain or a
tree of `n` nodes takes about `log n` rounds. What they leave is treated as dense. The
matrix must be positive definite: there is no pivoting.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._programs import at_places
from .dense import definite_inverse


# The fixed cost of a round, in multiplications. Most of it is the compilation of the round:
# the first run of 64 bodies in directors takes 2.5 times as long with 160 rounds as with 7,
# and a step takes the same time.
_ROUND = 3000


class Round(NamedTuple):
    """The nodes of a round, and the neighbours of each when it is eliminated."""

    nodes: list[int]
    neighbours: list[list[int]]


class Order(NamedTuple):
    """The order of an elimination: the rounds, and the nodes that they leave.

    - `nodes`: the rows of each node.
    - `adjacent`: the nodes that are coupled to each.
    """

    nodes: Sequence[np.ndarray]
    adjacent: Sequence[set[int]]
    rounds: list[Round]
    left: list[int]

    @property
    def num_left(self) -> int:
        return sum(self.nodes[k].size for k in self.left)

    def shape(self, number: int) -> tuple[int, int, int, int]:
        """For a round: how many neighbours a node has at most, how many rows these have
        and the node, and the number of nodes."""
        nodes, neighbours = self.rounds[number]
        size = lambda k: self.nodes[k].size
        width = max((size(j) for others in neighbours for j in others), default=0)
        depth = max(map(len, neighbours))
        return depth, width, max(map(size, nodes)), len(nodes)

    @property
    def width(self) -> int:
        """The number of rows of the largest block."""
        shapes = map(self.shape, range(len(self.rounds)))
        return max([self.num_left, *(own for _, _, own, _ in shapes)])

    @property
    def cost(self) -> float:
        """About how many multiplications the elimination takes."""
        shapes = map(self.shape, range(len(self.rounds)))
        return self.num_left**3 + sum(
            _ROUND + count * own * (own**2 + d * width * (own + (d + 1) * width / 2))
            for d, width, own, count in shapes
        )


class Sums(NamedTuple):
    """How the numbers of a vector change: those that change come first in the new vector.

    - `old`: the places of the old values; one past the end for zero.
    - `terms`: the places of what is subtracted from each that changes, shape
      `(changed, terms)`; one past the end for nothing.
    """

    old: np.ndarray
    terms: np.ndarray

    def __call__(self, numbers: Float[Array, " n"], terms: Array) -> Float[Array, " m"]:
        kept = at_places(jnp.append(numbers, 0), self.old)
        count, width = self.terms.shape
        if width == 0:
            return kept
        added = at_places(jnp.append(terms.ravel(), 0), self.terms.T)
        return jnp.concatenate([kept[:count] - jnp.sum(added, axis=0), kept[count:]])


class EntriesOfRound(NamedTuple):
    """The entries of `p` nodes of `b` rows, each with `d` neighbours of `c` rows.

    Places of absent entries are one past the end, where a zero is, or two, where a one is.

    - `pivots`: the entries of the diagonal blocks, shape `(b, b, p)`.
    - `couplings`: the entries in the rows of the neighbours, shape `(d, c, b, p)`.
    - `others`: how the other entries change, by products of the couplings of two
      neighbours, shape `(pairs, c, c, p)`.
    """

    pivots: np.ndarray
    couplings: np.ndarray
    others: Sums


class RowsOfRound(NamedTuple):
    """The rows of the same nodes.

    - `own`: the rows of the nodes among those before the round, shape `(b, p)`.
    - `others`: how the other rows change, by numbers of shape `(d, c, p)`.
    - `neighbours`: the rows of the neighbours among the others, shape `(d, c, p)`.
    - `back`: the rows before the round, in the others followed by those of the nodes.
    """

    own: np.ndarray
    others: Sums
    neighbours: np.ndarray
    back: np.ndarray


class Factors(eqx.Module):
    """The factors of a matrix.

    - `inverses`: for each round, the inverses of the pivots, shape `(b, b, p)`.
    - `below`: the factors of the neighbours, shape `(d, c, b, p)`.
    - `last`: the inverse of what is left after all rounds.
    """

    inverses: list[Float[Array, "b b p"]]
    below: list[Float[Array, "d c b p"]]
    last: Float[Array, "n n"]


class GraphElimination:
    """The tables of all rounds, of a matrix with the given nodes and couplings.

    - `entries`: the two rows that each entry couples, the later one first.
    - `rounds`: the tables of each round.
    - `last`: the places of the entries that they leave, shape `(n, n)`; `last_rows`: the
      places of the rows that they leave, and `last_back` the reverse.
    """

    def __init__(self, order: Order):
        nodes, adjacent, rounds, left = order
        blocks, num_entries = _all_blocks(nodes, adjacent, rounds)
        layouts = [_layout(blocks, of, order.shape(k)) for k, of in enumerate(rounds)]
        last = [[blocks.of(k, j) for j in left] for k in left]
        last = np.block(last) if left else np.zeros((0, 0), int)
        blocks.number([x for layout in layouts for x in layout] + [last])
        entries = blocks.sorted(np.arange(num_entries))
        rows = np.arange(blocks.count)
        self.entries = np.array(blocks.entries)[entries]
        self.rounds = []
        for of, layout in zip(rounds, layouts, strict=True):
            of_entries, entries = _entries_of_round(blocks, of, layout, entries)
            of_rows, rows = _rows_of_round(blocks, of, layout[1].shape, rows)
            self.rounds.append((of_entries, of_rows))
        place = np.full(len(blocks.entries), entries.size)
        place[entries] = np.arange(entries.size)
        self.last = place[last]
        back = {int(row): k for k, row in enumerate(rows)}
        self.last_rows = np.array([back[int(x)] for k in left for x in nodes[k]], int)
        self.last_back = np.argsort(self.last_rows)

    @property
    def description(self) -> str:
        counts = ", ".join(str(x.own.shape[1]) for _, x in self.rounds)
        rounds = f"nodes eliminated together: {counts}; then " if self.rounds else ""
        return f"{rounds}{self.last_rows.size} rows as a dense matrix"

    def factorised(self, entries: Float[Array, " entries"]) -> Factors:
        inverses, below = [], []
        for tables, _ in self.rounds:
            numbers = jnp.append(entries, jnp.array([0, 1], entries.dtype))
            found = _inverses(at_places(numbers, tables.pivots))
            couplings = at_places(numbers, tables.couplings)
            factors = jnp.sum(couplings[:, :, :, None] * found[None, None], axis=2)
            one, other = np.tril_indices(len(couplings))
            products = factors[one][:, :, None] * couplings[other][:, None]
            entries = tables.others(entries, jnp.sum(products, axis=3))
            inverses.append(found)
            below.append(factors)
        last = at_places(jnp.append(entries, 0), self.last)
        return Factors(inverses, below, definite_inverse(last))

    def solve(
        self, factors: Factors, right: Float[Array, " rows"]
    ) -> Float[Array, " rows"]:
        values = []
        for (_, tables), below in zip(self.rounds, factors.below, strict=True):
            own = at_places(jnp.append(right, 0), tables.own)
            values.append(own)
            right = tables.others(right, jnp.sum(below * own[None, None], axis=2))
        last = at_places(right, self.last_rows)
        x = at_places(jnp.sum(factors.last * last[None], axis=1), self.last_back)
        rounds = zip(self.rounds, values, factors.inverses, factors.below, strict=True)
        for (_, tables), value, inverse, below in reversed(list(rounds)):
            near = at_places(jnp.append(x, 0), tables.neighbours)
            own = jnp.sum(inverse * value[None], axis=1)
            own = own - jnp.sum(below * near[:, :, None], axis=(0, 1))
            x = at_places(jnp.concatenate([x, own.ravel()]), tables.back)
        return x


def _inverses(matrices: Float[Array, "b b p"]) -> Float[Array, "b b p"]:
    return jax.vmap(definite_inverse, in_axes=2, out_axes=2)(matrices)


def elimination_order(
    nodes: Sequence[np.ndarray],
    adjacent: Sequence[set[int]],
    most_rounds: float = np.inf,
) -> Order | None:
    """The order for a matrix with the given rows of nodes and couplings of nodes.

    `None` if it takes more than `most_rounds`.
    """
    near, sizes = [set(others) for others in adjacent], [len(rows) for rows in nodes]
    rounds = []
    # The fill of the nodes that are left.
    fill = {k: _fill(near, k) for k in range(len(near))}
    # A dense matrix of few rows is cheaper than one more round.
    while len(fill) > 1 and sum(sizes[k] for k in fill) > 4:
        if len(fill) > 3 and all(len(near[k]) == len(fill) - 1 for k in fill):
            break
        if len(rounds) >= most_rounds:
            return None
        most = max(1, min(fill.values()))
        chosen, blocked = [], set[int]()
        for k in sorted(fill, key=lambda k: (fill[k], len(near[k]), k)):
            if fill[k] <= most and k not in blocked:
                chosen.append(k)
                blocked |= near[k]
        chosen.sort()
        rounds.append(Round(chosen, [sorted(near[k]) for k in chosen]))
        for k in chosen:
            del fill[k]
            for j in near[k]:
                near[j] |= near[k]
                near[j] -= {j, k}
        # That of all other nodes is as before.
        for k in blocked.union(*(near[j] for j in blocked)):
            fill[k] = _fill(near, k)
    return Order(nodes, adjacent, rounds, sorted(fill))


def _fill(near: list[set[int]], k: int) -> int:
    """How many pairs of neighbours become coupled if a node is eliminated."""
    return sum(len(near[k] - near[j]) - 1 for j in near[k]) // 2


class _Blocks:
    """The numbers of the entries of each pair of nodes.

    - `entries`: the two rows of each entry.
    """

    def __init__(self, nodes: Sequence[np.ndarray]):
        self.nodes, self.count = nodes, sum(map(len, nodes))
        self.entries: list[tuple[int, int]] = []
        self._blocks: dict[tuple[int, int], np.ndarray] = {}

    def of(self, k: int, j: int) -> np.ndarray:
        """The numbers of the entries of a block, which is new if it was not asked for."""
        if k < j:
            return self.of(j, k).T
        if (k, j) not in self._blocks:
            rows, columns = self.nodes[k], self.nodes[j]
            numbers = np.zeros((rows.size, columns.size), int)
            for a, b in np.ndindex(numbers.shape):
                if k > j or a >= b:
                    numbers[a, b] = len(self.entries)
                    self.entries.append((int(rows[a]), int(columns[b])))
            if k == j:
                numbers = np.maximum(numbers, numbers.T)
            self._blocks[k, j] = numbers
        return self._blocks[k, j]

    def number(self, layouts: list[np.ndarray]) -> None:
        """Finds the order in which the entries are used."""
        used = np.concatenate([x.ravel() for x in layouts])
        entries, first = np.unique(used[used >= 0], return_index=True)
        self._rank = np.empty(len(self.entries), int)
        self._rank[entries] = first

    def sorted(self, entries: np.ndarray) -> np.ndarray:
        """Entries in the order in which they are used."""
        return entries[np.argsort(self._rank[entries])]


# The numbers that stand for an entry of zero and for one of one in padded blocks.
_ZERO, _ONE = -2, -1


def _all_blocks(
    nodes: Sequence[np.ndarray], adjacent: Sequence[set[int]], rounds: list[Round]
) -> tuple[_Blocks, int]:
    """The blocks of the matrix and then of its fill, and the entries of the former."""
    blocks = _Blocks(nodes)
    for k, others in enumerate(adjacent):
        for j in (k, *others):
            blocks.of(k, j)
    count = len(blocks.entries)
    for of in rounds:
        for others in of.neighbours:
            for k, j in itertools.combinations(others, 2):
                blocks.of(k, j)
    return blocks, count


def _layout(
    blocks: _Blocks, of: Round, shape: tuple[int, int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the pivots and of the couplings of a round."""
    size = lambda k: blocks.nodes[k].size
    depth, width, own, count = shape
    pivots = np.full((own, own, count), _ZERO)
    pivots[np.arange(own), np.arange(own)] = _ONE
    couplings = np.full((depth, width, own, count), _ZERO)
    for p, (k, others) in enumerate(zip(of.nodes, of.neighbours, strict=True)):
        pivots[: size(k), : size(k), p] = blocks.of(k, k)
        for d, j in enumerate(others):
            couplings[d, : size(j), : size(k), p] = blocks.of(j, k)
    return pivots, couplings


def _entries_of_round(
    blocks: _Blocks,
    of: Round,
    layout: tuple[np.ndarray, np.ndarray],
    before: np.ndarray,
) -> tuple[EntriesOfRound, np.ndarray]:
    """The entries of a round, and those that are left after it.

    `before` are the entries before the round, in the order of their places.
    """
    pivots, couplings = layout
    place = np.full(len(blocks.entries) + 2, before.size)
    place[_ONE] = before.size + 1
    place[before] = np.arange(before.size)
    changes = _changes_of_entries(blocks, of, couplings.shape)
    changed = blocks.sorted(np.array(list(changes), int))
    used = np.concatenate([pivots.ravel(), couplings.ravel(), changed])
    after = np.concatenate([changed, blocks.sorted(before[~np.isin(before, used)])])
    depth, width, _, count = couplings.shape
    none = depth * (depth + 1) // 2 * width * width * count
    terms = _padded([changes[k] for k in changed], none)
    others = Sums(place[after], terms)
    return EntriesOfRound(place[pivots], place[couplings], others), after


def _rows_of_round(
    blocks: _Blocks, of: Round, shape: tuple[int, ...], before: np.ndarray
) -> tuple[RowsOfRound, np.ndarray]:
    """The rows of a round, and those that are left after it.

    `shape` is that of its couplings, and `before` are the rows before it.
    """
    depth, width, own, count = shape
    mine = np.full((own, count), blocks.count)
    near = np.full((depth, width, count), blocks.count)
    for p, (k, others) in enumerate(zip(of.nodes, of.neighbours, strict=True)):
        mine[: blocks.nodes[k].size, p] = blocks.nodes[k]
        for d, j in enumerate(others):
            near[d, : blocks.nodes[j].size, p] = blocks.nodes[j]
    place = np.full(blocks.count + 1, before.size)
    place[before] = np.arange(before.size)
    changes: dict[int, list[int]] = {}
    for at in np.flatnonzero(near < blocks.count):
        changes.setdefault(int(near.flat[at]), []).append(int(at))
    changed = np.array(list(changes), int)
    used = np.concatenate([mine.ravel(), changed])
    after = np.concatenate([changed, np.sort(before[~np.isin(before, used)])])
    others = Sums(place[after], _padded(list(changes.values()), near.size))
    place_after = np.full(blocks.count + 1, after.size)
    place_after[after] = np.arange(after.size)
    neighbours = place_after[near]
    inside = mine < blocks.count
    place_after[mine[inside]] = after.size + np.flatnonzero(inside)
    return RowsOfRound(place[mine], others, neighbours, place_after[before]), after


def _changes_of_entries(
    blocks: _Blocks, of: Round, shape: tuple[int, ...]
) -> dict[int, list[int]]:
    """The places of what is subtracted from each entry in a round."""
    depth, width, _, count = shape
    one, other = np.tril_indices(depth)
    products = np.arange(one.size * width * width * count)
    products = products.reshape(one.size, width, width, count)
    entries: dict[int, list[int]] = {}
    for p, others in enumerate(of.neighbours):
        for pair, (d, e) in enumerate(zip(one, other, strict=True)):
            if d >= len(others):
                continue
            block = blocks.of(others[d], others[e])
            for a, b in np.ndindex(block.shape):
                if d > e or a >= b:
                    at = int(products[pair, a, b, p])
                    entries.setdefault(int(block[a, b]), []).append(at)
    return entries


def _padded(lists: list[list[int]], none: int) -> np.ndarray:
    table = np.full((len(lists), max(map(len, lists), default=0)), none)
    for row, places in zip(table, lists, strict=True):
        row[: len(places)] = places
    return table
