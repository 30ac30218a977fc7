"""Symmetric block-diagonal matrices, such as the inertia of many bodies."""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from ..._programs import at_places, Indices, is_known, jacobian_pattern
from ..._types import Flag
from .dense import definite_inverse


# The largest block size for which a matrix is stored in blocks, and the size up to which a
# matrix is always stored as an array.
_LARGEST_BLOCK = 16
_FEW = 8


class Places(Indices):
    """The rows of each block; the same for a matrix and its inverse.

    - `rows`: the rows of each block, shape `(blocks, size)`; the number of rows at padded
      positions, where a block is smaller than the largest one. `read`: the same with the
      first row of the block at padded positions, whose values are not used.
    - `padding`: ones on the diagonal at padded positions.
    - `coupled`: whether an entry can be nonzero in any of the blocks, shape `(size, size)`.
      Rows of a block are coupled if they have the same number in `parts`.
    - `back`: the position of each row in the blocks, and `within`: in its own block.
    """

    def __init__(self, labels: np.ndarray, parts: np.ndarray):
        super().__init__(np.stack([labels, parts]))
        size, sizes = labels.size, np.bincount(labels)
        order = np.argsort(labels, kind="stable")
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        within = np.arange(size) - starts[labels[order]]
        self.rows = np.full((sizes.size, sizes.max()), size)
        self.rows[labels[order], within] = order
        self.read = np.where(self.rows == size, self.rows[:, :1], self.rows)
        self.padding = (self.rows == size)[:, :, None] * np.eye(sizes.max())
        own = np.append(parts, -1)[self.rows]
        self.coupled = np.any(own[:, :, None] == own[:, None, :], axis=0)
        self.back = np.zeros(size, int)
        self.back[order] = labels[order] * sizes.max() + within
        self.within = np.zeros(size, int)
        self.within[order] = within
        self.parts = parts


class BlockDiagonal(eqx.Module):
    """A symmetric block-diagonal matrix, which can be multiplied like an array.

    All blocks have the size of the largest one. Smaller blocks are padded with an identity.
    """

    places: Places = eqx.field(static=True)
    blocks: Float[Array, "blocks size size"]

    @property
    def shape(self) -> tuple[int, int]:
        size = self.places.back.size
        return size, size

    @property
    def dtype(self) -> Any:
        return self.blocks.dtype

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        by_block = at_places(x, self.places.read)[:, None, :]
        products = self.with_known_zeros(self.blocks) * by_block
        return at_places(jnp.sum(products, axis=-1).ravel(), self.places.back)

    def __rmatmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self @ x  # symmetric

    def with_known_zeros(self, blocks: Float[Array, "*many size size"]) -> Array:
        """Blocks of this matrix, with constants for the entries that are always zero.

        Products with them cost nothing.
        """
        return jnp.where(self.places.coupled, blocks, 0)

    def diagonal(self) -> Float[Array, " n"]:
        diagonals = diagonal_of(self.blocks)
        return at_places(diagonals.ravel(), self.places.back)


Symmetric: TypeAlias = Float[Array, "n n"] | BlockDiagonal


def inverse_of(matrix: Symmetric) -> Symmetric:
    """The inverse of a positive definite matrix."""
    if isinstance(matrix, BlockDiagonal):
        return BlockDiagonal(matrix.places, jax.vmap(_inverse)(matrix.blocks))
    return _inverse(matrix)


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    # Scaled to a unit diagonal first, so that diagonal matrices are inverted without
    # rounding errors, whatever the ratios of their entries are.
    root = jnp.sqrt(diagonal_of(matrix))
    scale = jnp.outer(root, root)
    return definite_inverse(matrix / scale) / scale


def padded(matrix: Symmetric, count: int) -> Symmetric:
    """The matrix with `count` further rows and columns of zeros."""
    if count == 0:
        return matrix
    if not isinstance(matrix, BlockDiagonal):
        return jnp.pad(matrix, ((0, count), (0, count)))
    rows, size = matrix.places.rows, matrix.shape[0]
    labels = np.zeros(size + 1, int)
    labels[rows.ravel()] = np.repeat(np.arange(len(rows)), rows.shape[1])
    new = size + np.arange(count)
    places = Places(
        np.append(labels[:size], len(rows) + np.arange(count)),
        np.append(matrix.places.parts, new),
    )
    zeros = jnp.asarray(places.padding[len(rows) :], matrix.dtype)
    return BlockDiagonal(places, jnp.concatenate([matrix.blocks, zeros]))


