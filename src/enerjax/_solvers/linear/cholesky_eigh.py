"""Cholesky factors and eigenvectors of small symmetric matrices, by plain operations."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .dense import inverse, SMALL


@jax.custom_jvp
def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower Cholesky factor; not finite where the matrix is not positive definite."""
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
    # dL = L low(L^-1 dA L^-T), where `low` is the lower triangle with half the diagonal.
    (x,), (dx,) = primals, tangents
    root = cholesky(x)
    back = inverse(root)
    inner = back @ (0.5 * (dx + dx.T)) @ back.T
    half = 0.5 * jnp.eye(x.shape[0], dtype=x.dtype)
    return root, root @ (jnp.tril(inner, -1) + half * inner)


def eigh(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The eigenvalues, not sorted, and the eigenvectors of a symmetric matrix."""
    if matrix.shape[0] == 1:
        # Under `vmap` the rule of `_eigh` would return an eigenvector without a batch axis
        # and a tangent with one, which JAX does not accept.
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
    # The eigenvectors of equal eigenvalues are not unique. They are not rotated among each
    # other.
    rotation = jnp.where(gap == 0, 0, inner / jnp.where(gap == 0, 1, gap))
    return (values, vectors), (jnp.diagonal(inner), vectors @ rotation)


# The largest number of sweeps. Five usually suffice.
_SWEEPS = 15


def _jacobi(
    matrix: Float[Array, "n n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues and eigenvectors by Jacobi rotations, `n/2` of them at a time.

    Each pass rotates rows `k` and `k + n/2`. All rows but the first then move on by one
    position. A sweep consists of the `n - 1` passes in which each row is paired with every
    other one (R. P. Brent and F. T. Luk, 1985).
    """
    size = matrix.shape[0]
    padded = size + size % 2
    half = padded // 2
    down, up = list(range(1, half)), list(range(padded - 1, half - 1, -1))
    ring = [*down, *up]
    ring = [*ring[-1:], *ring[:-1]]
    moved = np.array([0, *ring[: half - 1], *reversed(ring[half - 1 :])])
    small = float(jnp.finfo(matrix.dtype).eps) ** 2

    def rotate(_, carry):
        x, vectors = carry
        diagonal = jnp.diagonal(x)
        p, q, mixed = diagonal[:half], diagonal[half:], jnp.diagonal(x[:half, half:])
        apart = (q - p) / jnp.where(mixed == 0, 1, 2 * mixed)
        tangent = jnp.where(apart < 0, -1, 1) / (jnp.abs(apart) + jnp.sqrt(1 + apart**2))
        tangent = jnp.where(mixed == 0, 0, tangent)
        c = 1 / jnp.sqrt(1 + tangent**2)
        s = tangent * c

        def rotated(x):
            one, other = x[:, :half], x[:, half:]
            columns = [one * c[None] - other * s[None], one * s[None] + other * c[None]]
            return jnp.concatenate(columns, axis=1)[:, moved]

        return rotated(rotated(x).T).T, rotated(vectors)

    def off(x):
        squares = x * x
        diagonal = jnp.sum(jnp.diagonal(squares))
        everything = jnp.sum(squares)
        mixed = jnp.sum(jnp.where(jnp.eye(padded, dtype=bool), 0, squares))
        return (mixed > small * everything) & (diagonal < jnp.inf)

    def sweep(carry):
        x, vectors, count = carry
        x, vectors = jax.lax.fori_loop(0, padded - 1, rotate, (x, vectors))
        return x, vectors, count + 1

    x = jnp.pad(matrix, (0, padded - size))
    vectors = jnp.eye(padded, dtype=matrix.dtype)
    rough = lambda carry: off(carry[0]) & (carry[2] < _SWEEPS)
    x, vectors, _ = jax.lax.while_loop(rough, sweep, (x, vectors, jnp.array(0)))
    # After a sweep every row is in its original position, also that of the padding.
    return jnp.diagonal(x)[:size], vectors[:size, :size]
