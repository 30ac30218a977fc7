"""The positive semidefinite part of a stiffness, with derivatives that always exist."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._solvers import as_dense, Assembled, cholesky, eigh, inverse, product, Symmetric


def semidefinite_part(
    stiffness: Float[Array, "nq nq"] | Assembled, inertia: Symmetric
) -> Float[Array, "nq nq"] | Assembled:
    """Positive semidefinite part in the metric of the inertia: independent of units.

    Of an assembled stiffness the sum of those of its elements, each in the masses of its
    coordinates.
    """
    if not isinstance(stiffness, Assembled):
        return _dense_part(stiffness, as_dense(inertia))
    masses = inertia.diagonal()
    part = jax.vmap(lambda block, mass: _dense_part(block, jnp.diag(mass)))
    return stiffness.map(lambda blocks, rows: part(blocks, masses[rows]))


def _dense_part(
    stiffness: Float[Array, "nq nq"], inertia: Float[Array, "nq nq"]
) -> Float[Array, "nq nq"]:
    root = cholesky(inertia)
    back = inverse(root)
    whole = product(product(back, stiffness), back.T)
    part = _positive_part(0.5 * (whole + whole.T))
    return product(product(root, part), root.T)


@jax.custom_jvp
def _positive_part(x: Float[Array, "n n"]) -> Float[Array, "n n"]:
    values, vectors = eigh(x)
    return product(vectors * jnp.maximum(values, 0)[None, :], vectors.T)


@_positive_part.defjvp
def _positive_part_jvp(primals, tangents):
    # The derivative of a matrix function by divided differences (Daleckii and Krein):
    # bounded where eigenvalues meet, unlike the derivatives of the eigenvectors.
    (x,), (dx,) = primals, tangents
    values, vectors = eigh(x)
    positive = jnp.maximum(values, 0)
    rows, columns = values[:, None], values[None, :]
    mixed = (rows > 0) != (columns > 0)
    quotient = (positive[:, None] - positive[None, :]) / jnp.where(mixed, rows - columns, 1)
    factor = jnp.where(mixed, quotient, (rows > 0).astype(x.dtype))
    inner = factor * product(product(vectors.T, dx), vectors)
    value = product(vectors * positive[None, :], vectors.T)
    return value, product(product(vectors, inner), vectors.T)
