"""Checks that the functions of a system fit its state, before anything is evaluated."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ..._programs import once_per_structure
from ..._types import Args
from ..base import AbstractSystem, SIGNATURES, State
from ..canonical import HamiltonianSystem, LagrangianSystem
from ..kinematics import ConfigurationKinematics
from ..names import Names
from ..separable import System


_KINETIC = "`(v, args)`, or `(q, qdot, args)` of `System.from_lagrangian`,"


def _signature(role: str) -> str:
    return _KINETIC if role == "kinetic" else f"`{SIGNATURES[role]}`"


def describe(role: str, fn: Any) -> str:
    """The role of a function in a system, with the name that the user gave to it."""
    name = getattr(fn, "__name__", None)
    return f"`{role}`" if name in (None, role, "<lambda>") else f"`{role}` (`{name}`)"


def _shape(role: str, fn: Callable, *inputs: Any) -> tuple[int, ...]:
    """The shape of the value of a function of the system, which must be a real array."""
    try:
        inspect.signature(fn).bind(*inputs)
    except TypeError as error:
        raise TypeError(
            f"{describe(role, fn)} must take {len(inputs)} arguments, {_signature(role)} "
            f"here: {error}."
        ) from None
    except ValueError:  # `fn` has no signature, like some functions in C
        pass
    out = _traced(role, fn, *inputs)
    if not hasattr(out, "shape") or not jnp.issubdtype(out.dtype, jnp.floating):
        kind = out.dtype if hasattr(out, "dtype") else f"a Python {type(out).__name__}"
        raise TypeError(
            f"{describe(role, fn)} must return a real JAX array, got {kind}. Write it "
            "with `jax.numpy` from its arguments: `0.0 * q[0]` is a zero of the right kind."
            + (" Is its `return` missing?" if out is None else "")
        )
    return out.shape


def _traced(role: str, fn: Callable, *inputs: Any) -> Any:
    """The shape and dtype of the value of a function; its errors name the function."""
    try:
        return eqx.filter_eval_shape(fn, *inputs)
    except (
        jax.errors.ConcretizationTypeError,
        jax.errors.TracerArrayConversionError,
        jax.errors.TracerIntegerConversionError,
    ) as error:
        raise TypeError(
            f"{describe(role, fn)} needs the value of a number that is traced. Write it "
            "with `jax.numpy`, not `math` or `numpy`, and `jnp.where` instead of `if`."
        ) from error
    except Exception as error:
        raise ValueError(
            f"{describe(role, fn)} raised {type(error).__name__}: "
            f"{str(error).removesuffix('.')}. It is called "
            f"with {_signature(role)}, and `args` is {_kind(inputs[-1])} here."
        ) from error


def _kind(args: Any) -> str:
    if isinstance(args, dict):
        return f"a dictionary with the keys {sorted(map(str, args))}"
    return "None" if args is None else f"of type {type(args).__name__}"


@once_per_structure
def check_shapes(system: AbstractSystem, state: State, args: Args) -> None:
    internal = _internal_rows(system, state)
    for role, fn, inputs in energies(system, state, args):
        shape = _shape(role, fn, *inputs)
        if shape != ():
            raise ValueError(
                f"{describe(role, fn)} must return a scalar, an energy, got shape {shape}."
                + (" Sum over the bodies, or index the entry." if shape else "")
            )
    rows = _rows("constraint", system.constraint, state.q, args)
    rows += _rows("driven", system.driven, state.q, state.t, args) + internal
    rows += _matrix_rows("nonholonomic", system.nonholonomic, state, args)
    if rows > state.q.size and not system.redundant:
        raise ValueError(
            f"{rows} constraints of {state.q.size} coordinates cannot be independent"
            + (f", {internal} of them between the axes of rigid bodies" if internal else "")
            + ". Leave out those that follow from the others, or declare "
            "`System(..., redundant=True)`."
        )
    _check_force(system, state, args)
    _check_symmetry(system, state, args)
    if isinstance(system, System):
        _check_separable(system, state, args)
    elif state.q.size != state.v.size:
        name = "momenta" if isinstance(system, HamiltonianSystem) else "velocities"
        raise ValueError(
            f"`q` has {state.q.size} entries and `v`, the {name}, has {state.v.size}: "
            "give as many of each."
        )
    _check_names(system.names, state, rows + state.q.size - state.v.size)


def _check_names(names: Any, state: State, num_constraints: int) -> None:
    if names is None:
        return
    if not isinstance(names, Names):
        raise TypeError(f"`names` must be `enerjax.Names(coordinates=...)`, got {names!r}.")
    sizes = dict(coordinates=state.q.size, velocities=state.v.size)
    for role, size in (sizes | dict(constraints=num_constraints)).items():
        given = getattr(names, role)
        if given is not None and len(given) != size:
            raise ValueError(
                f"`Names(...)` has {len(given)} {role}, and the system has {size}: give a "
                "name for each."
            )


def _internal_rows(system: AbstractSystem, state: State) -> int:
    """The number of constraints between the axes of rigid bodies."""
    if not isinstance(system, System):
        return 0
    return jax.eval_shape(system.kinematics.constraint, state.q).size


def energies(
    system: AbstractSystem, state: State, args: Args
) -> list[tuple[str, Callable, tuple]]:
    """The roles of the user's energy functions, the functions, and their arguments."""
    q, v = state.q, state.v
    if isinstance(system, HamiltonianSystem):
        return [("hamiltonian", system.hamiltonian, (q, v, args))]
    if isinstance(system, LagrangianSystem):
        kinetic = ("kinetic", system.kinetic, (q, v, args))
        return [("potential", system.potential, (q, args)), kinetic]
    assert isinstance(system, System)
    potential = ("potential", system.potential, (q, args))
    if not callable(system.kinetic):
        return [potential]
    return [potential, ("kinetic", system.kinetic, (v, args))]


