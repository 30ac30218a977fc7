"""The identity of the chain rule on random programs over all rules."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import enerjax as ej


SIZE = 4
INCREMENTS = (10.0, 1.0, 1e-4, 1e-8, 1e-16, 0.0)
MATRIX = np.random.default_rng(1).normal(size=(SIZE, SIZE)) / 2


def _matrix(x):
    return jnp.asarray(MATRIX, x.dtype)


def _regular(x, y):
    return 6 * jnp.eye(SIZE, dtype=x.dtype) + jnp.outer(jnp.sin(x), jnp.cos(y))


def _definite(x):
    return 3 * jnp.eye(SIZE, dtype=x.dtype) + jnp.outer(jnp.tanh(x), jnp.tanh(x))


def _scan(x, y):
    body = lambda carry, z: (0.5 * jnp.sin(carry) + z * carry[::-1] / 3, carry * z)
    return jax.lax.scan(body, x, y)[0]


# Bounded on bounded inputs, so that no program overflows; every rule of the table.
UNARY = {
    "sin": jnp.sin,
    "cos": jnp.cos,
    "tan": lambda x: jnp.tan(jnp.tanh(x)),
    "exp": lambda x: jnp.exp(-x * x),
    "exp2": lambda x: jnp.exp2(jnp.sin(x)),
    "expm1": lambda x: jnp.expm1(jnp.cos(x)),
    # The noise of a step does not tell the rounding of `1 + x^2`, which would cancel.
    "log": lambda x: jnp.log(2 + x * x),
    "log1p": lambda x: jnp.log1p(x**2),
    "sqrt": lambda x: jnp.sqrt(1 + x * x),
    "rsqrt": lambda x: jax.lax.rsqrt(1 + x * x),
    "cbrt": lambda x: jnp.cbrt(1 + x * x),
    "powers": lambda x: (1 + x * x) ** 0.3 + (1 + x * x) ** -1.5,
    "cube": lambda x: jnp.tanh(x) ** 3,
    "inverse square": lambda x: (1 + x**2) ** -2,
    "asin": lambda x: jnp.arcsin(0.9 * jnp.sin(x)),
    "acos": lambda x: jnp.arccos(0.9 * jnp.cos(x)),
    "atan": jnp.arctan,
    "sinh": lambda x: jnp.sinh(jnp.sin(x)),
    "cosh": lambda x: jnp.cosh(jnp.cos(x)),
    "tanh": jnp.tanh,
    "asinh": jnp.arcsinh,
    "acosh": lambda x: jnp.arccosh(2.5 + jnp.sin(x)),
    "atanh": lambda x: jnp.arctanh(0.8 * jnp.sin(x)),
    "logistic": jax.nn.sigmoid,
    "softplus": jax.nn.softplus,
    "erf": jax.scipy.special.erf,
    "abs": jnp.abs,
    "clip": lambda x: jnp.clip(x, -0.7, 0.9),
    "flip": lambda x: x[::-1],
    "gather": lambda x: x[jnp.array([2, 0, 0, 3])],
    "cumsum": lambda x: jnp.cumsum(x) / 3,
    "pad": lambda x: jnp.pad(x, 1)[:-2],
    "stack": lambda x: jnp.stack([x, 2 * x]).sum(axis=0) / 3,
    "split": lambda x: jnp.concatenate(jnp.split(x, 2)[::-1]),
    "update": lambda x: x.at[1].set(x[2] / 2).at[0].add(x[3]),
    "dynamic": lambda x: jax.lax.dynamic_update_slice(
        x, jax.lax.dynamic_slice(x, (1,), (2,)) / 2, (0,)
    ),
    "linear": lambda x: _matrix(x) @ x,
    "norm": lambda x: x / jnp.linalg.norm(jnp.append(x, jnp.ones((), x.dtype))),
    "max": lambda x: x - jnp.max(x),
    "product": lambda x: jnp.prod(jnp.cos(x)) * x,
    "cholesky": lambda x: jnp.linalg.cholesky(_definite(x)) @ x / 3,
    "det": lambda x: jnp.log(jnp.linalg.det(_definite(x))) * jnp.sin(x),
    "jit": lambda x: jax.jit(lambda y: y * jnp.sin(y))(x),
    "remat": lambda x: jax.checkpoint(lambda y: jnp.cos(y) ** 2)(x),
}
BINARY = {
    "add": lambda x, y: (x + y) / 2,
    "sub": lambda x, y: (x - y) / 2,
    "mul": lambda x, y: x * jnp.tanh(y),
    "div": lambda x, y: x / (1 + y * y),
    "pow": lambda x, y: (1 + x * x) ** jnp.sin(y),
    "hypot": lambda x, y: jnp.hypot(x, 1 + jnp.abs(y)) / 2,
    "atan2": lambda x, y: jnp.arctan2(x, 1 + y * y),
    "maximum": jnp.maximum,
    "minimum": jnp.minimum,
    "where": lambda x, y: jnp.where(x > y, jnp.sin(x), y / 2),
    "einsum": lambda x, y: jnp.einsum("i,j,ij->j", x, y, _matrix(x)) / 4,
    "cross": lambda x, y: jnp.append(jnp.cross(x[:3], jnp.cos(y[1:])), y[0]),
    "solve": lambda x, y: jnp.linalg.solve(_regular(x, y), y),
    "inverse": lambda x, y: jnp.linalg.inv(_regular(x, y)) @ x,
    "triangular": lambda x, y: jax.scipy.linalg.solve_triangular(
        _definite(x), y, lower=True
    ),
    "cond": lambda x, y: jax.lax.cond(
        x[0] > 0, lambda x, y: x * y[::-1] / 2, lambda x, y: jnp.sin(x) - y / 2, x, y
    ),
    "scan": _scan,
}
STEP = st.one_of(
    st.tuples(st.sampled_from(sorted(UNARY)), st.integers(0, 99)),
    st.tuples(st.sampled_from(sorted(BINARY)), st.integers(0, 99), st.integers(0, 99)),
)


def build(steps):
    """A scalar function; `noise` perturbs every entry of what is between, relatively."""

    def program(x, noise):
        values = [x]
        for (name, *operands), eps in zip(steps, noise, strict=True):
            chosen = [values[-1 - k % len(values)] for k in operands]
            function = UNARY.get(name) or BINARY[name]
            # Values inside of a step count as well: the inputs are perturbed too.
            chosen = [c * (1 + eps[0]) for c in chosen]
            values.append(function(*chosen) * (1 + eps[1]))
        return jnp.sum(values[-1] * values[len(values) // 2])

    return program


@functools.partial(jax.jit, static_argnums=0)
def _defect(function, silent, a, b):
    """The defect in units of what rounding every intermediate value once would do."""
    value = lambda x: function(x, silent)
    change = ej.discrete_jvp(value, a, b)(b - a)
    size = jnp.zeros((), a.dtype)
    for x in (a, b):
        by_input, by_noise = jax.grad(function, argnums=(0, 1))(x, silent)
        size += jnp.sum(jnp.abs(by_noise)) + jnp.abs(by_input) @ jnp.abs(x)
        size += jnp.abs(value(x))
    # The discrete derivative passes between the points: a product of a factor that is large
    # at one of them and a factor that is large at the other is large in no value.
    between = ej.discrete_grad(lambda inputs: function(*inputs))((a, silent), (b, silent))
    size += jnp.sum(jnp.abs(between[1])) + jnp.abs(between[0]) @ (jnp.abs(a) + jnp.abs(b))
    unit = jnp.finfo(a.dtype).eps * size + jnp.finfo(a.dtype).tiny
    return jnp.abs(change - (value(b) - value(a))) / unit


def _check(steps, point):
    program = build(steps)
    for dtype, increment in itertools.product((jnp.float64, jnp.float32), INCREMENTS):
        a = jnp.asarray(point[:SIZE], dtype)
        b = a + jnp.asarray(increment, dtype) * jnp.asarray(point[SIZE:], dtype)
        silent = jnp.zeros((len(steps), 2, SIZE), dtype)
        assert _defect(program, silent, a, b) <= 50, increment
    # A process can map only so many of them, and no other example has this one.
    _defect.clear_cache()  # pyright: ignore[reportAttributeAccessIssue]


PROGRAMS = dict(
    steps=st.lists(STEP, min_size=1, max_size=6),
    point=st.lists(st.floats(-2, 2, width=16), min_size=2 * SIZE, max_size=2 * SIZE),
)


@settings(max_examples=3, deadline=None, derandomize=True, database=None)
@given(**PROGRAMS)
@pytest.mark.slow
def test_the_identity_holds_on_random_programs(steps, point):
    _check(steps, point)


@pytest.mark.slow
@settings(max_examples=500, deadline=None, derandomize=True, database=None)
@given(**PROGRAMS)
def test_the_identity_holds_on_many_random_programs(steps, point):
    _check(steps, point)
