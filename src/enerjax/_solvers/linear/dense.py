"""Inverses of small dense matrices, in plain array operations.

LAPACK calls cost microseconds each for matrices of a few rows, and one such call keeps XLA
from compiling the loop around it into a single function.
"""

import abc
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._programs import LARGEST_SUM, unmerged
from ..._types import Flag, Scalar
from .norms import largest


# Rows up to which plain operations beat LAPACK.
SMALL = 32
# Rows up to which the elimination is written out: it compiles slowly.
_UNROLLED = 3


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse; not finite where the matrix is singular."""
    return enerjax_inverse(matrix)


@jax.jit
def enerjax_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The discrete derivative and the patterns know it by its name, also under `vmap`."""
    return _inverse(matrix)


@jax.custom_jvp
def _inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """By Gauss-Jordan elimination in place with row pivoting; rows are not exchanged."""
    size = matrix.shape[0]
    if size == 1:
        return 1 / matrix
    if size > SMALL:
        return jnp.linalg.inv(matrix)
    order = jnp.arange(size)

    def column(k, carry):
        table, free, rows, columns = carry
        entries = jax.lax.dynamic_slice(table, (0, k), (size, 1))[:, 0]
        sizes = jnp.where(free, jnp.abs(entries), -1)
        # The first of the largest: cheaper as two plain reductions than `argmax`. (Where
        # an entry is not a number there is none.)
        pivot = jnp.min(jnp.where(sizes == jnp.max(sizes), order, size))
        chosen = order == pivot
        row = jax.lax.dynamic_slice(table, (pivot, 0), (1, size))[0]
        entry = jax.lax.dynamic_slice(entries, (pivot,), (1,))[0]
        # All becomes so then.
        entry = jnp.where(pivot < size, entry, jnp.nan)
        # The unknown of the column and the right-hand side of the row change places.
        row = jnp.where(order == k, 1, row) / entry
        factors = jnp.where(chosen, 0, entries)
        kept = jnp.where((order == k)[None], 0, table) - factors[:, None] * row[None]
        table = jnp.where(chosen[:, None], row[None], kept)
        rows = jnp.where(order == k, pivot, rows)
        return table, free & ~chosen, rows, jnp.where(chosen, k, columns)

    none = jnp.zeros((size,), order.dtype)
    carry = matrix, jnp.ones((size,), bool), none, none
    if size <= _UNROLLED:
        carry = functools.reduce(lambda c, k: column(k, c), range(size), carry)
    else:
        carry = jax.lax.fori_loop(0, size, column, carry)
    table, _, rows, columns = carry
    return table[rows][:, columns]


@_inverse.defjvp
def _inverse_jvp(primals, tangents):
    # Matrix products alone, however often it is differentiated.
    (x,), (dx,) = primals, tangents
    y = inverse(x)
    return y, -_sums(_sums(y, dx), y)


