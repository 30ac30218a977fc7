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
from .interval import Time
from .lapse import over_time


# A function whose entries are added up, each of a few coordinates.
Summands: TypeAlias = Callable[[Coordinates], Float[Array, " elements"]]


def is_weight(system: System, q: Coordinates, args: Args) -> bool:
    """Whether the potential of a large system is linear, so that none of it bends."""
    if q.size <= LARGE or isinstance(system.potential, Elements):
        return False
    bends = jacobian_pattern(jax.grad(lambda q: system.potential(q, args)), q)
    return bends is not None and bends.nnz == 0


def element_energies(system: System, q: Coordinates, args: Args) -> list[Summands] | None:
    """What adds up to the potential of a large system, if it says so."""
    potential = system.potential
    if q.size <= LARGE or not isinstance(potential, Elements):
        return None
    return [lambda q, part=part: part.each(q, args) for part in potential.parts]


def gradient_and_work_by_rows(
    derivative: AbstractCorrected,
    still: list[Summands],
    moved: Callable[[Coordinates, Time], Scalar] | None,
    a: tuple[Coordinates, Time],
    b: tuple[Coordinates, Time],
) -> tuple[Coordinates, Scalar | None]:
    """As `gradient_and_work`, each summand of `still` corrected by itself.

    A correction along the whole increment would couple all bodies with each other.
    """
    (qa, ta), (qb, tb) = a, b
    total, work = jnp.zeros_like(qa), None
    if moved is not None and ta is not tb:
        total, work = over_time(derivative, moved, a, b)
    elif moved is not None:
        still = [*still, lambda q: moved(q, ta)[None]]
    for fn in still:
        rows = RowPattern(fn, qa)
        gradients = lambda q, fn=fn, rows=rows: rows.derivative(fn, q)
        by_row = derivative.gradients_of_rows(fn, gradients, rows.own, qa, qb)
        total = total.at[rows.columns].add(by_row)
    return total, work
