"""The matrix of the multipliers, `G = B M^-1 B^T`, of the constraints of a step."""

from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float

from .._solvers import Schur, schur, schur_tables, Symmetric
from .._types import Coordinates, Multipliers, Velocities


class ConstraintMatrix(eqx.Module):
    """Products and solves with the gradients `B` of all constraints at one position.

    - `inverse_inertia`: `M^-1`.
    - `schur`: `B`, and `G = B M^-1 B^T` eliminated.
    """

    inverse_inertia: Symmetric
    schur: Schur

    def product(self, velocity: Velocities) -> Multipliers:
        """`B velocity`, rates of change of the constraints."""
        return self.schur.product(velocity)

    def velocity(self, impulses: Multipliers) -> Velocities:
        """`M^-1 B^T impulses`, what impulses of the constraints add to velocities."""
        return self.inverse_inertia @ self.schur.transposed(impulses)

    def solve(self, right: Float[Array, "k nc"]) -> Float[Array, "k nc"]:
        """`G^-1` times some vectors."""
        return self.schur.solve(right)


def constraint_matrix(
    constraint: Callable[[Coordinates], Multipliers],
    q: Coordinates,
    inverse_inertia: Symmetric,
) -> ConstraintMatrix | None:
    """The matrix at `q`; `None` without constraints, or where it is not narrow."""
    tables = schur_tables(constraint, q, inverse_inertia)
    if tables is None:
        return None
    return ConstraintMatrix(inverse_inertia, schur(tables, constraint, q, inverse_inertia))
