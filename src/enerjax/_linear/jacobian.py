"""A function with its Jacobian, in the form that suits its size and structure."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .banded import Band, BandFactors, coloured_products, column_colours
from .dense import AbstractFactors, Inverse, LU, SMALL, solve
from .dependence import Dense
from .dots import plain_products
from .pattern import jacobian_pattern


# Unknowns from which structure is looked for.
_LARGE = 64


class Linearisable(eqx.Module):
    """A function from vectors to vectors, and linear algebra with its Jacobian.

    Made while a program is traced, by `linearisable`. Small and full Jacobians are dense
    arrays; those that can be ordered into a narrow band are bands.
    """

    value: Callable[[Float[Array, " n"]], Float[Array, " n"]]
    band: Band | None

    def jacobian(self, x: Float[Array, " n"]) -> Array:
        """The Jacobian, in the form that `first_factors` are renewed with."""
        if self.band is not None:
            return self.band.evaluate(self.value, x)
        return jax.jacfwd(self.value)(x)

    def first_factors(
        self, kept: AbstractFactors | None, x: Float[Array, " n"]
    ) -> AbstractFactors:
        """What the first Jacobian of an iteration renews."""
        if kept is not None:
            return kept
        if self.band is not None:
            return BandFactors.empty(self.band, x.dtype)
        return LU.empty(x.size, x.dtype)

    def solve(self, x: Float[Array, " n"], right: Float[Array, " n"]) -> Array:
        """`J(x)^-1 right`, differentiable in all there is, and transposable in `right`."""
        matrix = self.jacobian(x)
        if self.band is None:
            return solve(matrix, right)
        factors = BandFactors.empty(self.band, x.dtype).renewed(matrix)
        factors = jax.lax.stop_gradient(factors)

        def transposed(multiply, right):
            del multiply
            return jax.linear_transpose(factors.solve, right)(right)[0]

        return jax.lax.custom_linear_solve(
            lambda t: jax.jvp(self.value, (x,), (t,))[1],
            right,
            lambda _, right: factors.solve(right),
            transposed,
        )


def linearisable(
    fn: Callable[[Array, PyTree], Array], like: Float[Array, " n"], args: Any
) -> Linearisable:
    """`fn(x, args)` as a function of `x`; what it depends on must be in `args`."""
    value = plain_products(fn, like, args)
    if like.size <= _LARGE:
        return Linearisable(value, None)
    try:
        band = Band(jacobian_pattern(value, like))
    except Dense:
        return Linearisable(value, None)
    return Linearisable(value, band if band.worth_it() else None)


def affine_root(
    fn: Callable[[Array], Array], like: Float[Array, " n"]
) -> Float[Array, " n"]:
    """Where an affine function vanishes; differentiable in what it closes over."""
    at = jnp.zeros_like(like)
    linear = linearisable(lambda x, _: fn(x), at, None)
    if linear.band is None:
        return -jnp.linalg.solve(linear.jacobian(at), linear.value(at))
    return -linear.solve(at, linear.value(at))


def jacobian_rows(
    fn: Callable[[Array], Array], x: Float[Array, " n"]
) -> tuple[Float[Array, "m width"], Int[np.ndarray, "m width"]]:
    """The entries of the rows of a Jacobian, and their columns; zeros fill short rows."""
    num_rows = jax.eval_shape(lambda x: fn(x), x).shape[0]
    if x.size <= _LARGE:
        columns = np.broadcast_to(np.arange(x.size), (num_rows, x.size))
        return jax.jacfwd(fn)(x), columns
    pattern = jacobian_pattern(lambda x: fn(x), x)
    colours = column_colours(pattern, np.arange(x.size))
    products = coloured_products(fn, x, colours)
    counts = np.diff(pattern.indptr)
    rows = np.repeat(np.arange(num_rows), counts)
    within = np.arange(rows.size) - np.repeat(pattern.indptr[:-1], counts)
    columns = np.zeros((num_rows, max(counts.max(initial=0), 1)), int)
    columns[rows, within] = pattern.indices
    filled = np.zeros(columns.shape)
    filled[rows, within] = 1
    entries = products[colours[columns], np.arange(num_rows)[:, None]]
    return entries * jnp.asarray(filled, x.dtype), columns


def kept_factors(size: int, dtype: Any) -> AbstractFactors | None:
    """What a solve hands to the next at first: an inverse, where it is small."""
    return Inverse.empty(size, dtype) if size <= SMALL else None
