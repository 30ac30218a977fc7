"""A system with its `args` bound: the operators of which every scheme is made.

The structure residual of an interval `a -> b` driven by `w` is (design: one `L` and a skew
`G` per interval, so that the two rows give the energy identity)

    S_q  = Lm^T (mu_b - mu_a) + G(q_m, mu_m) (q_b - q_a) + h w_q
    S_mu = Lm (q_b - q_a) - h w_mu

at `q_m = (q_a + q_b)/2`, `mu_m = (mu_a + mu_b)/2`. The drive is the discrete gradient of

    H + lambda . Phi(q) + eta . psi(q, mu),      psi = dPhi/dt

Forces `f` add `-h Lm^T f` to the first row. Where constraints are driven, `Phi(q, t)`,
their part of the discrete gradient is over `q` and `t` together (`lapse.py`), and its entry
for `t` is the power that they bring in.

Two kinds of model fill this in: `SeparableModel` for constant inertia, where `S_mu` can be
solved for the velocities by hand, and `CanonicalModel` for any Hamiltonian.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative
from .._solvers import Assembled, RowPattern, Symmetric
from .._system import AbstractSystem, State
from .._types import Args, Coordinates, JointMultipliers, Multipliers, Scalar, Velocities
from .interval import Drive, Increment, lapse_of, Scales, Time


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
        """A state of the schemes as the user has it, without its time."""

    @abc.abstractmethod
    def kinetic(self, state: State) -> Scalar: ...

    @abc.abstractmethod
    def potential(self, state: State) -> Scalar: ...

    @abc.abstractmethod
    def momentum(self, state: State) -> Velocities: ...

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
    def slope(self, state: State) -> Coordinates:
        """`dH/dq` less the applied forces `L^T f`."""

    @abc.abstractmethod
    def velocity(self, state: State) -> Velocities:
        """The velocities that forces are conjugate to: `L qdot` or `dH/dp`."""

    @abc.abstractmethod
    def push(self, qa: Coordinates, qb: Coordinates, rate: Coordinates) -> Velocities:
        """`Lm rate`"""

    @abc.abstractmethod
    def pull(self, qa: Coordinates, qb: Coordinates, force: Velocities) -> Coordinates:
        """`Lm^T force`"""

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
        """`Hess_q (H + lambda . Phi)`, of elements if it can be, and the inertia."""

    @abc.abstractmethod
    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        """`vdot` (or `pdot`) and `lambda` that satisfy the equations of motion."""

    @abc.abstractmethod
    def multipliers(self, state: State) -> Multipliers:
        """`lambda` alone, of `accelerations`."""

    def fixed(self, q: Coordinates) -> Float[Array, " nf"]:
        """The joints that do not depend on time."""
        if self.system.constraint is None:
            return jnp.zeros((0,), q.dtype)
        return self.system.constraint(q, self.args)

    def driven(self, q: Coordinates, t: Time) -> Float[Array, " nd"]:
        """The joints that do."""
        if self.system.driven is None:
            return jnp.zeros((0,), q.dtype)
        assert t is not None
        return self.system.driven(q, t, self.args)

    def joint(self, q: Coordinates, t: Time) -> JointMultipliers:
        """The constraints that are held at velocity level too: fixed, then driven."""
        if self.system.driven is None:
            return self.fixed(q)
        return jnp.concatenate([self.fixed(q), self.driven(q, t)])

    @abc.abstractmethod
    def constraint(self, q: Coordinates, t: Time) -> Multipliers:
        """`Phi(q, t)`: joints first, then coordinate constraints."""

    def joint_rate(self, q: Coordinates, v: Velocities, t: Time) -> JointMultipliers:
        """`psi(q, v, t) = dPhi/dt` of the joints."""
        return jax.jvp(self.joint, (q, t), (self.lift(q, v), lapse_of(t)))[1]

    def symmetry_momenta(self, state: State) -> Float[Array, " ns"]:
        """Of the symmetries that the user has named."""
        symmetry = self.system.symmetry
        none = jnp.zeros((0,), state.q.dtype)
        return symmetry(state.q, self.args) @ self.momentum(state) if symmetry else none

    def split(self, increment: Increment) -> tuple[Increment, Increment]:
        """The multipliers of what does not depend on time, and those of what does."""
        if self.system.driven is None:
            return increment, increment
        q, t = increment.rate, jnp.zeros((), increment.rate.dtype)
        first = jax.eval_shape(self.fixed, q).size
        last = first + jax.eval_shape(self.driven, q, t).size

        def parts(x: Array) -> tuple[Array, Array]:
            return jnp.concatenate([x[:first], x[last:]]), x[first:last]

        multipliers = lambda z: (z.impulse, z.velocity_impulse)
        fixed, driven = zip(*map(parts, multipliers(increment)), strict=True)
        with_those = lambda some: eqx.tree_at(multipliers, increment, some)
        return with_those(fixed), with_those(driven)

    def driven_action(
        self, q: Coordinates, rate: Coordinates, t: Time, h: Scalar, driven: Increment
    ) -> Scalar:
        """`h (lambda . g + eta . dg/dt)` of the driven joints."""
        constraint, psi = jax.jvp(self.driven, (q, t), (rate, lapse_of(t)))
        out = driven.impulse @ constraint
        if driven.velocity_impulse.size > 0:
            out = out + h * driven.velocity_impulse @ psi
        return out

    def force(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        """`f`, of a system that has forces."""
        assert self.system.force is not None
        assert t is not None
        return self.system.force(q, v, t, self.args)

    def damping(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        """The part of `f` that changes sign with the velocity."""
        return 0.5 * (self.force(q, v, t) - self.force(q, -v, t))

    def fill(self, count: int, dtype: Any) -> Float[Array, " count"] | None:
        """What makes equations for `count` scaled multipliers regular, if need be."""
        if not self.system.redundant:
            return None
        return jnp.full((count,), -(float(jnp.finfo(dtype).eps) ** 0.5), dtype)

    def fill_behind(self, x: Array, count: int) -> Float[Array, " n"] | None:
        """The same for equations in `x` and `count` multipliers."""
        fill = self.fill(count, x.dtype)
        return None if fill is None else jnp.concatenate([jnp.zeros_like(x), fill])

    def energy_scale(self, state: State, h: Scalar) -> Scalar:
        """An energy that a step of length `h` handles; never zero, no derivative.

        The largest of the kinetic energy and of what the forces, acting for `h`, and the
        drives would make of that of a body at rest.
        """
        pushed = h * self.slope(state) / self.scales.coordinate
        size = jnp.maximum(2 * self.kinetic(state), pushed @ pushed)
        if self.system.driven is not None:
            q, t = state.q, state.t
            assert t is not None
            moved = (self.constraint(q, t + h) - self.constraint(q, t)) / h
            size = jnp.maximum(size, jnp.sum((moved / self.scales.constraint) ** 2))
        return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))

    def _scales(self, state: State) -> Scales:
        """The scales at `q`. They steer Newton's tests, and enter a solution only where
        constraints repeat each other: in the norm of which the multipliers are least."""
        q = state.q
        coordinate = jnp.sqrt(self.metric(state).diagonal())
        constraint = lambda q: self.constraint(q, state.t)
        pattern = RowPattern(constraint, q)
        entries, columns = pattern.derivative(constraint, q), pattern.columns
        constraint = jnp.sqrt(jnp.sum((entries / coordinate[columns]) ** 2, axis=1))
        # A gradient that vanishes makes the step equations singular, which is reported
        # as such; it must not turn the scaling into a division by zero.
        constraint = jnp.where(constraint > 0, constraint, 1.0)
        size = jnp.sum(jnp.abs(entries * q[columns]), axis=1)
        scales = Scales(coordinate, constraint, size)
        return scales if self.system.redundant else jax.lax.stop_gradient(scales)
