"""The order in which the Jacobian of step equations is eliminated in blocks.

It is found from the sparsity pattern. Unknowns of one owner, such as a coordinate at two
nodes of a step, form a group, and so do owners that touch the same unknowns, such as the
multipliers of a joint. Groups are eliminated in the order of least degree (A. George and
J. W. H. Liu, 1989). The multipliers of a constraint wait for the coordinates that it acts
on. What is eliminated then always is a regular part of the system: some bodies with their
inertia, and some constraints that act on these bodies alone. Groups that are eliminated
one after the other are merged into nodes of similar size.
"""

import heapq
from collections.abc import Iterator, Sequence

import numpy as np
import scipy
from jaxtyping import Int
from typing_extensions import TypeAliasType

from ..._programs import shape_of


# A number for each unknown: not negative for coordinates, negative for multipliers, and
# `None` for multipliers of relations between coordinates.
Owners = TypeAliasType("Owners", tuple[int | None, ...])


# Numbers of unknowns up to which nodes are merged; the one with the least work is chosen.
_WIDTHS = 4, 6, 8, 12, 16, 24, 32
# Nodes up to this size are merged even if most of the new block is zero.
_NARROW = 8
# Larger nodes are merged if at most this part of the new coupling is zero.
_ZEROS = 0.5


class Nodes:
    """The nodes of an elimination in their order.

    - `labels`: the node of each unknown.
    - `later`: for each node, the later nodes that it is coupled to when it is eliminated.
    - `width`: the size of the largest node.
    """

    def __init__(self, closed: "scipy.sparse.csr_array", labels: np.ndarray):
        self.labels = labels
        near, self.later = _adjacent(closed, labels), []
        for k in range(len(near)):
            mine = {j for j in near[k] if j > k}
            self.later.append(sorted(mine))
            for j in mine:
                near[j] |= mine - {j}
        self.width = int(np.bincount(labels).max())


def elimination_orders(
    pattern: "scipy.sparse.csr_array", owners: Int[np.ndarray, " n"]
) -> Iterator[Nodes]:
    """Divisions of the unknowns into nodes, which differ in the size of the nodes.

    `owners` are those of `known_owners`.
    """
    closed = _closed(pattern)
    groups = _groups(closed, owners)
    sizes = np.bincount(groups).tolist()
    awaited = _awaited(closed, owners, groups)
    order = _least_degree(_adjacent(closed, groups), sizes, awaited)
    for width in _WIDTHS:
        yield Nodes(closed, _merged(order, sizes, width)[groups])


def known_owners(
    pattern: "scipy.sparse.csr_array", owners: Owners
) -> Int[np.ndarray, " n"]:
    """A number for each unknown: not negative for coordinates, negative for multipliers.

    Coordinates with a relation, and its multiplier, have one owner.
    """
    unknown = np.iinfo(int).min
    known = np.array([unknown if owner is None else owner for owner in owners])
    closed = _closed(pattern)
    for k in np.flatnonzero(known == unknown):
        near = known[closed.indices[closed.indptr[k] : closed.indptr[k + 1]]]
        related = np.unique(near[near >= 0])
        known[np.isin(known, related)] = related[0]
        known[k] = related[0]
    return known


def _closed(pattern: "scipy.sparse.csr_array") -> "scipy.sparse.csr_array":
    """The symmetric pattern with the diagonal."""
    places = np.arange(shape_of(pattern)[0])
    diagonal = scipy.sparse.csr_array((np.ones(places.size, bool), (places, places)))
    return scipy.sparse.csr_array(pattern + pattern.T + diagonal)


def _groups(closed: "scipy.sparse.csr_array", owners: np.ndarray) -> np.ndarray:
    """The group of each unknown."""
    number = np.unique(owners, return_inverse=True)[1]
    is_multiplier = np.zeros(int(number.max()) + 1, bool)
    is_multiplier[number[owners < 0]] = True
    seen: dict[tuple[bool, frozenset[int]], int] = {}
    groups = [
        seen.setdefault((bool(is_multiplier[k]), frozenset(near | {k})), len(seen))
        for k, near in enumerate(_adjacent(closed, number))
    ]
    return np.array(groups)[number]


