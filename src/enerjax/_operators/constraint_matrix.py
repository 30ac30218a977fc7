"""The constraint matrix `G = B M^-1 B^T` of the equations for the multipliers."""

import equinox as eqx
from jaxtyping import Array, Float

from .._solvers import Schur, Symmetric
from .._types import Multipliers, Velocities


class ConstraintMatrix(eqx.Module):
    """Products and solves with the gradients `B` of all constraints at one position.

    - `inverse_inertia`: `M^-1`.
    - `schur`: `B`, and the factors of `G = B M^-1 B^T`.
    """

    inverse_inertia: Symmetric
    schur: Schur

    def product(self, velocity: Velocities) -> Multipliers:
        """`B velocity`, the rates of change of the constraints."""
        return self.schur.product(velocity)

    def velocity(self, impulses: Multipliers) -> Velocities:
        """`M^-1 B^T impulses`, the velocities that impulses of the constraints cause."""
        return self.inverse_inertia @ self.schur.transposed(impulses)

    def solve(self, right: Float[Array, "k nc"]) -> Float[Array, "k nc"]:
        """`G^-1` times each of `k` vectors."""
        return self.schur.solve(right)
