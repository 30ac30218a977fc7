"""Discrete derivatives by the chain rule, with the signatures of JAX's transformations."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._types import Coordinates, Scalar
from .base import AbstractDerivative
from .fallback import fallback
from .rules import RULES
from .transform import increment, Moving, Value, Walk


def discrete_jvp(
    fn: Callable[..., PyTree[Array]], a: PyTree[Array], b: PyTree[Array], *args: Any
) -> Callable[[PyTree[Array]], PyTree[Array]]:
    """The discrete derivative of `fn` between `a` and `b`, as a linear map.

    `D = discrete_jvp(fn, a, b, *args)` is linear, `D(b - a) = fn(b) - fn(a)` to round-off,
    symmetric in `a` and `b`, and the Jacobian-vector product at `b = a`. Composes with all
    transformations of JAX, in float64 and float32.

    **Arguments:**

    - `fn`: a function of a pytree of real arrays and of `args`.
    - `a`, `b`: the two points, pytrees of the same structure.
    - `args`: further arguments of `fn`, the same at both points.

    **Returns:** the map from pytrees like `a` to pytrees like `fn(a)`.

    **Raises:** `TypeError` if `a` and `b` differ in structure, shape or dtype, or are not
    real.
    """
    push = _traced(fn, a, b, args)
    return lambda d: push(d, Walk(RULES, fallback))


def discrete_grad(fn: Callable[..., Scalar]) -> Callable[..., PyTree[Array]]:
    """The discrete gradient of a scalar function, as a function of two points.

    `discrete_grad(fn)(a, b, *args)` is a pytree `D` like `a` with
    `D . (b - a) = fn(b) - fn(a)` to round-off and `D = grad fn(a)` at `b = a`. If `fn` is
    written in terms of invariants, such as distances of points, `D` keeps the symmetry.

    **Reference:** discrete gradients: O. Gonzalez (1996); by the chain rule for difference
    quotients, this library.
    """

    def gradient(a: PyTree[Array], b: PyTree[Array], *args: Any) -> PyTree[Array]:
        push = discrete_jvp(fn, a, b, *args)
        value, pull = jax.vjp(push, jax.tree.map(jnp.zeros_like, a))
        if jnp.shape(value) != ():
            raise TypeError(
                f"`discrete_grad` is for scalar functions, and this one has shape "
                f"{jnp.shape(value)}. Use `discrete_jacobian`."
            )
        return pull(jnp.ones_like(value))[0]

    return gradient


def discrete_jacobian(fn: Callable[..., PyTree[Array]]) -> Callable[..., PyTree[Array]]:
    """The discrete derivative of `fn` as arrays, shaped as by `jax.jacobian`.

    `discrete_jacobian(fn)(a, b, *args)` has, for each pair of leaves of `fn(a)` and `a`, an
    array of their shapes side by side.
    """

    def jacobian(a: PyTree[Array], b: PyTree[Array], *args: Any) -> PyTree[Array]:
        push = discrete_jvp(fn, a, b, *args)
        return jax.jacfwd(push)(jax.tree.map(jnp.zeros_like, a))

    return jacobian


def discrete_fallbacks(fn: Callable[..., PyTree[Array]]) -> Callable[..., list[str]]:
    """The primitives of `fn` that have no rule, as a function of two points.

    The discrete derivative of such a primitive is its corrected mean derivative. The list
    also names the functions that define their own derivative (`jax.custom_jvp`,
    `jax.custom_vjp`): that derivative is used, and not the one of the program inside. The
    list is empty if the chain rule holds for all of `fn`.
    """

    def fallbacks(a: PyTree[Array], b: PyTree[Array], *args: Any) -> list[str]:
        walk = Walk(RULES, fallback)
        push = _traced(fn, a, b, args)
        jax.eval_shape(lambda d: push(d, walk), a)
        return walk.fallbacks

    return fallbacks


def _traced(
    fn: Callable, a: PyTree[Array], b: PyTree[Array], args: tuple
) -> Callable[[PyTree[Array], Walk], PyTree[Array]]:
    """A function that maps an increment of the input to that of the output."""
    a, b = (jax.tree.map(jnp.asarray, x) for x in (a, b))
    flat_a, structure = jax.tree.flatten(a)
    flat_b, structure_b = jax.tree.flatten(b)
    types = [[(x.shape, x.dtype) for x in flat] for flat in (flat_a, flat_b)]
    if structure != structure_b or types[0] != types[1]:
        raise TypeError(f"The two points must be alike, got {types[0]} and {types[1]}.")
    if not all(jnp.issubdtype(x.dtype, jnp.floating) for x in flat_a):
        raise TypeError(f"The two points must be real arrays, got {types[0]}.")
    program, shape = jax.make_jaxpr(lambda x: fn(x, *args), return_shape=True)(a)
    dtypes = [x.dtype for x in jax.tree.leaves(shape)]
    if not all(jnp.issubdtype(dtype, jnp.floating) for dtype in dtypes):
        raise TypeError(f"The function must return real arrays, got {dtypes}.")
    out_structure = jax.tree.structure(shape)

    def push(d: PyTree[Array], walk: Walk) -> PyTree[Array]:
        inputs = list(map(Moving, flat_a, flat_b, structure.flatten_up_to(d)))
        outs = walk.closed(program, inputs)
        return out_structure.unflatten([valid_increment(x) for x in outs])

    return push


def valid_increment(value: Value) -> Array:
    """The increment of an output; NaN if the output is not finite at one of the points.

    A difference quotient can be finite where the function is not defined, such as that of
    a logarithm between two negative numbers.
    """
    if not isinstance(value, Moving):
        return increment(value)
    valid = jnp.isfinite(value.a) & jnp.isfinite(value.b)
    return jnp.where(valid, 1, jnp.nan).astype(value.d.dtype) * value.d


class ChainRule(AbstractDerivative):
    """Discrete differentiation by the chain rule: exact without a correction.

    See `discrete_grad`. The discrete gradient inherits the symmetries of the program, so
    schemes that use it conserve momenta as well as energy. Second-order accurate.
    """

    def gradient(
        self,
        fn: Callable[[Coordinates], Scalar],
        a: Coordinates,
        b: Coordinates,
        *,
        weights: Coordinates | float = 1.0,
        size: Scalar | float = 0.0,
    ) -> Coordinates:
        del weights, size  # no correction
        return discrete_grad(fn)(a, b)
