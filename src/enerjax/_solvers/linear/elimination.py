"""One step of a block elimination: a few columns are eliminated from some rows."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .dense import order_after, product


# Columns from which LAPACK is faster than plain operations.
LAPACK_FROM = 64
# Columns up to which the loop over columns is unrolled. Longer unrolled loops compile
# slowly.
_UNROLLED = 8


def eliminate_columns(
    panel: Float[Array, "m w"],
) -> tuple[Float[Array, "m w"], Int[Array, " m"]]:
    """The elimination, with row pivoting, of the first `w` unknowns from `m` rows.

    `panel` contains the first `w` columns of these rows. Returns the reduction and the
    order of the rows, the `w` pivot rows first. The first `w` rows of the reduction are the
    inverse of the pivot rows. The others multiply the pivot rows, and give what is added to
    the remaining rows to eliminate the unknowns; see `apply_reduction`.
    """
    return _by_lapack(panel) if panel.shape[1] >= LAPACK_FROM else _by_gauss_jordan(panel)


def apply_reduction(
    reduction: Float[Array, "m w"], order: Int[Array, " m"], rows: Float[Array, "m k"]
) -> tuple[Float[Array, "w k"], Float[Array, "rest k"]]:
    """The elimination applied to further columns: the pivot rows, and the other rows."""
    count = reduction.shape[1]
    rows = rows[order]
    pivots = rows[:count]
    products = reduction @ pivots if count >= 16 else product(reduction, pivots)
    return products[:count], rows[count:] + products[count:]


def _by_lapack(panel: Float[Array, "m w"]) -> tuple[Array, Array]:
    """From `P rows = [L1; L2] U`: the reduction is `[(L1 U)^-1; -L2 L1^-1]`."""
    count = panel.shape[1]
    panel, pivots, _ = jax.lax.linalg.lu(panel)
    order = order_after(pivots, len(panel))
    own, below = panel[:count], panel[count:]
    solve = jax.lax.linalg.triangular_solve
    eye = jnp.eye(count, dtype=panel.dtype)
    inverse = solve(own, eye, left_side=True, lower=True, unit_diagonal=True)
    reduction = jnp.concatenate([solve(own, inverse, left_side=True), -below @ inverse])
    return reduction, order.astype(jnp.arange(1).dtype)


def _by_gauss_jordan(panel: Float[Array, "m w"]) -> tuple[Array, Array]:
    """In-place Gauss-Jordan elimination, without calls that XLA cannot fuse."""
    num_rows, count = panel.shape
    numbers, columns = jnp.arange(num_rows), jnp.arange(count)

    def column(k, carry):
        # Rows stay where they are until the end. A row has a `place`, and the row at each
        # place is in `order`.
        panel, place, order = carry
        entries = jax.lax.dynamic_index_in_dim(panel, k, 1, keepdims=False)
        sizes = jnp.where(place >= k, jnp.abs(entries), -1)
        # The first of the largest entries. Two reductions cost less than `argmax`. (If an
        # entry is NaN, all entries become NaN.)
        pivot = jnp.min(jnp.where(sizes == jnp.max(sizes), numbers, num_rows - 1))
        row, entry, before, first = (
            jax.lax.dynamic_index_in_dim(x, at, keepdims=False)
            for x, at in ((panel, pivot), (entries, pivot), (place, pivot), (order, k))
        )
        chosen = numbers == pivot
        place = jnp.where(chosen, k, jnp.where(numbers == first, before, place))
        order = jnp.where(numbers == k, pivot, jnp.where(numbers == before, first, order))
        # Exchanges the unknown of the column with the right-hand side of the row.
        row = jnp.where(columns == k, 1, row) / entry
        factors = jnp.where(chosen, 0, entries)
        kept = jnp.where((columns == k)[None], 0, panel) - factors[:, None] * row[None]
        return jnp.where(chosen[:, None], row[None], kept), place, order

    carry = panel, numbers, numbers
    if count <= _UNROLLED:
        carry = functools.reduce(lambda c, k: column(k, c), range(count), carry)
    else:
        carry = jax.lax.fori_loop(0, count, column, carry)
    panel, _, order = carry
    return panel[order], order
