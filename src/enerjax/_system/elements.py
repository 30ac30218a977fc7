"""Functions that are sums over elements, and say so."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import Indices
from .._types import Args, Coordinates, Scalar
from .strains import AbstractStrainEnergy, StrainArrays


class _OfStrains(eqx.Module):
    """The energy of the strains of one element, as a function of its coordinates."""

    strain: Callable[[Float[Array, " width"], Any, Args], Array]
    stiffness: Callable[[Any, Args], Any]

    def __call__(self, x: Float[Array, " width"], k: Any, args: Args) -> Scalar:
        strains = self.strains(x, k, args)
        return 0.5 * jnp.sum(strains * self.stresses(strains, k, args))

    def strains(self, x: Float[Array, " width"], k: Any, args: Args) -> Float[Array, " m"]:
        strains = jnp.asarray(self.strain(x, k, args), x.dtype)
        if strains.ndim > 1:
            raise ValueError(
                "`Elements.from_strains(strain, stiffness, table)`: `strain` must return a "
                f"number or a vector for one element, got shape {strains.shape}."
            )
        return strains.reshape(-1)

    def stresses(
        self, strains: Float[Array, " m"], k: Any, args: Args
    ) -> Float[Array, " m"]:
        stiffness = jnp.asarray(self.stiffness(k, args), strains.dtype)
        count = strains.size
        if stiffness.shape not in ((), (count,), (count, count)):
            raise ValueError(
                "`Elements.from_strains(strain, stiffness, table)`: the number of strains "
                f"of an element is {count}, so `stiffness` must return a number, a vector "
                f"{(count,)} or a matrix {(count, count)}; got shape {stiffness.shape}."
            )
        if stiffness.ndim < 2:
            return stiffness * strains
        # The energy depends on the symmetric part alone.
        return jnp.sum(0.5 * (stiffness + stiffness.T) * strains[None], axis=1)


class Elements(AbstractStrainEnergy):
    """One function of a few coordinates, applied to many groups of them.

    Use it as the `potential` of a `System`, an energy that is a sum over springs, beams or
    weights. Several can be added, `springs + weights`, and `constraint` functions can call
    them too. The program is as large as for one element. For large
    systems `EnergyConsistent` takes the stiffness of each element from here.
    `EnergyMomentumDecaying` damps elements that are made by `from_strains`.

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

    @staticmethod
    def from_strains(
        strain: Callable[[Float[Array, " width"], Any, Args], Array],
        stiffness: Callable[[Any, Args], Any],
        table: Any,
    ) -> "Elements":
        """Elements with the energy `Gamma . K Gamma / 2` of strains `Gamma`.

            springs = ej.Elements.from_strains(stretch, lambda k, args: args["k"][k], table)
            stretch(x, k, args)  # the length of spring number k less that without stress

        **Arguments:**

        - `strain`: `strain(x, k, args)` of the coordinates `x` of element `k`, shape
          `(width,)`: one strain, or several, shape `(m,)`.
        - `stiffness`: `stiffness(k, args)`, which must not be negative: a number, one for
          each strain, shape `(m,)`, or a symmetric matrix, shape `(m, m)` (energy per
          strain squared). Of a matrix only the symmetric part counts.
        - `table`: the indices of the coordinates of each element, shape `(elements,
          width)`.

        Where strains are functions of distances and of dot products of differences of
        points or of directors, `EnergyMomentumDecaying` conserves angular momentum to
        round-off; with cross products, such as areas, to second order.

        **Returns:** `Elements` whose values are these energies.

        **Raises:** `TypeError` and `ValueError` for bad arguments; when it is called,
        `ValueError` for strains and stiffnesses whose shapes do not fit.
        """
        for name, fn, of in (("strain", strain, "(x, k, args)"),
                             ("stiffness", stiffness, "(k, args)")):  # fmt: skip
            if not callable(fn):
                raise TypeError(
                    "`Elements.from_strains(strain, stiffness, table)`: "
                    f"`{name}` must be a function of {of}, got {type(fn).__name__}."
                )
        return Elements(_OfStrains(strain, stiffness), table)

    def each(self, q: Coordinates, args: Args = None) -> Float[Array, "elements ..."]:
        """The values of the elements."""
        return self._each(self.fn, q, args)

    def _each(self, fn: Callable, q: Coordinates, args: Args) -> Array:
        table = self.table.array
        if table.max(initial=-1) >= q.size:
            raise ValueError(
                f"`Elements(fn, table)`: `table` contains the index {table.max()}, but "
                f"there are {q.size} coordinates, counted from 0."
            )
        return jax.vmap(fn, in_axes=(0, 0, None))(q[table], self._numbers, args)

    @property
    def _numbers(self) -> Array:
        return jnp.arange(self.table.array.shape[0])

    def __call__(self, q: Coordinates, args: Args = None) -> Array:
        values = self.each(q, args)
        value = jnp.sum(values) if values.ndim == 1 else values.ravel()
        return sum((other(q, args) for other in self.others), start=value)

    def strains(self, q: Coordinates, args: Args = None) -> StrainArrays:
        return tuple(part._each(fn.strains, q, args) for part, fn in self._of_strains)

    def stresses(self, strains: StrainArrays, args: Args = None) -> StrainArrays:
        return tuple(
            jax.vmap(fn.stresses, in_axes=(0, 0, None))(own, part._numbers, args)
            for (part, fn), own in zip(self._of_strains, strains, strict=True)
        )

    def angles(self, q, args=None):
        return q[:0]

    @property
    def _of_strains(self) -> "list[tuple[Elements, _OfStrains]]":
        parts = ((part, part.fn) for part in self.parts)
        return [(part, fn) for part, fn in parts if isinstance(fn, _OfStrains)]

    def __add__(self, other: "Elements") -> "Elements":
        if not isinstance(other, Elements):
            return NotImplemented
        others = (*self.others, Elements(other.fn, other.table.array), *other.others)
        return Elements(self.fn, self.table.array, others=others)

    @property
    def parts(self) -> "tuple[Elements, ...]":
        """The summands, each with one function."""
        return (Elements(self.fn, self.table.array), *self.others)
