"""The squares in a sum, by which plain potentials tell the stiffness of their springs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from enerjax._programs import squares_in

from .helpers import EPS


K = jnp.array([1.0, 2.0, 3.0])
Q = jnp.array([0.3, -0.4, 0.9, 1.3, 0.2, -0.6])


def _of_distance(q):
    return (jnp.linalg.norm(q[:3] - q[3:]) - 1.5) ** 2


# Functions that are sums of squares alone, and how many squares each has.
SUMS = {
    "power": (lambda q: 0.5 * 7.0 * (q[0] - 1) ** 2, 1),
    "product with itself": (lambda q: 0.5 * K[1] * q[0] * q[0] + q[1] * q[1] / 3, 2),
    "factors on both sides": (lambda q: (K[0] * q[0]) * (K[2] * q[0]), 1),
    "square": (lambda q: jnp.sum(K * jnp.square(q[:3] - q[3:])), 3),
    "dot product": (lambda q: jnp.dot(q, q) / 2, 6),
    "weights": (lambda q: 0.5 * K @ (q[:3] - 1) ** 2, 3),
    "weighted by one": (lambda q: jax.vmap(lambda x: x @ x)(q.reshape(2, 3)) @ K[:2], 6),
    "weighted dot products": (
        lambda q: jnp.sum(K[:2] * jax.vmap(lambda x: x @ x)(q.reshape(2, 3))),
        6,
    ),
    "sums of sums": (lambda q: jnp.sum(K * jnp.sum(q.reshape(2, 3) ** 2, axis=0)), 6),
    "a function within": (lambda q: jax.jit(_of_distance)(q) * 4.0, 1),
    "negative": (lambda q: -((-q[0]) ** 2) - (2.0 - q[1] ** 2), 2),
}


@pytest.mark.parametrize("name", SUMS)
def test_all_squares_of_a_sum_are_found(name):
    fn, count = SUMS[name]
    found = squares_in(fn, Q)
    assert sum(x.value.size for x in found) == count
    # What is left of the second derivative is that of the squares, `2 c x x''`.
    own = lambda q: sum(jnp.sum(x.coefficient * x.value**2) for x in squares_in(fn, q))
    if count > 0:
        np.testing.assert_allclose(
            jax.grad(own)(Q), jax.grad(fn)(Q), rtol=0, atol=100 * EPS
        )


REST = {
    "linear": lambda q: 9.81 * q[0],
    "a coefficient that varies": lambda q: q[1] * q[0] ** 2,
    "a quotient that varies": lambda q: q[0] ** 2 / q[1],
    "another power": lambda q: q[0] ** 4,
    "squares within a function": lambda q: jnp.sqrt(q[0] ** 2 + q[1] ** 2),
    "a product of two": lambda q: q[0] * q[1],
    "a quadratic form": lambda q: q[:3] @ jnp.diag(K) @ q[:3],
}


@pytest.mark.parametrize("name", REST)
def test_nothing_else_is_taken_for_a_square(name):
    assert squares_in(REST[name], Q) == []


def test_squares_beside_other_terms_are_found():
    of_both = lambda q: sum(rest(q) for rest in REST.values()) + 3.0 * q[5] ** 2
    (square,) = squares_in(of_both, Q)
    np.testing.assert_allclose(square.coefficient, 3.0)
    np.testing.assert_allclose(square.value, Q[5])
