"""One step of a block elimination: some columns of a few rows."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


# Columns from which LAPACK is faster than plain operations.
LIBRARY = 16


def pivot_rows_first(rows: Float[Array, "m w"], count: int) -> tuple[Array, Array]:
    """Rows reduced so that their first `count` columns are those of the identity.

    With row pivoting: the rows that were pivots come first. Returns the columns behind,
    `(m, w - count)`, and the matrix `(m, m)` that takes the rows there.
    """
    return _by_library(rows, count) if count >= LIBRARY else _by_hand(rows, count)


def _by_library(rows: Float[Array, "m w"], count: int) -> tuple[Array, Array]:
    """`P rows = [L1; L2] U` in the first columns: `(L1 U)^-1`, and less `L2 L1^-1`."""
    panel, _, order = jax.lax.linalg.lu(rows[:, :count])
    eye = jnp.eye(rows.shape[0], dtype=rows.dtype)
    own, below = panel[:count], panel[count:]
    solve = jax.lax.linalg.triangular_solve
    inverse = solve(
        own, eye[:count, :count], left_side=True, lower=True, unit_diagonal=True
    )
    first, rest = solve(own, inverse, left_side=True), -below @ inverse
    behind = rows[order, count:]
    turned = [first @ behind[:count], behind[count:] + rest @ behind[:count]]
    turn = eye.at[:, :count].set(jnp.concatenate([first, rest]))
    return jnp.concatenate(turned), turn[:, jnp.argsort(order)]


def _by_hand(rows: Float[Array, "m w"], count: int) -> tuple[Array, Array]:
    """By Gauss and Jordan, without a call that would break up the loop around."""
    num_rows, num_columns = rows.shape
    whole = jnp.concatenate([rows, jnp.eye(num_rows, dtype=rows.dtype)], axis=1)
    numbers, counted = jnp.arange(num_rows), jnp.arange(count)

    def column(k, carry):
        whole, free, places = carry
        entries = whole[:, k]
        pivot = jnp.argmax(jnp.where(free, jnp.abs(entries), -1))
        chosen = numbers == pivot
        row = whole[pivot] / entries[pivot]
        factors = jnp.where(chosen, 0, entries)
        whole = jnp.where(chosen[:, None], row[None], whole - factors[:, None] * row[None])
        return whole, free & ~chosen, jnp.where(counted == k, pivot, places)

    carry = whole, jnp.ones((num_rows,), bool), jnp.zeros((count,), numbers.dtype)
    whole, free, places = jax.lax.fori_loop(0, count, column, carry)
    # What is left, in its order: the row of the first, second, ... that is free.
    # (Counted plainly: `cumsum` is not possible in one function.)
    before = free[None, :] & (numbers[None, :] <= numbers[:, None])
    number_of = jnp.where(free, jnp.sum(before, axis=1), 0)
    left = jnp.arange(1, num_rows - count + 1)
    rest = jnp.argmax(number_of[None, :] == left[:, None], axis=1)
    whole = whole[jnp.concatenate([places, rest])]
    return whole[:, count:num_columns], whole[:, num_columns:]
