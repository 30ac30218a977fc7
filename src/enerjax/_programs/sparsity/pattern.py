"""Which entries of a Jacobian can differ from zero: read off the traced program.

Every array of the program carries, for each of its entries, the set of the unknowns that
the entry depends on, as a row of a sparse matrix of truth values. Exact for arithmetic,
reductions and moves of entries with known indices; what is not known here (loops, dense
factorisations, indices that are computed) counts as depending on all that goes into it.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.sparse import csr_array

from ..tracing import evaluate, interpret, is_known, name_of, wrapped_program
from .dependence import Constant, Dense, Depends, everything, RULES, Value


# Unknowns from which structure is looked for.
LARGE = 64


def jacobian_pattern(
    fn: Callable[[Array], Array], like: Array, *, of_values: bool = False
) -> csr_array | None:
    """The entries of `d fn / dx` that can differ from zero; rows are those of `fn`.

    Shape `(fn(like).size, like.size)`; `None` where so many can that the pattern is of no
    use. Of a traced program: nothing is evaluated but indices. With `of_values` what a
    value depends on without a derivative, as by a comparison, counts too.
    """
    program = jax.make_jaxpr(fn)(like)
    size = like.size
    unknowns = Depends(_identity(size), like)
    consts = [c if is_known(c) else Constant(jnp.asarray(c)) for c in program.consts]
    try:
        with jax.ensure_compile_time_eval():
            rule = functools.partial(_equation, of_values=of_values)
            (out,) = interpret(program.jaxpr, consts, [unknowns], rule)
    except Dense:
        return None
    if isinstance(out, Depends):
        return out.rows
    return csr_array((int(np.prod(jnp.shape(out))), size), dtype=bool)


def _identity(size: int) -> csr_array:
    index = np.arange(size + 1)
    return csr_array((np.ones(size, bool), index[:-1], index), shape=(size, size))


def _equation(equation: Any, values: list[Value], of_values: bool) -> list[Value]:
    primitive, params = equation.primitive, equation.params
    avals = [var.aval for var in equation.outvars]
    rule = RULES.get(name_of(equation))
    inner = wrapped_program(equation)
    if rule is None and inner is not None:
        within = functools.partial(_equation, of_values=of_values)
        return interpret(*inner, values, within)
    if not any(isinstance(v, Depends) for v in values):
        if any(isinstance(v, Constant) for v in values) or primitive.name in _LOOPS:
            return list(map(Constant, avals))
        return evaluate(primitive, values, params)
    # Truth values and indices have no derivative.
    smooth = any(jnp.issubdtype(aval.dtype, jnp.inexact) for aval in avals)
    if not of_values and (not smooth or primitive.name in _ZERO):
        return list(map(Constant, avals))
    rows = (rule or everything)(primitive, values, params, avals)
    return [Depends(r, aval) for r, aval in zip(rows, avals, strict=True)]


_LOOPS = {"while", "scan", "cond"}
_ZERO = {"sign", "floor", "ceil", "round", "stop_gradient", "is_finite"}
