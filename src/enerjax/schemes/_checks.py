"""What the arguments of schemes must be."""

from typing import Any

from .._discrete import AbstractDerivative


def check_formulation(scheme: str, formulation: str) -> None:
    if formulation not in ("ggl", "index3"):
        raise ValueError(
            f'`{scheme}(formulation={formulation!r})`: use "ggl" (joints held at position '
            'and velocity level) or "index3" (position level only).'
        )


def check_derivative(scheme: str, derivative: Any) -> None:
    if not isinstance(derivative, AbstractDerivative):
        missing = isinstance(derivative, type)
        raise TypeError(
            f"`{scheme}(derivative=...)` must be a discrete derivative such as "
            f"`ChainRule()`, got {derivative!r}"
            + (": the parentheses are missing." if missing else ".")
        )
