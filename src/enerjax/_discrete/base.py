import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._types import Coordinates, Scalar


class AbstractDerivative(eqx.Module):
    """A discrete gradient: a rule that turns a function and two points into a vector.

    Every form satisfies, with `D = gradient(fn, a, b)`,

        D . (b - a) = fn(b) - fn(a)     (directionality, to round-off)
        D -> grad fn(a)   as b -> a     (consistency)

    is symmetric in `a` and `b`, and linear in `fn`: the discrete gradient of
    `V + lam . Phi` is that of `V` plus those of the constraints, row by row.

    Schemes try the first two at the start of a run, with the functions of the system. A
    form that is not directional must say so, `is_directional = False` in the class: the
    energy is then not kept, and the audit of a run shows by how much.
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

        `weights` are what squares of the increments are weighted with in the norm of a
        correction: they matter where the entries have different units. `size` tells how
        large the terms of `fn` are, where they may cancel: a correction below their
        round-off is none.
        """


def significant(defect: Array, size: Array) -> Array:
    """`defect`, or zero where it is the round-off of a difference of numbers of `size`.

    Not a number stays what it is: it must show in the step.
    """
    return jnp.where(jnp.abs(defect) <= jnp.finfo(defect.dtype).eps * size, 0, defect)