def as_dense(matrix: Symmetric) -> Float[Array, "n n"]:
    """The matrix as a plain array."""
    if not isinstance(matrix, BlockDiagonal):
        return matrix
    return jax.vmap(matrix.__matmul__)(jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def diagonal_of(matrices: Float[Array, "... n n"]) -> Float[Array, "... n"]:
    """The entries on the diagonals.

    After `jax.numpy.diagonal`, which has a branch for some processors, the reverse pass
    would not know the table of the places, and be left to XLA.
    """
    places = np.arange(matrices.shape[-1])
    return matrices[..., places, places]


def blocks_of(matrix: Symmetric) -> Float[Array, "blocks size size"]:
    """The blocks along the diagonal; a plain array is one block."""
    return matrix.blocks if isinstance(matrix, BlockDiagonal) else matrix[None]


def scaled_blocks(matrix: Symmetric) -> Float[Array, "blocks size size"]:
    """The blocks of a matrix, with ones on the diagonal where that is positive."""
    blocks = blocks_of(matrix)
    masses = diagonal_of(blocks)
    largest = jnp.max(jnp.abs(masses))
    root = jnp.sqrt(jnp.where(masses > 0, masses, jnp.where(largest > 0, largest, 1)))
    return blocks / (root[:, :, None] * root[:, None, :])


def is_positive_definite(
    matrix: Symmetric, margins: Float[np.ndarray, " n"] | None = None
) -> Flag:
    """Whether a matrix is positive definite, after it is scaled to ones on the diagonal and
    `margins` are added there."""
    blocks = scaled_blocks(matrix)
    if margins is not None:
        is_array = not isinstance(matrix, BlockDiagonal)
        rows = np.arange(margins.size)[None] if is_array else matrix.places.rows
        added = np.append(margins, 0)[rows][:, :, None] * np.eye(rows.shape[1])
        blocks = blocks + jnp.asarray(added, matrix.dtype)
    is_positive = diagonal_of(blocks) > 0
    return jnp.all(is_positive) & jnp.all(jnp.isfinite(jnp.linalg.cholesky(blocks)))


def hessian(
    fn: Callable[[Array], Array],
    at: Float[Array, " n"],
    together: np.ndarray | None = None,
) -> Symmetric:
    """The Hessian of a scalar function; block-diagonal if it is large and has that form.

    Rows with the same number in `together` are in one block.
    """
    gradient = jax.grad(fn)
    pattern = jacobian_pattern(gradient, at) if at.size > _FEW else None
    places = None if pattern is None else _places(pattern, together)
    if places is None:
        return jax.jacfwd(gradient)(at)
    # One product for each column of the blocks, for all blocks at once.
    size = places.rows.shape[1]
    seeds = jnp.asarray(np.arange(size)[:, None] == places.within, at.dtype)
    push = lambda seed: jax.jvp(gradient, (at,), (seed,))[1]
    columns = jnp.pad(jax.vmap(push)(seeds), ((0, 0), (0, 1)))[:, places.rows]
    padding = jnp.asarray(places.padding, at.dtype)
    return BlockDiagonal(places, jnp.transpose(columns, (1, 2, 0)) + padding)


def in_blocks(matrix: Float[Array, "n n"]) -> Symmetric:
    """The matrix in block-diagonal form, if it is large, known and has that form."""
    if matrix.shape[0] <= _FEW or not is_known(matrix):
        return matrix
    places = _places(scipy.sparse.csr_array(np.asarray(matrix) != 0))
    if places is None:
        return matrix
    padded = jnp.pad(matrix, ((0, 1), (0, 1))).at[-1, -1].set(0)
    blocks = padded[places.rows[:, :, None], places.rows[:, None, :]]
    return BlockDiagonal(places, blocks + jnp.asarray(places.padding, matrix.dtype))


def _places(
    pattern: "scipy.sparse.csr_array", together: np.ndarray | None = None
) -> Places | None:
    parts = _components(pattern)
    labels = parts
    if together is not None:
        joined = pattern.toarray() | (together[:, None] == together[None])
        labels = _components(scipy.sparse.csr_array(joined))
    is_small = np.bincount(labels).max() <= _LARGEST_BLOCK
    return Places(labels, parts) if is_small else None


def _components(pattern: "scipy.sparse.csr_array") -> np.ndarray:
    return scipy.sparse.csgraph.connected_components(pattern, directed=False)[1]
