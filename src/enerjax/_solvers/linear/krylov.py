"""Linear equations with a matrix that is known by its products, and nearly inverted.

The method of generalised conjugate residuals (S. C. Eisenstat, H. C. Elman and M. H.
Schultz, SIAM Journal on Numerical Analysis 20, 1983) with an approximate inverse.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._programs import part
from ..._types import Count, Scalar


Vector = Float[Array, " n"]
Map = Callable[[Vector], Vector]

# Up to this number of unknowns all directions are kept: they suffice with any approximate
# inverse. Of more unknowns few are kept, because each correction copies all of them.
_SMALL, _FEW = 64, 16


class _Search(NamedTuple):
    """The state of the iterations.

    - `x`, `left`: the solution so far, and its residual.
    - `directions`, `images`: those of the corrections so far, and their products with the
      matrix, which are orthonormal. Rows that are not yet used are zero.
    - `used`: the number of rows that are used, and of corrections.
    """

    x: Vector
    left: Vector
    directions: Float[Array, "most n"]
    images: Float[Array, "most n"]
    used: Count


# The most searches. Each begins with the true residual of the one before, from which the
# residual that the iterations keep differs by round-off, and after a breakdown by more.
# With few directions they go on from one another: with an approximate inverse by which
# errors shrink to a half, fifty corrections reach round-off.
_SEARCHES, _SEARCHES_BY_FEW = 3, 12


def solve_by_products(product: Map, approximate: Map, right: Vector) -> Vector:
    """The solution `x` of `product(x) = right`, where `approximate` nearly inverts it.

    It is NaN if its residual is not smaller than `right` by three quarters of the digits.
    """
    eps = jnp.finfo(right.dtype).eps
    # The squares of extreme numbers would overflow or vanish.
    largest = jnp.max(jnp.abs(right), initial=0.0)
    unit = jnp.where(largest > 0, largest, 1.0)
    right = right / unit
    size = _norm(right)
    searches = _SEARCHES if right.size <= _SMALL else _SEARCHES_BY_FEW

    def refined(carry: tuple[Vector, Vector, Count]) -> tuple[Vector, Vector, Count]:
        x, left, count = carry
        x = x + _found(product, approximate, left)
        return x, right - product(x), count + 1

    goes_on = lambda carry: (_norm(carry[1]) > eps**0.875 * size) & (carry[2] < searches)
    first = jnp.zeros_like(right), right, jnp.array(0)
    x, left, _ = jax.lax.while_loop(goes_on, refined, first)
    return jnp.where(_norm(left) <= eps**0.75 * size, unit * x, jnp.nan)


def _norm(x: Vector) -> Scalar:
    return jnp.sqrt(jnp.sum(x * x))


def _found(product: Map, approximate: Map, right: Vector) -> Vector:
    """The solution that one search finds."""
    most = right.size if right.size <= _SMALL else _FEW
    eps = jnp.finfo(right.dtype).eps
    put = jax.lax.dynamic_update_index_in_dim
    size = _norm(right)

    def correct(search: _Search) -> _Search:
        x, left, directions, images, used = search
        direction = approximate(left)
        image = product(direction)
        before = _norm(image)

        def orthogonal(k: Count, pair: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
            image, direction = pair
            share = jnp.sum(images[k] * image)
            return image - share * images[k], direction - share * directions[k]

        # The second pass removes what cancellation leaves in the first.
        for _ in range(2):
            pair = image, direction
            image, direction = jax.lax.fori_loop(0, used, orthogonal, pair)
        length = _norm(image)
        # Less than that is round-off.
        scale = jnp.where(length > eps**0.75 * before, 1 / length, 0)
        image, direction = scale * image, scale * direction
        share = jnp.sum(image * left)
        return _Search(
            x=x + share * direction,
            left=left - share * image,
            directions=put(directions, direction, used, 0),
            images=put(images, image, used, 0),
            used=used + 1,
        )

    none = jnp.zeros((most, right.size), right.dtype)
    first = _Search(jnp.zeros_like(right), right, none, none, jnp.array(0))
    goes_on = lambda c: (_norm(c.left) > 8 * eps * size) & (c.used < most)
    return jax.lax.while_loop(goes_on, correct, first).x


def solver_by_products(fn: Map, x: Vector, approximate: Map) -> Callable[[Vector], Vector]:
    """A function that solves with the Jacobian of `fn` at `x`, and can be transposed.

    `approximate` is linear and nearly inverts the Jacobian.
    """

    def solve(right: Vector) -> Vector:
        _, push = jax.linearize(fn, x)
        return solve_by_products(push, approximate, right)

    def solve_transposed(right: Vector) -> Vector:
        _, pull = jax.vjp(fn, x)
        _, nearly = jax.vjp(approximate, right)
        return solve_by_products(lambda y: pull(y)[0], lambda y: nearly(y)[0], right)

    # The products that JAX passes to these have lost the known indices, without which the
    # iterations cannot be one function.
    return lambda right: jax.lax.custom_linear_solve(
        lambda t: jax.jvp(fn, (x,), (t,))[1],
        right,
        lambda _, right: part(solve)(right),
        lambda _, right: part(solve_transposed)(right),
    )
