"""Checks and calls of users' functions, whose errors name the part."""

import inspect
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from .._types import Multipliers


def check_function(part: str, role: str, value: Any, *inputs: str) -> None:
    """Raises a `TypeError` unless `value` is a function of these inputs."""
    wanted = f"`{role}` of '{part}' must be a function of ({', '.join(inputs)}), "
    if not callable(value):
        raise TypeError(f"{wanted}got {type(value).__name__}.")
    try:
        inspect.signature(value).bind(*inputs)
    except TypeError as error:
        raise TypeError(f"{wanted}and cannot be called so: {error}.") from None
    except ValueError:  # `value` has no signature, like some functions in C
        pass


def takes_view(part: str, role: str, value: Any) -> bool:
    """Whether a function takes (view, t, args) and not (t, args).

    A function that takes either is called with (t, args); one that takes neither is an
    error.
    """
    try:
        check_function(part, role, value, "t", "args")
    except TypeError as error:
        if not callable(value):
            raise
        try:
            check_function(part, role, value, "view", "t", "args")
        except TypeError:
            message = str(error).replace("(t, args)", "(t, args) or of (view, t, args)", 1)
            raise TypeError(message) from None
        return True
    return False


def ask(part: str, function: Callable, *inputs: Any) -> Any:
    """The value of a function; an error about a missing number names the part."""
    try:
        return function(*inputs)
    except KeyError as error:
        raise ValueError(
            f"The function of '{part}' asks for {error}, which does not exist. Pass "
            "numbers for your own functions as `Scene(..., args={...})`, and those for a "
            "curve with the curve."
        ) from None


def vector_of(part: str, function: Callable, *inputs: Any) -> Multipliers:
    """The value of a function that must return a vector."""
    rows = ask(part, function, *inputs)
    if jnp.ndim(rows) != 1:
        raise ValueError(
            f"The function of '{part}' must return a vector, got shape {jnp.shape(rows)}. "
            "Wrap a single constraint as `jnp.array([value])`."
        )
    return rows
