"""How the entries of an array depend on unknowns, primitive by primitive.

**To add a rule:** enter `rule(primitive, values, params, avals)` in `RULES`; it returns,
for each output, one row of unknowns for each entry. A primitive without a rule counts as
depending, everywhere, on all that goes in.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_array, vstack

from ..tracing import evaluate
from .data_movement import MOVES


class Depends:
    """An array of the program: its shape, and one row of unknowns for each entry."""

    def __init__(self, rows: csr_array, aval: Any):
        self.rows = rows
        self.shape, self.dtype = aval.shape, aval.dtype


class Constant:
    """An array that depends on no unknown, and has no value yet."""

    def __init__(self, aval: Any):
        self.shape, self.dtype = aval.shape, aval.dtype


# A `Depends`, a `Constant`, or a number or array where the value is known.
Value: TypeAlias = Any


def _entries(value: Value) -> int:
    return int(np.prod(np.shape(value), dtype=int))


def _rows(value: Value, width: int) -> csr_array:
    if isinstance(value, Depends):
        return value.rows
    return csr_array((_entries(value), width), dtype=bool)


def _width(values: list[Value]) -> int:
    return next(shape_of(v.rows)[1] for v in values if isinstance(v, Depends))


def shape_of(rows: csr_array) -> tuple[int, int]:
    num_rows, width = rows.shape  # pyright: ignore
    return num_rows, width


def _where(rows: csr_array, keep: np.ndarray) -> csr_array:
    """The rows with a truth value, the others empty."""
    counts = np.diff(rows.indptr)
    kept = np.repeat(keep, counts)
    pointers = np.concatenate([[0], np.cumsum(np.where(keep, counts, 0))])
    return csr_array((rows.data[kept], rows.indices[kept], pointers), shape=rows.shape)


def _elementwise(primitive: Any, values: list[Value], params: Any, avals: Any) -> list:
    """Entry by entry; a factor or a choice that is known to be zero cuts the entry off."""
    (aval,), out = avals, None
    known = [np.asarray(v) for v in values if not isinstance(v, Depends | Constant)]
    for k, value in enumerate(values):
        if not isinstance(value, Depends):
            continue
        rows = value.rows
        if value.shape != aval.shape:
            places = np.arange(_entries(value)).reshape(value.shape)
            rows = rows[np.broadcast_to(places, aval.shape).ravel()]
        if primitive.name == "mul" and known:
            rows = _where(rows, np.broadcast_to(known[0] != 0, aval.shape).ravel())
        if primitive.name == "select_n" and known and known[0].shape == np.shape(value):
            if not isinstance(values[0], Constant | Depends):
                rows = _where(rows, known[0].astype(int).ravel() == k - 1)
        out = rows if out is None else out + rows
    return [out]


def _moved(primitive: Any, values: list[Value], params: Any, avals: Any) -> list:
    """Entries change their places: the program is run with their numbers instead."""
    moving = [k for k, v in enumerate(values) if isinstance(v, Depends)]
    indices = [k for k in range(len(values)) if k not in _MOVED[primitive.name](values)]
    if any(isinstance(values[k], Constant | Depends) for k in indices):
        return everything(primitive, values, params, avals)
    operands, parts, first = list(values), [], 1
    for k, value in enumerate(values):
        if k in indices:
            continue
        numbers = np.zeros(np.shape(value))
        if k in moving:
            numbers = (first + np.arange(_entries(value), dtype=float)).reshape(value.shape)
            parts.append(value.rows)
            first += _entries(value)
        operands[k] = numbers
    blank = csr_array((1, _width(values)), dtype=bool)
    table = csr_array(vstack([blank, *parts]))
    move = MOVES.get(primitive.name)
    outs = move(*operands, **params) if move else evaluate(primitive, operands, params)
    return [table[np.nan_to_num(np.asarray(out)).astype(int).ravel()] for out in outs]


def _summed(primitive: Any, values: list[Value], params: Any, avals: Any) -> list:
    """Entries along some axes come together in one."""
    (value,), axes = values, params["axes"]
    keep = [k for k in range(len(value.shape)) if k not in axes]
    numbers = np.arange(int(np.prod([value.shape[k] for k in keep], dtype=int)))
    shape = [n if k in keep else 1 for k, n in enumerate(value.shape)]
    target = np.broadcast_to(numbers.reshape(shape), value.shape).ravel()
    return [_gathered(value.rows, target, numbers.size)]


def _gathered(rows: csr_array, target: np.ndarray, count: int) -> csr_array:
    """Rows united with those of the same target; none for a target below zero."""
    source = np.nonzero(target >= 0)[0]
    ones = np.ones(source.size, bool)
    shape = (count, target.size)
    return csr_array((ones, (target[source], source)), shape=shape) @ rows


def _added(primitive: Any, values: list[Value], params: Any, avals: Any) -> list:
    """`scatter-add`: updates join the entries where they fall."""
    operand, index, updates = values
    if isinstance(index, Constant | Depends):
        return everything(primitive, values, params, avals)
    (aval,) = avals
    count, width = int(np.prod(aval.shape, dtype=int)), _width(values)
    zero = jnp.zeros(aval.shape)
    fall = lambda u: evaluate(primitive, [zero, index, u], params)[0]
    _, pull = jax.vjp(fall, jnp.zeros(np.shape(updates)))
    numbers = (1 + jnp.arange(count, dtype=zero.dtype)).reshape(aval.shape)
    target = np.asarray(pull(numbers)[0]).astype(int).ravel() - 1
    joined = _gathered(_rows(updates, width), target, count)
    return [_rows(operand, width) + joined]


def _within(primitive: Any, values: list[Value], params: Any, avals: Any) -> list:
    """What goes on within each of many matrices stays there."""
    (value,) = values
    part = np.arange(_entries(value)) // int(np.prod(value.shape[-2:], dtype=int))
    return [_gathered(value.rows, part, part[-1] + 1)[part]]


def _product(primitive: Any, values: list[Value], params: Any, avals: Any) -> list:
    """`dot_general`: each side united along what is summed over, and repeated beside the
    free axes of the other."""
    contracted, batch = params["dimension_numbers"]
    (aval,), out, num_batch = avals, None, len(batch[0])
    num_left = len(np.shape(values[0])) - num_batch - len(contracted[0])
    for side, value in enumerate(values):
        if not isinstance(value, Depends):
            continue
        # The axes of this side in the order of the output: shared, then free.
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


def everything(primitive: Any, values: list[Value], params: Any, avals: Any) -> list:
    """Every entry on all that goes in."""
    width = _width(values)
    moving = [v.rows for v in values if isinstance(v, Depends)]
    union = np.unique(np.concatenate([rows.indices for rows in moving]))
    outs = []
    for aval in avals:
        count = int(np.prod(aval.shape, dtype=int))
        if count * union.size > _TOO_MANY:
            raise Dense
        pointers = union.size * np.arange(count + 1)
        ones = np.ones(count * union.size, bool)
        outs.append(csr_array((ones, np.tile(union, count), pointers), (count, width)))
    return outs


class Dense(Exception):
    """The pattern holds too many entries to be of use."""


_TOO_MANY = 20_000_000
_first = lambda values: [0]
_all = lambda values: range(len(values))
# The operands whose entries move; the others are indices.
_MOVED: dict[str, Callable] = {
    "reshape": _first, "transpose": _first, "squeeze": _first,
    "broadcast_in_dim": _first, "slice": _first, "rev": _first, "gather": _first,
    "dynamic_slice": _first, "copy": _first, "concatenate": _all, "pad": _all,
    "stack": _all, "unstack": _first,
    "dynamic_update_slice": lambda values: [0, 1], "scatter": lambda values: [0, 2],
    "split": _first,
}  # fmt: skip
_ELEMENTWISE = (
    "add sub mul div rem neg sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh "
    "atanh exp exp2 expm1 log log1p sqrt rsqrt cbrt pow integer_pow square abs max min "
    "clamp select_n logistic erf erfc erf_inv lgamma digamma add_any nextafter "
    "convert_element_type reduce_precision real imag"
)
RULES: dict[str, Callable] = {
    **{name: _elementwise for name in _ELEMENTWISE.split()},
    **{name: _moved for name in _MOVED},
    "reduce_sum": _summed,
    "reduce_max": _summed,
    "reduce_min": _summed,
    "reduce_prod": _summed,
    "scatter-add": _added,
    "dot_general": _product,
    "jit enerjax_inverse": _within,
}
