"""Bad input, told before any step: what is wrong, why that is likely, what to do.

Shapes and types are checked always, values where they are known: outside of `jit`, `vmap`
and `grad`.
"""

import functools
import operator
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._kinematics import ConfigurationKinematics
from ._schemes import AbstractScheme
from ._system import State, System
from ._tracing import is_known
from ._types import Args, Real, Scalar


def prepare(
    system: System, scheme: AbstractScheme, start: State, args: Args, h: Real
) -> tuple[State, Args, Scalar]:
    """Checked start, `args` of arrays, and `h` in the dtype of the start."""
    if not isinstance(scheme, AbstractScheme):
        raise TypeError(
            f"`scheme` must be a scheme such as `EnergyPreserving()`, got {scheme!r}"
            + (": the parentheses are missing." if isinstance(scheme, type) else ".")
        )
    start, args = check_system(system, start, args)
    if any(jnp.ndim(x) > 0 for x in jax.tree.leaves(scheme)):
        raise ValueError(
            f"The numbers of the scheme must be scalars, got {scheme}. To sweep them put "
            "the scheme inside `jax.vmap`."
        )
    if is_known(h) and np.ndim(h) == 0 and not 0 < float(np.real(h)) < np.inf:
        raise ValueError(f"`h` must be positive and finite, got {h}.")
    h = jnp.asarray(h, start.q.dtype)
    if h.ndim != 0:
        raise ValueError(
            f"`h` must be a scalar, got shape {h.shape}. To sweep it use `jax.vmap`."
        )
    return start, args, h


def positive_integer(name: str, count: Any) -> int:
    """`count` as an `int`, from any integer type."""
    try:
        number = operator.index(count)
    except TypeError:
        number = 0
    if number < 1 or isinstance(count, bool):
        raise ValueError(f"`{name}` must be a positive integer, got {count!r}.")
    return number


def check_system(system: System, state: State, args: Args) -> tuple[State, Args]:
    """Checks a system against a state and `args`, and makes arrays of their leaves."""
    if not isinstance(system, System):
        raise TypeError(f"`system` must be an `enerjax.System`, got {type(system)}.")
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
    args = jax.tree.map(lambda x: _as_array(x, q.dtype), args)
    _check_shapes(system, state, args)
    if is_known((system, state, args)):
        _check_values(system, state, args)
    return state, args


@functools.cache
def _warn_single_precision() -> None:
    warnings.warn(
        "This run is in float32: energies and constraints hold to about 1e-6 instead of "
        "1e-15, and Newton's tolerances follow. For double precision run "
        '`jax.config.update("jax_enable_x64", True)` before the first array is made.',
        stacklevel=5,
    )


def _as_array(x: Any, dtype: Any) -> Any:
    """Python floats become arrays: as they are, each new value would recompile."""
    if isinstance(x, float | np.floating):
        return jnp.asarray(x, dtype)
    return jnp.asarray(x) if isinstance(x, np.ndarray) else x


def _describe(role: str, fn: Any) -> str:
    name = getattr(fn, "__name__", None)
    return f"`{role}`" if name in (None, role, "<lambda>") else f"`{role}` (`{name}`)"


def _shape(role: str, fn: Callable, *inputs: Any) -> tuple[int, ...]:
    """Of the value of a function of the system, which must be a real array."""
    out = eqx.filter_eval_shape(fn, *inputs)
    if not hasattr(out, "shape") or not jnp.issubdtype(out.dtype, jnp.floating):
        kind = out.dtype if hasattr(out, "dtype") else f"a Python {type(out).__name__}"
        raise TypeError(
            f"{_describe(role, fn)} must return a real JAX array, got {kind}. Write it "
            "with `jax.numpy` from its arguments: `0.0 * q[0]` is a zero of the right kind."
        )
    return out.shape


