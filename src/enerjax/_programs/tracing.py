"""Traced values and programs: what JAX knows of a function before it runs."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


def is_known(tree: Any) -> bool:
    """Whether every number in `tree` has a value now: whether no leaf is traced."""
    return not any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))


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
            return jnp.asarray(atom.val, atom.aval.dtype)  # pyright: ignore
        return known[atom]

    for eqn in jaxpr.eqns:
        outs = equation(eqn, list(map(read, eqn.invars)))
        known.update(zip(eqn.outvars, outs, strict=True))
    return list(map(read, jaxpr.outvars))


def evaluate(primitive: Any, values: list[Any], params: dict[str, Any]) -> list[Any]:
    """The outputs of a primitive, as a list."""
    bound = primitive.get_bind_params(params)
    # A pair before JAX 0.10, the parameters alone since.
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    out = primitive.bind(*functions, *values, **params)
    return list(out) if primitive.multiple_results else [out]


def name_of(equation: Any) -> str:
    """Under which name rules know it: that of its primitive, or `jit f`, where it calls a
    function `f` of one array, which returns one, under `jax.jit`."""
    name = equation.primitive.name
    # (A derivative of what has a name keeps it, and has more inputs or outputs.)
    if name in _JIT and len(equation.invars) == len(equation.outvars) == 1:
        return f"jit {equation.params['name']}"
    return name


_JIT = ("jit", "pjit")
# Primitives that only wrap a program, and the parameter that holds it.
_WRAPPERS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "remat2": "jaxpr",
}


def wrapped_program(equation: Any) -> tuple[Jaxpr, list[Any]] | None:
    """The program, and its constants, where an equation only wraps one."""
    name = _WRAPPERS.get(equation.primitive.name)
    if name is None:
        return None
    program = equation.params[name]
    if isinstance(program, ClosedJaxpr):
        return program.jaxpr, program.consts
    return program, []


def function_with_own_derivative(equation: Any) -> tuple[str, bool] | None:
    """The name of a function whose derivative is given, and whether JAX or this library
    defines it, where an equation calls one: under `jax.custom_jvp` or `jax.custom_vjp`."""
    if equation.primitive.name not in ("custom_jvp_call", "custom_vjp_call"):
        return None
    program, _ = wrapped_program(equation) or (None, [])
    info = getattr(program, "debug_info", None)
    source = getattr(info, "func_src_info", None) or ""
    return getattr(info, "func_name", None) or "(unnamed)", any(
        str(home) in source for home in _TRUSTED
    )


# Where a derivative that is given is that of the program inside, only better computed.
_TRUSTED = Path(jax.__file__).parent, Path(__file__).parents[1]


def programs_within(equation: Any) -> Iterator[Jaxpr]:
    """All programs among the parameters of an equation: bodies, branches, what it wraps."""
    yield from _programs(equation.params.values())


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
