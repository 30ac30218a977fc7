"""The unknowns and rows of an interval of a step, and discrete gradients over it."""

import functools
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative
from .._types import Coordinates, Increments, JointMultipliers, Multipliers, Scalar


# The time of a state, or `None` for a system without forces and driven constraints.
Time: TypeAlias = Scalar | None


def time_rate(t: Time) -> Time:
    """The derivative of the time with respect to itself: one, or `None` without a time."""
    return None if t is None else jnp.ones_like(t)


class Increment(eqx.Module):
    """The unknowns that lead to one node of a step, and the rows that determine them.

    | field | shape | as unknown | as row |
    |---|---|---|---|
    | `impulse` | `(nc,)` | `h lambda` | `Phi(q)/h` |
    | `rate` | `(nu,)` | the step over `h` | balance of momentum, `S_q` |
    | `momentum` | `(np,)` | `p`; empty where velocities are eliminated | `S_mu/h` |
    | `velocity_impulse` | `(nj,)` | `eta` | `psi(q, v)`; empty for index 3 |

    A step is `q - q0`, or for rigid bodies that are moved by rotations a translation and a
    rotation vector, six numbers for each body.

    `impulse` is an energy times a time per unit of the constraint, and its row a rate of
    change of the constraint; `rate` is a coordinate per time, and its row a generalised
    momentum. The unknown is the rate and not `q`, because the rounding error of `q` would
    enter the velocities divided by `h`. An unknown and its row have reciprocal units, so
    one set of `Scales` serves both. Jacobians are evaluated for ranges of neighbouring
    unknowns, so the fields that the velocities depend on are neighbours.
    """

    impulse: Multipliers
    rate: Increments
    momentum: Float[Array, " np"]
    velocity_impulse: JointMultipliers


class Gradient(eqx.Module):
    """A gradient of the energy, including constraints, at a state or over an interval.

    - `impulse`: `h dH/dq`, shape `(nq,)`; a generalised momentum. Empty where all terms are
      in `rows`.
    - `rate`: `dH/dp`, shape `(np,)`, a rate of the coordinates; empty where the velocities
      are eliminated.
    - `work`: `h dH/dt`, the work of the driven constraints (energy). `None` if there are
      none, and over a jump, in which no time passes.
    - `rows`: terms that belong to the rows of the balance of momentum, shape `(nu,)`, and
      not to coordinates: forces, and torques on rates. `None` if there are none.
    """

    impulse: Coordinates
    rate: Float[Array, " np"]
    work: Scalar | None = None
    rows: Increments | None = None

    def less(self, load: Increments | None) -> "Gradient":
        """This gradient minus the impulse `h Lm^T f` of a force."""
        if load is None:
            return self
        rows = -load if self.rows is None else self.rows - load
        return Gradient(self.impulse, self.rate, self.work, rows)

    def plus(self, impulse: Coordinates, rows: Increments | None) -> "Gradient":
        """This gradient with further terms in the coordinates and in the rows."""
        total = self.impulse + impulse if impulse.size > 0 else self.impulse
        added = Gradient(total, self.rate, self.work, self.rows)
        return added if rows is None else added.less(-rows)


class Scales(eqx.Module):
    """Factors that give rates and impulses the dimension of the square root of an energy.

    - `coordinate`: the square root of the inertia of each coordinate. The rate of a
      coordinate times it is the square root of an energy.
    - `step`: the same for each rate of an `Increment`; that is `coordinate` itself, except
      for rigid bodies that are moved by rotations.
    - `constraint`: the norm of the gradient of each constraint in the metric of the inverse
      inertia. `constraint rate / constraint` and `impulse * constraint` are the square root
      of an energy.
    - `constraint_size`: the size of the terms whose sum is the constraint. The machine
      epsilon times this size is the round-off of the constraint.
    """

    coordinate: Float[Array, " nq"]
    step: Float[Array, " nu"]
    constraint: Float[Array, " nc"]
    constraint_size: Float[Array, " nc"]


def gradient_and_work(
    derivative: AbstractDerivative,
    fixed: Callable[[Coordinates], Scalar],
    driven: Callable[[Coordinates, Time], Scalar] | None,
    a: tuple[Coordinates, Time],
    b: tuple[Coordinates, Time],
    weights: Any = 1.0,
    size: Scalar | float = 0.0,
) -> tuple[Coordinates, Scalar | None]:
    """The discrete gradient of `fixed(x) + driven(x, t)`, and its component for `t`.

    The discrete gradient of `driven` is taken with respect to `x` and `t` jointly, so that

        D . (xb - xa) + Dt (tb - ta) = driven(xb, tb) - driven(xa, ta)

    The correction of a corrected discrete derivative is added to `Dt` alone. There it is
    bounded even if `x` does not change, and only `Dt` contains the work of the driven
    constraints. `fixed` has a discrete gradient of its own, because its correction would
    otherwise be counted as work of the driven constraints. `weights` are those that the
    `gradient` of this derivative takes.
    """
    (xa, ta), (xb, tb) = a, b
    gradient = functools.partial(derivative.gradient, weights=weights, size=size)
    if driven is None:
        return gradient(fixed, xa, xb), None
    # The two nodes of a jump share one time variable, because no time passes in a jump.
    if ta is tb:
        both = lambda x: fixed(x) + driven(x, ta)
        return gradient(both, xa, xb), None
    with_time, work = gradient_with_time(derivative, driven, a, b)
    return gradient(fixed, xa, xb) + with_time, work


def gradient_with_time(
    derivative: AbstractDerivative,
    driven: Callable[[Coordinates, Time], Scalar],
    a: tuple[Coordinates, Time],
    b: tuple[Coordinates, Time],
) -> tuple[Coordinates, Scalar]:
    """The components for `x` and for `t` of the joint discrete gradient."""
    (xa, ta), (xb, tb) = a, b
    assert ta is not None
    assert tb is not None
    ends = jnp.append(xa, ta), jnp.append(xb, tb)
    time = jnp.zeros_like(ends[0]).at[-1].set(1)
    joint = derivative.gradient(lambda x: driven(x[:-1], x[-1]), *ends, weights=time)
    return joint[:-1], joint[-1]