def _sums(a: Float[Array, "n n"], b: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """`a @ b`; many tangents of it at once are faster so."""
    if a.shape[0] ** 3 > LARGEST_SUM:
        return product(a, b)
    return jnp.sum(a[:, :, None] * b[None], axis=1)


class AbstractFactors(eqx.Module):
    """What is kept of a matrix to solve with it, and to begin the next one with."""

    @abc.abstractmethod
    def renewed(self, matrix: Float[Array, "n n"]) -> "AbstractFactors":
        """Of another matrix; one that differs little can cost less."""

    @abc.abstractmethod
    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Nearly `matrix^-1 right`; not finite where the matrix is singular."""


class Inverse(AbstractFactors):
    """An approximate inverse, which a chord iteration makes good.

    Renewed by the iteration of G. Schulz (1933), `X (1 + E)` with `E = 1 - A X`, which
    leaves `E^2`; computed afresh where the old one is too far off. Of the matrix with rows
    of size one: others would make `E` look larger than it is.
    """

    inverse: Float[Array, "n n"]

    @classmethod
    def empty(cls, size: int, dtype: Any) -> "Inverse":
        """Of no matrix yet: corrects nothing, and is renewed."""
        return cls(jnp.full((size, size), jnp.nan, dtype))

    def renewed(self, matrix: Float[Array, "n n"]) -> "Inverse":
        sizes = jnp.max(jnp.abs(matrix), axis=1)
        matrix = matrix / sizes[:, None]

        # Of carries: an inverse, the error that it had before it was improved, as a matrix,
        # and a bound on the size of what that has left.
        def is_rough(carry) -> Flag:
            _, _, left = carry
            return (left > _ENOUGH) & (left < _FAR)

        def turn(carry):
            x, error, _ = carry
            error, size = unmerged(_square)(error)
            return x + product(x, error), error, size * size

        def is_lost(carry) -> Flag:
            _, _, left = carry
            return ~(left < _FAR)

        def start_again(carry):
            _, error, left = carry
            # By a one that XLA cannot see: it would move what does not change in a loop out
            # of it, and eliminate in every step.
            one = jnp.where(left < _FAR, 0, jnp.ones_like(left))
            return inverse(one * matrix), error, jnp.zeros_like(left)

        x = self.inverse * sizes[None]
        error, size = unmerged(_defect)(matrix, x)
        carry = x + product(x, error), error, jnp.where(size < _FAR, size * size, size)
        carry = jax.lax.while_loop(is_rough, turn, carry)
        x, _, _ = jax.lax.while_loop(is_lost, start_again, carry)
        return Inverse(x / sizes[None])

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.inverse @ right


class LU(AbstractFactors):
    """The factors of LAPACK."""

    factors: Float[Array, "n n"]
    permutation: Int[Array, " n"]

    @classmethod
    def empty(cls, size: int, dtype: Any) -> "LU":
        return cls(jnp.zeros((size, size), dtype), jnp.arange(size))

    def renewed(self, matrix: Float[Array, "n n"]) -> "LU":
        factors, _, permutation = jax.lax.linalg.lu(matrix)
        return LU(factors, permutation.astype(self.permutation.dtype))

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        column = right[self.permutation][:, None]
        column = jax.lax.linalg.triangular_solve(
            self.factors, column, left_side=True, lower=True, unit_diagonal=True
        )
        return jax.lax.linalg.triangular_solve(self.factors, column, left_side=True)[:, 0]


def solve(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    """Differentiable, and transposable in `right`."""
    if matrix.shape[0] > SMALL:
        return jnp.linalg.solve(matrix, right)
    return inverse(matrix) @ right


# Errors of an inverse beyond which it is computed afresh, and which are small enough for a
# chord iteration to gain as many digits at a time.
_FAR = 0.3
_ENOUGH = 1e-7


def product(a: Float[Array, "n k"], b: Any) -> Float[Array, "n m"]:
    """`a @ b`, which XLA fuses with its surroundings where both are small arrays."""
    if a.shape[1] > SMALL or not isinstance(b, jax.Array):
        return a @ b
    # Row by row of `b`: the inner loop is over neighbours, and is vectorised.
    terms = [a[:, k, None] * b[None, k] for k in range(a.shape[1])]
    return functools.reduce(jnp.add, terms) if terms else a @ b


def _defect(matrix: Array, inverse: Array) -> tuple[Array, Scalar]:
    """What an inverse leaves of the identity, and the size of that."""
    identity = jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    defect = identity - product(matrix, inverse)
    return defect, _row_sum(defect)


def _square(e: Float[Array, "n n"]) -> tuple[Array, Scalar]:
    """`e^2` and its size."""
    square = product(e, e)
    return square, _row_sum(square)


def _row_sum(matrix: Float[Array, "n n"]) -> Scalar:
    return largest(jnp.sum(jnp.abs(matrix), axis=1))
