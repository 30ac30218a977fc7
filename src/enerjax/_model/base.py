"""A system with its `args` bound: the operators of which every scheme is made.

The structure residual of an interval `a -> b` driven by `w` is (design: one `L` and a skew
`G` per interval, so that the two rows give the energy identity)

    S_q  = Lm^T (mu_b - mu_a) + G(q_m, mu_m) (q_b - q_a) + h w_q
    S_mu = Lm (q_b - q_a) - h w_mu

at `q_m = (q_a + q_b)/2`, `mu_m = (mu_a + mu_b)/2`. The drive is the discrete gradient of

    H + lambda . Phi(q) + eta . psi(q, mu),      psi = dPhi/dt

Two kinds of model fill this in: `SeparableModel` for constant inertia, where `S_mu` can be
solved for the velocities by hand, and `CanonicalModel` for any Hamiltonian.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative
from .._linear import Assembled, RowPattern, Symmetric
from .._system import AbstractSystem, State
from .._types import (
    Args,
    Coordinates,
    JointMultipliers,
    Multipliers,
    Scalar,
    Velocities,
)


class Increment(eqx.Module):
    """The unknowns that lead to one node of a step, and the rows that determine them.

    | field | as unknown | as row |
    |---|---|---|
    | `rate` | `(q - q0)/h` | balance of momentum, `S_q` |
    | `momentum` | `p`; empty where velocities are eliminated | `S_mu/h` |
    | `impulse` | `h lambda` | `Phi(q)/h` |
    | `velocity_impulse` | `eta` | `psi(q, v)`; empty for index 3 |

    The rate and not `q` is the unknown: the rounding of `q`, divided by `h`, would
    otherwise enter the velocities. Each unknown and its row have reciprocal units, so
    one set of `Scales` serves both.
    """

    rate: Coordinates
    momentum: Float[Array, " np"]
    impulse: Multipliers
    velocity_impulse: JointMultipliers


class Drive(eqx.Module):
    """What drives an interval: `h w_q`, and `w_mu` where momenta are unknowns."""

    impulse: Coordinates
    drift: Float[Array, " np"]


class Scales(eqx.Module):
    """How large a unit of each unknown is in the square root of an energy.

    `coordinate`: of a rate of change of each coordinate (square root of a mass).
    `constraint`: of the rate of change of each constraint, in the same measure; so
    `rate * coordinate`, `constraint rate / constraint` and
    `impulse * constraint` all have the dimension of the square root of an energy.
    """

    coordinate: Float[Array, " nq"]
    constraint: Float[Array, " nc"]
    # What the constraints are differences of: their round-off, divided by eps.
    constraint_size: Float[Array, " nc"]


class AbstractModel(eqx.Module):
    """The functions of a system at fixed `args`, and those derived from them.

    In a `State` inside of the schemes `v` are velocities or momenta, as the model has it.
    """

    system: eqx.AbstractVar[AbstractSystem]
    args: eqx.AbstractVar[Args]
    scales: eqx.AbstractVar[Scales]

    @property
    @abc.abstractmethod
    def has_own_momenta(self) -> bool:
        """Whether momenta are unknowns: `v` is then `p`, and `Increment.momentum` full."""

    @property
    @abc.abstractmethod
    def has_canonical_rates(self) -> bool:
        """Whether `L = I`: velocities are rates of the coordinates, or `v` is `p`."""

    @abc.abstractmethod
    def enter(self, state: State) -> State:
        """A user's state as the schemes have it."""

    @abc.abstractmethod
    def leave(self, state: State) -> State:
        """A state of the schemes as the user has it."""

    @abc.abstractmethod
    def kinetic(self, state: State) -> Scalar: ...

    @abc.abstractmethod
    def potential(self, state: State) -> Scalar: ...

    @abc.abstractmethod
    def gradient(self, state: State, h: Scalar) -> Drive:
        """`h dH/dq` and `dH/dmu` in one state, without multipliers."""

    @abc.abstractmethod
    def drive(
        self,
        derivative: AbstractDerivative,
        a: State,
        b: State,
        h: Scalar,
        increment: Increment,
    ) -> Drive:
        """The discrete gradient over `a -> b` with the multipliers of `increment`."""

    @abc.abstractmethod
    def structure(
        self, a: State, b: State, h: Scalar, rate: Coordinates, drive: Drive
    ) -> Drive:
        """`S_q` and `S_mu/h`; `rate` is `(q_b - q_a)/h`, exact."""

    @abc.abstractmethod
    def reaction(self, state: State, eta: JointMultipliers) -> Velocities:
        """`dpsi/dmu^T eta`: what velocity-level multipliers add to the velocity."""

    @abc.abstractmethod
    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        """The rates of the coordinates, `L(q)^+ v` or `dH/dp`."""

    @abc.abstractmethod
    def metric(self, state: State) -> Symmetric:
        """The inertia in the coordinates, regular."""

    @abc.abstractmethod
    def mobility(self, state: State) -> Symmetric:
        """Takes a push on `psi(q, .)` to the smallest change of `v`, in the inertia."""

    @abc.abstractmethod
    def stiffness(
        self, state: State, multipliers: Multipliers
    ) -> tuple[Float[Array, "nq nq"] | Assembled, Symmetric]:
        """`Hess_q (H + lambda . Phi)` and the inertia, where `L = I`.

        Of many elements the first is assembled and the second in blocks, where it can be.
        """

    @abc.abstractmethod
    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        """`vdot` (or `pdot`) and `lambda` that satisfy the equations of motion."""

    @abc.abstractmethod
    def multipliers(self, state: State) -> Multipliers:
        """`lambda` alone, of `accelerations`."""

    def joint(self, q: Coordinates) -> JointMultipliers:
        """The constraints that are held at velocity level too."""
        if self.system.constraint is None:
            return jnp.zeros((0,), q.dtype)
        return self.system.constraint(q, self.args)

    @abc.abstractmethod
    def constraint(self, q: Coordinates) -> Multipliers:
        """`Phi(q)`: joints first, then coordinate constraints."""

    def joint_rate(self, q: Coordinates, v: Velocities) -> JointMultipliers:
        """`psi(q, v) = dPhi/dt` of the joints."""
        return jax.jvp(self.joint, (q,), (self.lift(q, v),))[1]

    def energy_scale(self, state: State, h: Scalar) -> Scalar:
        """An energy that a step of length `h` handles; never zero, no derivative.

        The larger of the kinetic energy and of what the potential forces, acting for `h`
        on a body at rest, would make of it.
        """
        pushed = self.gradient(state, h).impulse / self.scales.coordinate
        size = jnp.maximum(2 * self.kinetic(state), pushed @ pushed)
        return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))

    def _scales(self, state: State) -> Scales:
        """The scales at `q`. They steer Newton's tests and never enter a solution."""
        q = state.q
        coordinate = jnp.sqrt(self.metric(state).diagonal())
        pattern = RowPattern(self.constraint, q)
        entries, columns = pattern.derivative(self.constraint, q), pattern.columns
        constraint = jnp.sqrt(jnp.sum((entries / coordinate[columns]) ** 2, axis=1))
        # A gradient that vanishes makes the step equations singular, which is reported
        # as such; it must not turn the scaling into a division by zero.
        constraint = jnp.where(constraint > 0, constraint, 1.0)
        size = jnp.sum(jnp.abs(entries * q[columns]), axis=1)
        return jax.lax.stop_gradient(Scales(coordinate, constraint, size))
