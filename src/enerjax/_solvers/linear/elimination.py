"""One step of a block elimination: a few columns are eliminated from some rows."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .dense import order_after, product


# Columns from which LAPACK is faster than plain operations.
LAPACK_FROM = 16
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
    products = reduction @ pivots if count >= LAPACK_FROM else product(reduction, pivots)
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
    numbers = jnp.arange(num_rows)

    def column(k, carry):
        panel, order = carry
        sizes = jnp.where(numbers >= k, jnp.abs(panel[:, 0]), -1)
        # The first of the largest entries. Two reductions cost less than `argmax`. (If an
        # entry is NaN, all entries become NaN.)
        pivot = jnp.min(jnp.where(sizes == jnp.max(sizes), numbers, num_rows - 1))
        exchanged = jnp.where(numbers == pivot, k, numbers)
        exchanged = jnp.where(numbers == k, pivot, exchanged)
        panel, order = panel[exchanged], order[exchanged]
        is_pivot = numbers == k
        # The eliminated column is dropped, and the column of the right-hand side of row `k`
        # is appended.
        row = jnp.append(panel[k, 1:], 1) / panel[k, 0]
        factors = jnp.where(is_pivot, -1, panel[:, 0])
        rest = jnp.where(is_pivot[:, None], 0, panel[:, 1:])
        rest = jnp.pad(rest, ((0, 0), (0, 1)))
        return rest - factors[:, None] * row[None], order

    carry = panel, numbers
    if count <= _UNROLLED:
        return functools.reduce(lambda carry, k: column(k, carry), range(count), carry)
    return jax.lax.fori_loop(0, count, column, carry)
