"""Checks of arguments that several schemes have."""

from typing import Any

import jax
import jax.numpy as jnp

from .._discrete import AbstractDerivative
from .._operators import AbstractModel
from .._programs import is_known
from .._types import Real, Scalar


def check_formulation(scheme: str, formulation: str) -> None:
    if formulation not in ("ggl", "index3"):
        raise ValueError(
            f'`{scheme}(formulation={formulation!r})`: use "ggl" (joints held at position '
            'and velocity level) or "index3" (position level only).'
        )


def check_derivative(scheme: str, derivative: Any) -> None:
    if not isinstance(derivative, AbstractDerivative):
        hint = ": the parentheses are missing." if isinstance(derivative, type) else "."
        raise TypeError(
            f"`{scheme}(derivative=...)` must be a discrete derivative such as "
            f"`ChainRule()`, got {derivative!r}{hint}"
        )


def refuse_nonholonomic(scheme: str, model: AbstractModel, why: str) -> None:
    if model.system.nonholonomic is not None:
        raise ValueError(
            f"`{scheme}` cannot be used with `nonholonomic` constraints: {why}. Use "
            "`EnergyPreserving`, `EnergyDecaying`, or for higher orders "
            "`Composed(EnergyPreserving(), order)`."
        )


def as_alpha(alpha: Real) -> Scalar:
    """A dissipation parameter as an array, checked where its value is known."""
    alpha, inside = _unit_interval("alpha", alpha)
    if not inside:
        raise ValueError(
            f"alpha = {alpha} lies outside [0, 1]: 0 preserves the energy, 1 annihilates "
            "the highest frequencies in one step; beyond, the scheme would create energy."
        )
    return alpha


def _unit_interval(name: str, number: Real) -> tuple[Scalar, bool]:
    """A number as an array, and whether it lies in [0, 1] or its value is unknown."""
    if isinstance(number, str) or jnp.iscomplexobj(number):
        raise TypeError(f"`{name}` must be a real number in [0, 1], got {number!r}.")
    if not is_known(number):
        return jnp.asarray(number, float), True
    # Under `jit`, the value of a constant would be traced without this context.
    with jax.ensure_compile_time_eval():
        array = jnp.asarray(number, float)
        return array, bool(jnp.all((array >= 0) & (array <= 1)))


def alpha_from_spectral_radius(rho_inf: Real) -> Scalar:
    """`alpha = (1 - rho_inf) / (1 + rho_inf)`"""
    rho_inf, inside = _unit_interval("rho_inf", rho_inf)
    if not inside:
        raise ValueError(
            f"rho_inf = {rho_inf} lies outside [0, 1]: it is the factor by which a step "
            "multiplies the amplitude of an infinitely fast oscillation."
        )
    if not is_known(rho_inf):
        return (1 - rho_inf) / (1 + rho_inf)
    with jax.ensure_compile_time_eval():
        return (1 - rho_inf) / (1 + rho_inf)
