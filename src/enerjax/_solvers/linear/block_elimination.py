"""Large sparse Jacobians as blocks, and their elimination.

The nodes of the elimination and their order are found once from the sparsity pattern; see
`elimination_order.py`. All nodes are padded to the same size, so the numbers of all blocks
are one array, and every operation is a product of two blocks. The elimination is a list of
such products. It is one short program for any mechanism and any number of bodies, and it
works in batches and on accelerators. Rows are exchanged within nodes, not between them.
Columns of the Jacobian that share no row have the same colour and are evaluated in one
product.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from ..._programs import in_one_function, shape_of
from .colours import coloured_products, column_colours
from .dense import AbstractFactors, eliminated, SMALL, UNROLLED
from .elimination_order import elimination_orders, known_owners, Nodes, Owners


# What happens to a block in a change: it is inverted, or replaced by the product of two
# blocks, or this is added to it.
_INVERT, _MULTIPLY, _ADD = range(3)


class BlockElimination:
    """The index tables by which a sparse matrix is stored in blocks and eliminated.

    The tables are constructed at trace time. See `Owners` for `owners`.
    Blocks are padded with decoupled unknowns, whose equation is `x = 0`.

    - `colours`: the colour of each column. Columns of equal colour share no row.
    - `places`: the index of each entry `(block, row, column)` in the coloured products,
      which are followed by a zero and a one.
    - `order`: the number of the unknown at each position of the nodes, shape
      `(nodes, width)`; the size of the matrix at padded positions.
    - `back`: the position of each unknown in the nodes.
    - `changes`: the changes of the elimination in their order: the block that changes, the
      two factors of a product, and which change it is.
    - `substitutions`: the products of the substitution in their order: the vector that
      changes, the block, and the vector that it multiplies. The vectors are those of the
      right-hand sides of all nodes, followed by those of the solution.
    """

    def __init__(
        self, pattern: "scipy.sparse.csr_array", owners: Owners, rarely: bool = False
    ):
        self._rarely = rarely
        self.size, _ = shape_of(pattern)
        known = known_owners(pattern, owners)
        nodes = min(elimination_orders(pattern, known), key=_cost)
        self.cost, self.width = _cost(nodes), nodes.width
        self.colours = column_colours(pattern, np.arange(self.size))
        self.num_colours = int(self.colours.max(initial=0)) + 1
        self._place_unknowns(nodes)
        numbers = self._number_blocks(nodes)
        self._find_entries(pattern, numbers)
        self._list_products(nodes, numbers)

    def _place_unknowns(self, nodes: Nodes) -> None:
        counts = np.bincount(nodes.labels)
        members = np.argsort(nodes.labels, kind="stable")
        starts = np.cumsum(counts) - counts
        self.back = np.empty(self.size, int)
        self.back[members] = np.repeat(
            np.arange(counts.size) * self.width - starts, counts
        ) + np.arange(self.size)
        self.order = np.full(counts.size * self.width, self.size)
        self.order[self.back] = np.arange(self.size)
        self.order = self.order.reshape(counts.size, self.width)

    def _number_blocks(self, nodes: Nodes) -> dict[tuple[int, int], int]:
        """The numbers of the blocks of each pair of nodes, diagonal ones first."""
        pairs = [(k, k) for k in range(len(nodes.later))]
        for k, later in enumerate(nodes.later):
            pairs += [pair for j in later for pair in ((k, j), (j, k))]
        return {pair: number for number, pair in enumerate(pairs)}

    def _find_entries(
        self, pattern: "scipy.sparse.csr_array", numbers: dict[tuple[int, int], int]
    ) -> None:
        rows, columns = pattern.nonzero()
        (one, row), (other, column) = (
            np.divmod(self.back[x], self.width) for x in (rows, columns)
        )
        pairs = zip(one.tolist(), other.tolist(), strict=True)
        block = np.array([numbers[pair] for pair in pairs], int)
        nowhere = self.num_colours * self.size
        self.places = np.full((len(numbers), self.width, self.width), nowhere)
        self.places[block, row, column] = rows * self.num_colours + self.colours[columns]
        node, row = np.nonzero(self.order == self.size)
        self.places[node, row, row] = nowhere + 1

    def _list_products(self, nodes: Nodes, numbers: dict[tuple[int, int], int]) -> None:
        count = len(nodes.later)
        changes, forward, backward = [], [], []
        for k, later in enumerate(nodes.later):
            of = lambda j, i: numbers[j, i]
            changes.append((of(k, k), of(k, k), of(k, k), _INVERT))
            changes += [(of(k, j), of(k, k), of(k, j), _MULTIPLY) for j in later]
            changes += [(of(j, i), of(j, k), of(k, i), _ADD) for j in later for i in later]
            forward.append((count + k, of(k, k), k))
            forward += [(j, of(j, k), count + k) for j in later]
            backward += [(count + k, of(k, j), count + j) for j in reversed(later)]
        self.changes = np.array(changes, int)
        self.substitutions = np.array(forward + backward[::-1], int)

    def description(self, size: int) -> str:
        return (
            f"{len(self.order)} nodes of up to {self.width} unknowns, coupled by "
            f"{len(self.places) - len(self.order)} blocks, "
            f"found by {self.num_colours} products with the Jacobian"
        )

    def is_cheaper_than_dense(self) -> bool:
        """Whether the elimination needs less work than that of the dense matrix."""
        return self.cost < _cost_of_dense(self.size)

    def empty(self, size: int, dtype: Any) -> "BlockFactors":
        """Placeholder factors, of the shapes that `renewed` returns."""
        del size
        return BlockFactors(self, jnp.zeros(self.places.shape, dtype))

    def evaluate(
        self, fn: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, "blocks width width"]:
        """The blocks of the Jacobian of `fn` at `x`."""
        products = coloured_products(fn, x, self.colours, self._rarely)
        numbers = jnp.append(products.ravel(), jnp.array([0, 1], x.dtype))
        # In the order in which loops keep blocks, by columns.
        by_columns = numbers[self.places.transpose(0, 2, 1).ravel()]
        return by_columns.reshape(self.places.shape).transpose(0, 2, 1)

    def factorised(
        self, blocks: Float[Array, "blocks width width"]
    ) -> Float[Array, "blocks width width"]:
        """The factors, block by block: `-D^-1`, `L` and `-D^-1 U`."""

        def change(blocks: Array, row: Array) -> tuple[Array, None]:
            at, left, right, how = row
            own = _block(blocks, at)
            product = lambda: _product(_block(blocks, left), _block(blocks, right))
            new = jax.lax.switch(
                how, [lambda: -_inverse(own), product, lambda: own + product()]
            )
            return _changed(blocks, at, new), None

        return jax.lax.scan(change, blocks, jnp.asarray(self.changes))[0]

    def substituted(
        self, factors: Float[Array, "blocks width width"], right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The solution for a right-hand side."""
        given = jnp.append(right, 0)[self.order]
        table = jnp.asarray(self.substitutions)

        def multiply(vectors: Array, row: Array) -> tuple[Array, None]:
            at, block, of = row
            change = jnp.sum(_block(factors, block) * _block(vectors, of)[None], axis=1)
            return _added(vectors, at, change), None

        vectors = jnp.concatenate([given, jnp.zeros_like(given)])
        vectors, _ = jax.lax.scan(multiply, vectors, table)
        return -vectors[len(given) :].ravel()[self.back]

    def substituted_transposed(
        self, factors: Float[Array, "blocks width width"], right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The solution with the transposed matrix: the same products in reverse."""
        given = -jnp.append(right, 0)[self.order]
        table = jnp.asarray(self.substitutions[::-1])

        def multiply(vectors: Array, row: Array) -> tuple[Array, None]:
            of, block, at = row
            change = jnp.sum(_block(factors, block) * _block(vectors, of)[:, None], axis=0)
            return _added(vectors, at, change), None

        vectors = jnp.concatenate([jnp.zeros_like(given), given])
        vectors, _ = jax.lax.scan(multiply, vectors, table)
        return vectors[: len(given)].ravel()[self.back]


class BlockFactors(AbstractFactors):
    """The factors of a sparse matrix, block by block."""

    elimination: BlockElimination = eqx.field(static=True)
    blocks: Float[Array, "blocks width width"]

    def renewed(self, matrix: Float[Array, "blocks width width"]) -> "BlockFactors":
        elimination = self.elimination
        return BlockFactors(elimination, in_one_function(elimination.factorised)(matrix))

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        return in_one_function(self.elimination.substituted)(self.blocks, right)

    def solve_transposed(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        substituted = self.elimination.substituted_transposed
        return in_one_function(substituted)(self.blocks, right)


def _cost(nodes: Nodes) -> float:
    """About how many nanoseconds the elimination takes on one core, as was measured."""
    width = nodes.width
    inverse = 9 * width**2 if width <= UNROLLED else 900 + 1.35 * width**3
    product = 2 * width**2 + 0.04 * width**3
    products = sum(len(later) * (1 + len(later)) for later in nodes.later)
    return len(nodes.later) * inverse + products * product


def _cost_of_dense(size: int) -> float:
    # Calls of LAPACK are no part of the one function of a step.
    return 1.35 * size**3 if size <= SMALL else 100_000 + 0.1 * size**3


def _block(blocks: Array, number: Array) -> Array:
    return jax.lax.dynamic_index_in_dim(blocks, number, keepdims=False)


def _changed(blocks: Array, number: Array, value: Array) -> Array:
    # As the last operation of a pass, this primitive writes one block and no others.
    starts = (number, *[0] * value.ndim)
    return jax.lax.dynamic_update_slice(blocks, value[None], starts)


def _added(vectors: Array, number: Array, change: Array) -> Array:
    return _changed(vectors, number, _block(vectors, number) + change)


def _product(a: Float[Array, "n n"], b: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    table, place, order = eliminated(matrix)
    return table[order][:, place]
