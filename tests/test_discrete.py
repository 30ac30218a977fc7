"""Discrete gradients: the identity, the limit, and every derivative of both."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import EPS


FORMS = {
    "gonzalez": ej.Gonzalez(),
    "mean value, 1 point": ej.MeanValue(points=1),
    "mean value, 2 points": ej.MeanValue(),
    "mean value, 3 points": ej.MeanValue(points=3),
}
form_names = pytest.mark.parametrize("form", FORMS)


def mixed(q):
    """Norms, exponentials and inverse powers of three points in space."""
    x = q.reshape(3, 3)
    ab, bc = x[1] - x[0], x[2] - x[1]
    r = jnp.sqrt(ab @ ab)
    return (r - 0.7) ** 2 + jnp.exp(-bc @ bc) + 0.3 / (1 + x[0] @ x[2]) ** 2 + jnp.cos(r)


def quadratic(q):
    return 0.5 * q @ (jnp.arange(1.0, 10.0) * q) - 3 * q[4] + q[0] * q[1] + 2


# Compiled as a whole: every operation that runs by itself is compiled by itself.
mixed_value, mixed_gradient = jax.jit(mixed), jax.jit(jax.grad(mixed))
quadratic_gradient = jax.jit(jax.grad(quadratic))
half_hessian = jax.jit(lambda a: jax.hessian(mixed)(a) / 2)


@functools.cache
def gradient(form, fn=mixed):
    return jax.jit(functools.partial(FORMS[form].gradient, fn))


@functools.cache
def derivative(form):
    """Of the discrete gradient of `mixed`, by the end of the increment."""
    return jax.jit(jax.jacfwd(gradient(form), argnums=1))


def points(seed, increment):
    random = np.random.default_rng(seed)
    a, direction = random.uniform(0.5, 1.5, size=(2, 9))
    return jnp.asarray(a), jnp.asarray(a + increment * (direction - 1.0))


def of_one(q):
    return jnp.sin(3 * q[0]) + q[0] ** 4


def combined(q):
    return 2.0 * mixed(q) - 3.0 * quadratic(q)


@functools.partial(jax.jit, static_argnums=0)
def round_off(fn, a, b):
    """The resolution of `fn`: what no algorithm that evaluates it can be asked to beat."""
    size = abs(fn(a)) + abs(fn(b)) + abs(jax.grad(fn)((a + b) / 2)) @ (abs(a) + abs(b))
    return 20 * EPS * (size + abs(jax.grad(fn)(b)) @ abs(b - a))


@form_names
@pytest.mark.parametrize(
    "increment", [10.0, 1.0, 1e-1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-13, 1e-16, 0.0]
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_directionality_holds_to_round_off(form, increment, seed):
    a, b = points(seed, increment)
    d = gradient(form)(a, b)
    assert np.all(np.isfinite(d))
    defect = abs(d @ (b - a) - (mixed_value(b) - mixed_value(a)))
    assert defect <= round_off(mixed, a, b)


@form_names
@pytest.mark.parametrize("increment", [1.0, 1e-3, 1e-7, 0.0])
def test_the_points_can_be_exchanged(form, increment):
    a, b = points(3, increment)
    forth, back = (gradient(form)(*pair) for pair in ((a, b), (b, a)))
    # Round-off: of the correction, divided by the length of the increment.
    length = max(increment, 1e-8)
    np.testing.assert_allclose(forth, back, rtol=0, atol=100 * EPS * (1 + 1 / length))


@form_names
def test_the_limit_is_the_gradient(form):
    a, b = points(4, 0.0)
    np.testing.assert_allclose(
        gradient(form)(a, b), mixed_gradient(a), rtol=0, atol=20 * EPS
    )


@form_names
def test_the_limit_is_approached_with_second_order(form):
    a, direction = points(5, 0.0)[0], points(6, 1.0)[1]
    error = []
    for h in (2e-2, 1e-2):
        left, right = a - h * direction, a + h * direction
        error.append(np.max(np.abs(gradient(form)(left, right) - mixed_gradient(a))))
    # Truncation.
    assert np.log2(error[0] / error[1]) == pytest.approx(2, abs=0.1)


@form_names
@pytest.mark.parametrize("increment", [10.0, 1.0, 1e-3, 1e-9, 0.0])
def test_midpoint_gradient_is_exact_for_quadratic_functions(form, increment):
    a, b = points(7, increment)
    d = gradient(form, quadratic)(a, b)
    exact = quadratic_gradient((a + b) / 2)
    scale = float(np.max(np.abs(exact)))
    # Round-off of the function, of which the correction sees a difference.
    resolution = float(round_off(quadratic, a, b)) / max(increment, 1e-8)
    np.testing.assert_allclose(d, exact, rtol=0, atol=20 * EPS * scale + resolution)


@form_names
@pytest.mark.parametrize(("a", "b"), [(0.3, 1.9), (-2.0, 1.0), (0.5, 0.5 + 1e-3)])
def test_in_one_dimension_it_is_the_quotient(form, a, b):
    d = gradient(form, of_one)(jnp.array([a]), jnp.array([b]))
    quotient = (np.sin(3 * b) + b**4 - np.sin(3 * a) - a**4) / (b - a)
    # Round-off of the difference.
    np.testing.assert_allclose(d[0], quotient, rtol=0, atol=40 * EPS / abs(b - a))


@form_names
@pytest.mark.parametrize("increment", [0.5, 0.0])
def test_it_is_linear_in_the_function(form, increment):
    a, b = points(8, increment)
    both = gradient(form, combined)(a, b)
    parts = 2.0 * gradient(form)(a, b) - 3.0 * gradient(form, quadratic)(a, b)
    # Round-off, of sizes up to a hundred, over the increment.
    np.testing.assert_allclose(both, parts, rtol=0, atol=1e4 * EPS)


@form_names
@pytest.mark.slow_for("mean value, 3 points")
def test_derivatives_at_equal_points_are_those_of_the_limit(form):
    a, _ = points(9, 0.0)
    # D(a, b) = grad fn(a) + Hess fn(a) (b - a) / 2 + ...
    first = derivative(form)(a, a)
    np.testing.assert_allclose(first, half_hessian(a), rtol=0, atol=100 * EPS)
    by_end = jax.jacrev(gradient(form), argnums=1)
    value_too = lambda a, b: (by_end(a, b),) * 2
    second, reverse = jax.jit(jax.jacfwd(value_too, argnums=1, has_aux=True))(a, a)
    np.testing.assert_allclose(reverse, first, rtol=0, atol=100 * EPS)
    assert np.all(np.isfinite(second))


@form_names
@pytest.mark.parametrize("increment", [1e-3, 1e-7, 1e-12, 1e-16])
def test_derivatives_stay_bounded_near_equal_points(form, increment):
    a, b = points(10, increment)
    first = derivative(form)(a, b)
    limit = half_hessian(a)
    assert np.all(np.isfinite(first))
    # Truncation; nothing is amplified by the division by the increment.
    assert np.max(np.abs(first - limit)) <= 0.1 * float(np.max(np.abs(limit)))


def test_gauss_points_bring_it_nearer_to_the_mean_value():
    a, b = points(11, 0.5)
    nodes, weights = np.polynomial.legendre.leggauss(20)
    mean = sum(
        w / 2 * mixed_gradient((a + b) / 2 + x / 2 * (b - a))
        for x, w in zip(nodes, weights, strict=True)
    )
    error = {name: float(np.max(np.abs(gradient(name)(a, b) - mean))) for name in FORMS}
    assert error["mean value, 1 point"] == pytest.approx(error["gonzalez"], rel=1e-6)
    assert error["mean value, 2 points"] < 0.2 * error["gonzalez"]
    assert error["mean value, 3 points"] < 0.2 * error["mean value, 2 points"]


@form_names
def test_it_can_be_compiled_and_batched(form):
    pairs = [points(seed, 0.3) for seed in range(3)]
    a, b = (jnp.stack(x) for x in zip(*pairs, strict=True))
    gradient = lambda a, b: FORMS[form].gradient(mixed, a, b)
    batch = jax.jit(jax.vmap(gradient))(a, b)
    for row, pair in zip(batch, pairs, strict=True):
        # Round-off over the increment.
        np.testing.assert_allclose(row, gradient(*pair), rtol=0, atol=1e-13)