def _awaited(
    closed: "scipy.sparse.csr_array", owners: np.ndarray, groups: np.ndarray
) -> list[set[int]]:
    """For each group, the groups of the coordinates that it waits for.

    A constraint acts on the coordinates that the multiplier of its position touches. The
    multiplier of its rate touches more, by the velocities that are eliminated.
    """
    awaited: list[set[int]] = [set() for _ in range(int(groups.max()) + 1)]
    fewest: dict[int, set[int]] = {}
    for k in np.flatnonzero(owners < 0).tolist():
        near = closed.indices[closed.indptr[k] : closed.indptr[k + 1]]
        near = set(groups[near[owners[near] >= 0]].tolist())
        known = fewest.get(int(owners[k]))
        if known is None or len(near) < len(known):
            fewest[int(owners[k])] = near
    for k in np.flatnonzero(owners < 0).tolist():
        awaited[groups[k]] |= fewest[int(owners[k])]
    return awaited


def _adjacent(closed: "scipy.sparse.csr_array", labels: np.ndarray) -> list[set[int]]:
    """For each label, the labels that it is coupled to."""
    rows, columns = closed.nonzero()
    pairs = np.unique(np.stack([labels[rows], labels[columns]]), axis=1)
    near: list[set[int]] = [set() for _ in range(int(labels.max()) + 1)]
    for one, other in pairs.T.tolist():
        if one != other:
            near[one].add(other)
    return near


def _least_degree(
    near: Sequence[set[int]], sizes: Sequence[int], awaited: Sequence[set[int]]
) -> list[tuple[int, set[int]]]:
    """The groups in the order of their elimination, with what each is coupled to then.

    None is eliminated before those that it waits for.
    """
    pending = [len(others) for others in awaited]
    waiting: list[list[int]] = [[] for _ in near]
    for k, others in enumerate(awaited):
        for j in others:
            waiting[j].append(k)
    near = [set(others) for others in near]
    left = set(range(len(near)))
    degree = lambda k: sum(sizes[j] for j in near[k])
    heap = [(degree(k), k) for k in left if not pending[k]]
    heapq.heapify(heap)
    order = []
    while left:
        d, k = heapq.heappop(heap)
        if k not in left or d != degree(k):
            continue
        left.remove(k)
        order.append((k, set(near[k])))
        for j in near[k]:
            near[j] = (near[j] | near[k]) - {j, k}
        for j in waiting[k]:
            pending[j] -= 1
        for j in near[k].union(waiting[k]):
            if not pending[j]:
                heapq.heappush(heap, (degree(j), j))
    return order


def _merged(
    order: Sequence[tuple[int, set[int]]], sizes: Sequence[int], width: int
) -> np.ndarray:
    """The node of each group, where nodes have at most `width` unknowns."""
    place = {k: number for number, (k, _) in enumerate(order)}
    owner, total = list(range(len(sizes))), list(sizes)
    reach = dict(order)

    def find(k: int) -> int:
        while owner[k] != k:
            k = owner[k]
        return k

    for k, _ in order:
        mine = reach[k] = {find(j) for j in reach[k]}
        if not mine:
            continue
        parent = min(mine, key=place.__getitem__)
        reach[parent] = {find(j) for j in reach[parent]} - {parent}
        size = total[k] + total[parent]
        zeros = sum(total[j] for j in reach[parent] - mine)
        if size <= width and (size <= _NARROW or zeros <= _ZEROS * size):
            owner[k], total[parent] = parent, size
            reach[parent] |= mine - {parent}
    roots = [k for k, _ in order if owner[k] == k]
    number = {k: node for node, k in enumerate(roots)}
    return np.array([number[find(k)] for k in range(len(sizes))])
