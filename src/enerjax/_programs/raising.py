"""Errors that a program raises when it runs, also where only derivatives are asked for."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._types import Scalar


def raising(check: Callable[[PyTree], PyTree], tree: PyTree) -> PyTree:
    """`check(tree)`, which is `tree` or raises an error when the program runs.

    XLA leaves out a check of values that nobody reads, and the derivatives of a run do not
    read its result. Here a factor of all rates, which is one, is checked too.
    """
    one = check(jnp.ones(()))
    guard = lambda x: _guarded(x, one) if eqx.is_inexact_array(x) else x
    return jax.tree.map(guard, check(tree))


@jax.custom_jvp
def _guarded(x: Array, one: Scalar) -> Array:
    del one
    return x


@_guarded.defjvp
def _guarded_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (x, one), (rate, _) = primals, tangents
    return x, rate * one.astype(rate.dtype)
