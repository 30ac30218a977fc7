"""Large systems as sums over elements: rods, springs, any row of the constraints."""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractCorrected
from .._programs import jacobian_pattern, LARGE
from .._solvers import RowPattern
from .._system import Elements, System
from .._types import Args, Coordinates, Scalar
from .interval import gradient_with_time, Time


# A function whose entries are added up, each of a few coordinates.
Summands: TypeAlias = Callable[[Coordinates], Float[Array, " elements"]]


def is_weight(system: System, q: Coordinates, args: Args) -> bool:
    """Whether the potential of a large system is linear: it then has no stiffness."""
    if q.size <= LARGE or isinstance(system.potential, Elements):
        return False
    hessian = jacobian_pattern(jax.grad(lambda q: system.potential(q, args)), q)
    return hessian is not None and hessian.nnz == 0


def element_energies(system: System, q: Coordinates, args: Args) -> list[Summands] | None:
    """The elements that the potential of a large system is the sum of, if it is known."""
    potential = system.potential
    if q.size <= LARGE or not isinstance(potential, Elements):
        return None
    return [lambda q, part=part: part.each(q, args) for part in potential.parts]


def gradient_and_work_by_rows(
    derivative: AbstractCorrected,
    fixed: list[Summands],
    driven: Callable[[Coordinates, Time], Scalar] | None,
    a: tuple[Coordinates, Time],
    b: tuple[Coordinates, Time],
) -> tuple[Coordinates, Scalar | None]:
    """Like `gradient_and_work`, but each summand of `fixed` is corrected by itself.

    One correction along the whole increment would couple all bodies with each other.
    """
    (qa, ta), (qb, tb) = a, b
    total, work = jnp.zeros_like(qa), None
    if driven is not None and ta is not tb:
        total, work = gradient_with_time(derivative, driven, a, b)
    elif driven is not None:
        fixed = [*fixed, lambda q: driven(q, ta)[None]]
    for fn in fixed:
        rows = RowPattern(fn, qa)
        gradients = lambda q, fn=fn, rows=rows: rows.derivative(fn, q)
        by_row = derivative.gradients_of_rows(fn, gradients, rows.own, qa, qb)
        total = total.at[rows.columns].add(by_row)
    return total, work
