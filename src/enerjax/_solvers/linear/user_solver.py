"""Linear solvers of the user's choice, instead of what size and structure suggest."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array

from ..._programs import shape_of
from .banded import coloured_products, column_colours
from .dense import AbstractFactors


class KLU(eqx.Module):
    """Sparse elimination by KLU of SuiteSparse, for equations that fit no narrow band.

    Grids, nets and frames with many loops: `Newton(linear_solver=ej.KLU())`. Runs on CPUs,
    in float64, and needs the extra `sparse` (the package `klujax`, under the LGPL). The
    matrix is factorised for every correction. KLU stops the whole program with an error
    where a matrix is singular: such a failure is no value here, and in a batch takes the
    other lanes with it.

    **Raises:** `ImportError` without the extra.

    **Reference:** T. A. Davis and E. Palamadai Natarajan (2010), ACM Transactions on
    Mathematical Software 37, algorithm 907.
    """

    def __check_init__(self):
        _klujax()


def _klujax() -> Any:
    try:
        import klujax  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "`KLU` needs the package `klujax`: `pip install enerjax[sparse]`."
        ) from error
    return klujax


class Scattered:
    """How a sparse matrix is stored as a list of its entries. Made while a program is
    traced."""

    def __init__(self, pattern: csr_array):
        self.rows, self.columns = pattern.nonzero()
        self._colours = column_colours(pattern, np.arange(shape_of(pattern)[1]))

    def evaluate(
        self, fn: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, " entries"]:
        """The entries of the Jacobian of `fn` at `x`."""
        products = coloured_products(fn, x, self._colours)
        return products[self.rows, self._colours[self.columns]]

    def empty(self, size: int, dtype: Any) -> "ScatteredFactors":
        del size
        return ScatteredFactors(self, jnp.zeros((self.rows.size,), dtype))


class ScatteredFactors(AbstractFactors):
    """The matrix itself: KLU keeps its factors where no loop of JAX can carry them."""

    form: Scattered = eqx.field(static=True)
    entries: Float[Array, " entries"]

    def renewed(self, matrix: Float[Array, " entries"]) -> "ScatteredFactors":
        return ScatteredFactors(self.form, matrix)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        x = _klujax().solve(self.form.rows, self.form.columns, self.entries, right)
        return x.astype(right.dtype)


class LineaxFactors(AbstractFactors):
    """What a solver of lineax makes of a dense matrix."""

    solver: lx.AbstractLinearSolver = eqx.field(static=True)
    matrix: Float[Array, "n n"]

    def renewed(self, matrix: Float[Array, "n n"]) -> "LineaxFactors":
        return LineaxFactors(self.solver, matrix)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        operator = lx.MatrixLinearOperator(self.matrix)
        # What a solver could not solve shows in the corrections of Newton's method.
        return lx.linear_solve(operator, right, self.solver, throw=False).value
