"""Linear solvers of the user's choice, instead of what size and structure suggest."""

import abc
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, PyTree
from scipy.sparse import csr_array

from ..._programs import shape_of
from .banded import coloured_products, column_colours
from .dense import AbstractFactors


@dataclass(frozen=True, eq=False)
class SparsePattern:
    """Where the entries of a square matrix stand that can differ from zero.

    Known while a program is traced, and the same for all matrices of a solve. The entries
    follow each other row by row, and by their columns within a row, as in the CSR format.

    - `size`: the number of rows.
    - `rows`, `columns`: NumPy integers, one for each entry.
    """

    size: int
    rows: np.ndarray
    columns: np.ndarray

    @cached_property
    def row_starts(self) -> np.ndarray:
        """The number of the first entry of each row, and behind the last row that of all
        entries: `indptr` of the CSR format, shape `(size + 1,)`."""
        return np.searchsorted(self.rows, np.arange(self.size + 1))

    @cached_property
    def transposed(self) -> "tuple[SparsePattern, np.ndarray]":
        """The pattern of the transposed matrix, and the order of its entries: they are
        `entries[order]`."""
        order = np.lexsort((self.rows, self.columns))
        columns, rows = self.rows[order], self.columns[order]
        return SparsePattern(self.size, rows, columns), order


class AbstractSparseSolver(eqx.Module):
    """A linear solver of your own, for `Newton(linear_solver=...)`.

    It is handed the pattern of the matrix and the entries, which are traced. Derivatives of
    a run take it too: forward ones solve with the Jacobian at the root, reverse ones with
    its transpose, which is handed over as a matrix of its own with the transposed pattern.
    So neither method needs a derivative, and both may call foreign code by
    `jax.pure_callback`. What they do is mapped by `jax.vmap`.
    """

    @abc.abstractmethod
    def factorise(
        self, pattern: SparsePattern, entries: Float[Array, " entries"]
    ) -> PyTree[Array]:
        """What is kept of a matrix, to solve with it more than once: any tree of arrays.

        A solver that keeps nothing returns the entries.
        """

    @abc.abstractmethod
    def solve(
        self, pattern: SparsePattern, factors: Any, right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The solution of `matrix @ x = right`, with what `factorise` has returned.

        It must not be finite where the matrix is singular: the run then reports a failure.
        A solution with a small error costs more iterations, and derivatives have the same
        relative error.
        """


class KLU(AbstractSparseSolver):
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

    def factorise(
        self, pattern: SparsePattern, entries: Float[Array, " entries"]
    ) -> Float[Array, " entries"]:
        # KLU keeps its factors where no loop of JAX can carry them.
        return entries

    def solve(
        self, pattern: SparsePattern, factors: Any, right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        x = _klujax().solve(pattern.rows, pattern.columns, factors, right)
        return x.astype(right.dtype)


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
    traced; without a `pattern` all entries can differ from zero."""

    def __init__(self, solver: AbstractSparseSolver, pattern: csr_array | None, size: int):
        if pattern is None:
            pattern = csr_array(np.ones((size, size), bool))
        rows, columns = pattern.nonzero()
        order = np.lexsort((columns, rows))
        self.solver = solver
        self.pattern = SparsePattern(size, rows[order], columns[order])
        self._colours = column_colours(pattern, np.arange(shape_of(pattern)[1]))

    def evaluate(
        self, fn: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, " entries"]:
        """The entries of the Jacobian of `fn` at `x`."""
        products = coloured_products(fn, x, self._colours)
        return products[self.pattern.rows, self._colours[self.pattern.columns]]

    def empty(self, size: int, dtype: Any) -> "ScatteredFactors":
        """Factors of no matrix yet."""
        del size
        entries = jax.ShapeDtypeStruct(self.pattern.rows.shape, dtype)
        by_solver = lambda entries: self.solver.factorise(self.pattern, entries)
        kept = eqx.filter_eval_shape(by_solver, entries)
        for leaf in jax.tree.leaves(kept):
            if not isinstance(leaf, jax.ShapeDtypeStruct):
                raise TypeError(
                    f"`{type(self.solver).__name__}.factorise` must return a tree of "
                    f"arrays; there is a {type(leaf).__name__} in it."
                )
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), kept)
        return ScatteredFactors(self.solver, self.pattern, zeros)

    def solve_transposed(
        self, entries: Float[Array, " entries"], right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """With the transpose of the matrix with these entries."""
        pattern, order = self.pattern.transposed
        factors = ScatteredFactors(self.solver, pattern, None)
        return factors.renewed(entries[order]).solve(right)


class ScatteredFactors(AbstractFactors):
    """What a solver keeps of a sparse matrix."""

    solver: AbstractSparseSolver
    pattern: SparsePattern = eqx.field(static=True)
    kept: PyTree[Array]

    def renewed(self, matrix: Float[Array, " entries"]) -> "ScatteredFactors":
        kept = self.solver.factorise(self.pattern, matrix)
        return ScatteredFactors(self.solver, self.pattern, kept)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        x = self.solver.solve(self.pattern, self.kept, right)
        told = f"{x.dtype}{list(x.shape)}" if eqx.is_array(x) else type(x).__name__
        wanted = f"{right.dtype}{list(right.shape)}"
        if told != wanted:
            raise ValueError(
                f"`{type(self.solver).__name__}.solve` must return an array {wanted}, as "
                f"the right-hand side is, got {told}."
            )
        return x


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
