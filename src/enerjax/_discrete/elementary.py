"""Difference quotients of elementary functions, without cancellation.

`quotient(a, b)` is `(f(b) - f(a)) / (b - a)`, and `f'(a)` at `b = a`, with all derivatives.
The even functions at the bottom (`sin x / x` and similar ones) are series, so that neither
they nor their derivatives lose digits near zero.
"""

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


Quotient = Callable[[Array, Array], Array]

# The series of `atan x / x` and `atanh x / x` are used below this argument. There 16 terms
# reach round-off: the next is 0.25^32 / 33, about 2e-21.
SMALL_RATIO = 0.25
_TERMS_OF_ATAN = 16
# Those of `sin x / x` and `sinh x / x` are used below 1, where 11 terms reach round-off:
# the next is 1 / 23!, about 4e-23.
_TERMS_OF_SIN = 11
# Gauss points of a mean slope: exact to degree 23.
_GAUSS_POINTS = 12


def _split(d: Array, near: Callable[[Array], Array], change: Array) -> Array:
    """`near(d)` for differences `d` below 1, else `change / d`.

    From 1 on this quotient loses no more than the rounding of the values, which have been
    computed anyway.
    """
    small = jnp.abs(d) < 1
    quotient = change / jnp.where(small, 1, d)
    return jnp.where(small, near(jnp.where(small, d, 0)), quotient)


def sin(a: Array, b: Array) -> Array:
    mean = jnp.cos(0.5 * (a + b))
    return _split(b - a, lambda d: mean * _sinc(0.5 * d), jnp.sin(b) - jnp.sin(a))


def cos(a: Array, b: Array) -> Array:
    mean = -jnp.sin(0.5 * (a + b))
    return _split(b - a, lambda d: mean * _sinc(0.5 * d), jnp.cos(b) - jnp.cos(a))


def tan(a: Array, b: Array) -> Array:
    scale = jnp.cos(a) * jnp.cos(b)
    return _split(b - a, lambda d: _sinc(d) / scale, jnp.tan(b) - jnp.tan(a))


def exp(a: Array, b: Array) -> Array:
    mean = jnp.exp(0.5 * (a + b))
    return _split(b - a, lambda d: mean * _sinhc(0.5 * d), jnp.exp(b) - jnp.exp(a))


def exp_of(change: Array, a: Array, b: Array) -> Array:
    """The quotient of `exp`, from the change of its argument and its two values."""
    mean = jnp.sqrt(a) * jnp.sqrt(b)
    return _split(change, lambda d: mean * _sinhc(0.5 * d), b - a)


def exp2(a: Array, b: Array) -> Array:
    rate = math.log(2)
    return rate * exp(rate * a, rate * b)


def sinh(a: Array, b: Array) -> Array:
    mean = jnp.cosh(0.5 * (a + b))
    return _split(b - a, lambda d: mean * _sinhc(0.5 * d), jnp.sinh(b) - jnp.sinh(a))


def cosh(a: Array, b: Array) -> Array:
    mean = jnp.sinh(0.5 * (a + b))
    return _split(b - a, lambda d: mean * _sinhc(0.5 * d), jnp.cosh(b) - jnp.cosh(a))


def tanh(a: Array, b: Array) -> Array:
    # Two values close to 1 are subtracted by their differences from 1, which keep digits.
    limit = 0.2 * math.log(float(jnp.finfo(a.dtype).max))
    clipped = lambda x: jnp.clip(x, -limit, limit)
    near = 1 / (jnp.cosh(clipped(a)) * jnp.cosh(clipped(b)))
    below_one = lambda x: 2 / (jnp.exp(2 * clipped(x)) + 1)
    change = jnp.where(
        (a > 0) & (b > 0),
        below_one(a) - below_one(b),
        jnp.where(
            (a < 0) & (b < 0), below_one(-b) - below_one(-a), jnp.tanh(b) - jnp.tanh(a)
        ),
    )
    return _split(b - a, lambda d: _sinhc(d) * near, change)