def _check_force(system: AbstractSystem, state: State, args: Args) -> None:
    if system.force is None:
        return
    shape = _shape("force", system.force, state.q, state.v, state.t, args)
    if shape != state.v.shape:
        raise ValueError(
            f"{describe('force', system.force)} returned shape {shape}, but `v` has "
            f"{state.v.size} entries: give one for each, conjugate to it (its power is "
            "`force . v`). A force on a point enters with the Jacobian of the point."
        )


def _check_symmetry(system: AbstractSystem, state: State, args: Args) -> None:
    if system.symmetry is None:
        return
    shape = _shape("symmetry", system.symmetry, state.q, args)
    if len(shape) != 2 or shape[1] != state.v.size:
        raise ValueError(
            f"{describe('symmetry', system.symmetry)} returned shape {shape}: give one row "
            f"of {state.v.size} velocities for each symmetry. A single one is "
            "`velocities[None]`."
        )


def _rows(role: str, fn: Callable | None, *inputs: Any) -> int:
    """The number of rows of a constraint."""
    if fn is None:
        return 0
    shape = _shape(role, fn, *inputs)
    if len(shape) != 1:
        raise ValueError(
            f"{describe(role, fn)} must return a vector, got shape {shape}. "
            "Wrap a single constraint as `jnp.array([value])`."
        )
    return shape[0]


def _matrix_rows(role: str, fn: Callable | None, state: State, args: Args) -> int:
    """The number of rows of a matrix that acts on the rates of the coordinates."""
    if fn is None:
        return 0
    shape = _shape(role, fn, state.q, args)
    if len(shape) != 2 or shape[1] != state.q.size:
        raise ValueError(
            f"{describe(role, fn)} returned shape {shape}: give the matrix `A` in "
            f"`A qdot = 0`, with {state.q.size} columns, one for each coordinate. A single "
            "row is `row[None]`."
        )
    return shape[0]


def _check_separable(system: System, state: State, args: Args) -> None:
    nq, nv = state.q.size, state.v.size
    if not callable(system.kinetic) and system.kinetic.shape != (nv, nv):
        raise ValueError(
            f"The inertia matrix has shape {system.kinetic.shape}, but `v` has {nv} "
            f"entries: give a ({nv}, {nv}) matrix."
        )
    redundant = _rows("coordinate_constraint", system.coordinate_constraint, state.q, args)
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
            f"{describe('kinematics', fn)} returned shape {shape}; `v = L qdot` with "
            f"{nv} velocities and {nq} coordinates needs ({nv}, {nq})."
        )
    if redundant != nq - nv:
        raise ValueError(
            f"{nq} coordinates with {nv} velocities are redundant {nq - nv} times, but "
            f"`coordinate_constraint` has {redundant} rows. Give "
            "one row for each redundancy, such as `p @ p - 1` for a unit quaternion."
        )
