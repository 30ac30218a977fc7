"""Roots and eigenvectors of small symmetric matrices, in plain array operations."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .dense import inverse, SMALL


@jax.custom_jvp
def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower triangular root; not finite where the matrix is not positive definite."""
    size = matrix.shape[0]
    if size > SMALL:
        return jnp.linalg.cholesky(matrix)
    order = jnp.arange(size)

    def column(k, carry):
        rest, root = carry
        entries = jnp.sum(jnp.where((order == k)[None], rest, 0), axis=1)
        pivot = jnp.sum(jnp.where(order == k, entries, 0))
        entries = jnp.where(order >= k, entries, 0) / jnp.sqrt(pivot)
        rest = rest - entries[:, None] * entries[None]
        return rest, jnp.where((order == k)[None], entries[:, None], root)

    carry = matrix, jnp.zeros_like(matrix)
    return jax.lax.fori_loop(0, size, column, carry)[1]


@cholesky.defjvp
def _cholesky_jvp(primals, tangents):
    # dL = L low(L^-1 dA L^-T), with half the diagonal.
    (x,), (dx,) = primals, tangents
    root = cholesky(x)
    back = inverse(root)
    inner = back @ (0.5 * (dx + dx.T)) @ back.T
    half = 0.5 * jnp.eye(x.shape[0], dtype=x.dtype)
    return root, root @ (jnp.tril(inner, -1) + half * inner)


def eigh(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues, in no order, and eigenvectors of a symmetric matrix."""
    if matrix.shape[0] == 1:
        # Its vector is the same in every lane of a batch, its tangent formally not: under
        # `vmap` the two below must have the same lanes.
        return matrix[0], jnp.ones_like(matrix)
    return _eigh(matrix)


@jax.custom_jvp
def _eigh(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    if matrix.shape[0] > SMALL:
        values, vectors = jnp.linalg.eigh(matrix)
        return values, vectors
    return _jacobi(matrix)


@_eigh.defjvp
def _eigh_jvp(primals, tangents):
    (x,), (dx,) = primals, tangents
    values, vectors = _eigh(x)
    inner = vectors.T @ (0.5 * (dx + dx.T)) @ vectors
    gap = values[None, :] - values[:, None]
    # Within equal eigenvalues the vectors are not determined: they stay.
    turn = jnp.where(gap == 0, 0, inner / jnp.where(gap == 0, 1, gap))
    return (values, vectors), (jnp.diagonal(inner), vectors @ turn)


# Sweeps after which the diagonal is taken as it is; five are usual.
_SWEEPS = 15


def _jacobi(
    matrix: Float[Array, "n n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """By Jacobi's rotations, half as many at a time as there are rows.

    In every turn row `k` is paired with row `k + n/2`; then all rows but the first move
    on by one place, so that each meets every other in a sweep (R. P. Brent and F. T. Luk,
    1985).
    """
    size = matrix.shape[0]
    padded = size + size % 2
    half = padded // 2
    down, up = list(range(1, half)), list(range(padded - 1, half - 1, -1))
    ring = [*down, *up]
    ring = [*ring[-1:], *ring[:-1]]
    moved = np.array([0, *ring[: half - 1], *reversed(ring[half - 1 :])])
    small = float(jnp.finfo(matrix.dtype).eps) ** 2

    def turn(_, carry):
        x, vectors = carry
        diagonal = jnp.diagonal(x)
        p, q, mixed = diagonal[:half], diagonal[half:], jnp.diagonal(x[:half, half:])
        apart = (q - p) / jnp.where(mixed == 0, 1, 2 * mixed)
        tangent = jnp.where(apart < 0, -1, 1) / (jnp.abs(apart) + jnp.sqrt(1 + apart**2))
        tangent = jnp.where(mixed == 0, 0, tangent)
        c = 1 / jnp.sqrt(1 + tangent**2)
        s = tangent * c

        def turned(x):
            one, other = x[:, :half], x[:, half:]
            columns = [one * c[None] - other * s[None], one * s[None] + other * c[None]]
            return jnp.concatenate(columns, axis=1)[:, moved]

        return turned(turned(x).T).T, turned(vectors)

    def off(x):
        squares = x * x
        diagonal = jnp.sum(jnp.diagonal(squares))
        everything = jnp.sum(squares)
        mixed = jnp.sum(jnp.where(jnp.eye(padded, dtype=bool), 0, squares))
        return (mixed > small * everything) & (diagonal < jnp.inf)

    def sweep(carry):
        x, vectors, count = carry
        x, vectors = jax.lax.fori_loop(0, padded - 1, turn, (x, vectors))
        return x, vectors, count + 1

    x = jnp.pad(matrix, (0, padded - size))
    vectors = jnp.eye(padded, dtype=matrix.dtype)
    rough = lambda carry: off(carry[0]) & (carry[2] < _SWEEPS)
    x, vectors, _ = jax.lax.while_loop(rough, sweep, (x, vectors, jnp.array(0)))
    # A sweep leaves every row, that of the padding too, where it was.
    return jnp.diagonal(x)[:size], vectors[:size, :size]
