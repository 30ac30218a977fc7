"""One step of a block elimination: some columns of a few rows."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .dense import product


# Columns from which LAPACK is faster than plain operations.
LIBRARY = 16
# Columns up to which the elimination is written out: it compiles slowly.
_UNROLLED = 8


def pivot_rows_first(
    panel: Float[Array, "m w"],
) -> tuple[Float[Array, "m w"], Int[Array, " m"]]:
    """What reduces the first columns of some rows to those of the identity.

    With row pivoting: the order of the rows, those that were pivots first, and the matrix
    by which these, in that order, are solved for the `w` unknowns and taken off the rest;
    see `reduced`.
    """
    return _by_library(panel) if panel.shape[1] >= LIBRARY else _by_hand(panel)


def reduced(
    turn: Float[Array, "m w"], order: Int[Array, " m"], rows: Float[Array, "m k"]
) -> tuple[Float[Array, "w k"], Float[Array, "rest k"]]:
    """The other columns of the rows: of the pivots, and of what is left."""
    count = turn.shape[1]
    rows = rows[order]
    pivots = rows[:count]
    turned = turn @ pivots if count >= LIBRARY else product(turn, pivots)
    return turned[:count], rows[count:] + turned[count:]


def _by_library(panel: Float[Array, "m w"]) -> tuple[Array, Array]:
    """`P rows = [L1; L2] U`: `(L1 U)^-1`, and less `L2 L1^-1`."""
    count = panel.shape[1]
    panel, _, order = jax.lax.linalg.lu(panel)
    own, below = panel[:count], panel[count:]
    solve = jax.lax.linalg.triangular_solve
    eye = jnp.eye(count, dtype=panel.dtype)
    inverse = solve(own, eye, left_side=True, lower=True, unit_diagonal=True)
    turn = jnp.concatenate([solve(own, inverse, left_side=True), -below @ inverse])
    return turn, order.astype(jnp.arange(1).dtype)


def _by_hand(panel: Float[Array, "m w"]) -> tuple[Array, Array]:
    """By Gauss and Jordan in place, without a call that would break up the loop around."""
    num_rows, count = panel.shape
    numbers = jnp.arange(num_rows)

    def column(k, carry):
        panel, order = carry
        sizes = jnp.where(numbers >= k, jnp.abs(panel[:, 0]), -1)
        # The first of the largest: cheaper as two plain reductions than `argmax`. (Where
        # an entry is not a number there is none, and all becomes so.)
        pivot = jnp.min(jnp.where(sizes == jnp.max(sizes), numbers, num_rows - 1))
        exchanged = jnp.where(numbers == pivot, k, numbers)
        exchanged = jnp.where(numbers == k, pivot, exchanged)
        panel, order = panel[exchanged], order[exchanged]
        is_pivot = numbers == k
        # The column is done; that of the right-hand side takes its place, as the last.
        row = jnp.append(panel[k, 1:], 1) / panel[k, 0]
        factors = jnp.where(is_pivot, -1, panel[:, 0])
        rest = jnp.where(is_pivot[:, None], 0, panel[:, 1:])
        rest = jnp.pad(rest, ((0, 0), (0, 1)))
        return rest - factors[:, None] * row[None], order

    carry = panel, numbers
    if count <= _UNROLLED:
        return functools.reduce(lambda carry, k: column(k, carry), range(count), carry)
    return jax.lax.fori_loop(0, count, column, carry)
