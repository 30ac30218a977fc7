"""Functions that are sums over elements, and say so."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import Indices
from .._types import Args, Coordinates


class Elements(eqx.Module):
    """One function of a few coordinates, applied to many groups of them.

    Use it as the `potential` of a `System`, an energy that is a sum over springs, beams or
    weights. Several can be added, `springs + weights`, and `constraint` functions can call
    them too. The program is as large as for one element. For large
    systems `EnergyConsistent` takes the stiffness of each element from here.

        springs = ej.Elements(energy_of_spring, table)
        energy_of_spring(x, k, args)  # coordinates table[k] of spring number k

    **Arguments:**

    - `fn`: `fn(x, k, args)` of the coordinates `x` of element `k`, shape `(width,)`, which
      finds the parameters of this element as `args["stiffness"][k]`. Its values are summed
      if they are scalars, and concatenated if they are vectors.
    - `table`: the indices of the coordinates of each element, shape `(elements, width)`.

    **Raises:** `TypeError` and `ValueError` for bad arguments; when it is called,
    `ValueError` for an index beyond the coordinates.
    """

    fn: Callable[[Float[Array, " width"], Any, Args], Array]
    table: Indices = eqx.field(static=True)
    others: "tuple[Elements, ...]"

    def __init__(self, fn: Callable, table: Any, *, others: "tuple[Elements, ...]" = ()):
        if not callable(fn):
            raise TypeError(
                f"`Elements(fn, table)`: `fn` must be a function of (x, k, args), got "
                f"{type(fn).__name__}."
            )
        array = np.asarray(table)
        if array.ndim != 2 or not np.issubdtype(array.dtype, np.integer):
            raise ValueError(
                "`Elements(fn, table)`: `table` must hold the indices of the coordinates "
                "of each element, integers of shape (elements, width); got shape "
                f"{array.shape} of {array.dtype}."
            )
        if array.min(initial=0) < 0:
            raise ValueError("`Elements(fn, table)`: indices in `table` start from 0.")
        self.fn, self.table, self.others = fn, Indices(array), others

    def each(self, q: Coordinates, args: Args = None) -> Float[Array, "elements ..."]:
        """The values of the elements."""
        table = self.table.array
        if table.max(initial=-1) >= q.size:
            raise ValueError(
                f"`Elements(fn, table)`: `table` contains the index {table.max()}, but "
                f"there are {q.size} coordinates, counted from 0."
            )
        numbers = jnp.arange(table.shape[0])
        return jax.vmap(self.fn, in_axes=(0, 0, None))(q[table], numbers, args)

    def __call__(self, q: Coordinates, args: Args = None) -> Array:
        values = self.each(q, args)
        value = jnp.sum(values) if values.ndim == 1 else values.ravel()
        return sum((other(q, args) for other in self.others), start=value)

    def __add__(self, other: "Elements") -> "Elements":
        if not isinstance(other, Elements):
            return NotImplemented
        others = (*self.others, Elements(other.fn, other.table.array), *other.others)
        return Elements(self.fn, self.table.array, others=others)

    @property
    def parts(self) -> "tuple[Elements, ...]":
        """The summands, each with one function."""
        return (Elements(self.fn, self.table.array), *self.others)
