"""Functions of the user's own: what is wrong with one is told with the name of its part."""

import inspect
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from .._types import Multipliers


def check_function(part: str, role: str, value: Any, *inputs: str) -> None:
    """Raises for what is no function of these."""
    wanted = f"`{role}` of '{part}' must be a function of ({', '.join(inputs)}), "
    if not callable(value):
        raise TypeError(f"{wanted}got {type(value).__name__}.")
    try:
        inspect.signature(value).bind(*inputs)
    except TypeError as error:
        raise TypeError(f"{wanted}and cannot be called so: {error}.") from None
    except ValueError:  # no signature to be had
        pass


def takes_view(part: str, role: str, value: Any) -> bool:
    """Whether a function is one of (view, t, args), and not of (t, args), which comes
    first where it can be called either way; raises for one that is neither."""
    try:
        check_function(part, role, value, "t", "args")
    except TypeError as error:
        if not callable(value):
            raise
        try:
            check_function(part, role, value, "view", "t", "args")
        except TypeError:
            told = str(error).replace("(t, args)", "(t, args) or of (view, t, args)", 1)
            raise TypeError(told) from None
        return True
    return False


def ask(part: str, function: Callable, *inputs: Any) -> Any:
    """Its value; a number that it does not find is told."""
    try:
        return function(*inputs)
    except KeyError as error:
        raise ValueError(
            f"The function of '{part}' asks for {error}, which is not there. Numbers for "
            "functions of your own are given as `Scene(..., args={...})`, those of a curve "
            "with it."
        ) from None


def vector_of(part: str, function: Callable, *inputs: Any) -> Multipliers:
    """Its value, which must be a vector."""
    rows = ask(part, function, *inputs)
    if jnp.ndim(rows) != 1:
        raise ValueError(
            f"The function of '{part}' must return a vector, got shape {jnp.shape(rows)}. "
            "Wrap a single constraint as `jnp.array([value])`."
        )
    return rows
