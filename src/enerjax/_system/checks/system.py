"""Checks of a system, its state and its `args`, before any step.

Shapes and types are always checked. Values are checked if they are known, which is outside
of `jit` and `vmap`.
"""

import functools
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._programs import as_array, is_known, values_of
from ..._types import Args, Real
from ..base import AbstractSystem, State
from .shapes import check_shapes
from .values import check_values


def check_system(
    system: AbstractSystem, state: State, args: Args, t: Real
) -> tuple[State, Args, bool]:
    """Checks a system with a state, `args` and a time.

    Returns the state and `args` as arrays, and whether values were known and checked.
    """
    if not isinstance(system, AbstractSystem):
        raise TypeError(f"`system` must be an `enerjax.System`, got {type(system)}.")
    check_not_varying((system, state, args, t))
    if not isinstance(state, State):
        raise TypeError(
            f"The start must be an `enerjax.State(q, v)`, got {type(state)}. "
            "`initial_state` makes one that satisfies the constraints."
        )
    q, v = state.q, state.v
    for name, x in (("q", q), ("v", v)):
        if x.ndim != 1 or x.size == 0 or jnp.iscomplexobj(x):
            raise ValueError(
                f"`{name}` must be a real vector with at least one entry, got shape "
                f"{x.shape} and dtype {x.dtype}."
                + (" To run a batch use `jax.vmap`." if x.ndim > 1 else "")
            )
    if q.dtype != v.dtype:
        raise TypeError(f"`q` is {q.dtype} and `v` is {v.dtype}: give both one dtype.")
    if q.dtype == jnp.float32 and not jax.config.read("jax_enable_x64"):
        _warn_single_precision()
    if q.dtype not in (jnp.float32, jnp.float64):
        raise TypeError(f"`q` and `v` are {q.dtype}: give them as float64 or float32.")
    args = jax.tree.map(lambda x: _as_array(x, q.dtype), args)
    _check_precision(args, q.dtype)
    check_number("t0` or `t", t)
    if jnp.ndim(t) != 0 or (is_known(t) and not np.isfinite(t)):
        raise ValueError(f"The time of the start must be a finite number, got {t}.")
    state = State(q, v, as_array(t, q.dtype) if system.is_timed else None)
    check_shapes(system, state, args)
    known = values_of((system, state, args))
    return state, args, is_known(known) and check_values(*known)


def check_not_varying(tree: Any) -> None:
    """Raises an error if numbers vary over the devices of a checked `jax.shard_map`.

    There JAX sums a derivative with respect to a number that does not vary over all
    devices.
    """
    types = [jax.typeof(x) for x in jax.tree.leaves(tree) if isinstance(x, jax.Array)]
    # The first form is that of JAX before 0.10.
    if any(getattr(x, "vma", None) for x in types) or any(
        getattr(getattr(x, "manual_axis_type", None), "varying", None) for x in types
    ):
        raise ValueError(
            "These numbers differ from device to device inside `jax.shard_map`, where JAX "
            "would sum the derivatives in the step equations over the devices. Pass "
            "`check_vma=False` to `shard_map`, or use `sweep`, which uses all devices."
        )


@functools.cache
def _warn_single_precision() -> None:
    warnings.warn(
        "This run is in float32: energies and constraints hold to about 1e-6 instead of "
        "1e-15, and Newton's method uses looser tolerances. For double precision run "
        '`jax.config.update("jax_enable_x64", True)` before the first array is created.',
        stacklevel=5,
    )


def check_number(name: str, x: Any) -> None:
    if not isinstance(x, jax.Array) and np.asarray(x).dtype.kind not in "iuf":
        raise TypeError(f"`{name}` must be a real number (time), got {x!r}.")


def _check_precision(args: Args, dtype: Any) -> None:
    """Raises an error for arrays of another precision than the start, whose results would
    have fewer digits than their dtype suggests."""
    for path, x in jax.tree_util.tree_leaves_with_path(args):
        if eqx.is_inexact_array(x) and not jnp.iscomplexobj(x) and x.dtype != dtype:
            raise TypeError(
                f"`args{jax.tree_util.keystr(path)}` is {x.dtype} and the start is {dtype}"
                ": give both one dtype. (Python floats get that of the start.)"
            )


def _as_array(x: Any, dtype: Any) -> Any:
    """Python floats become arrays, because each new Python float would recompile.

    The array of a Python float, such as `jnp.array(2.0)`, remembers where it comes from
    (its type is weak). It becomes an ordinary one, because each kind would recompile too.
    """
    if isinstance(x, float | np.floating):
        return as_array(x, dtype)
    if isinstance(x, jax.Array) and jax.typeof(x).weak_type:
        return jnp.asarray(x, x.dtype)
    return jnp.asarray(x) if isinstance(x, np.ndarray) else x
