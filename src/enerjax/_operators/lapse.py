"""Discrete gradients over an interval in which time may pass."""

import functools
from collections.abc import Callable

import jax.numpy as jnp

from .._discrete import AbstractDerivative
from .._types import Coordinates, Scalar
from .interval import Time


def gradient_and_work(
    derivative: AbstractDerivative,
    still: Callable[[Coordinates], Scalar],
    moved: Callable[[Coordinates, Time], Scalar] | None,
    a: tuple[Coordinates, Time],
    b: tuple[Coordinates, Time],
    weights: Coordinates | float = 1.0,
    size: Scalar | float = 0.0,
) -> tuple[Coordinates, Scalar | None]:
    """The discrete gradient of `still(x) + moved(x, t)`, and its part in `t`.

    `moved` is differenced over `x` and `t` together, so that

        D . (xb - xa) + Dt (tb - ta) = moved(xb, tb) - moved(xa, ta)

    Corrected forms put their correction into `Dt` alone: it is bounded there where
    nothing moves, and what drives a constraint does no work but through it. What does not
    depend on time stays apart, lest its own defect be counted as work of the drive.
    """
    (xa, ta), (xb, tb) = a, b
    gradient = functools.partial(derivative.gradient, weights=weights, size=size)
    if moved is None:
        return gradient(still, xa, xb), None
    # The nodes of a jump share the time itself: none passes.
    if ta is tb:
        both = lambda x: still(x) + moved(x, ta)
        return gradient(both, xa, xb), None
    with_time, work = over_time(derivative, moved, a, b)
    return gradient(still, xa, xb) + with_time, work


def over_time(
    derivative: AbstractDerivative,
    moved: Callable[[Coordinates, Time], Scalar],
    a: tuple[Coordinates, Time],
    b: tuple[Coordinates, Time],
) -> tuple[Coordinates, Scalar]:
    """The part in `x` and that in `t` of the joint discrete gradient."""
    (xa, ta), (xb, tb) = a, b
    assert ta is not None
    assert tb is not None
    ends = jnp.append(xa, ta), jnp.append(xb, tb)
    time = jnp.zeros_like(ends[0]).at[-1].set(1)
    joint = derivative.gradient(lambda x: moved(x[:-1], x[-1]), *ends, weights=time)
    return joint[:-1], joint[-1]
