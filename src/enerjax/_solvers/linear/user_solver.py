"""Linear solvers that the user chooses: sparse ones, and those of lineax."""

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
import scipy
from jaxtyping import Array, Float, PyTree

from ..._programs import shape_of
from .colours import coloured_products, column_colours
from .dense import AbstractFactors


@dataclass(frozen=True, eq=False)
class SparsePattern:
    """The positions of the structurally nonzero entries of a square matrix.

    The pattern is known at trace time and is the same for all matrices of a solve. The
    entries are sorted by row, and by column within a row, as in the CSR format.

    - `size`: the number of rows.
    - `rows`, `columns`: NumPy integers, one for each entry.
    """

    size: int
    rows: np.ndarray
    columns: np.ndarray

    @cached_property
    def row_starts(self) -> np.ndarray:
        """The index of the first entry of each row, followed by the number of entries:
        `indptr` of the CSR format, shape `(size + 1,)`."""
        return np.searchsorted(self.rows, np.arange(self.size + 1))

    @cached_property
    def transposed(self) -> "tuple[SparsePattern, np.ndarray]":
        """The pattern of the transposed matrix, and the permutation `order` for which its
        entries are `entries[order]`."""
        order = np.lexsort((self.rows, self.columns))
        columns, rows = self.rows[order], self.columns[order]
        return SparsePattern(self.size, rows, columns), order


class AbstractSparseSolver(eqx.Module):
    """The base class of sparse linear solvers for `Newton(linear_solver=...)`.

    Both methods receive the pattern of the matrix. The entries are traced arrays. The
    solver is used for derivatives of a run too: forward mode solves with the Jacobian at
    the root, and reverse mode with its transpose, which is passed as another matrix with
    the transposed pattern. Therefore neither method has to be differentiable, and both may
    call foreign code by `jax.pure_callback`. Both must support `jax.vmap`.
    """

    @abc.abstractmethod
    def factorise(
        self, pattern: SparsePattern, entries: Float[Array, " entries"]
    ) -> PyTree[Array]:
        """The factors of a matrix, any tree of arrays, which `solve` may use repeatedly.

        A solver that does not keep factors returns the entries.
        """

    @abc.abstractmethod
    def solve(
        self, pattern: SparsePattern, factors: Any, right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The solution `x` of `matrix @ x = right`; `factors` are those of `factorise`.

        For a singular matrix it must contain values that are not finite; the run then
        reports a failure. An inaccurate solution costs more iterations, and derivatives
        have the same relative error.
        """


class AbstractWithoutFactors(AbstractSparseSolver):
    """A solver that factorises the matrix for every solution.

    Its factors are not arrays, so loops of JAX cannot carry them.
    """

    def factorise(
        self, pattern: SparsePattern, entries: Float[Array, " entries"]
    ) -> Float[Array, " entries"]:
        return entries


class KLU(AbstractWithoutFactors):
    """Sparse elimination by KLU of SuiteSparse, for large Jacobians whose blocks fill.

    Examples are grids, nets and frames with many loops: `Newton(linear_solver=ej.KLU())`.
    It runs on CPUs, in float64, and needs the extra `sparse` (the package `klujax`, under
    the LGPL). The matrix is factorised for every correction. If a matrix is singular, KLU
    stops the whole program with an error. The failure is then not reported as a result, and
    the other lanes of a batch are lost too.

    **Raises:** `ImportError` without the extra.

    **Reference:** T. A. Davis and E. Palamadai Natarajan (2010), ACM Transactions on
    Mathematical Software 37, algorithm 907.
    """

    def __check_init__(self):
        _klujax()

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


class SuperLU(AbstractWithoutFactors):
    """Sparse elimination by SuperLU of SciPy, with row pivoting, on the host.

    **Reference:** J. W. Demmel et al. (1999), SIAM Journal on Matrix Analysis and
    Applications 20, page 720.
    """

    def solve(
        self, pattern: SparsePattern, factors: Any, right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        shape = pattern.size, pattern.size

        def solution(entries: np.ndarray, right: np.ndarray) -> np.ndarray:
            places = pattern.columns, pattern.row_starts
            matrix = scipy.sparse.csr_array(
                (np.asarray(entries, float), *places), shape=shape
            )
            try:
                found = scipy.sparse.linalg.splu(matrix.tocsc())
            except RuntimeError:  # exactly singular
                return np.full_like(right, np.nan)
            return found.solve(np.asarray(right, float)).astype(right.dtype)

        return jax.pure_callback(solution, right, factors, right, vmap_method="sequential")


class Sparse:
    """A Jacobian that is stored as the list of its structurally nonzero entries.

    It is constructed at trace time. Without a `pattern` all entries are stored.
    """

    def __init__(
        self,
        solver: AbstractSparseSolver,
        pattern: "scipy.sparse.csr_array | None",
        size: int,
    ):
        full = np.ones((size, size), bool)
        known: Any = scipy.sparse.csr_array(full) if pattern is None else pattern
        rows, columns = known.nonzero()
        order = np.lexsort((columns, rows))
        self.solver = solver
        self.pattern = SparsePattern(size, rows[order], columns[order])
        self._colours = column_colours(known, np.arange(shape_of(known)[1]))

    def evaluate(
        self, fn: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, " entries"]:
        """The entries of the Jacobian of `fn` at `x`."""
        products = coloured_products(fn, x, self._colours)
        return products[self.pattern.rows, self._colours[self.pattern.columns]]

    def description(self, size: int) -> str:
        entries = self.pattern.rows.size
        return f"{entries} structural entries, {type(self.solver).__name__}"

    def empty(self, size: int, dtype: Any) -> "SparseFactors":
        """Placeholder factors, of the shapes that `renewed` returns."""
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
        return SparseFactors(self.solver, self.pattern, zeros)

    def solve_transposed(
        self, entries: Float[Array, " entries"], right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The solution with the transpose of the matrix with these entries."""
        pattern, order = self.pattern.transposed
        factors = SparseFactors(self.solver, pattern, None)
        return factors.renewed(entries[order]).solve(right)


class SparseFactors(AbstractFactors):
    """The factors that a user's solver keeps of a sparse matrix."""

    solver: AbstractSparseSolver
    pattern: SparsePattern = eqx.field(static=True)
    kept: PyTree[Array]

    def renewed(self, matrix: Float[Array, " entries"]) -> "SparseFactors":
        kept = self.solver.factorise(self.pattern, matrix)
        return SparseFactors(self.solver, self.pattern, kept)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        x = self.solver.solve(self.pattern, self.kept, right)
        returned = f"{x.dtype}{list(x.shape)}" if eqx.is_array(x) else type(x).__name__
        expected = f"{right.dtype}{list(right.shape)}"
        if returned != expected:
            raise ValueError(
                f"`{type(self.solver).__name__}.solve` must return an array {expected}, as "
                f"the right-hand side is, got {returned}."
            )
        return x


class LineaxFactors(AbstractFactors):
    """A dense matrix, with which a solver of lineax solves."""

    solver: lx.AbstractLinearSolver = eqx.field(static=True)
    matrix: Float[Array, "n n"]

    def renewed(self, matrix: Float[Array, "n n"]) -> "LineaxFactors":
        return LineaxFactors(self.solver, matrix)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        operator = lx.MatrixLinearOperator(self.matrix)
        # A failure of the solver is detected by the corrections of Newton's method.
        return lx.linear_solve(operator, right, self.solver, throw=False).value
