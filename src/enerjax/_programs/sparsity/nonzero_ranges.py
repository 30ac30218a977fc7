"""Which entries of tangents can differ from zero in which columns, before these are known.

As tables of truth values, whose last axis are the columns.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .data_movement import MOVES


# Truth values beyond which it is not asked.
_MOST = 2**15
# What is left of arithmetic in a tangent.
ELEMENTWISE = frozenset("add add_any convert_element_type copy div mul neg sub".split())


def filled_after(
    equation: Any, masks: Sequence[Any], count: int
) -> list[np.ndarray] | None:
    """Of the outputs of an equation, given those of its inputs, `False` of constants.

    `None` where it is not asked for: one of them is, or there are too many entries.
    """
    name, params = equation.primitive.name, equation.params
    shapes = [(*x.aval.shape, count) for x in equation.outvars]
    if max(map(math.prod, shapes)) > _MOST or any(mask is None for mask in masks):
        return None
    pairs = zip(equation.invars, masks, strict=True)
    tables = [np.broadcast_to(mask, (*x.aval.shape, count)) for x, mask in pairs]
    if name in ELEMENTWISE:
        return [np.broadcast_to(functools.reduce(np.logical_or, tables), shapes[0])]
    if name == "reduce_sum":
        return [np.asarray(np.any(tables[0], axis=params["axes"]))]
    if name in MOVES:
        return moved(MOVES[name], tables, params)
    columns = [np.any(x, axis=tuple(range(x.ndim - 1))) for x in tables]
    union = functools.reduce(np.logical_or, columns)
    return [np.broadcast_to(union, shape) for shape in shapes]


def moved(
    move: Callable, tables: Sequence[np.ndarray], params: dict[str, Any]
) -> list[np.ndarray]:
    """What a move of entries makes of tables with a row for each entry."""
    places, rows, first = [], [], 0
    for table in tables:
        *shape, width = table.shape
        rows.append(np.reshape(table, (math.prod(shape), width)))
        places.append(np.arange(first, first + len(rows[-1])).reshape(shape))
        first += len(rows[-1])
    joined = np.concatenate(rows)
    return [joined[out.astype(int)] for out in move(*places, **params)]


def ends(filled: np.ndarray) -> range:
    """From the first to the last column that is not zero."""
    some = np.flatnonzero(np.any(filled, axis=tuple(range(filled.ndim - 1))))
    return range(int(some[0]), int(some[-1]) + 1) if some.size else range(0)
