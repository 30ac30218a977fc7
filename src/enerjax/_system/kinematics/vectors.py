"""Vectors in space, of all bodies at once.

A vector is an array of shape `(3, bodies)`. The axes of all bodies are one of shape
`(3, 3, bodies)`: first the number of the axis, then the component. Formulas for such arrays
have a third of the operations that formulas for single components have, so they are traced
faster. Their compiled programs are as fast.
"""

import functools
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


Component: TypeAlias = Float[Array, " bodies"]
Vector3: TypeAlias = Float[Array, "3 bodies"]
# The directors of each body, their rates, or gradients with respect to them.
Axes: TypeAlias = Float[Array, "3 3 bodies"]


def dot(a: Vector3, b: Vector3) -> Component:
    return jnp.sum(a * b, axis=0)


def cross(
    a: Float[Array, "*n 3 bodies"], b: Float[Array, "*n 3 bodies"]
) -> Float[Array, "*n 3 bodies"]:
    (a1, a2), (b1, b2) = _next_two(a, axis=-2), _next_two(b, axis=-2)
    return a1 * b2 - a2 * b1


def sum_of_products(a: Axes, b: Axes) -> Vector3:
    """`sum a_i x b_i`"""
    return jnp.sum(cross(a, b), axis=0)


def in_axes(axes: Axes, vector: Vector3) -> Vector3:
    """The components of a vector in body axes."""
    return jnp.sum(axes * vector[None], axis=1)


def all_in_axes(axes: Axes, vectors: Axes) -> Axes:
    """The components of three vectors in body axes."""
    return jnp.sum(axes[None] * vectors[:, None], axis=2)


def rates_of_directors(axes: Axes, spin: Vector3) -> Axes:
    """The rates `R (W x e_i)` of the directors; linear in the directors."""
    (w1, w2), (d1, d2) = _next_two(spin, axis=0), _next_two(axes, axis=0)
    return w2[:, None] * d1 - w1[:, None] * d2


def _next_two(x: Array, axis: int) -> tuple[Array, Array]:
    """The entries `1, 2, 0` and `2, 0, 1` along an axis of three."""
    cut = functools.partial(jax.lax.slice_in_dim, axis=axis)
    twice = jnp.concatenate([x, cut(x, 0, 2)], axis)
    return cut(twice, 1, 4), cut(twice, 2, 5)
