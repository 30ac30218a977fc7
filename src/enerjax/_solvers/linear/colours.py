"""Colours of the columns of sparse Jacobians: columns that share no row have the same one.

The sum of all columns of a colour is a single product with the Jacobian.
"""

from collections.abc import Callable

import numpy as np
import scipy
from jaxtyping import Array, Float

from ..._programs import columns_along, columns_in_turn, shape_of


def coloured_products(
    fn: Callable[[Array], Array],
    x: Float[Array, " n"],
    colours: np.ndarray,
    rarely: bool = False,
) -> Float[Array, "m ... colours"]:
    """For each colour, the sum of the columns of the Jacobian that have this colour.

    If they are needed `rarely`, a program is chosen that compiles quickly.
    """
    numbers = np.arange(int(colours.max(initial=0)) + 1)
    columns = columns_in_turn if rarely else columns_along
    return columns(fn, x, colours[:, None] == numbers)


def column_colours(pattern: "scipy.sparse.csr_array", order: np.ndarray) -> np.ndarray:
    """Colours of the columns, such that columns of equal colour share no row.

    Greedy: in the given `order`, each column gets the first colour that is still free.
    """
    by_column = pattern.tocsc()
    num_rows, num_columns = shape_of(pattern)
    seen: list[set[int]] = [set() for _ in range(num_rows)]
    colours = np.zeros(num_columns, int)
    for column in order:
        rows = by_column.indices[by_column.indptr[column] : by_column.indptr[column + 1]]
        taken = set().union(*(seen[row] for row in rows))
        colour = next(c for c in range(len(taken) + 1) if c not in taken)
        colours[column] = colour
        for row in rows:
            seen[row].add(colour)
    return colours
