"""Inverses of small dense matrices, in plain array operations.

LAPACK calls cost microseconds each for matrices of a few rows, and one such call keeps XLA
from compiling the loop around it into a single function.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._programs import in_one_function
from ..._types import Flag, Scalar
from .norms import largest


# Rows up to which plain operations beat LAPACK.
SMALL = 32
# Rows up to which the loop over columns is unrolled. Longer unrolled loops compile slowly.
UNROLLED = 8
# The same for definite matrices, for which no pivots are looked for.
_UNROLLED_IF_DEFINITE = 16


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse; not finite where the matrix is singular."""
    return enerjax_inverse(matrix)


@jax.jit
def enerjax_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The rules of discrete derivatives and sparsity patterns find it by this name."""
    return _inverse(matrix)


@jax.custom_jvp
def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    if len(matrix) == 1:
        return 1 / matrix
    if len(matrix) > SMALL:
        return jnp.linalg.inv(matrix)
    table, place, order = eliminated(matrix)
    return table[order][:, place]


@_inverse.defjvp
def _inverse_jvp(primals, tangents):
    return _change_of_inverse(inverse, primals, tangents)


def _change_of_inverse(
    invert: Callable[[Array], Array], primals: Any, tangents: Any
) -> tuple[Array, Array]:
    """Derivatives of any order consist of matrix products alone."""
    (x,), (dx,) = primals, tangents
    y = invert(x)
    return y, -product(product(y, dx), y)


@jax.jit
def inverse_by_cofactors(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of up to four rows, without pivots; not finite where it is singular.

    Its relative error is round-off times `s1^2 / (s_(n-1) s_n)`, with the singular values
    in their order, where pivoting has `s1 / s_n`. Scales of rows and columns do not matter.
    """
    if len(matrix) == 1:
        return 1 / matrix
    rows = list(matrix)
    of_rows = jnp.stack(_COFACTORS[len(matrix)](*rows))
    return of_rows.T / (rows[0] @ of_rows[0])


def _cofactors_of_2(a: Array, b: Array) -> list[Array]:
    return [jnp.stack([b[1], -b[0]]), jnp.stack([-a[1], a[0]])]


def _cofactors_of_3(a: Array, b: Array, c: Array) -> list[Array]:
    return [jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)]


def _cofactors_of_4(a: Array, b: Array, c: Array, d: Array) -> list[Array]:
    first, last = _minors(a, b), _minors(c, d)
    of = lambda x, minors: jnp.sum(x[_OTHERS] * minors, axis=1)
    return [of(b, last), -of(a, last), of(d, first), -of(c, first)]


def _minors(a: Array, b: Array) -> Float[Array, "4 3"]:
    """For each column and each of the others, the signed minor of the remaining two."""
    left, right = np.triu_indices(4, 1)
    minors = a[left] * b[right] - a[right] * b[left]
    return jnp.concatenate([minors, -minors])[_MINORS]


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
# The minors of the columns 01, 02, 03, 12, 13 and 23, and then their negatives.
_MINORS = np.array([[5, 10, 3], [11, 2, 7], [4, 8, 0], [9, 1, 6]])

_COFACTORS: dict[int, Callable[..., list[Array]]] = {
    2: _cofactors_of_2,
    3: _cofactors_of_3,
    4: _cofactors_of_4,
}


def eliminated(
    panel: Float[Array, "m w"],
) -> tuple[Float[Array, "m w"], Int[Array, " m"], Int[Array, " m"]]:
    """Gauss-Jordan elimination of `w` unknowns from `m` rows in place, with row pivoting.

    Returns the table, the place of each row, and the row at each place; the first `w`
    places are those of the pivot rows. In the order of the places, the first `w` rows of
    the table are the inverse of the pivot rows. The others multiply the pivot rows, and
    give what is added to the remaining rows to eliminate the unknowns.
    """
    num_rows, count = panel.shape
    numbers, columns = jnp.arange(num_rows), jnp.arange(count)

    def column(k, carry):
        # Rows stay where they are.
        table, place, order = carry
        entries = jax.lax.dynamic_index_in_dim(table, k, 1, keepdims=False)
        sizes = jnp.where(place >= k, jnp.abs(entries), -1)
        # The first of the largest entries. Two reductions cost less than `argmax`.
        most = jnp.max(sizes)
        pivot = jnp.min(jnp.where(sizes == most, numbers, num_rows - 1))
        row, entry, before, first = (
            jax.lax.dynamic_index_in_dim(x, at, keepdims=False)
            for x, at in ((table, pivot), (entries, pivot), (place, pivot), (order, k))
        )
        # If an entry is NaN, the whole table becomes NaN.
        entry = jnp.where(jnp.isnan(most), jnp.nan, entry)
        chosen = numbers == pivot
        place = jnp.where(chosen, k, jnp.where(numbers == first, before, place))
        order = jnp.where(numbers == k, pivot, jnp.where(numbers == before, first, order))
        # Exchanges the unknown of the column with the right-hand side of the row.
        row = jnp.where(columns == k, 1, row) / entry
        factors = jnp.where(chosen, 0, entries)
        change = factors[:, None] * row[None]
        kept = jnp.where((columns == k)[None], -change, table - change)
        return jnp.where(chosen[:, None], row[None], kept), place, order

    carry = panel, numbers, numbers
    if count <= UNROLLED:
        return functools.reduce(lambda c, k: column(k, c), range(count), carry)
    return jax.lax.fori_loop(0, count, column, carry)


