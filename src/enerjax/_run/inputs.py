"""Bad input, told before any step: what is wrong, why that is likely, what to do.

Shapes and types are checked always, values where they are known: outside of `jit`, `vmap`
and `grad`.
"""

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._programs import is_known
from .._solvers import RootFinder
from .._system import (
    AbstractSystem,
    check_not_mixed,
    check_number,
    check_system,
    describe,
    State,
)
from .._types import Args, Real, Scalar
from ..schemes import AbstractScheme
from .derivative_check import check_derivatives


def prepare(
    system: AbstractSystem,
    scheme: AbstractScheme,
    start: State,
    args: Args,
    h: Real,
    t: Real,
    root_finder: RootFinder,
) -> tuple[State, Args, Scalar, Scalar]:
    """Checked start, `args` of arrays, and `h` and `t` in the dtype of the start."""
    if not isinstance(root_finder, RootFinder.__value__):
        raise TypeError(
            "`root_finder` must be a root finder such as `enerjax.Newton()`, or one of "
            "optimistix, or a solver of its for least squares, such as "
            f"`LevenbergMarquardt(rtol, atol)`; got {root_finder!r}."
        )
    if not isinstance(scheme, AbstractScheme):
        raise TypeError(
            f"`scheme` must be a scheme such as `EnergyPreserving()`, got {scheme!r}"
            + (": the parentheses are missing." if isinstance(scheme, type) else ".")
        )
    check_not_mixed((scheme, h))
    start, args = check_system(system, start, args, t)
    if system.force is not None and min(scheme.stages) < 0:
        raise ValueError(
            f"`{type(scheme).__name__}` has stages that go backwards in time, and there a "
            f"damper feeds energy in: {describe('force', system.force)} cannot be used "
            "with it. Take the scheme that is composed, with a shorter `h`; constraints "
            "that are `driven` may stay."
        )
    if any(jnp.ndim(x) > 0 for x in jax.tree.leaves(scheme)):
        raise ValueError(
            f"The numbers of the scheme must be scalars, got {scheme}. To sweep them put "
            "the scheme inside `jax.vmap`."
        )
    check_number("h", h)
    if is_known(h) and np.ndim(h) == 0 and not 0 < float(np.real(h)) < np.inf:
        raise ValueError(f"`h` must be positive and finite, got {h}.")
    h = jnp.asarray(h, start.q.dtype)
    if h.ndim != 0:
        raise ValueError(
            f"`h` must be a scalar, got shape {h.shape}. To sweep it use `jax.vmap`."
        )
    if is_known((scheme, system, start, args)):
        check_derivatives(scheme, system, start, args)
    return start, args, h, jnp.asarray(t, h.dtype)


def positive_integer(name: str, count: Any) -> int:
    """`count` as an `int`, from any integer type."""
    try:
        number = operator.index(count)
    except TypeError:
        number = 0
    if number < 1 or isinstance(count, bool):
        raise ValueError(f"`{name}` must be a positive integer, got {count!r}.")
    return number


def check_halvings(max_halvings: int | None) -> None:
    """Raises for what is no small number of halvings."""
    if max_halvings is None:
        return
    whole = isinstance(max_halvings, int) and not isinstance(max_halvings, bool)
    if not whole or not 0 <= max_halvings <= 20:
        raise ValueError(
            "`max_halvings` must be an integer from 0 to 20: a step that fails is tried "
            f"again in up to `2 ** max_halvings` parts. Got {max_halvings!r}."
        )
