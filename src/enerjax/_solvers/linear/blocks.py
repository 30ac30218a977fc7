"""Symmetric matrices of small blocks along the diagonal: the inertia of many bodies."""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ..._programs import Indices, is_known, jacobian_pattern, summed


# Rows of the largest block that counts as small, and of a matrix that is not worth it.
_BLOCK = 16
_FEW = 8


class Places(Indices):
    """Which rows belong together; the same for a matrix and its inverse.

    `filling` are the ones on the diagonal where a block is smaller than the largest.
    """

    def __init__(self, labels: np.ndarray):
        super().__init__(labels)
        size, sizes = labels.size, np.bincount(labels)
        order = np.argsort(labels, kind="stable")
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        within = np.arange(size) - starts[labels[order]]
        self.rows = np.full((sizes.size, sizes.max()), size)
        self.rows[labels[order], within] = order
        self.filling = (self.rows == size)[:, :, None] * np.eye(sizes.max())
        self.back = np.zeros(size, int)
        self.back[order] = labels[order] * sizes.max() + within
        self.within = np.zeros(size, int)
        self.within[order] = within


class BlockDiagonal(eqx.Module):
    """A matrix of blocks; where a block is smaller than the largest, ones fill it up.

    Takes the place of an array in products with vectors.
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
        parts = jnp.append(x, 0)[self.places.rows]
        return summed(self.blocks * parts[:, None, :]).ravel()[self.places.back]

    def __rmatmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return self @ x  # symmetric

    def diagonal(self) -> Float[Array, " n"]:
        diagonals = jnp.diagonal(self.blocks, axis1=1, axis2=2)
        return diagonals.ravel()[self.places.back]


Symmetric: TypeAlias = Float[Array, "n n"] | BlockDiagonal


def inverse_of(matrix: Symmetric) -> Symmetric:
    """Of a positive definite matrix."""
    if isinstance(matrix, BlockDiagonal):
        return BlockDiagonal(matrix.places, jax.vmap(_inverse)(matrix.blocks))
    return _inverse(matrix)


def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    # Scaled to a unit diagonal first: a diagonal one is then inverted to the last digit,
    # whatever the ratios are.
    root = jnp.sqrt(jnp.diagonal(matrix))
    scale = jnp.outer(root, root)
    return jnp.linalg.inv(matrix / scale) / scale


def as_dense(matrix: Symmetric) -> Float[Array, "n n"]:
    """As a plain array."""
    if not isinstance(matrix, BlockDiagonal):
        return matrix
    return jax.vmap(matrix.__matmul__)(jnp.eye(matrix.shape[0], dtype=matrix.dtype))


def blocks_of(matrix: Symmetric) -> Float[Array, "blocks size size"]:
    """What stands along the diagonal; a plain array is one block."""
    return matrix.blocks if isinstance(matrix, BlockDiagonal) else matrix[None]


def hessian(fn: Callable[[Array], Array], at: Float[Array, " n"]) -> Symmetric:
    """The Hessian of a scalar function; of blocks where it is large and falls apart."""
    gradient = jax.grad(fn)
    pattern = jacobian_pattern(gradient, at) if at.size > _FEW else None
    places = None if pattern is None else _places(pattern)
    if places is None:
        return jax.jacfwd(gradient)(at)
    # One product for each column of the blocks, for all blocks at once.
    size = places.rows.shape[1]
    seeds = jnp.asarray(np.arange(size)[:, None] == places.within, at.dtype)
    push = lambda seed: jax.jvp(gradient, (at,), (seed,))[1]
    columns = jnp.pad(jax.vmap(push)(seeds), ((0, 0), (0, 1)))[:, places.rows]
    filling = jnp.asarray(places.filling, at.dtype)
    return BlockDiagonal(places, jnp.transpose(columns, (1, 2, 0)) + filling)


def in_blocks(matrix: Float[Array, "n n"]) -> Symmetric:
    """A given matrix; of blocks where it is large, known and falls apart."""
    if matrix.shape[0] <= _FEW or not is_known(matrix):
        return matrix
    places = _places(csr_array(np.asarray(matrix) != 0))
    if places is None:
        return matrix
    padded = jnp.pad(matrix, ((0, 1), (0, 1))).at[-1, -1].set(0)
    blocks = padded[places.rows[:, :, None], places.rows[:, None, :]]
    return BlockDiagonal(places, blocks + jnp.asarray(places.filling, matrix.dtype))


def _places(pattern: csr_array) -> Places | None:
    _, labels = connected_components(pattern, directed=False)
    return Places(labels) if np.bincount(labels).max() <= _BLOCK else None
