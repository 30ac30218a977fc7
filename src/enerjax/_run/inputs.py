"""Checks of the arguments of a run, before any step.

Shapes and types are always checked. Values are checked if they are known, which is outside
of `jit`, `vmap` and `grad`.
"""

import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._programs import as_array, is_known
from .._solvers import RootFinder
from .._system import (
    AbstractSystem,
    check_not_varying,
    check_number,
    check_system,
    check_without_rotations,
    describe,
    State,
)
from .._types import Args, Real, Scalar
from ..schemes import AbstractScheme, AbstractSchemeWithRotations
from .discrete_gradient_check import check_derivatives
from .experience import Experience, experience_of
from .start_check import with_checked_rates


class Prepared(NamedTuple):
    """The checked arguments of a run.

    - `system`, `start`, `args`: their numbers are arrays with checked derivatives.
    - `h`, `t`: the length of a step and the time of the start in the dtype of the start;
      those that the user gives as numbers of Python or NumPy are NumPy's.
    - `experience`: what earlier calls have shown of the system.
    - `is_checked`: whether the values were known, and have been checked.
    """

    system: AbstractSystem
    start: State
    args: Args
    h: Scalar
    t: Scalar
    experience: Experience
    is_checked: bool


def prepare(
    system: AbstractSystem,
    scheme: AbstractScheme,
    start: State,
    args: Args,
    h: Real,
    t: Real,
    root_finder: RootFinder,
) -> Prepared:
    """Checks the arguments of a run."""
    if not isinstance(root_finder, RootFinder.__value__):
        raise TypeError(
            "`root_finder` must be a root finder such as `enerjax.Newton()`, or a root "
            "finder or least-squares solver of optimistix, such as "
            f"`LevenbergMarquardt(rtol, atol)`; got {root_finder!r}."
        )
    if not isinstance(scheme, AbstractScheme):
        raise TypeError(
            f"`scheme` must be a scheme such as `EnergyPreserving()`, got {scheme!r}"
            + (": the parentheses are missing." if isinstance(scheme, type) else ".")
        )
    check_not_varying((scheme, h))
    start, args, is_checked = check_system(system, start, args, t)
    if system.force is not None and min(scheme.stages) < 0:
        raise ValueError(
            f"`{type(scheme).__name__}` has stages that go backwards in time, in which a "
            f"damper would add energy: {describe('force', system.force)} cannot be used "
            "with it. Use the scheme that it is composed of, with a shorter `h`. "
            "(`driven` constraints are possible.)"
        )
    if any(jnp.ndim(x) > 0 for x in jax.tree.leaves(scheme)):
        raise ValueError(
            f"The numbers of the scheme must be scalars, got {scheme}. To sweep them put "
            "the scheme inside `jax.vmap`."
        )
    check_number("h", h)
    if is_known(h) and np.ndim(h) == 0 and not 0 < float(np.real(h)) < np.inf:
        raise ValueError(f"`h` must be positive and finite, got {h}.")
    step = as_array(h, start.q.dtype)
    if step.ndim != 0:
        raise ValueError(
            f"`h` must be a scalar, got shape {step.shape}. To sweep it use `jax.vmap`."
        )
    experience = experience_of(scheme, system, start, args)
    has_rotations = isinstance(scheme.stage, AbstractSchemeWithRotations)
    if not has_rotations and is_known((system, start, args)):
        check_without_rotations(system, start, args, type(scheme.stage).__name__)
    if is_known((scheme, system, start, args)):
        check_derivatives(scheme, system, start, args, experience)
    at = as_array(t, step.dtype)
    system, args = with_checked_rates(system, scheme, start, args, step)
    return Prepared(system, start, args, step, at, experience, is_checked)


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
    """Raises an error unless this is a small number of halvings, or `None`."""
    if max_halvings is None:
        return
    is_int = isinstance(max_halvings, int) and not isinstance(max_halvings, bool)
    if not is_int or not 0 <= max_halvings <= 20:
        raise ValueError(
            "`max_halvings` must be an integer from 0 to 20: a failed step is divided into "
            f"up to `2 ** max_halvings` steps. Got {max_halvings!r}."
        )
