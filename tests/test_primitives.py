"""One classification of the primitives of JAX serves every reader of programs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._programs import jacobian_pattern, primitives, shape_of


BASIC = [
    "ARITHMETIC",
    "ELEMENTARY",
    "CHOICES",
    "COMPONENTS",
    "PIECEWISE_CONSTANT",
    "COMPARISONS",
    "LOGIC",
    "BITS",
    "DATA_MOVEMENT",
    "REDUCTIONS",
    "LOGICAL_REDUCTIONS",
    "PLACES_OF_EXTREMES",
    "CALLS",
    "CONTROL_FLOW",
]


def test_a_primitive_is_in_one_basic_class_only():
    for pair in itertools.combinations(BASIC, 2):
        one, other = (set(getattr(primitives, name)) for name in pair)
        assert not one & other, pair


# What these move had a rule in some modules only, while each had a list of its own.
MOVES = {
    "tile": lambda x: jnp.tile(x, 2),
    "unstack": lambda x: jnp.concatenate(jnp.unstack(x.reshape(2, -1))),
    "stack": lambda x: jnp.stack([x, x]),
}


@pytest.mark.parametrize("name", MOVES)
def test_moved_entries_have_a_discrete_rule(name):
    move = MOVES[name]
    fn = lambda x: jnp.sum(jnp.sin(move(x)) ** 3)
    a, b = jnp.linspace(0.1, 0.7, 6), jnp.linspace(0.4, -0.3, 6)
    assert ej.discrete_fallbacks(fn)(a, b) == []
    change = ej.discrete_grad(fn)(a, b) @ (b - a)
    np.testing.assert_allclose(change, fn(b) - fn(a), rtol=1e-14)


@pytest.mark.parametrize("name", MOVES)
def test_moved_entries_keep_the_pattern_sparse(name):
    fn = lambda x: jnp.ravel(MOVES[name](x))
    x = jnp.linspace(0.1, 0.7, 6)
    pattern = jacobian_pattern(fn, x)
    assert pattern is not None
    assert shape_of(pattern) == (fn(x).size, x.size)
    np.testing.assert_array_equal(pattern.toarray(), jax.jacobian(fn)(x) != 0)
