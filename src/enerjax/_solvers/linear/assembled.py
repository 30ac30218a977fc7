"""Symmetric matrices that are assembled from element matrices, such as the stiffness."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._programs import Indices
from .jacobian import RowPattern


class ElementMatrices(eqx.Module):
    """Element matrices of equal size, and the rows (and columns) of the assembled matrix
    to which each is added."""

    rows: Indices = eqx.field(static=True)
    blocks: Float[Array, "elements width width"]


class Assembled(eqx.Module):
    """A matrix that is the sum of element matrices, for products with vectors only."""

    groups: tuple[ElementMatrices, ...]

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        out = jnp.zeros_like(x)
        for group in self.groups:
            rows = group.rows.array
            products = jnp.sum(group.blocks * x[rows][:, None, :], axis=-1)
            out = out.at[rows].add(products)
        return out

    def map(self, fn: Callable[[Array, np.ndarray], Array]) -> "Assembled":
        """The matrix assembled from `fn(blocks, rows)` in place of the blocks."""
        return Assembled(
            tuple(
                ElementMatrices(group.rows, fn(group.blocks, group.rows.array))
                for group in self.groups
            )
        )


def row_hessians(fn: Callable[[Array], Array], x: Float[Array, " n"]) -> ElementMatrices:
    """The Hessian of each entry of `fn` with respect to the unknowns it depends on."""
    pattern = RowPattern(fn, x, small=0)
    gradients = lambda x: pattern.derivative(fn, x)
    return ElementMatrices(Indices(pattern.columns), pattern.derivative(gradients, x))
