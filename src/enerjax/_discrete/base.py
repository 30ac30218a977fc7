import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._types import Coordinates, Scalar


class AbstractDerivative(eqx.Module):
    """A discrete gradient: it maps a function and two points to a vector.

    Every form satisfies, with `D = gradient(fn, a, b)`,

        D . (b - a) = fn(b) - fn(a)     (directionality, to round-off)
        D -> grad fn(a)   as b -> a     (consistency)

    is symmetric in `a` and `b`, and linear in `fn`: the discrete gradient of
    `V + lam . Phi` is that of `V` plus those of the constraints, row by row.

    The first two are checked at the start of a run, with the functions of the system. A
    form that is not directional must set `is_directional = False` in its class. The energy
    is then not conserved, and the audit of a run shows by how much.
    """

    is_directional: ClassVar[bool] = True

    @abc.abstractmethod
    def gradient(
        self,
        fn: Callable[[Coordinates], Scalar],
        a: Coordinates,
        b: Coordinates,
        *,
        weights: Coordinates | float = 1.0,
        size: Scalar | float = 0.0,
    ) -> Coordinates:
        """The discrete gradient of the scalar function `fn` between `a` and `b`.

        `weights` are those of the squared increments in the norm of a correction; they
        matter if the entries have different units. `size` is that of the terms of `fn`,
        which may cancel: a correction below their round-off is dropped.
        """


def significant(defect: Array, size: Array) -> Array:
    """`defect`, or zero if it is the round-off of a difference of numbers of `size`.

    NaN stays NaN, so that the step fails.
    """
    return jnp.where(jnp.abs(defect) <= jnp.finfo(defect.dtype).eps * size, 0, defect)
