"""The chain rule for difference quotients: identity, symmetry, limits, complete rules."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import long


MATRIX = jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)))
POINT = jnp.array([0.3, -0.8, 1.1, 0.6])
DIRECTION = jnp.array([0.9, 0.4, -1.3, 0.7])
INCREMENTS = (10.0, 1.0, 1e-3, 1e-8, 1e-16, 0.0)


def _spd(x):
    return 3 * jnp.eye(4) + jnp.outer(x, x) + jnp.diag(jnp.sin(x) ** 2)


def _square(x):
    return MATRIX + 6 * jnp.eye(4) + jnp.outer(x, jnp.cos(x))


# One function a family of rules; together they use every rule of the table.
FUNCTIONS = {
    "quadratic": lambda x: x @ MATRIX @ x - 3 * x[1],
    "inverse distance": lambda x: 1 / jnp.linalg.norm(x[:2] - x[2:]),
    "circular": lambda x: jnp.sum(
        jnp.sin(x) * jnp.cos(x[::-1]) + jnp.tan(0.1 * jnp.sin(x))
    ),
    "exponential": lambda x: jnp.sum(jnp.exp(x / 3) + jnp.exp2(x / 3) + jnp.expm1(-x / 3)),
    "logarithm": lambda x: jnp.sum(jnp.log(1 + x * x) + jnp.log1p(x**2)),
    "powers": lambda x: jnp.sum((x * x + 0.1) ** 1.5 + (x * x + 0.1) ** -0.3 + x**5),
    "varying power": lambda x: jnp.sum((x * x + 0.1) ** (x / 9)),
    "roots": lambda x: jnp.sum(jnp.cbrt(x * x + 0.1) + jax.lax.rsqrt(x * x + 1)),
    "hyperbolic": lambda x: jnp.sum(jnp.sinh(x / 3) + jnp.cosh(x / 3) + jnp.tanh(x)),
    "area": lambda x: (
        jnp.sum(jnp.arcsinh(x) + jnp.arccosh(1.1 + x * x))
        + jnp.sum(jnp.arctanh(0.9 * jnp.sin(x)))
    ),
    "arc": lambda x: (
        jnp.sum(jnp.arcsin(jnp.sin(x) * 0.9) + jnp.arccos(0.8 * jnp.cos(x)))
        + jnp.sum(jnp.arctan(x))
    ),
    "angle": lambda x: jnp.arctan2(x[0], x[1]) * jnp.arctan2(x[2] - x[1], x[3]),
    "special": lambda x: jnp.sum(jax.nn.softplus(x) + jax.nn.sigmoid(x) + jax.lax.erf(x)),
    "hypot": lambda x: jnp.hypot(x[0], x[1]) * jnp.hypot(x[2], x[3]),
    "extremes": lambda x: (
        jnp.max(x) * jnp.minimum(x[1], x[2]) + jnp.sum(jnp.clip(x, -1, 1))
    ),
    "branches": lambda x: (
        jnp.sum(jnp.where(x > 0.3, x * x, jnp.abs(x)))
        + jnp.where((x[0] > 0.5) & (x[1] < 0), x[2] ** 3, x[3])
    ),
    "sign": lambda x: jnp.sum(jnp.sign(x) * jnp.floor(2 * x) * x),
    "solve": lambda x: x @ jnp.linalg.solve(_square(x), jnp.cos(x)),
    "inverse": lambda x: jnp.trace(jnp.linalg.inv(_square(x)) @ MATRIX),
    "determinant": lambda x: jnp.linalg.det(_square(x)) / 1000,
    "cholesky": lambda x: jnp.sum(jnp.linalg.cholesky(_spd(x)) @ x),
    "triangular": lambda x: (
        jnp.sum(jax.scipy.linalg.solve_triangular(_spd(x), x, lower=True))
        + jnp.sum(jax.scipy.linalg.solve_triangular(_spd(x), x, trans=1))
    ),
    "cross": lambda x: jnp.sum(jnp.cross(x[:3], jnp.sin(x[1:])) ** 2),
    "einsum": lambda x: jnp.einsum("i,ij,jk,k->", x, MATRIX, MATRIX, x * x),
    "product": lambda x: jnp.prod(x + 2) + jnp.prod(jnp.outer(x, x) + 1, axis=0) @ x,
    "structure": lambda x: (
        jnp.sum(jnp.stack(jnp.split(x, 2)) ** 3)
        * jnp.mean(jnp.concatenate([x, x[jnp.array([0, 2])]]).at[1].add(x[0]))
        + jnp.sum(jnp.cumsum(jnp.pad(x, 1)) ** 2)
    ),
    "scan": lambda x: jax.lax.scan(lambda c, y: (jnp.sin(c) + c * y, c * c), x[0], x)[
        1
    ].sum(),
    "remat": lambda x: jax.checkpoint(lambda y: jnp.sum(jnp.sin(y) ** 2))(x),
    "cond": lambda x: jax.lax.cond(MATRIX[0, 0] > 0, jnp.sin, jnp.cos, x)[0] * x[1],
}
# Primitives that have no rule: the identity holds all the same.
HOLES = {
    "sort": lambda x: jnp.sort(x) @ jnp.arange(4.0),
    "gamma": lambda x: jnp.sum(jax.scipy.special.gammaln(x * x + 1)),
    "while": lambda x: jax.lax.while_loop(
        lambda c: c[0] < 3,
        lambda c: (c[0] + 1, c[1] * jnp.sin(c[2]), c[2]),
        (0, x[0], x[1]),
    )[1],
    "table": lambda x: jnp.arange(99.0)[jnp.floor(2 * x[0]).astype(int) + 40] * x[1],
    "interp": lambda x: jnp.interp(x[0], jnp.arange(-9.0, 9.0), jnp.arange(18.0) ** 2),
    "moving cond": lambda x: jax.lax.cond(x[0] > 0.5, jnp.sum, lambda y: y @ y, x),
}


def _defect(function, a, b):
    """Of the identity, in units of round-off of what enters it; and the gradient."""
    gradient = ej.discrete_grad(function)(a, b)
    change = function(b) - function(a)
    size = jnp.abs(function(a)) + jnp.abs(function(b)) + 1e-300
    size = size + jnp.abs(gradient) @ (jnp.abs(a) + jnp.abs(b))
    unit = jnp.finfo(a.dtype).eps * size
    return jnp.abs(gradient @ (b - a) - change) / unit, gradient


@functools.cache
def defect_and_gradient(name):
    # Both points are arguments, as in a step: XLA evaluates functions of constants itself,
    # some by other approximations, and equal points would not give equal values.
    return jax.jit(functools.partial(_defect, (FUNCTIONS | HOLES)[name]))


@pytest.mark.parametrize("name", [*FUNCTIONS, *HOLES])
def test_the_identity_holds_at_every_increment(name):
    for increment in INCREMENTS:
        defect, _ = defect_and_gradient(name)(POINT, POINT + increment * DIRECTION)
        assert defect <= 50, increment  # round-off


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_has_rules_and_the_points_are_interchangeable(name):
    b = POINT + DIRECTION
    assert ej.discrete_fallbacks(FUNCTIONS[name])(POINT, b) == []
    _, forth = defect_and_gradient(name)(POINT, b)
    _, back = defect_and_gradient(name)(b, POINT)
    np.testing.assert_allclose(forth, back, rtol=1e-12, atol=1e-13)  # round-off


def with_derivative(function):
    """The derivative and the value, from one program."""
    return jax.jacfwd(lambda x: (function(x),) * 2, has_aux=True)


@pytest.mark.parametrize("name", long(FUNCTIONS, "solve", "determinant", "inverse"))
@pytest.mark.slow_for(
    *("hypot", "triangular", "special", "arc", "extremes", "cross", "circular"),
    *("hyperbolic", "area", "product", "powers", "structure"),
)
def test_at_one_point_it_is_the_gradient_and_half_the_hessian(name):
    function = FUNCTIONS[name]
    gradient = lambda b: ej.discrete_grad(function)(POINT, b)
    twice = jax.jit(with_derivative(with_derivative(gradient)))
    (second, _), (forward, value) = twice(POINT)
    hessian, limit = jax.jit(with_derivative(jax.grad(function)))(POINT)
    # Round-off, with the curvature of the function.
    close = functools.partial(np.testing.assert_allclose, rtol=1e-10, atol=1e-10)
    close(value, limit)
    close(forward, 0.5 * hessian)
    close(jax.jit(jax.jacrev(gradient))(POINT), 0.5 * hessian)
    assert jnp.all(jnp.isfinite(second))


def test_primitives_without_a_rule_are_listed():
    b = POINT + DIRECTION
    assert ej.discrete_fallbacks(HOLES["sort"])(POINT, b) == ["sort"]
    assert ej.discrete_fallbacks(HOLES["gamma"])(POINT, b) == ["lgamma"]


@pytest.mark.parametrize(
    "function",
    [jnp.sin, jnp.exp, jnp.log1p, jnp.sqrt, jnp.arctan, jnp.tanh, lambda x: x**-3],
    ids=["sin", "exp", "log1p", "sqrt", "atan", "tanh", "power"],
)
def test_in_one_dimension_it_is_the_difference_quotient(function):
    a, b = jnp.array(0.7), jnp.array(2.3)
    quotient = (function(b) - function(a)) / (b - a)
    np.testing.assert_allclose(ej.discrete_grad(function)(a, b), quotient, rtol=1e-14)


def test_forces_of_distances_have_no_resultant_and_no_torque():
    def potential(x):
        points = x.reshape(3, 3)
        sides = points - jnp.roll(points, 1, axis=0)
        lengths = jnp.linalg.norm(sides, axis=1)
        bend = jnp.arccos(sides[0] @ sides[1] / (lengths[0] * lengths[1]))
        return jnp.sum(jnp.exp(-lengths)) + jnp.sum(lengths**-6) + bend**2

    a = jnp.array([0.1, 0.2, 0.0, 1.0, 0.1, 0.3, 0.4, 1.2, -0.5])
    b = a + jnp.array([0.5, -0.4, 0.9, 0.3, 0.8, -0.2, -0.7, 0.1, 0.6])

    @functools.partial(jax.jit, static_argnums=0)
    def unbalanced(derivative, a, b):
        # The discrete torque acts at the mean positions.
        middle = (0.5 * (a + b)).reshape(3, 3)
        force = derivative.gradient(potential, a, b).reshape(3, 3)
        torque = jnp.sum(jnp.cross(middle, force), axis=0)
        size = jnp.sum(jnp.abs(force)) * (1 + jnp.max(jnp.abs(middle)))
        resultant = jnp.sum(force, axis=0)
        return jnp.max(jnp.abs(jnp.concatenate([resultant, torque]))) / size

    assert unbalanced(ej.ChainRule(), a, b) <= 1e-14  # round-off
    assert (
        unbalanced(ej.Gonzalez(), a, b) > 1e-3
    )  # keeps no symmetry: not a matter of digits


def test_pytrees_and_further_arguments_pass_through():
    function = lambda x, k, power: k * x["u"] @ x["u"] + jnp.sin(x["w"]) ** power
    a = {"u": jnp.array([1.0, 2.0]), "w": jnp.array(0.3)}
    b = {"u": jnp.array([0.5, -1.0]), "w": jnp.array(0.9)}
    gradient = ej.discrete_grad(function)(a, b, 2.5, 2)
    step = jax.tree.map(jnp.subtract, b, a)
    total = gradient["u"] @ step["u"] + gradient["w"] * step["w"]
    change = function(b, 2.5, 2) - function(a, 2.5, 2)
    np.testing.assert_allclose(total, change, rtol=1e-14)
    pushed = ej.discrete_jvp(function, a, b, 2.5, 2)(step)
    np.testing.assert_allclose(pushed, change, rtol=1e-14)


def test_the_jacobian_maps_the_increment_to_the_change():
    function = lambda x: jnp.array([jnp.sin(x[0]) * x[1], x @ x, jnp.exp(x[2])])
    a, b = POINT, POINT + DIRECTION
    jacobian = ej.discrete_jacobian(function)(a, b)
    assert jacobian.shape == (3, 4)
    np.testing.assert_allclose(jacobian @ (b - a), function(b) - function(a), rtol=1e-14)


def test_it_composes_with_the_transformations_of_jax():
    function = FUNCTIONS["solve"]
    gradient = ej.discrete_grad(function)
    b = POINT + DIRECTION
    many = jnp.stack([b, b + 1, POINT])
    batched = jax.jit(jax.vmap(gradient, in_axes=(None, 0)))(POINT, many)
    single = jax.jit(gradient)
    alone = jnp.stack([single(POINT, x) for x in many])
    np.testing.assert_allclose(batched, alone, rtol=1e-12, atol=1e-14)
    total = lambda x: jnp.sum(jax.checkpoint(gradient)(POINT, x) ** 2)
    forward, reverse = jax.jit(lambda x: (jax.jacfwd(total)(x), jax.grad(total)(x)))(b)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-12)
    walked = jax.lax.scan(lambda c, x: (c + gradient(POINT, x), None), 0 * b, many)[0]
    np.testing.assert_allclose(walked, jnp.sum(alone, axis=0), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", ["quadratic", "inverse distance", "solve", "branches"])
def test_single_precision_keeps_the_identity_to_its_own_round_off(name):
    single = lambda x: FUNCTIONS[name](x.astype(jnp.float64)).astype(jnp.float32)
    defect = jax.jit(lambda a, b: _defect(single, a, b)[0])
    a = POINT.astype(jnp.float32)
    for increment in (1.0, 1e-3, 1e-7, 0.0):
        b = a + jnp.float32(increment) * DIRECTION.astype(jnp.float32)
        assert defect(a, b) <= 50


def test_unlike_or_complex_points_are_refused():
    function = FUNCTIONS["quadratic"]
    with pytest.raises(TypeError, match="alike"):
        ej.discrete_grad(function)(POINT, POINT[:3])
    with pytest.raises(TypeError, match="real"):
        ej.discrete_grad(function)(POINT.astype(complex), POINT.astype(complex))
    with pytest.raises(TypeError, match="scalar"):
        ej.discrete_grad(jnp.sin)(POINT, POINT)
