"""Functions with their Jacobians, which are stored as their size and sparsity suggest."""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy
from jaxtyping import Array, Float

from ..._programs import (
    columns_in_turn,
    in_one_function,
    jacobian_columns,
    jacobian_pattern,
    LARGE,
    shape_of,
)
from .block_elimination import BlockElimination, BlockFactors
from .colours import coloured_products, column_colours
from .dense import AbstractFactors, Inverse, inverse, LU, SMALL
from .elimination_order import Owners
from .krylov import Map
from .user_solver import AbstractSparseSolver, LineaxFactors, Sparse, SuperLU


# Equations with more unknowns than this and without `owners` are left to SuperLU.
_MANY = 256


class Dense:
    """A Jacobian that is stored as a dense array.

    If its sparsity pattern is known, columns that share no row are evaluated together.
    """

    def __init__(
        self,
        solver: lx.AbstractLinearSolver | None,
        pattern: "scipy.sparse.csr_array | None" = None,
        rarely: bool = False,
    ):
        self.solver, self._rarely = solver, rarely
        self._colours = None
        if pattern is None:
            return
        self._colours = column_colours(pattern, np.arange(shape_of(pattern)[1]))
        self._nonzero = pattern.toarray()

    def description(self, size: int) -> str:
        if self.solver is not None:
            return f"dense, {type(self.solver).__name__} of lineax"
        if size > SMALL:
            return "dense, LU factors by LAPACK"
        return "dense, an approximate inverse in plain operations"

    def evaluate(self, fn: Callable[[Array], Array], x: Float[Array, " n"]) -> Array:
        if self._colours is None:
            return (
                columns_in_turn(fn, x, np.eye(x.size))
                if self._rarely
                else (jacobian_columns(fn, x))
            )
        products = coloured_products(fn, x, self._colours, self._rarely)
        columns = products[:, self._colours]
        return jnp.where(self._nonzero, columns, 0)

    def empty(self, size: int, dtype: Any) -> AbstractFactors:
        if self.solver is None:
            return (Inverse if size <= SMALL else LU).empty(size, dtype)
        return LineaxFactors(self.solver, jnp.zeros((size, size), dtype))


# How a Jacobian is stored and solved with.
Form: TypeAlias = Dense | BlockElimination | Sparse


