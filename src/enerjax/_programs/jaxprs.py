"""Traced values and programs: what is known of a function before it runs."""

from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jaxtyping import Array

from .primitives import CALLS, JIT, LINEAR_SOLVE, WITH_OWN_DERIVATIVE


def is_known(tree: Any) -> bool:
    """Whether every number in `tree` has a value now: whether no leaf is traced."""
    return not any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))


def module_of(*values: Any) -> ModuleType:
    """`numpy` for known values, so that nothing is compiled; else `jax.numpy`."""
    return np if is_known(values) else jnp


def as_array(x: Any, dtype: Any) -> Any:
    """A number as an array: of NumPy for a number of Python or NumPy, which is the fastest.

    An array of JAX stays on its device.
    """
    return (jnp if isinstance(x, jax.Array) else np).asarray(x, dtype)


def has_numbers(x: Any) -> bool:
    """Whether the entries of an array, or of its type, are numbers: not random keys."""
    kind = getattr(x, "dtype", None)
    return kind is None or not jnp.issubdtype(kind, jax.dtypes.extended)


def known_numbers(x: Any) -> np.ndarray | None:
    """An array of numbers, if their values are known."""
    return np.asarray(x) if is_known(x) and has_numbers(x) else None


def interpret(
    jaxpr: Any,
    consts: list[Any],
    inputs: list[Any],
    equation: Callable[[Any, list[Any]], list[Any]],
) -> list[Any]:
    """The outputs of a program whose equations mean what `equation(eqn, values)` says."""
    known = dict(zip(jaxpr.constvars, consts, strict=True))
    known.update(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> Any:
        if isinstance(atom, Literal):
            return np.asarray(atom.val, atom.aval.dtype)  # pyright: ignore
        return known[atom]

    for eqn in jaxpr.eqns:
        # The new equation comes from the same line as the one that it stands for. Literals
        # are NumPy arrays; as with JAX, what is undefined is NaN, without a warning.
        source = source_info_util.user_context(eqn.source_info.traceback)
        with source, np.errstate(all="ignore"):
            outs = equation(eqn, list(map(read, eqn.invars)))
        known.update(zip(eqn.outvars, outs, strict=True))
    return list(map(read, jaxpr.outvars))


def interpret_within_jit(
    jaxpr: Any,
    consts: list[Any],
    inputs: list[Any],
    equation: Callable[[Any, list[Any]], list[Any]],
) -> list[Any]:
    """`interpret`, where the programs of `jit` within the program are interpreted too."""

    def within(eqn: Any, values: list[Any]) -> list[Any]:
        inner = wrapped_program(eqn) if eqn.primitive.name in JIT else None
        return equation(eqn, values) if inner is None else interpret(*inner, values, within)

    return interpret(jaxpr, consts, inputs, within)


def evaluate(primitive: Any, values: list[Any], params: dict[str, Any]) -> list[Any]:
    """The outputs of a primitive, as a list."""
    bound = primitive.get_bind_params(params)
    # Before JAX 0.10 this is a pair of functions and parameters, since then the parameters.
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    out = primitive.bind(*functions, *values, **params)
    return list(out) if primitive.multiple_results else [out]


def with_constants_as_inputs(jaxpr: Jaxpr) -> Jaxpr:
    """The program whose first inputs are its constants."""
    # Since JAX 0.11 a program holds the values of its constants.
    if hasattr(jaxpr, "with_consts"):
        return jaxpr.with_consts([])  # pyright: ignore
    return jaxpr.replace(constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars])


def parts_of_scan(params: dict[str, Any]) -> tuple[int, int]:
    """How many inputs of a scan are constant, and how many are carried."""
    # Since JAX 0.11 a tree of the inputs says it.
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    constant, carried, _ = params["ft_in"].unpack()
    return len(constant), len(carried)


def name_of(equation: Any) -> str:
    """The name under which tables of rules list an equation.

    It is the name of the primitive. For a call, under `jax.jit`, of a function `f` from one
    array to one array it is `jit f`.
    """
    name = equation.primitive.name
    # The derivative of a named function keeps the name, but has more inputs or outputs.
    if name in JIT and len(equation.invars) == len(equation.outvars) == 1:
        return f"jit {equation.params['name']}"
    return name


def _polynomial(x: Array, *coefficients: Array) -> Array:
    """A sum of powers by W. Horner's scheme, the coefficients of low powers first."""
    total = jnp.broadcast_to(coefficients[-1], x.shape)
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def wrapped_program(equation: Any) -> tuple[Jaxpr, list[Any]] | None:
    """The program and its constants, if an equation only wraps a program."""
    if equation.primitive.name == "polynomial":
        # An operation since JAX 0.12, before a program of sums and products.
        closed = jax.make_jaxpr(_polynomial)(*(x.aval for x in equation.invars))
        return closed.jaxpr, closed.consts
    name = CALLS.get(equation.primitive.name)
    if name is None:
        return None
    program = equation.params[name]
    if isinstance(program, ClosedJaxpr):
        return program.jaxpr, program.consts
    return program, []


def function_with_own_derivative(equation: Any) -> tuple[str, bool] | None:
    """The function under `jax.custom_jvp` or `jax.custom_vjp` that an equation calls.

    Returned are its name, and whether JAX or this library defines it; `None` for others.
    """
    if equation.primitive.name not in WITH_OWN_DERIVATIVE:
        return None
    program, _ = wrapped_program(equation) or (None, [])
    info = getattr(program, "debug_info", None)
    source = getattr(info, "func_src_info", None) or ""
    return getattr(info, "func_name", None) or "(unnamed)", any(
        str(home) in source for home in _TRUSTED
    )


# Functions that are defined in these folders have the derivative of the program inside,
# computed in a better way.
_TRUSTED = Path(jax.__file__).parent, Path(__file__).parents[1]


def programs_within(equation: Any) -> Iterator[Jaxpr]:
    """All programs that an equation runs: bodies, branches, wrapped ones.

    Of those of a linear solve it runs one, the solution.
    """
    params = equation.params
    if equation.primitive.name == LINEAR_SOLVE:
        params = dict(program=params["jaxprs"].solve)
    yield from _programs(params.values())


def solution_program(
    values: list[Any], params: dict[str, Any]
) -> tuple[ClosedJaxpr, list[Any]]:
    """The program by which `jax.lax.custom_linear_solve` solves, and its inputs."""
    counts = params["const_lengths"]
    first = counts.matvec + counts.vecmat
    consts = values[first : first + counts.solve]
    return params["jaxprs"].solve, [*consts, *values[sum(counts) :]]


def _programs(params: Any) -> Iterator[Jaxpr]:
    for param in params:
        if isinstance(param, ClosedJaxpr):
            yield param.jaxpr
        elif isinstance(param, Jaxpr):
            yield param
        elif isinstance(getattr(param, "jaxpr", None), Jaxpr):
            yield param.jaxpr
        elif isinstance(param, tuple | list):
            yield from _programs(param)
