"""A check at the start of a run that discrete gradients satisfy their definition."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._discrete import AbstractCorrected, AbstractDerivative, ChainRule
from .._programs import compiled_for_once, is_known
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
from .experience import Experience


# The round-off of a gradient may be this many times that of its entries.
_ROUND_OFF = 1e4
# The distance of the two points, relative to the coordinates: large against round-off, and
# small enough to stay where the functions are defined.
_DISTANCE = 1e-3


def check_derivatives(
    scheme: AbstractScheme,
    system: AbstractSystem,
    state: State,
    args: Args,
    experience: Experience,
) -> None:
    """Raises an error for a discrete gradient that violates its definition.

    `D(a, a)` must be the gradient at `a`, and `D(a, b) . (b - a)` the difference of the
    values. Corrected mean gradients satisfy both by construction and are not checked. What
    has passed is not checked again with other numbers: the check takes as long as hundreds
    of steps of a small system.
    """
    if experience.has_valid_gradients:
        return
    is_derivative = lambda x: isinstance(x, AbstractDerivative)
    for derivative in jax.tree.leaves(scheme, is_leaf=is_derivative):
        if not is_derivative(derivative) or isinstance(derivative, AbstractCorrected):
            continue
        found = _facts(derivative, system, state, args)
        if not is_known(found):  # the functions of the system close over tracers
            return
        for (role, fn, _), (is_gradient, is_directional) in zip(
            _functions(system, state, args), found, strict=True
        ):
            name = f"`{type(derivative).__name__}`"
            if not is_gradient:
                raise ValueError(
                    f"{describe(role, fn)}: its discrete gradient `D(a, a)` by {name} is "
                    f"not its gradient at the start, a = {state.q}. Forces would be wrong, "
                    "and the balance of the energy would not show it. "
                    + _remedy(derivative)
                )
            if not is_directional:
                raise ValueError(
                    f"{describe(role, fn)}: {name} violates `D . (b - a) = f(b) - f(a)` "
                    f"near the start, q = {state.q}, so the energy would not be kept. If "
                    "that is intended set `is_directional = False` in the class: "
                    "`solution.audit` then shows what is lost or gained."
                )
    experience.has_valid_gradients = True


def _remedy(derivative: AbstractDerivative) -> str:
    if isinstance(derivative, ChainRule):
        return (
            "Does the function define a derivative of its own (`jax.custom_jvp`) that is "
            "not symmetric, or does it have steps? `derivative=MeanValue()` takes "
            "`jax.grad` of the function as a whole."
        )
    return "Its method `gradient` must be consistent: `D(a, a) = jax.grad(fn)(a)`."


def _functions(
    system: AbstractSystem, state: State, args: Args
) -> list[tuple[str, Callable, tuple]]:
    """The functions whose discrete gradients a scheme takes, and their arguments."""
    constant = isinstance(system, System)
    found = [x for x in energies(system, state, args) if x[0] != "kinetic" or not constant]
    if system.constraint is not None:
        found.append(("constraint", system.constraint, (state.q, args)))
    if system.driven is not None:
        found.append(("driven", system.driven, (state.q, state.t, args)))
    if system.nonholonomic is not None:
        found.append(("nonholonomic", system.nonholonomic, (state.q, args)))
    return found


@compiled_for_once
def _facts(
    derivative: AbstractDerivative, system: AbstractSystem, state: State, args: Args
) -> list[tuple[Flag, Flag]]:
    return [
        _check(derivative, *_as_scalar_function(fn, inputs))
        for _, fn, inputs in _functions(system, state, args)
    ]


def _as_scalar_function(fn: Callable, inputs: tuple) -> tuple[Callable, Float[Array, " n"]]:
    """The weighted sum of the rows of a function, as a function of one vector: that of all
    of its arguments but `args`."""
    *variables, args = inputs
    flat, unravel = ravel_pytree(variables)

    def value(x: Array) -> Scalar:
        rows = jnp.ravel(fn(*unravel(x), args))
        return rows @ jnp.cos(jnp.arange(rows.size, dtype=rows.dtype))

    return value, flat


def _check(
    derivative: AbstractDerivative, fn: Callable[[Any], Scalar], x: Float[Array, " n"]
) -> tuple[Flag, Flag]:
    """Whether `D(a, a)` is the gradient, and `D(a, b)` directional."""
    eps = _ROUND_OFF * jnp.finfo(x.dtype).eps
    near = x + _DISTANCE * (1 + jnp.abs(x)) * direction_without_symmetry(x)
    both = lambda x: (derivative.gradient(fn, x, x), jax.grad(fn)(x))
    discrete, exact = jax.lax.map(both, jnp.stack([x, near]))
    # At an equilibrium the gradient vanishes although its terms do not; the change of the
    # gradient tells their size.
    size = jnp.max(jnp.abs(exact)) + jnp.max(jnp.abs(exact[1] - exact[0])) / _DISTANCE
    error = jnp.max(jnp.abs(discrete - exact), axis=1)
    # One of two points suffices: the other may be at a kink, without a unique gradient.
    is_gradient = jnp.any(error <= eps * size)
    if isinstance(derivative, ChainRule) or not derivative.is_directional:
        return is_gradient, jnp.array(True)
    mean = derivative.gradient(fn, x, near)
    change, values = mean @ (near - x), (fn(x), fn(near))
    terms = abs(values[0]) + abs(values[1]) + abs(mean) @ (abs(x) + abs(near))
    return is_gradient, jnp.abs(change - (values[1] - values[0])) <= eps * terms