class Linearisable(eqx.Module):
    """A function from vectors to vectors, and linear algebra with its Jacobian.

    It is constructed at trace time.

    - `value`: the function.
    - `jacobian`: its Jacobian at a vector, with the regularisation, as
      `AbstractFactors.renewed` takes it.
    - `form`: how the Jacobian is stored and solved with: as a dense array, in blocks, or as
      the list of entries that a user's sparse solver receives.
    - `regularisation`: numbers that are added to the diagonal of a Jacobian that may be
      singular; else `None`.
    """

    value: Callable[[Float[Array, " n"]], Float[Array, " n"]]
    jacobian: Callable[[Float[Array, " n"]], Array]
    form: Form
    regularisation: Float[Array, " n"] | None

    @property
    def is_dense(self) -> bool:
        """Whether the Jacobian is dense, and the user has chosen no solver."""
        return isinstance(self.form, Dense) and self.form.solver is None

    @property
    def keeps_factors(self) -> bool:
        """Whether the next search can begin with the factors of this one."""
        return self.is_dense

    def first_factors(
        self, kept: AbstractFactors | None, x: Float[Array, " n"]
    ) -> AbstractFactors:
        """The factors that the first Jacobian of a search renews."""
        if kept is not None and self.keeps_factors:
            return kept
        return self.form.empty(x.size, x.dtype)

    def solve(self, x: Float[Array, " n"], right: Float[Array, " n"]) -> Array:
        """`J(x)^-1 right`, differentiable in all arguments and transposable in `right`.

        Where the Jacobian is singular and there is a `regularisation`, this is the solution
        that is orthogonal to the null space.
        """
        return self.refined(self.regularised_solver(x), right)

    def refined(
        self, solve: Callable[[Array], Array], right: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """`solve(right)` without the error of first order in the regularisation."""
        first = solve(right)
        if self.regularisation is None:
            return first
        return first + solve(self.regularisation * first)

    def null_space_part(
        self, solve: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """The part of `x` in the null space of the Jacobian.

        `solve` must solve with the regularised Jacobian. The error is of second order in
        the regularisation. Unknowns without a regularisation are determined by the
        equations, and their part is zero.
        """
        assert self.regularisation is not None
        return jnp.where(
            self.regularisation == 0,
            0,
            solve(self.regularisation * solve(self.regularisation * x)),
        )

    def regularised_solver(self, x: Float[Array, " n"]) -> Callable[[Array], Array]:
        """A function that solves with the regularised Jacobian at `x`."""
        is_small = self.is_dense and x.size <= SMALL
        if is_small and self.regularisation is None:
            found = in_one_function(lambda x: inverse(self.jacobian(x)))(x)
            return lambda right: found @ right
        if is_small:
            # An explicit inverse of a nearly singular matrix is too inaccurate.
            matrix = self.jacobian(x)
            return lambda right: jnp.linalg.solve(matrix, right)
        solve, solve_transposed = self.constant_solvers(x)

        def product(t: Array) -> Array:
            image = jax.jvp(self.value, (x,), (t,))[1]
            return image if self.regularisation is None else image + self.regularisation * t

        return lambda right: jax.lax.custom_linear_solve(
            product,
            right,
            lambda _, right: solve(right),
            lambda _, right: solve_transposed(right),
        )

    def constant_solvers(self, x: Float[Array, " n"]) -> tuple[Map, Map]:
        """Functions that solve with the regularised Jacobian at `x` and its transpose.

        They have no derivatives with respect to `x`. If there is a regularisation, the
        Jacobian must not be small and dense: an explicit inverse would be too inaccurate.
        """
        matrix, form = jax.lax.stop_gradient(self.jacobian(x)), self.form
        if self.is_dense and x.size <= SMALL:
            found = in_one_function(inverse)(matrix)
            return found.__matmul__, found.T.__matmul__
        factors = form.empty(x.size, x.dtype).renewed(matrix)
        if isinstance(form, Sparse):
            return factors.solve, lambda right: form.solve_transposed(matrix, right)
        if isinstance(factors, BlockFactors):
            return factors.solve, factors.solve_transposed
        # `linear_transpose` has no rule for programs compiled into one function.
        return factors.solve, lambda right: jax.vjp(factors.solve, right)[1](right)[0]


def regularised(
    value: Callable[[Array], Array], regularisation: Float[Array, " n"] | None
) -> Callable[[Array], Array]:
    """The function whose Jacobian is that of `value` with the regularisation."""
    if regularisation is None:
        return value
    return lambda x: value(x) + regularisation * x


def form_of(
    fn: Callable[[Array], Array],
    like: Float[Array, " n"],
    linear_solver: lx.AbstractLinearSolver | AbstractSparseSolver | None = None,
    *,
    owners: Owners | None = None,
    rarely: bool = False,
    small: int = SMALL,
) -> Form:
    """How the Jacobian of `fn` is stored and solved with.

    By default its size and its sparsity decide. If it is needed `rarely`, its program is
    one that compiles quickly. Structure is searched for where there are more unknowns than
    `small`. `owners` tells coordinates from multipliers; without it, SuperLU solves large
    equations.
    """
    if isinstance(linear_solver, lx.AbstractLinearSolver):
        return Dense(linear_solver)
    if linear_solver is not None:
        return Sparse(linear_solver, jacobian_pattern(fn, like), like.size)
    pattern = jacobian_pattern(fn, like) if like.size > small else None
    if pattern is None:
        return Dense(None, rarely=rarely)
    if owners is not None:
        blocks = BlockElimination(pattern, owners, rarely)
        return blocks if blocks.is_cheaper_than_dense() else Dense(None, pattern, rarely)
    if like.size > _MANY:
        return Sparse(SuperLU(), pattern, like.size)
    return Dense(None, pattern, rarely)


def affine_root(
    fn: Callable[[Array], Array],
    like: Float[Array, " n"],
    regularisation: Float[Array, " n"] | None = None,
) -> Float[Array, " n"]:
    """The root of an affine function, differentiable in the values in its closure.

    The linear part may be singular if there is a `regularisation`, which is added to its
    diagonal.
    """
    at, added = jnp.zeros_like(like), regularised(fn, regularisation)
    form = form_of(added, at, rarely=True)
    jacobian = lambda x: form.evaluate(added, x)
    linear = Linearisable(fn, jacobian, form, regularisation)
    if linear.is_dense and regularisation is None:
        return -jnp.linalg.solve(linear.jacobian(at), linear.value(at))
    return -linear.solve(at, linear.value(at))


class RowPattern:
    """The unknowns that each entry of a function depends on, found at trace time.

    `columns`: the numbers of these unknowns, shape `(m, width)`. Rows with fewer unknowns
    are padded with their first one, which couples them to no others. The pattern is
    searched for where there are more unknowns than `small`.
    """

    def __init__(
        self, fn: Callable[[Array], Array], like: Float[Array, " n"], small: int = LARGE
    ):
        size = like.size
        num_rows = jax.eval_shape(lambda x: fn(x), like).shape[0]
        pattern = jacobian_pattern(lambda x: fn(x), like) if size > small else None
        if pattern is None:
            self.columns = np.broadcast_to(np.arange(size), (num_rows, size))
            self._colours = np.arange(size)
            self._nonzero = np.ones((num_rows, size))
            return
        self._colours = column_colours(pattern, np.arange(size))
        counts = np.diff(pattern.indptr)
        rows = np.repeat(np.arange(num_rows), counts)
        within = np.arange(rows.size) - np.repeat(pattern.indptr[:-1], counts)
        first = np.append(pattern.indices, 0)[pattern.indptr[:-1]] * (counts > 0)
        width = max(counts.max(initial=0), 1)
        self.columns = np.repeat(first[:, None], width, axis=1)
        self.columns[rows, within] = pattern.indices
        self._nonzero = np.zeros(self.columns.shape)
        self._nonzero[rows, within] = 1

    @property
    def num_colours(self) -> int:
        """The number of products that the derivatives of all rows take."""
        return int(self._colours.max(initial=-1)) + 1

    def own(self, x: Float[Array, " n"]) -> Float[Array, "m width"]:
        """The values of the unknowns of each row, padded with zeros."""
        return x[self.columns] * jnp.asarray(self._nonzero, x.dtype)

    def derivative(
        self, fn: Callable[[Array], Array], x: Float[Array, " n"]
    ) -> Float[Array, "m ... width"]:
        """The derivatives of the rows of `fn` with respect to the unknowns of each row.

        `fn` returns an array of shape `(m, ...)` with this pattern or a sparser one. Short
        rows are padded with zeros.
        """
        products = coloured_products(fn, x, self._colours)
        num_rows, width = self.columns.shape
        numbers = np.arange(num_rows)
        entries = products[numbers[:, None], ..., self._colours[self.columns]]
        entries = jnp.moveaxis(entries, 1, -1)
        shape = (num_rows, *[1] * (entries.ndim - 2), width)
        return entries * jnp.asarray(self._nonzero, x.dtype).reshape(shape)


def kept_factors(size: int, dtype: Any) -> AbstractFactors | None:
    """The initial factors of a run whose solves pass their factors on, else `None`.

    Only small systems, whose factors are an approximate inverse, pass them on.
    """
    return Inverse.empty(size, dtype) if size <= SMALL else None
