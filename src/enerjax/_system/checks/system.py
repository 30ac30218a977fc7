"""A system, its state and its `args`, told what is wrong with them before any step.

Shapes and types are checked always, values where they are known: outside of `jit`, `vmap`
and `grad`.
"""

import functools
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._programs import is_known
from ..._types import Args, Real
from ..base import AbstractSystem, State
from .shapes import check_shapes
from .values import check_values


def check_system(
    system: AbstractSystem, state: State, args: Args, t: Real
) -> tuple[State, Args]:
    """Checks a system against a state, `args` and the time, and makes arrays of them."""
    if not isinstance(system, AbstractSystem):
        raise TypeError(f"`system` must be an `enerjax.System`, got {type(system)}.")
    check_not_mixed((system, state, args, t))
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
    state = State(q, v, jnp.asarray(t, q.dtype) if system.is_timed else None)
    check_shapes(system, state, args)
    if is_known((system, state, args)):
        check_values(system, state, args)
    return state, args


def check_not_mixed(tree: Any) -> None:
    """A derivative by what is the same on all devices would be summed over them."""
    kinds = [jax.typeof(x) for x in jax.tree.leaves(tree) if isinstance(x, jax.Array)]
    # Since JAX 0.10 a part of what it has been before.
    parts = [getattr(kind, "manual_axis_type", None) for kind in kinds]
    if any(getattr(kind, "vma", None) for kind in kinds) or any(
        getattr(part, "varying", None) for part in parts
    ):
        raise ValueError(
            "These numbers differ from device to device inside `jax.shard_map`, where JAX "
            "would sum the derivatives that make the step equations over the devices. Pass "
            "`check_vma=False` to `shard_map`, or use `sweep`, which takes all devices."
        )


@functools.cache
def _warn_single_precision() -> None:
    warnings.warn(
        "This run is in float32: energies and constraints hold to about 1e-6 instead of "
        "1e-15, and Newton's tolerances follow. For double precision run "
        '`jax.config.update("jax_enable_x64", True)` before the first array is made.',
        stacklevel=5,
    )


def check_number(name: str, x: Any) -> None:
    if not isinstance(x, jax.Array) and np.asarray(x).dtype.kind not in "iuf":
        raise TypeError(f"`{name}` must be a real number (time), got {x!r}.")


def _check_precision(args: Args, dtype: Any) -> None:
    """Arrays of another precision would lose digits, or feign them, step by step."""
    for path, x in jax.tree_util.tree_leaves_with_path(args):
        if eqx.is_inexact_array(x) and not jnp.iscomplexobj(x) and x.dtype != dtype:
            raise TypeError(
                f"`args{jax.tree_util.keystr(path)}` is {x.dtype} and the start is {dtype}"
                ": give both one dtype. (Python floats take that of the start.)"
            )


def _as_array(x: Any, dtype: Any) -> Any:
    """Python floats become arrays: as they are, each new value would recompile."""
    if isinstance(x, float | np.floating):
        return jnp.asarray(x, dtype)
    return jnp.asarray(x) if isinstance(x, np.ndarray) else x
