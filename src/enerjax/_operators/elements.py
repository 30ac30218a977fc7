"""Potentials and constraints as sums over elements, such as springs."""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractCorrected
from .._programs import jacobian_pattern, LARGE, summands_of
from .._solvers import RowPattern, SMALL
from .._system import Elements, System
from .._types import Args, Coordinates, Scalar
from .interval import gradient_with_time, Time


# A function whose entries each depend on a few coordinates; their sum is an energy.
Summands: TypeAlias = Callable[[Coordinates], Float[Array, " elements"]]


def has_linear_potential(system: System, q: Coordinates, args: Args) -> bool:
    """Whether a large system has a linear potential, and therefore no stiffness."""
    if q.size <= LARGE or isinstance(system.potential, Elements):
        return False
    hessian = jacobian_pattern(jax.grad(lambda q: system.potential(q, args)), q)
    return hessian is not None and hessian.nnz == 0


# The derivatives of all summands take one product for each colour of the columns. With more
# of them they cost more than the dense Jacobian that they avoid.
_MOST_COLOURS = 24


def element_energies(system: System, q: Coordinates, args: Args) -> list[Summands] | None:
    """The summands of the potential of a large system, or `None` if they are unknown.

    Newton's method needs a sparse Jacobian, which one correction for the whole potential
    would make dense. Without constraints the threshold is lower, and those of a plain
    function are read off its program. With constraints their derivatives would cost more
    than a correction for the whole potential, which the chord method omits.
    """
    potential = system.potential
    kinds = system.constraint, system.driven, system.nonholonomic
    is_free = all(x is None for x in kinds)
    if q.size <= (SMALL if is_free else LARGE):
        return None
    if isinstance(potential, Elements):
        return [lambda q, part=part: part.each(q, args) for part in potential.parts]
    if not is_free:
        return None
    found = summands_of(lambda q: potential(q, args))
    if jax.eval_shape(found, q).size < 2:
        return None
    is_sparse = RowPattern(found, q, small=0).num_colours <= _MOST_COLOURS
    return [found] if is_sparse else None


def gradient_and_work_by_rows(
    derivative: AbstractCorrected,
    fixed: list[Summands],
    driven: Callable[[Coordinates, Time], Scalar] | None,
    a: tuple[Coordinates, Time],
    b: tuple[Coordinates, Time],
    masses: Coordinates,
) -> tuple[Coordinates, Scalar | None]:
    """Like `gradient_and_work`, but with a separate correction for each summand.

    A single correction along the whole increment would couple all bodies with each other.
    The metric of each is that of the `masses` of the coordinates.
    """
    (qa, ta), (qb, tb) = a, b
    total, work = jnp.zeros_like(qa), None
    if driven is not None and ta is not tb:
        total, work = gradient_with_time(derivative, driven, a, b)
    elif driven is not None:
        fixed = [*fixed, lambda q: driven(q, ta)[None]]
    for fn in fixed:
        rows = RowPattern(fn, qa, small=0)
        gradients = lambda q, fn=fn, rows=rows: rows.derivative(fn, q)
        by_row = derivative.gradients_of_rows(fn, gradients, rows.own, qa, qb, masses)
        total = total.at[rows.columns].add(by_row)
    return total, work
