"""Symmetric matrices that are assembled from small ones: the stiffness of many elements."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._programs import Indices
from .jacobian import RowPattern


class ElementMatrices(eqx.Module):
    """Small matrices of one size, and the rows (and columns) of the whole where each is
    added."""

    rows: Indices = eqx.field(static=True)
    blocks: Float[Array, "elements width width"]


class Assembled(eqx.Module):
    """The sum of what the elements add. Takes the place of an array in products with
    vectors."""

    parts: tuple[ElementMatrices, ...]

    def __matmul__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        out = jnp.zeros_like(x)
        for part in self.parts:
            rows = part.rows.array
            products = jnp.sum(part.blocks * x[rows][:, None, :], axis=-1)
            out = out.at[rows].add(products)
        return out

    def map(self, fn: Callable[[Array, np.ndarray], Array]) -> "Assembled":
        """With `fn(blocks, rows)` in the place of the blocks."""
        changed = [fn(part.blocks, part.rows.array) for part in self.parts]
        return Assembled(tuple(map(ElementMatrices, [p.rows for p in self.parts], changed)))


def row_hessians(fn: Callable[[Array], Array], x: Float[Array, " n"]) -> ElementMatrices:
    """The Hessian of each row of `fn`, on the unknowns that the row depends on."""
    pattern = RowPattern(fn, x)
    gradients = lambda x: pattern.derivative(fn, x)
    return ElementMatrices(Indices(pattern.columns), pattern.derivative(gradients, x))