def _check_shapes(system: System, state: State, args: Args) -> None:
    nq, nv = state.q.size, state.v.size
    _check_scalar("potential", system.potential, state.q, args)
    if callable(system.kinetic):
        _check_scalar("kinetic", system.kinetic, state.v, args)
    elif system.kinetic.shape != (nv, nv):
        raise ValueError(
            f"The inertia matrix has shape {system.kinetic.shape}, but `v` has {nv} "
            f"entries: give a ({nv}, {nv}) matrix."
        )
    count = dict(constraint=0, coordinate_constraint=0)
    for role in count:
        fn = getattr(system, role)
        if fn is None:
            continue
        shape = _shape(role, fn, state.q, args)
        if len(shape) != 1:
            raise ValueError(
                f"{_describe(role, fn)} must return a vector, got shape {shape}. "
                "Wrap a single constraint as `jnp.array([value])`."
            )
        count[role] = shape[0]
    if not isinstance(system.kinematics, ConfigurationKinematics):
        if nq != nv:
            raise ValueError(
                f"`q` has {nq} entries and `v` has {nv}. Without `kinematics` the "
                "velocities are the rates of the coordinates: give as many of each, or "
                "`System(..., kinematics=L)` with `v = L(q, args) qdot`."
            )
        return
    fn = system.kinematics.matrix
    shape = _shape("kinematics", fn, state.q, args)
    if shape != (nv, nq):
        raise ValueError(
            f"{_describe('kinematics', fn)} returned shape {shape}; `v = L qdot` with "
            f"{nv} velocities and {nq} coordinates needs ({nv}, {nq})."
        )
    if count["coordinate_constraint"] != nq - nv:
        raise ValueError(
            f"{nq} coordinates with {nv} velocities are redundant {nq - nv} times, but "
            f"`coordinate_constraint` has {count['coordinate_constraint']} rows. Give "
            "one row for each redundancy, such as `p @ p - 1` for a unit quaternion."
        )


def _check_scalar(role: str, fn: Callable, x: Array, args: Args) -> None:
    shape = _shape(role, fn, x, args)
    if shape != ():
        raise ValueError(
            f"{_describe(role, fn)} must return a scalar, an energy, got shape {shape}."
            + (" Sum over the bodies, or index the entry." if shape else "")
        )


@eqx.filter_jit
def _facts(system: System, state: State, args: Args) -> dict[str, Array]:
    v = state.v
    if callable(system.kinetic):
        energy = lambda v: system.kinetic_energy(State(state.q, v), args)
        rest = jnp.zeros_like(v)
        inertia = jax.hessian(energy)(rest)
        # A probe with no symmetry, of the size of the velocities.
        probe = (1 + jnp.max(jnp.abs(v))) * jnp.cos(
            jnp.arange(1, v.size + 1, dtype=v.dtype)
        )
        quadratic = 0.5 * probe @ inertia @ probe
        error = jnp.abs(energy(probe) - quadratic) + jnp.abs(energy(-probe) - quadratic)
        size = jnp.abs(probe) @ jnp.abs(inertia) @ jnp.abs(probe)
        is_quadratic = error <= 1e3 * jnp.finfo(v.dtype).eps * size
    else:
        inertia = system.kinetic.astype(v.dtype)
        is_quadratic = jnp.array(True)
    masses, eps = jnp.diagonal(inertia), 1e3 * jnp.finfo(v.dtype).eps
    root = jnp.sqrt(jnp.where(masses > 0, masses, 1))
    scaled = inertia / jnp.outer(root, root)
    finite = lambda tree: jnp.all(
        jnp.array([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(tree)], bool)
    )
    constraints = (system.constraint, system.coordinate_constraint)
    model = [f(state.q, args) for f in constraints if f is not None]
    return dict(
        start=finite(state),
        args=finite([x for x in jax.tree.leaves(args) if eqx.is_inexact_array(x)]),
        potential=finite(system.potential(state.q, args)),
        constraint=finite(model),
        inertia=finite(inertia),
        quadratic=is_quadratic,
        symmetric=jnp.all(jnp.abs(scaled - scaled.T) <= eps),
        definite=jnp.all(masses > 0) & finite(jnp.linalg.cholesky(scaled)),
    )


def _check_values(system: System, state: State, args: Args) -> None:
    facts = _facts(system, state, args)
    if not is_known(facts):  # the functions of the system close over traced numbers
        return
    kinetic = "inertia matrix"
    if callable(system.kinetic):
        kinetic = "inertia (the Hessian of " + _describe("kinetic", system.kinetic) + ")"
    potential = _describe("potential", system.potential)
    for name, message in (
        ("start", f"The start is not finite: q = {state.q}, v = {state.v}."),
        ("args", f"`args` holds a number that is not finite: {args}."),
        (
            "potential",
            f"{potential} is not finite at the start, q = {state.q}. Is it defined there?",
        ),
        ("constraint", "The constraints are not finite at the start. Defined there?"),
        (
            "inertia",
            f"The {kinetic} is not finite. A kinetic energy must have second derivatives "
            "at `v = 0`: write `v @ v`, not the square of a norm.",
        ),
        (
            "quadratic",
            f"{_describe('kinetic', system.kinetic)} is not quadratic in `v` with "
            "constant inertia: it must be `1/2 v . M v`, with no linear or constant part.",
        ),
        ("symmetric", f"The {kinetic} is not symmetric."),
        (
            "definite",
            f"The {kinetic} is not positive definite. A coordinate without mass, or a "
            "negative mass? Every velocity needs some inertia.",
        ),
    ):
        if not facts[name]:
            raise ValueError(message)
