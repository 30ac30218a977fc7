"""Programs rewritten with primitives that are possible in one function.

Products of matrices become sums of products. Sums of many entries become loops over their
terms. Running sums become sums of chosen terms, or of shifted arrays if they are long.
Factors of small matrices are found by plain operations; see `small_matrices.py`. A scatter
to places that are known while the program is traced, as in the derivative of `x[indices]`,
becomes a gather: XLA can gather inside of one function, but not scatter.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal
from jax.extend.core.primitives import reduce_sum_p
from jaxtyping import Array, Int

from ..jaxprs import (
    evaluate,
    interpret,
    programs_within,
    solution_program,
    wrapped_program,
)
from ..numpy_primitives import evaluated
from ..places import at_places
from ..primitives import CONTRACTION, CUMULATIVE, LINEAR_SOLVE, SCATTERS
from .possible import FACTORS, is_part, is_small_product, LARGEST_SUM, NAME
from .products import written_out
from .small_matrices import in_plain_operations, is_small


def rewritten(jaxpr: Any, known: Sequence[np.ndarray | None]) -> ClosedJaxpr:
    """The program, rewritten, as a function of the inputs whose values are not known."""
    inputs = [*jaxpr.constvars, *jaxpr.invars]
    unknown = [x for x, value in zip(inputs, known, strict=True) if value is None]

    def program(*numbers: Array) -> list[Any]:
        remaining = iter(numbers)
        values = [next(remaining) if value is None else value for value in known]
        count = len(jaxpr.constvars)
        return interpret(jaxpr, values[:count], values[count:], _equation)

    like = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in unknown]
    return jax.make_jaxpr(program)(*like)


def as_index(x: Any) -> np.ndarray | None:
    """The array of indices that `x` is, if its values are known."""
    if isinstance(x, Tracer) or jnp.ndim(x) == 0:
        return None
    is_whole = getattr(x.dtype, "kind", "key") in "iub"
    return np.asarray(x, x.dtype) if is_whole else None


def _equation(eqn: Any, values: list[Any]) -> list[Any]:
    values = [_known(*pair) for pair in zip(eqn.invars, values, strict=True)]
    name, params = eqn.primitive.name, eqn.params
    is_index = all(not jnp.issubdtype(x.aval.dtype, jnp.inexact) for x in eqn.outvars)
    if is_index and all(isinstance(x, np.ndarray) for x in values):
        with jax.ensure_compile_time_eval():
            return list(map(np.asarray, evaluated(eqn.primitive, values, params)))
    if _must_be_replaced(eqn):
        if is_part(eqn):
            program = params["program"]
            count = len(program.jaxpr.constvars)
            return interpret(program.jaxpr, values[:count], values[count:], _equation)
        if name == LINEAR_SOLVE:
            program, inputs = solution_program(values, params)
            return interpret(program.jaxpr, program.consts, inputs, _equation)
        if name == CONTRACTION and eqn.outvars[0].aval.size <= LARGEST_SUM:
            left, right = values
            return [written_out(left, right, params["dimension_numbers"])]
        if name in SCATTERS and isinstance(values[1], np.ndarray):
            return [_scattered(name, values, params)]
        if name in _OF_PAIRS:
            return [_reduced(eqn.primitive, jnp.asarray(values[0]), params)]
        if name in CUMULATIVE:
            return [_running(name, jnp.asarray(values[0]), **params)]
        if name in FACTORS:
            return in_plain_operations(name, list(map(jnp.asarray, values)), params)
    elif any(map(_needs_rewriting, programs_within(eqn))):
        if name in _LOOPS:
            return _LOOPS[name](values, params)
        inner = wrapped_program(eqn)
        if inner is not None:
            return interpret(*inner, values, _equation)
    return evaluate(eqn.primitive, values, params)


def _known(atom: Any, value: Any) -> Any:
    """A value, as a NumPy array where it is an index written into the program."""
    if not isinstance(atom, Literal):
        return value
    found = np.asarray(atom.val, value.dtype)
    return value if jnp.issubdtype(found.dtype, jnp.inexact) else found


def _must_be_replaced(eqn: Any) -> bool:
    name = eqn.primitive.name
    if name in _OF_PAIRS:
        return eqn.invars[0].aval.size > LARGEST_SUM
    if is_part(eqn):
        return True
    if name in FACTORS:
        return is_small(eqn)
    return name in (*SCATTERS, *CUMULATIVE, LINEAR_SOLVE) or (
        name == CONTRACTION and not is_small_product(eqn)
    )


def _needs_rewriting(jaxpr: Any) -> bool:
    return any(
        _must_be_replaced(eqn) or any(map(_needs_rewriting, programs_within(eqn)))
        for eqn in jaxpr.eqns
        if is_part(eqn) or eqn.primitive.name != NAME
    )


# Loops and branches -----------------------------------------------------------------------


def _outputs(closed: ClosedJaxpr, values: list[Any]) -> list[Any]:
    out = interpret(closed.jaxpr, closed.consts, values, _equation)
    return [
        jnp.asarray(x, aval.dtype) for x, aval in zip(out, closed.out_avals, strict=True)
    ]


def _scan(values: list[Any], params: dict[str, Any]) -> list[Any]:
    count, inner = params["num_carry"], params["jaxpr"]
    first = params["num_consts"]
    consts, carry, rows = np.split(np.arange(len(values)), [first, first + count])
    pick = lambda numbers: [values[k] for k in numbers]

    def turn(carry, row):
        out = _outputs(inner, [*pick(consts), *carry, *row])
        return out[:count], out[count:]

    how = {key: params[key] for key in ("length", "reverse", "unroll")}
    carry, rows = lax.scan(turn, pick(carry), pick(rows), **how)
    return [*carry, *rows]


def _while(values: list[Any], params: dict[str, Any]) -> list[Any]:
    first, second = params["cond_nconsts"], params["body_nconsts"]
    outer, inner = values[:first], values[first : first + second]
    goes_on = lambda carry: _outputs(params["cond_jaxpr"], [*outer, *carry])[0]
    turn = lambda carry: _outputs(params["body_jaxpr"], [*inner, *carry])
    return lax.while_loop(goes_on, turn, list(map(jnp.asarray, values[first + second :])))


def _cond(values: list[Any], params: dict[str, Any]) -> list[Any]:
    number, *operands = values
    branches = [lambda _, b=branch: _outputs(b, operands) for branch in params["branches"]]
    return lax.switch(number, branches, None)


_LOOPS = {"scan": _scan, "while": _while, "cond": _cond}


# Scatters to known places ----------------------------------------------------------------

# The number of updates of one place up to which they are added by a gather of all places
# each. More gathers compile slowly: a run of 60 springs between two coordinates took 18 s
# to compile.
_UNROLLED = 8


def _scattered(name: str, values: list[Any], params: dict[str, Any]) -> Array:
    operand, index, updates = values
    places = places_of_updates(operand.shape, index, updates.shape, params)
    updates, size = jnp.ravel(updates), operand.size
    if name == "scatter":
        source, falls = np.arange(size), places >= 0
        source[places[falls]] = size + np.flatnonzero(falls)
        return at_places(
            jnp.append(jnp.ravel(operand), updates), source.reshape(operand.shape)
        )
    order = np.argsort(places, kind="stable")
    order = order[places[order] >= 0]
    to = places[order]
    # The number of earlier updates of the same place: one pass over all places adds the
    # first update of each, the next pass the second.
    before = np.arange(to.size) - np.searchsorted(to, to)
    updates = jnp.append(updates, jnp.zeros((), updates.dtype))
    # The few places with many updates, such as a body that all others are attached to, are
    # added up by themselves: passes over all places would be many.
    often = np.unique(to[before >= _UNROLLED])
    is_often = np.isin(to, often)
    if often.size > 0:
        source = np.full((1 + before.max(), often.size), updates.size - 1)
        place = np.searchsorted(often, to[is_often])
        source[before[is_often], place] = order[is_often]
        sums = _reduced(reduce_sum_p, at_places(updates, source), dict(axes=(0,)))
        source = np.full(size, often.size)
        source[often] = np.arange(often.size)
        sums = jnp.append(sums, jnp.zeros((), sums.dtype))
        operand = operand + at_places(sums, source.reshape(operand.shape))
    before, to, order = (x[~is_often] for x in (before, to, order))
    source = np.full((1 + before.max(initial=-1), size), updates.size - 1)
    source[before, to] = order
    add = lambda x, row: x + at_places(updates, row.reshape(operand.shape))
    return functools.reduce(add, source, operand)


# Sums of many entries -------------------------------------------------------------------

# The reductions that are replaced if they are large, as operations on two operands.
_OF_PAIRS: dict[str, Callable[[Any, Any], Any]] = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
# A loop over the terms takes this many entries at a time, so that it uses vectors.
_SIDE_BY_SIDE = 64


def _reduced(primitive: Any, x: Array, params: dict[str, Any]) -> Array:
    """A reduction over axes: a loop over rows of terms, then a small one over the rest."""
    op, axes = _OF_PAIRS[primitive.name], params["axes"]
    kept = [k for k in range(x.ndim) if k not in axes]
    shape = tuple(x.shape[k] for k in kept)
    size = math.prod(shape)
    terms = jnp.transpose(x, (*axes, *kept)).reshape(-1, size)
    count = len(terms)
    if count <= _UNROLLED:
        return functools.reduce(op, terms).reshape(shape)
    width = min(max(_SIDE_BY_SIDE // size, 1), count)
    whole = count - count % width
    rows = terms[:whole].reshape(-1, width * size)
    total, _ = lax.scan(lambda total, row: (op(total, row), None), rows[0], rows[1:])
    rest = [*total.reshape(width, size), *terms[whole:]]
    if len(rest) <= _UNROLLED:
        return functools.reduce(op, rest).reshape(shape)
    (out,) = evaluate(primitive, [jnp.stack(rest)], params | dict(axes=(0,)))
    return out.reshape(shape)


# Running sums -----------------------------------------------------------------------------

# The operation on two entries, the one on many, and the number that changes nothing.
_OF_RUNNING: dict[str, tuple[Callable[..., Array], Callable[..., Array], float]] = {
    "cumsum": (lax.add, jnp.sum, 0),
    "cumprod": (lax.mul, jnp.prod, 1),
    "cummax": (lax.max, jnp.max, -np.inf),
    "cummin": (lax.min, jnp.min, np.inf),
}


def _running(name: str, x: Array, *, axis: int, reverse: bool) -> Array:
    """Each entry joined with all before it along an axis."""
    of_two, of_many, neutral = _OF_RUNNING[name]
    count = x.shape[axis]
    is_float = jnp.issubdtype(x.dtype, jnp.floating)
    if x.size * count <= LARGEST_SUM and (is_float or np.isfinite(neutral)):
        before = np.tril(np.ones((count, count), bool))
        before = (before.T if reverse else before).reshape(
            *[1] * axis, count, count, *[1] * (x.ndim - axis - 1)
        )
        terms = jnp.where(before, jnp.expand_dims(x, axis), jnp.asarray(neutral, x.dtype))
        return of_many(terms, axis=axis + 1).astype(x.dtype)
    # By shifts that double (W. D. Hillis and G. L. Steele, 1986).
    x = jnp.moveaxis(x, axis, 0)
    x = x[::-1] if reverse else x
    shift = 1
    while shift < count:
        x = jnp.concatenate([x[:shift], of_two(x[:-shift], x[shift:])])
        shift *= 2
    return jnp.moveaxis(x[::-1] if reverse else x, 0, axis)


# Primitives that this module replaces, where their indices are known and sizes allow it.
REWRITTEN = SCATTERS | CUMULATIVE | FACTORS | _OF_PAIRS.keys() | {CONTRACTION, LINEAR_SOLVE}


def places_of_updates(
    shape: tuple[int, ...], index: np.ndarray, update_shape: tuple[int, ...], params: Any
) -> Int[np.ndarray, " updates"]:
    """The place in the flat array of each flat update; negative if it is dropped."""
    dims, grid = params["dimension_numbers"], np.indices(update_shape)
    windows, shared = dims.update_window_dims, dims.operand_batching_dims
    at = [grid[k] for k in range(len(update_shape)) if k not in windows]
    starts = index[tuple(at)]
    skipped = (*dims.inserted_window_dims, *shared)
    inner = [k for k in range(len(shape)) if k not in skipped]
    first, within = np.zeros((2, len(shape), *update_shape), int)
    room = np.array(shape) - 1
    for axis, k in zip(inner, windows, strict=True):
        within[axis] = grid[k]
        room[axis] -= update_shape[k] - 1
    for k, axis in enumerate(dims.scatter_dims_to_operand_dims):
        first[axis] = starts[..., k]
    for axis, k in zip(shared, dims.scatter_indices_batching_dims, strict=True):
        first[axis] = at[k]
    room = room.reshape(-1, *[1] * len(update_shape))
    if params["mode"] == lax.GatherScatterMode.CLIP:
        first = np.clip(first, 0, room)
    falls = np.all((first >= 0) & (first <= room), axis=0)
    strides = np.cumprod([1, *shape[:0:-1]])[::-1]
    places = np.tensordot(strides[: len(shape)], first + within, 1)
    return np.where(falls, places, -1).ravel()
