"""Checks of users' numbers: NumPy arrays for known values, JAX arrays for traced ones."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._programs import is_known, module_of


def number(
    part: str,
    role: str,
    value: Any,
    *shapes: tuple[int, ...],
    least: float | None = None,
) -> Any:
    """`value` as a finite array with one of the shapes, and no entry below `least`."""
    known = is_known(value)
    try:
        array = np.asarray(value, float) if known else jnp.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(f"{role} of {part} must be of numbers, got {value!r}.") from None
    if array.shape not in shapes:
        wanted = " or ".join(str(shape) if shape else "a scalar" for shape in shapes)
        raise ValueError(f"{role} of {part} must be {wanted}, got shape {array.shape}.")
    if known and not np.all(np.isfinite(array)):
        raise ValueError(f"{role} of {part} is not finite: {value}.")
    if known and least is not None and np.any(array < least):
        raise ValueError(f"{role} of {part} must not be below {least:g}, got {value}.")
    return array


def positive(part: str, role: str, value: Any) -> Any:
    array = number(part, role, value, ())
    if is_known(array) and not array > 0:
        raise ValueError(f"{role} of {part} must be positive, got {value}.")
    return array


def joined(*parts: Any) -> Any:
    """All entries one after the other."""
    return module_of(parts).concatenate([x.reshape(-1) for x in parts])


def velocities(
    part: str, *values: tuple[Any, tuple[int, ...]]
) -> tuple[Any, tuple[bool, ...]]:
    """The entries of a velocity and an angular velocity, and which of them are prescribed.

    Each is passed with its shape. One that is `None` is zero and not prescribed.
    """
    entries, prescribed = [], []
    roles = ("`velocity`", "`angular_velocity`")[: len(values)]
    for role, (value, shape) in zip(roles, values, strict=True):
        array = np.zeros(shape) if value is None else value
        entries.append(number(part, role, array, shape))
        prescribed += [value is not None] * entries[-1].size
    return joined(*entries), tuple(prescribed)


def direction(part: str, role: str, value: Any, dimension: int) -> Any:
    """A unit vector along `value`."""
    array = number(part, role, value, (dimension,))
    xp = module_of(array)
    length = xp.sqrt(xp.sum(array**2))
    if is_known(array) and not length > 0:
        raise ValueError(f"{role} of {part} must not be zero.")
    return array / length


def basis(axis: Any) -> Any:
    """A right-handed basis with unit vectors as rows. The axis is the last of them in
    space, and the first in the plane."""
    xp = module_of(axis)
    if axis.shape == (2,):
        return xp.stack([axis, axis[::-1] * np.array([-1.0, 1.0])])
    aside = xp.cross(axis, xp.eye(3)[xp.argmin(xp.abs(axis))])
    x = aside / xp.sqrt(xp.sum(aside**2))
    return xp.stack([x, xp.cross(axis, x), axis])