def logistic(a: Array, b: Array) -> Array:
    return 0.25 * tanh(0.5 * a, 0.5 * b)


def log(a: Array, b: Array) -> Array:
    # For negative arguments this is the quotient of log|x|, which has the same slope: a
    # `where` may evaluate it without choosing it.
    return _log_ratio(b - a, a + b, jnp.log(jnp.abs(b)) - jnp.log(jnp.abs(a)))


def log1p(a: Array, b: Array) -> Array:
    modulus = lambda x: jnp.log1p(jnp.where(x < -1, -2 - x, x))
    return _log_ratio(b - a, 2 + a + b, modulus(b) - modulus(a))


def _log_ratio(d: Array, total: Array, change: Array) -> Array:
    """The quotient of `log`, from the difference and the sum of its arguments."""
    near = jnp.abs(d) < SMALL_RATIO * jnp.abs(total)
    return series_or_quotient(near, d, total, lambda x: 2 * _atanhc(x), change)


def series_or_quotient(
    near: Array, d: Array, total: Array, series: Callable[[Array], Array], change: Array
) -> Array:
    """`series(d / total) / total` where `near`, else `change / d`."""
    total = jnp.where(near, total, 1)
    ratio = jnp.where(near, d, 0) / total
    return jnp.where(near, series(ratio) / total, change / jnp.where(near, 1, d))


def sqrt(a: Array, b: Array) -> Array:
    return 1 / (jnp.sqrt(a) + jnp.sqrt(b))


def rsqrt(a: Array, b: Array) -> Array:
    root_a, root_b = jnp.sqrt(a), jnp.sqrt(b)
    return -1 / (root_a * root_b * (root_a + root_b))


def cbrt(a: Array, b: Array) -> Array:
    root_a, root_b = jnp.cbrt(a), jnp.cbrt(b)
    return 1 / (root_a**2 + root_a * root_b + root_b**2)


def integer_pow(a: Array, b: Array, n: int) -> Array:
    if n < 0:
        return -integer_pow(a, b, -n) / (a ** (-n) * b ** (-n))
    # An empty sum for n = 0.
    terms = [a**k * b ** (n - 1 - k) for k in range(n)]
    return sum(terms, jnp.zeros_like(a))


def half_integer_pow(a: Array, b: Array, n: int) -> Array:
    """The quotient of `sqrt(x)**n` with an odd `n`."""
    if abs(n) == 1:
        return sqrt(a, b) if n == 1 else rsqrt(a, b)
    # The square root has no derivative at zero, but its powers from 3 on have.
    root = lambda x: jnp.where(x == 0, 0, jnp.sqrt(jnp.where(x == 0, 1, x)))
    root_a, root_b = root(a), root(b)
    total = root_a + root_b
    ratio = integer_pow(root_a, root_b, n) / jnp.where(total == 0, 1, total)
    return jnp.where(total == 0, 0, ratio) if n > 0 else ratio


def pow(a: Array, b: Array, exponent: Array) -> Array:
    """The quotient of `x**exponent`, also for negative `x` and a whole exponent."""
    signs = jnp.where(a > 0, 1, 0) * jnp.where(b > 0, 1, 0)
    mirrored = jnp.where(a < 0, 1, 0) * jnp.where(b < 0, 1, 0)
    alike = signs + mirrored > 0
    size_a, size_b = (jnp.where(alike, jnp.abs(x), 1) for x in (a, b))
    slope = exp(exponent * jnp.log(size_a), exponent * jnp.log(size_b)) * exponent
    slope = slope * log(size_a, size_b)
    minus_one = jnp.where(mirrored > 0, -1, 1).astype(a.dtype)
    slope = jnp.where(mirrored > 0, -(minus_one**exponent) * slope, slope)
    # If one end is zero, or the signs differ, nothing cancels, unless both ends are zero.
    apart = jnp.where(alike | (a == b), 1, b - a)
    there = lambda x: jnp.where(alike, 1, x) ** exponent
    at_zero = exponent * jnp.where(alike, 1, a) ** (exponent - 1)
    return jnp.where(
        alike, slope, jnp.where(a == b, at_zero, (there(b) - there(a)) / apart)
    )


