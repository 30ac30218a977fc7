"""Factors of matrices, and solutions with them, by operations on rows and columns.

`small_matrices.py` writes the operations out, `dense.py` has loops over the columns.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float


class Forms(NamedTuple):
    """How matrices are factored, and how a lower triangular one is solved with."""

    cholesky: Callable[..., Array]
    lu: Callable[..., tuple[Array, Array, Array]]
    substituted: Callable[..., Array]


def outputs(
    name: str, values: list[Array], params: dict[str, Any], forms: Forms
) -> list[Array]:
    """The outputs of `lu`, `cholesky` or `triangular_solve`."""
    if name == "cholesky":
        return [of_each(forms.cholesky, 2, *values)]
    if name == "lu":
        return list(of_each(forms.lu, 2, *values))
    keys = "left_side lower transpose_a unit_diagonal".split()
    how = {key: params[key] for key in keys}
    solve = functools.partial(_triangular_solve, forms.substituted, **how)
    return [of_each(solve, 2, *values)]


def of_each(fn: Callable, num_axes: int, *values: Array) -> Any:
    """`fn` of the last axes of arrays, for all entries of the others."""
    for _ in values[0].shape[: values[0].ndim - num_axes]:
        fn = jax.vmap(fn)
    return fn(*values)


def _triangular_solve(
    substituted: Callable[..., Array],
    matrix: Float[Array, "n n"],
    right: Array,
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    unit_diagonal: bool,
) -> Array:
    if not left_side:
        matrix, lower, right = matrix.T, not lower, right.T
    if transpose_a:
        matrix, lower = matrix.T, not lower
    if lower:
        out = substituted(matrix, right, unit_diagonal)
    else:
        out = substituted(matrix[::-1, ::-1], right[::-1], unit_diagonal)[::-1]
    return out if left_side else out.T
