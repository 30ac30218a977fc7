"""Traced values and programs: what JAX knows of a function before it runs."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.extend.core import Literal


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