class AbstractFactors(eqx.Module):
    """The factors of a matrix, which may also speed up the next factorisation."""

    @abc.abstractmethod
    def renewed(self, matrix: Float[Array, "n n"]) -> "AbstractFactors":
        """The factors of another matrix; they may cost less if it differs little."""

    @abc.abstractmethod
    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Approximately `matrix^-1 right`; not finite where the matrix is singular."""


class Inverse(AbstractFactors):
    """An approximate inverse. Its small error is corrected by the iterations that use it.

    The inverse `X` of a new matrix `A` is found by the iteration of G. Schulz (1933), which
    replaces `X` by `X (1 + E)` with `E = 1 - A X`; the new error is `E^2`. Where `E` is too
    large, the inverse is computed by elimination. The rows of `A` are scaled to a largest
    entry of one first, because rows of unequal size would enlarge `E`.
    """

    inverse: Float[Array, "n n"]

    @classmethod
    def empty(cls, size: int, dtype: Any) -> "Inverse":
        """A placeholder of NaNs, which `renewed` replaces by an elimination."""
        return cls(jnp.full((size, size), jnp.nan, dtype))

    def renewed(self, matrix: Float[Array, "n n"]) -> "Inverse":
        sizes = jnp.max(jnp.abs(matrix), axis=1)
        matrix = matrix / sizes[:, None]

        # A carry contains the inverse, its error `E` before the last iteration, and a bound
        # on the norm of its error now.
        def is_rough(carry) -> Flag:
            _, _, left = carry
            return (left > _ENOUGH) & (left < _FAR)

        def improve(carry):
            x, error, _ = carry
            error, size = _square(error)
            return x + product(x, error), error, size * size

        def is_lost(carry) -> Flag:
            _, _, left = carry
            return ~(left < _FAR)

        def start_again(carry):
            _, error, left = carry
            # XLA would move this elimination out of the loop, because it does not depend on
            # the carry, and compute it in every step. The factor of one, which depends on
            # the carry, prevents that.
            one = jnp.where(left < _FAR, 0, jnp.ones_like(left))
            return inverse(one * matrix), error, jnp.zeros_like(left)

        x = self.inverse * sizes[None]
        error, size = _defect(matrix, x)
        carry = x + product(x, error), error, jnp.where(size < _FAR, size * size, size)
        carry = jax.lax.while_loop(is_rough, improve, carry)
        x, _, _ = jax.lax.while_loop(is_lost, start_again, carry)
        return Inverse(x / sizes[None])

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.inverse @ right


class LU(AbstractFactors):
    """The triangular factors `P A = L U`, by LAPACK."""

    factors: Float[Array, "n n"]
    permutation: Int[Array, " n"]

    @classmethod
    def empty(cls, size: int, dtype: Any) -> "LU":
        return cls(jnp.zeros((size, size), dtype), jnp.arange(size))

    def renewed(self, matrix: Float[Array, "n n"]) -> "LU":
        factors, pivots, _ = jax.lax.linalg.lu(matrix)
        permutation = order_after(pivots, len(matrix))
        return LU(factors, permutation.astype(self.permutation.dtype))

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        # A lookup by the permutation would be a scatter when it is transposed, and
        # functions of machine code have no large scatters to computed places.
        is_at = self.permutation[:, None] == np.arange(right.size)[None]
        column = jnp.sum(jnp.where(is_at, right[None], 0), axis=1)[:, None]
        column = jax.lax.linalg.triangular_solve(
            self.factors, column, left_side=True, lower=True, unit_diagonal=True
        )
        return jax.lax.linalg.triangular_solve(self.factors, column, left_side=True)[:, 0]


def order_after(pivots: Int[Array, " w"], num_rows: int) -> Int[Array, " m"]:
    """The order of rows after the exchanges of each of the first with its pivot, in turn.

    JAX's own loop is not one function. For 90 rows it takes longer than their factors do.
    """
    order = lambda pivots: jax.lax.linalg.lu_pivots_to_permutation(pivots, num_rows)
    return in_one_function(order)(pivots)


def solve(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """`matrix^-1 right`, differentiable and transposable in `right`."""
    if matrix.shape[0] > SMALL:
        return jnp.linalg.solve(matrix, right)
    return inverse(matrix) @ right


def solve_definite(
    matrix: Float[Array, "n n"], right: Float[Array, " n"]
) -> Float[Array, " n"]:
    """`matrix^-1 right` for a symmetric positive definite matrix, in few operations."""
    if matrix.shape[0] > _UNROLLED_IF_DEFINITE:
        return solve(matrix, right)
    return _solve_definite(matrix, right)


@jax.custom_jvp
def definite_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a symmetric positive definite matrix, for which no pivots are needed.

    Inverses of larger matrices are those of LAPACK.
    """
    if matrix.shape[0] > SMALL:
        return jnp.linalg.inv(matrix)
    order = np.arange(matrix.shape[0])

    def column(k: Any, matrix: Array) -> Array:
        pivot = 1 / matrix[k, k]
        own = order == k
        row = jnp.where(own, pivot, matrix[k] * pivot)
        factors = jnp.where(own, -1, matrix[:, k])
        left = jnp.where(own[None] | own[:, None], 0, matrix)
        return left - factors[:, None] * row[None]

    if order.size > _UNROLLED_IF_DEFINITE:
        return jax.lax.fori_loop(0, order.size, column, matrix)
    return functools.reduce(lambda matrix, k: column(k, matrix), order, matrix)