def atan(a: Array, b: Array) -> Array:
    # The angle between (1, a) and (1, b), which is less than half a turn.
    return angle_ratio(b - a, 1 + a * b)


def atanh(a: Array, b: Array) -> Array:
    d, total = b - a, 1 - a * b
    near = jnp.abs(d) < SMALL_RATIO * jnp.abs(total)
    # Beyond 1 this is the quotient of the inverse of coth, which has the same slope.
    inside = lambda x: jnp.arctanh(
        jnp.where(jnp.abs(x) > 1, 1 / jnp.where(x == 0, 1, x), x)
    )
    return series_or_quotient(near, d, total, _atanhc, inside(b) - inside(a))


def angle_ratio(cross: Array, dot: Array) -> Array:
    """The angle `atan2(cross, dot)` over `cross`."""
    near = jnp.abs(cross) < SMALL_RATIO * dot
    angle = jnp.arctan2(jnp.where(near, 0, cross), jnp.where(near, 1, dot))
    return series_or_quotient(near, cross, dot, atanc, angle)


def absolute(a: Array, b: Array) -> Array:
    size = jnp.abs(a) + jnp.abs(b)
    ordinary = (size > 0) & jnp.isfinite(size)
    ratio = jnp.where(ordinary, a + b, 0) / jnp.where(ordinary, size, 1)
    return jnp.where(ordinary, ratio, jnp.sign(a))


def smooth(function: Callable[[Array], Array], reach: float) -> Quotient:
    """The quotient of a smooth function without an addition theorem.

    Within `reach` it is the mean of the derivative by Gauss quadrature, which is exact to
    round-off if `reach` is well within the radius of convergence of the function's series.
    Beyond, it is the plain quotient, in which hardly anything cancels.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_POINTS)

    def quotient(a: Array, b: Array) -> Array:
        mid, half = 0.5 * (a + b), 0.5 * (b - a)
        near = jnp.abs(half) * (1 + jnp.abs(mid)) < reach
        inner = jnp.where(near, half, 0)
        mean = jnp.zeros_like(a)
        for x, w in zip(nodes.tolist(), weights.tolist(), strict=True):
            point = mid + x * inner
            slope = jax.jvp(function, (point,), (jnp.ones_like(point),))[1]
            mean = mean + 0.5 * w * slope
        far = (function(b) - function(a)) / jnp.where(near, 1, b - a)
        return jnp.where(near, mean, far)

    return quotient


def _even(series: Sequence[float]) -> Callable[[Array], Array]:
    """An even function near zero, by its series in `x**2`.

    Its derivative has a series of its own, so that it is one number for all directions.
    """
    slopes = [2 * k * coefficient for k, coefficient in enumerate(series)][1:]

    @jax.custom_jvp
    def function(x: Array) -> Array:
        return _polynomial(series, x * x)

    @function.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        (x,), (d,) = primals, tangents
        return function(x), x * _polynomial(slopes, x * x) * d

    return function


def _polynomial(coefficients: Sequence[float], x: Array) -> Array:
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


def _factorials(sign: int) -> list[float]:
    return [sign**k / math.factorial(2 * k + 1) for k in range(_TERMS_OF_SIN)]


def _odd_numbers(sign: int) -> list[float]:
    return [sign**k / (2 * k + 1) for k in range(_TERMS_OF_ATAN)]


_sinc = _even(_factorials(-1))
_sinhc = _even(_factorials(1))
atanc = _even(_odd_numbers(-1))
_atanhc = _even(_odd_numbers(1))
