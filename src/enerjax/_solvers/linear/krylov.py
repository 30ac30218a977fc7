"""Linear equations with a matrix that is known by its products, and nearly inverted.

The preconditioned Richardson iteration, `x + P (b - A x)` with the approximate inverse `P`,
comes first: a correction costs one product. Where it does not converge, another solver
follows, or the method of generalised conjugate residuals (S. C. Eisenstat, H. C. Elman and
M. H. Schultz, SIAM Journal on Numerical Analysis 20, 1983).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._programs import in_any_lane, part
from ..._types import Count, Flag, Scalar


Vector = Float[Array, " n"]
Map = Callable[[Vector], Vector]

# Up to this number of unknowns the conjugate residuals keep all directions, which suffice
# with any approximate inverse. If there are more unknowns they keep few directions, because
# each correction copies all of them.
_FEW_UNKNOWNS, _FEW_DIRECTIONS = 64, 16
# The most searches. Each begins with the true residual of the one before, from which the
# residual that the iterations keep differs by round-off, and after a breakdown by more.
# With few directions they go on from one another: with an approximate inverse by which
# errors shrink to a half, fifty corrections reach round-off.
_SEARCHES, _SEARCHES_BY_FEW = 3, 12
# The Richardson iteration ends where two corrections together leave more than a quarter of
# the residual. One correction may leave more than half: the residuals of the constraints at
# position level and of those at velocity level shrink in turn.
_SHRINKS = 0.25
# At that rate 64 corrections reach round-off.
_MOST_CORRECTIONS = 64


class _Richardson(NamedTuple):
    """The state of the Richardson iteration.

    - `x`, `left`: the solution so far, and its residual.
    - `size`, `last`, `before_last`: the size of this residual, and those of the two before.
    - `used`: the number of corrections.
    """

    x: Vector
    left: Vector
    size: Scalar
    last: Scalar
    before_last: Scalar
    used: Count


class _Search(NamedTuple):
    """The state of the conjugate residuals.

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


def solve_by_products(
    product: Map, approximate: Map, right: Vector, otherwise: Map | None = None
) -> Vector:
    """The solution `x` of `product(x) = right`, where `approximate` nearly inverts it.

    Where it does not, `otherwise` solves; by default the conjugate residuals. These give
    NaN if they do not reduce the residual by three quarters of the digits, which suffice
    for the Richardson iteration.
    """
    if otherwise is None:
        otherwise = lambda right: _by_conjugate_residuals(product, approximate, right)
    eps = jnp.finfo(right.dtype).eps
    # The squares of extreme numbers would overflow or vanish.
    largest = jnp.max(jnp.abs(right), initial=0.0)
    unit = jnp.where(largest > 0, largest, 1.0)
    right = right / unit
    last = _by_richardson(product, approximate, right)
    # NaN compares false: such a residual is left to the other solver.
    is_found = last.size <= eps**0.75 * _norm(right)
    # The conjugate residuals of lanes without a right-hand side end at once.
    rest = lambda: otherwise(jnp.where(is_found, 0, right))
    other = jax.lax.cond(in_any_lane(~is_found), rest, lambda: jnp.zeros_like(right))
    return unit * jnp.where(is_found, last.x, other)


def _by_richardson(product: Map, approximate: Map, right: Vector) -> _Richardson:
    """The end of the Richardson iteration, whether it has converged or not."""
    eps = jnp.finfo(right.dtype).eps
    size = _norm(right)

    def goes_on(now: _Richardson) -> Flag:
        shrinks = now.size <= _SHRINKS * now.before_last
        # One more correction follows when the residual is small, for the entries of the
        # solution that are far smaller than others.
        was_large = now.last > eps**0.875 * size
        return was_large & shrinks & (now.used < _MOST_CORRECTIONS)

    def correct(now: _Richardson) -> _Richardson:
        x = now.x + approximate(now.left)
        left = right - product(x)
        return _Richardson(x, left, _norm(left), now.size, now.last, now.used + 1)

    infinite = jnp.full_like(size, jnp.inf)
    first = _Richardson(
        jnp.zeros_like(right), right, size, infinite, infinite, jnp.array(0)
    )
    return jax.lax.while_loop(goes_on, correct, first)


def _by_conjugate_residuals(product: Map, approximate: Map, right: Vector) -> Vector:
    """Searches that follow one another, each from the true residual of the one before."""
    eps = jnp.finfo(right.dtype).eps
    size = _norm(right)
    searches = _SEARCHES if right.size <= _FEW_UNKNOWNS else _SEARCHES_BY_FEW

    def refined(carry: tuple[Vector, Vector, Count]) -> tuple[Vector, Vector, Count]:
        x, left, count = carry
        x = x + _found(product, approximate, left)
        return x, right - product(x), count + 1

    goes_on = lambda carry: (_norm(carry[1]) > eps**0.875 * size) & (carry[2] < searches)
    first = jnp.zeros_like(right), right, jnp.array(0)
    x, left, _ = jax.lax.while_loop(goes_on, refined, first)
    return jnp.where(_norm(left) <= eps**0.75 * size, x, jnp.nan)


def _norm(x: Vector) -> Scalar:
    return jnp.sqrt(jnp.sum(x * x))


def _found(product: Map, approximate: Map, right: Vector) -> Vector:
    """The solution that one search finds."""
    most = right.size if right.size <= _FEW_UNKNOWNS else _FEW_DIRECTIONS
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


def jacobian_solver(
    fn: Map,
    x: Vector,
    approximate: Map,
    otherwise: Map | None = None,
    otherwise_transposed: Map | None = None,
) -> Map:
    """A function that solves with the Jacobian of `fn` at `x`, and can be transposed.

    `approximate` is linear and nearly inverts the Jacobian. Where it does not, `otherwise`
    solves, and `otherwise_transposed` with the transpose; see `solve_by_products`.
    """

    def solve(right: Vector) -> Vector:
        _, push = jax.linearize(fn, x)
        return solve_by_products(push, approximate, right, otherwise)

    def transposed(of: Map) -> Map:
        """The transpose of the derivative at `x`, which of a linear map is the map."""
        _, pull = jax.vjp(of, x)
        return lambda y: pull(y)[0]

    def solve_transposed(right: Vector) -> Vector:
        products = transposed(fn), transposed(approximate)
        return solve_by_products(*products, right, otherwise_transposed)

    # The products that JAX passes to these have lost the known indices, without which the
    # iterations cannot be one function.
    return lambda right: jax.lax.custom_linear_solve(
        lambda t: jax.jvp(fn, (x,), (t,))[1],
        right,
        lambda _, right: part(solve)(right),
        lambda _, right: part(solve_transposed)(right),
    )
