"""Whether discrete gradients are what a scheme takes them for, tried at the start."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._discrete import AbstractCorrected, AbstractDerivative, ChainRule
from .._programs import is_known
from .._system import (
    AbstractSystem,
    describe,
    direction_without_symmetry,
    energies,
    State,
    System,
)
from .._types import Args, Flag, Scalar
from ..schemes import AbstractScheme


# Round-off of gradients and differences of them, in units of that of their entries.
_ROUND_OFF = 1e4
# How far apart the two points are where one is not enough, of the coordinates.
_APART = 1e-3


def check_derivatives(
    scheme: AbstractScheme, system: AbstractSystem, state: State, args: Args
) -> None:
    """Raises where a discrete gradient contradicts the function that it is of.

    `D(a, a)` must be the gradient at `a`, and `D(a, b) . (b - a)` the difference of the
    values. Those that are corrections of a mean gradient satisfy both as they are made.
    """
    is_derivative = lambda x: isinstance(x, AbstractDerivative)
    for derivative in jax.tree.leaves(scheme, is_leaf=is_derivative):
        if not is_derivative(derivative) or isinstance(derivative, AbstractCorrected):
            continue
        found = _facts(derivative, system, state, args)
        if not is_known(found):  # the functions of the system close over traced numbers
            return
        for (role, fn, _), (is_gradient, is_directional) in zip(
            _functions(system, state, args), found, strict=True
        ):
            own = f"`{type(derivative).__name__}`"
            if not is_gradient:
                raise ValueError(
                    f"{describe(role, fn)}: its discrete gradient by {own} is not its "
                    f"gradient at the start, q = {state.q}, where both ends of an interval "
                    "are the same. Forces would be wrong, and the balance of the energy "
                    "would not tell. " + _remedy(derivative)
                )
            if not is_directional:
                raise ValueError(
                    f"{describe(role, fn)}: {own} violates `D . (b - a) = f(b) - f(a)` "
                    f"near the start, q = {state.q}, and with it the energy would not be "
                    "kept. If that is intended set `is_directional = False` in the class: "
                    "`solution.audit` then shows what is lost or gained."
                )


def _remedy(derivative: AbstractDerivative) -> str:
    if isinstance(derivative, ChainRule):
        return (
            "Does the function give a derivative of its own (`jax.custom_jvp`) that is "
            "not symmetric, or is it stepped? `derivative=MeanValue()` takes `jax.grad` of "
            "the function as a whole."
        )
    return "Its method `gradient` must be consistent: `D(a, a) = jax.grad(fn)(a)`."


def _functions(
    system: AbstractSystem, state: State, args: Args
) -> list[tuple[str, Callable, tuple]]:
    """The functions that discrete gradients are taken of, and their arguments."""
    constant = isinstance(system, System)
    found = [x for x in energies(system, state, args) if x[0] != "kinetic" or not constant]
    if system.constraint is not None:
        found.append(("constraint", system.constraint, (state.q, args)))
    if system.driven is not None:
        found.append(("driven", system.driven, (state.q, state.t, args)))
    return found


@eqx.filter_jit
def _facts(
    derivative: AbstractDerivative, system: AbstractSystem, state: State, args: Args
) -> list[tuple[Flag, Flag]]:
    return [
        _tried(derivative, *_as_one_number(fn, inputs))
        for _, fn, inputs in _functions(system, state, args)
    ]


def _as_one_number(fn: Callable, inputs: tuple) -> tuple[Callable, Float[Array, " n"]]:
    """A function of one vector: of all but `args`, with its rows summed up unequally."""
    *variables, args = inputs
    flat, unravel = ravel_pytree(variables)

    def value(x: Array) -> Scalar:
        rows = jnp.ravel(fn(*unravel(x), args))
        return rows @ jnp.cos(jnp.arange(rows.size, dtype=rows.dtype))

    return value, flat


def _tried(
    derivative: AbstractDerivative, fn: Callable[[Any], Scalar], x: Float[Array, " n"]
) -> tuple[Flag, Flag]:
    """Whether `D(a, a)` is the gradient, and `D(a, b)` directional."""
    eps = _ROUND_OFF * jnp.finfo(x.dtype).eps
    near = x + _APART * (1 + jnp.abs(x)) * direction_without_symmetry(x)
    both = lambda x: (derivative.gradient(fn, x, x), jax.grad(fn)(x))
    discrete, exact = jax.lax.map(both, jnp.stack([x, near]))
    # At an equilibrium the gradient vanishes, and its terms do not: how it changes tells.
    size = jnp.max(jnp.abs(exact)) + jnp.max(jnp.abs(exact[1] - exact[0])) / _APART
    off = jnp.max(jnp.abs(discrete - exact), axis=1)
    # At a kink, which one of two points may have, the gradient is what JAX takes it for.
    is_gradient = jnp.any(off <= eps * size)
    if isinstance(derivative, ChainRule) or not derivative.is_directional:
        return is_gradient, jnp.array(True)
    mean = derivative.gradient(fn, x, near)
    change, values = mean @ (near - x), (fn(x), fn(near))
    terms = abs(values[0]) + abs(values[1]) + abs(mean) @ (abs(x) + abs(near))
    return is_gradient, jnp.abs(change - (values[1] - values[0])) <= eps * terms
