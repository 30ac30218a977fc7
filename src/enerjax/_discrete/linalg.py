"""Rules of matrix factorisations and solves: the product rule, solved for the factor.

The product rule of the equation that defines an output is exact if each factor is replaced
by its mean over the two points: `A x = b` gives `mean(A) dx = db - dA mean(x)`. The mean of
two regular matrices can be singular (that of a rotation and its opposite is zero); the
increment is then not finite.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .arithmetic import both
from .transform import (
    at_a,
    at_b,
    increment,
    moves,
    Moving,
    NoRule,
    refuse_choices,
    Switching,
    Value,
)


def _transposed(x: Array) -> Array:
    return jnp.swapaxes(x, -1, -2)


def _lower(factor: Array, right: Array, unit: bool = False) -> Array:
    """`factor^-1 right` with a lower triangular factor."""
    return jax.lax.linalg.triangular_solve(
        factor, right, left_side=True, lower=True, unit_diagonal=unit
    )


def cholesky(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """`dA = dL Lm^T + Lm dL^T`, so `Lm^-1 dA Lm^-T` is `Lm^-1 dL` plus its transpose."""
    (matrix,) = values
    ((a, b),) = both(values, params)
    # The primitive leaves the upper triangle undefined.
    mean = jnp.tril(0.5 * (a + b))
    symmetric = 0.5 * (matrix.d + _transposed(matrix.d))
    inner = _lower(mean, _transposed(_lower(mean, symmetric)))
    eye = jnp.eye(a.shape[-1], dtype=a.dtype)
    return [Moving(a, b, mean @ (jnp.tril(inner) - 0.5 * inner * eye))]


def triangular_solve(values: list[Value], params: dict[str, Any]) -> list[Value]:
    if params["conjugate_a"]:
        raise NoRule
    ((a, b),) = both(values, params)
    matrix, right = values
    lower, unit = params["lower"], params["unit_diagonal"]
    # The solve reads one triangle, without the diagonal if `unit_diagonal` replaces that.
    offset = int(unit)
    entries = jnp.ones(at_a(matrix).shape, bool)
    used = jnp.tril(entries, -offset) if lower else jnp.triu(entries, offset)
    change = increment(right)
    if moves(matrix):
        moved = jnp.where(used, matrix.d, 0)
        moved = _transposed(moved) if params["transpose_a"] else moved
        mean = 0.5 * (a + b)
        change = change - (moved @ mean if params["left_side"] else mean @ moved)
    factor = 0.5 * (at_a(matrix) + at_b(matrix))
    options = {k: v for k, v in params.items() if k not in ("walk", "primitive")}
    return [Moving(a, b, jax.lax.linalg.triangular_solve(factor, change, **options))]


def linear_solve(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """`matvec(x) = b`: the rule needs the product with the matrix, not the solver."""
    lengths, program = params["const_lengths"], params["jaxprs"].matvec
    consts = values[: lengths.matvec]
    right = values[sum(lengths) :]
    refuse_choices([*consts, *right])
    ends = both(values, params)
    walk = params["walk"]
    means = [0.5 * (a + b) for a, b in ends]
    changes = [increment(v) for v in right]
    if any(moves(c) for c in consts):
        moved = walk.closed(program, [*consts, *means])
        changes = [db - increment(m) for db, m in zip(changes, moved, strict=True)]
    middle = [0.5 * (at_a(c) + at_b(c)) if moves(c) else c for c in consts]
    out = _solve(program, middle, changes)
    return [Moving(a, b, d) for (a, b), d in zip(ends, out, strict=True)]


def _solve(program: Any, consts: list[Array], right: list[Array]) -> list[Array]:
    """`x` in `program(consts, x) = right`, linear in `x`, by a dense matrix."""
    axis = _column_axis(program.jaxpr)
    if axis is not None:
        of_matrix, of_x = axis
        matrix = consts[0] if of_matrix == 1 else consts[0].T
        columns = jnp.moveaxis(right[0], of_x, 0)
        flat = columns.reshape(columns.shape[0], -1)
        out = jnp.linalg.solve(matrix, flat).reshape(columns.shape)
        return [jnp.moveaxis(out, 0, of_x)]
    flat, unravel = ravel_pytree(right)
    product = lambda x: ravel_pytree(jaxpr_as_fun(program)(*consts, *unravel(x)))[0]
    return unravel(jnp.linalg.solve(jax.jacfwd(product)(flat), flat))


def _column_axis(jaxpr: Any) -> tuple[int, int] | None:
    """The contracted axes of matrix and `x`, if the program is a product with one matrix.

    Several right-hand sides, as for an inverse, then share one small matrix. In the general
    case they are joined to one long vector.
    """
    first = jaxpr.eqns[0]
    if first.primitive.name != "dot_general" or first.invars != jaxpr.invars:
        return None
    (contracted, batch) = first.params["dimension_numbers"]
    only_moved = all(e.primitive.name in ("transpose", "squeeze") for e in jaxpr.eqns[1:])
    if first.invars[0].aval.ndim != 2 or any(map(len, batch)) or not only_moved:
        return None
    return contracted[0][0], contracted[1][0]


def inverse(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """`X_b - X_a = -X_b dA X_a`, averaged with the opposite order."""
    (matrix,) = values
    ((a, b),) = both(values, params)
    return [Moving(a, b, -0.5 * (a @ matrix.d @ b + b @ matrix.d @ a))]


def lu(values: list[Value], params: dict[str, Any]) -> list[Value]:
    """`P dA = dL Um + Lm dU`, if both points have the same pivots.

    Otherwise no product rule relates the two factorisations, and their difference is shared
    among the entries of the matrix.
    """
    (matrix,) = values
    (fa, fb), (pa, pb), (ra, rb) = both(values, params)
    if matrix.a.ndim != 2 or matrix.a.shape[0] != matrix.a.shape[1]:
        raise NoRule
    mean = 0.5 * (fa + fb)
    eye = jnp.eye(mean.shape[0], dtype=mean.dtype)
    # A pivot that changes its sign may have the mean zero.
    keep = jnp.diagonal(fa) * jnp.diagonal(fb) > 0
    same = jnp.all(ra == rb) & jnp.all(keep)
    lower = jnp.tril(mean, -1) + eye
    upper = jnp.where(same, jnp.triu(mean), eye)
    inner = _lower(lower, matrix.d[ra], unit=True)
    inner = jax.lax.linalg.triangular_solve(upper, inner, left_side=False, lower=False)
    exact = lower @ jnp.tril(inner, -1) + jnp.triu(inner) @ upper
    moved = matrix.b - matrix.a
    squares, decided = jnp.sum(moved**2), jnp.sum(moved * matrix.d)
    shared = (fb - fa) * decided / jnp.where(squares > 0, squares, 1)
    factors = Moving(fa, fb, jnp.where(same, exact, shared))
    decides = [jnp.broadcast_to(x.astype(float), pa.shape) for x in (squares, decided)]
    return [factors, Switching(pa, pb, *decides), Switching(ra, rb, *decides)]