@definite_inverse.defjvp
def _definite_inverse_jvp(primals, tangents):
    return _change_of_inverse(definite_inverse, primals, tangents)


@jax.custom_jvp
def _solve_definite(matrix: Array, right: Array) -> Array:
    return _substituted(_root_free_cholesky(matrix), right)


@_solve_definite.defjvp
def _solve_definite_jvp(primals, tangents):
    (matrix, right), (d_matrix, d_right) = primals, tangents
    factors = _root_free_cholesky(matrix)
    x = _substituted(factors, right)
    return x, _substituted(factors, d_right - d_matrix @ x)


# Traced once for each size: both consist of many operations.
@jax.jit
def _root_free_cholesky(matrix: Array) -> tuple[list[Array], list[Array]]:
    """The pivots, and the columns below the diagonal of the factor, of `L D L^T`."""
    pivots, columns = [], []
    for _ in range(matrix.shape[0]):
        below = matrix[1:, 0]
        pivots.append(matrix[0, 0])
        columns.append(below / matrix[0, 0])
        matrix = matrix[1:, 1:] - columns[-1][:, None] * below[None]
    return pivots, columns


@jax.jit
def _substituted(factors: tuple[list[Array], list[Array]], right: Array) -> Array:
    pivots, columns = factors
    scaled = []
    for pivot, column in zip(pivots, columns, strict=True):
        scaled.append(right[:1] / pivot)
        right = right[1:] - column * right[0]
    x = right[:0]
    for first, column in zip(reversed(scaled), reversed(columns), strict=True):
        x = jnp.concatenate([first - jnp.sum(column * x), x])
    return x


# The error of an inverse above which it is computed by elimination, and the error that is
# small enough: each correction with the inverse then gains seven digits.
_FAR = 0.3
_ENOUGH = 1e-7


def product(a: Float[Array, "n k"], b: Any) -> Float[Array, "n m"]:
    """`a @ b`, which XLA fuses with its surroundings where both are small arrays."""
    if a.shape[1] > SMALL or not isinstance(b, jax.Array):
        return a @ b
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def _defect(matrix: Array, inverse: Array) -> tuple[Array, Scalar]:
    """The error `1 - A X` of an inverse, and its norm."""
    identity = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    defect = identity - product(matrix, inverse)
    return defect, _row_sum(defect)


def _square(e: Float[Array, "n n"]) -> tuple[Array, Scalar]:
    """`e^2` and its norm."""
    square = product(e, e)
    return square, _row_sum(square)


def _row_sum(matrix: Float[Array, "n n"]) -> Scalar:
    return largest(jnp.sum(jnp.abs(matrix), axis=1))
