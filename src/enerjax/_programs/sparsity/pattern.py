"""Which entries of a Jacobian can differ from zero: read off the traced program.

Every array of the program carries, for each of its entries, the set of the unknowns that
the entry depends on, as a row of a sparse matrix of truth values. The sets are exact for
arithmetic, reductions, and moves of entries with known indices. The outputs of anything
else (loops, dense factorisations, computed indices) count as depending on all its inputs.

**To add a rule:** enter `rule(primitive, values, params, avals)` in `_RULES`. It returns
one matrix for each output, with one row of unknowns for each entry.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array

from ..jaxprs import interpret, is_known, name_of, wrapped_program
from ..numpy_primitives import as_rows, evaluated, moved
from ..primitives import (
    CONTRACTION,
    CONTROL_FLOW,
    CUMULATIVE,
    DATA_MOVEMENT,
    ELEMENTWISE,
    moved_operands,
    PIECEWISE_CONSTANT,
    REDUCTIONS,
)


# Systems with more unknowns than this are searched for structure.
LARGE = 64
# Primitives whose outputs have a derivative of zero.
_ZERO = PIECEWISE_CONSTANT | {"stop_gradient"}
# Patterns with more entries than this are of no use.
_MAX_ENTRIES = 20_000_000


class _Depends:
    """An array that depends on unknowns, with a row of unknowns for each entry."""

    def __init__(self, rows: "scipy.sparse.csr_array", aval: Any):
        self.rows = rows
        self.shape, self.dtype = aval.shape, aval.dtype


class _Constant:
    """An array that depends on no unknown, but whose value is not known yet."""

    def __init__(self, aval: Any):
        self.shape, self.dtype = aval.shape, aval.dtype


# `_Depends`, `_Constant`, or the array itself where its value is known.
_Value: TypeAlias = Any


class _TooDense(Exception):
    """The pattern holds too many entries to be of use."""


def jacobian_pattern(
    fn: Callable[[Array], Array], like: Array, *, of_values: bool = False
) -> "scipy.sparse.csr_array | None":
    """The entries of the Jacobian `d fn / dx` that can differ from zero.

    The pattern has the shape `(fn(like).size, like.size)`. It is `None` if so many entries
    can differ from zero that a pattern is of no use. `fn` is traced, and nothing but
    indices is evaluated. With `of_values` a dependence without a derivative, as through a
    comparison, counts too.
    """
    program = jax.make_jaxpr(fn)(like)
    size = like.size
    unknowns = _Depends(_identity(size), like)
    consts = [c if is_known(c) else _Constant(jnp.asarray(c)) for c in program.consts]
    try:
        with jax.ensure_compile_time_eval():
            rule = functools.partial(_equation, of_values=of_values)
            (out,) = interpret(program.jaxpr, consts, [unknowns], rule)
    except _TooDense:
        return None
    if isinstance(out, _Depends):
        return out.rows
    return scipy.sparse.csr_array((int(np.prod(jnp.shape(out))), size), dtype=bool)


def _identity(size: int) -> "scipy.sparse.csr_array":
    index = np.arange(size + 1)
    return scipy.sparse.csr_array(
        (np.ones(size, bool), index[:-1], index), shape=(size, size)
    )


def _equation(equation: Any, values: list[_Value], of_values: bool) -> list[_Value]:
    primitive, params = equation.primitive, equation.params
    avals = [var.aval for var in equation.outvars]
    rule = _RULES.get(name_of(equation))
    inner = wrapped_program(equation)
    if rule is None and inner is not None:
        within = functools.partial(_equation, of_values=of_values)
        return interpret(*inner, values, within)
    if not any(isinstance(v, _Depends) for v in values):
        if any(isinstance(v, _Constant) for v in values) or primitive.name in CONTROL_FLOW:
            return list(map(_Constant, avals))
        return evaluated(primitive, values, params)
    # Truth values and indices have no derivative.
    smooth = any(jnp.issubdtype(aval.dtype, jnp.inexact) for aval in avals)
    if not of_values and (not smooth or primitive.name in _ZERO):
        return list(map(_Constant, avals))
    rows = (rule or _everything)(primitive, values, params, avals)
    return [_Depends(r, aval) for r, aval in zip(rows, avals, strict=True)]


# One rule for each primitive -------------------------------------------------------------


def _entries(value: _Value) -> int:
    return int(np.prod(np.shape(value), dtype=int))


def _rows(value: _Value, width: int) -> "scipy.sparse.csr_array":
    if isinstance(value, _Depends):
        return value.rows
    return scipy.sparse.csr_array((_entries(value), width), dtype=bool)


def _width(values: list[_Value]) -> int:
    return next(shape_of(v.rows)[1] for v in values if isinstance(v, _Depends))


def shape_of(rows: "scipy.sparse.csr_array") -> tuple[int, int]:
    num_rows, width = rows.shape  # pyright: ignore
    return num_rows, width


def _where(rows: "scipy.sparse.csr_array", keep: np.ndarray) -> "scipy.sparse.csr_array":
    """The rows to keep; the others become empty."""
    counts = np.diff(rows.indptr)
    kept = np.repeat(keep, counts)
    pointers = np.concatenate([[0], np.cumsum(np.where(keep, counts, 0))])
    return scipy.sparse.csr_array(
        (rows.data[kept], rows.indices[kept], pointers), shape=rows.shape
    )


def _elementwise(primitive: Any, values: list[_Value], params: Any, avals: Any) -> list:
    """Entry by entry. Known zero factors and known choices remove dependences."""
    (aval,), out = avals, None
    known = [np.asarray(v) for v in values if not isinstance(v, _Depends | _Constant)]
    for k, value in enumerate(values):
        if not isinstance(value, _Depends):
            continue
        rows = value.rows
        if value.shape != aval.shape:
            places = np.arange(_entries(value)).reshape(value.shape)
            rows = rows[np.broadcast_to(places, aval.shape).ravel()]
        if primitive.name == "mul" and known:
            rows = _where(rows, np.broadcast_to(known[0] != 0, aval.shape).ravel())
        if primitive.name == "select_n" and known and known[0].shape == np.shape(value):
            if not isinstance(values[0], _Constant | _Depends):
                rows = _where(rows, known[0].astype(int).ravel() == k - 1)
        out = rows if out is None else out + rows
    return [out]


def _moved(primitive: Any, values: list[_Value], params: Any, avals: Any) -> list:
    """Data movement: entries are numbered, and the primitive moves their numbers."""
    dependent = [k for k, v in enumerate(values) if isinstance(v, _Depends)]
    numbered = moved_operands(primitive.name, len(values))
    indices = [k for k in range(len(values)) if k not in numbered]
    if any(isinstance(values[k], _Constant | _Depends) for k in indices):
        return _everything(primitive, values, params, avals)
    operands, rows, first = list(values), [], 1
    for k, value in enumerate(values):
        if k in indices:
            continue
        numbers = np.zeros(np.shape(value))
        if k in dependent:
            numbers = (first + np.arange(_entries(value), dtype=float)).reshape(value.shape)
            rows.append(value.rows)
            first += _entries(value)
        operands[k] = numbers
    blank = scipy.sparse.csr_array((1, _width(values)), dtype=bool)
    table = scipy.sparse.csr_array(scipy.sparse.vstack([blank, *rows]))
    outs = moved(primitive, operands, params)
    return [table[np.nan_to_num(np.asarray(out)).astype(int).ravel()] for out in outs]


def _summed(primitive: Any, values: list[_Value], params: Any, avals: Any) -> list:
    """Reductions: the entries along some axes come together in one."""
    (value,), axes = values, params["axes"]
    keep = [k for k in range(len(value.shape)) if k not in axes]
    numbers = np.arange(int(np.prod([value.shape[k] for k in keep], dtype=int)))
    shape = [n if k in keep else 1 for k, n in enumerate(value.shape)]
    target = np.broadcast_to(numbers.reshape(shape), value.shape).ravel()
    return [_gathered(value.rows, target, numbers.size)]


def _running(primitive: Any, values: list[_Value], params: Any, avals: Any) -> list:
    """Running sums: each entry joins those before it along an axis."""
    (value,), axis = values, params["axis"]
    places = np.moveaxis(np.arange(_entries(value)).reshape(value.shape), axis, 0)
    places = places[::-1] if params["reverse"] else places
    if places.size * len(places) > _MAX_ENTRIES:
        raise _TooDense
    after, before = np.tril_indices(len(places))
    pairs = places[after].ravel(), places[before].ravel()
    joins = scipy.sparse.csr_array(
        (np.ones(pairs[0].size, bool), pairs), shape=(places.size, places.size)
    )
    return [joins @ value.rows]


def _gathered(
    rows: "scipy.sparse.csr_array", target: np.ndarray, count: int
) -> "scipy.sparse.csr_array":
    """The unions of the rows with the same target. Negative targets are left out."""
    source = np.nonzero(target >= 0)[0]
    ones = np.ones(source.size, bool)
    shape = (count, target.size)
    return scipy.sparse.csr_array((ones, (target[source], source)), shape=shape) @ rows


def _added(primitive: Any, values: list[_Value], params: Any, avals: Any) -> list:
    """`scatter-add`: each update joins the entry that it is added to."""
    operand, index, updates = values
    if isinstance(index, _Constant | _Depends):
        return _everything(primitive, values, params, avals)
    (aval,) = avals
    count, width = int(np.prod(aval.shape, dtype=int)), _width(values)
    # The operation of the program adds numbers of its own dtype, which cannot be places.
    zero = jnp.zeros(aval.shape)
    names = "dimension_numbers", "indices_are_sorted", "unique_indices", "mode"
    how = {name: params[name] for name in names}
    fall = lambda u: jax.lax.scatter_add(zero, index, u, **how)
    _, pull = jax.vjp(fall, jnp.zeros(np.shape(updates)))
    numbers = (1 + jnp.arange(count, dtype=zero.dtype)).reshape(aval.shape)
    target = np.asarray(pull(numbers)[0]).astype(int).ravel() - 1
    joined = _gathered(_rows(updates, width), target, count)
    return [_rows(operand, width) + joined]


def _each_matrix(primitive: Any, values: list[_Value], params: Any, avals: Any) -> list:
    """Every entry depends on its own matrix, of a batch of matrices."""
    (value,) = values
    matrix = np.arange(_entries(value)) // int(np.prod(value.shape[-2:], dtype=int))
    return [_gathered(value.rows, matrix, matrix[-1] + 1)[matrix]]


def _product(primitive: Any, values: list[_Value], params: Any, avals: Any) -> list:
    """`dot_general`: an entry depends on a row of the left side and a column of the right.

    The entries of each side are united along the contracted axes, and repeated along the
    free axes of the other side.
    """
    contracted, batch = params["dimension_numbers"]
    (aval,), out, num_batch = avals, None, len(batch[0])
    num_left = len(np.shape(values[0])) - num_batch - len(contracted[0])
    for side, value in enumerate(values):
        if not isinstance(value, _Depends):
            continue
        if not isinstance(values[1 - side], _Constant | _Depends):
            return [_product_with_known(values, params["dimension_numbers"], side)]
        # The axes of this side in the order of the output: batch axes, then free ones.
        free = [
            k for k in range(len(value.shape)) if k not in (*contracted[side], *batch[side])
        ]
        order = [*batch[side], *free]
        sizes = [value.shape[k] for k in order]
        numbers = np.arange(int(np.prod(sizes, dtype=int))).reshape(sizes)
        summed = [value.shape[k] for k in contracted[side]]
        wide = np.broadcast_to(numbers.reshape(sizes + [1] * len(summed)), sizes + summed)
        target = np.transpose(wide, np.argsort([*order, *contracted[side]])).ravel()
        united = _gathered(value.rows, target, numbers.size)
        before = num_left if side == 1 else 0
        after = len(aval.shape) - num_batch - num_left if side == 0 else 0
        shape = sizes[:num_batch] + [1] * before + sizes[num_batch:] + [1] * after
        rows = united[np.broadcast_to(numbers.reshape(shape), aval.shape).ravel()]
        out = rows if out is None else out + rows
    return [out]


def _product_with_known(values: list[_Value], numbers: Any, side: int) -> Any:
    """`dot_general` with a factor whose zeros are known."""
    contracted, batch = numbers
    value, factor = values[side], np.asarray(values[1 - side]) != 0
    entries = np.arange(_entries(value)).reshape(value.shape)
    own = as_rows(entries, contracted[side], batch[side])
    other = as_rows(factor, contracted[1 - side], batch[1 - side])
    part, place, term = np.nonzero(other)
    if own.shape[1] * place.size > _MAX_ENTRIES:
        raise _TooDense
    free = np.arange(own.shape[1])
    source = own[part[:, None], free, term[:, None]]
    sizes = (own.shape[1], other.shape[1]) if side == 0 else (other.shape[1], own.shape[1])
    pair = (free, place[:, None]) if side == 0 else (place[:, None], free)
    target = (part[:, None] * sizes[0] + pair[0]) * sizes[1] + pair[1]
    count = len(own) * math.prod(sizes)
    ones = np.ones(source.size, bool)
    joins = scipy.sparse.csr_array(
        (ones, (target.ravel(), source.ravel())), shape=(count, entries.size)
    )
    return joins @ value.rows


def _everything(primitive: Any, values: list[_Value], params: Any, avals: Any) -> list:
    """Every entry depends on all unknowns that any input depends on."""
    width = _width(values)
    dependent = [v.rows for v in values if isinstance(v, _Depends)]
    union = np.unique(np.concatenate([rows.indices for rows in dependent]))
    outs = []
    for aval in avals:
        count = int(np.prod(aval.shape, dtype=int))
        if count * union.size > _MAX_ENTRIES:
            raise _TooDense
        pointers = union.size * np.arange(count + 1)
        ones = np.ones(count * union.size, bool)
        outs.append(
            scipy.sparse.csr_array((ones, np.tile(union, count), pointers), (count, width))
        )
    return outs


_RULES: dict[str, Callable] = {
    **dict.fromkeys(ELEMENTWISE, _elementwise),
    **dict.fromkeys(DATA_MOVEMENT, _moved),
    **dict.fromkeys(REDUCTIONS, _summed),
    **dict.fromkeys(CUMULATIVE, _running),
    "scatter-add": _added,
    CONTRACTION: _product,
    "jit enerjax_inverse": _each_matrix,
}
