"""The stiffness matrix of the dissipation of `EnergyConsistent`, constant in a step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._solvers import as_dense, Assembled, cholesky, eigh, inverse, product, Symmetric
from .._system import State
from .._types import Scalar
from .base import StepProblem


class DissipativeStiffness(eqx.Module):
    """The positive semidefinite part of the stiffness near the start of a step.

    With `tau = alpha h / 6`:

    - `matrix`: `K+`, the positive semidefinite part of `K` in the metric of the inertia.
    - `inertia`, `inverse_inertia`: `M` and `M^-1` in the same position.
    - `jump_matrix`: `X = (M + tau^2 K+)^-1 (h/6) K+`, which gives the jump of the
      velocities, `j_v = X (dq + tau dv)`. It is empty where the stiffness is assembled
      from elements. `X` would then be a dense matrix, so `j_v` is an unknown instead.
    - `velocity_matrix`: `(1 + tau X)^-1`, where velocities are eliminated; else empty.
    """

    matrix: Float[Array, "nq nq"] | Assembled
    inertia: Symmetric
    inverse_inertia: Symmetric
    jump_matrix: Float[Array, "nx nx"]
    velocity_matrix: Float[Array, "nd nd"]


def dissipative_stiffness(step: StepProblem, alpha: Scalar) -> DissipativeStiffness:
    """The dissipative stiffness in the middle of a motion with constant velocity.

    The decay of the energy requires only that the matrix is positive semidefinite, and the
    order of accuracy only that it is close to the stiffness. Therefore it is computed from
    the multipliers at the start. A matrix that depends on the unknowns would cost an
    eigenvalue problem in every iteration.
    """
    model, start, h = step.model, step.start, step.h
    half_way = start.q + 0.5 * h * model.lift(start.q, start.v)
    middle = State(half_way, start.v, step.middle_time)
    stiffness, inertia = model.stiffness(middle, model.multipliers(start))
    matrix = _semidefinite_part(stiffness, inertia)
    none, tau = jnp.zeros((0, 0), h.dtype), alpha * h / 6
    if isinstance(matrix, Assembled):
        inverse_inertia = model.inverse_metric(middle)
        return DissipativeStiffness(
            matrix=matrix,
            inertia=inertia,
            inverse_inertia=inverse_inertia,
            jump_matrix=none,
            velocity_matrix=none,
        )
    inertia = as_dense(inertia)
    jump_matrix = product(inverse(inertia + tau**2 * matrix), h / 6 * matrix)
    if model.has_own_momenta:
        inverse_inertia, velocity_matrix = inverse(inertia), none
    else:
        inverse_inertia = model.inverse_metric(middle)
        velocity_matrix = inverse(jnp.eye(start.q.size, dtype=h.dtype) + tau * jump_matrix)
    return DissipativeStiffness(
        matrix=matrix,
        inertia=inertia,
        inverse_inertia=inverse_inertia,
        jump_matrix=jump_matrix,
        velocity_matrix=velocity_matrix,
    )


def _semidefinite_part(
    stiffness: Float[Array, "nq nq"] | Assembled, inertia: Symmetric
) -> Float[Array, "nq nq"] | Assembled:
    """The positive semidefinite part in the metric of the inertia, independent of units.

    For a stiffness that is assembled from elements, this is the sum of the positive
    semidefinite parts of the element matrices, each in the metric of the masses of its
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
