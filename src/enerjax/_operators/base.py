"""A system with its `args` bound: the operators of which every scheme consists.

The structure residual of an interval `a -> b` with a gradient `w` is

    S_q  = Lm^T (mu_b - mu_a) + G(q_m, mu_m) (q_b - q_a) + h w_q
    S_mu = Lm (q_b - q_a) - h w_mu

at `q_m = (q_a + q_b)/2`, `mu_m = (mu_a + mu_b)/2`. One `L` and one skew `G` serve the whole
interval, so that both rows together give the energy identity. `w` is the discrete gradient
of

    H + lambda . Phi(q) + eta . psi(q, mu),      psi = dPhi/dt

Forces `f` add `-h Lm^T f` to the first row. Where constraints are driven, `Phi(q, t)`,
their part of the discrete gradient is taken over `q` and `t` together, and its entry for
`t` is the power that they supply.

Two kinds of model implement this. In a `SeparableModel` the inertia is constant, and the
velocities follow from `S_mu` in closed form. A `CanonicalModel` takes any Hamiltonian, and
momenta are unknowns.
"""

import abc
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._discrete import AbstractCorrected, AbstractDerivative
from .._solvers import Assembled, RowPattern, Symmetric
from .._system import AbstractSystem, State
from .._types import Args, Coordinates, JointMultipliers, Multipliers, Scalar, Velocities
from .constraint_matrix import ConstraintMatrix
from .interval import Gradient, Increment, Scales, Time, time_rate


# `M^-1 C(q, t)^T eta`: what velocity-level multipliers add to a velocity.
Reaction: TypeAlias = Callable[[Coordinates, Time, JointMultipliers], Velocities]


class AbstractModel(eqx.Module):
    """The functions of a system at fixed `args`, and those derived from them.

    In the states of a model, `v` are velocities where the inertia is constant, and momenta
    `p` where the system has a Hamiltonian.
    """

    system: eqx.AbstractVar[AbstractSystem]
    args: eqx.AbstractVar[Args]
    scales: eqx.AbstractVar[Scales]

    @property
    @abc.abstractmethod
    def has_own_momenta(self) -> bool:
        """Whether momenta are unknowns of the step; `State.v` is then `p`."""

    @property
    @abc.abstractmethod
    def has_constraint_matrix(self) -> bool:
        """Whether a chord iteration with `B M^-1 B^T` can solve the step equations."""

    @property
    @abc.abstractmethod
    def has_canonical_rates(self) -> bool:
        """Whether `L = I`: velocities are the rates of the coordinates, or `v` is `p`."""

    @abc.abstractmethod
    def to_internal(self, state: State) -> State:
        """A user's state, `(q, v)`, as a state of the model."""

    @abc.abstractmethod
    def to_user(self, state: State) -> State:
        """A state of the model as a user's state, without its time."""

    @abc.abstractmethod
    def kinetic(self, state: State) -> Scalar:
        """The kinetic energy."""

    @abc.abstractmethod
    def potential(self, state: State) -> Scalar:
        """The potential energy."""

    @abc.abstractmethod
    def momentum(self, state: State) -> Velocities:
        """The momenta `mu`: `M v` or `p`."""

    @abc.abstractmethod
    def gradient(self, state: State, h: Scalar) -> Gradient:
        """`h dH/dq` and `dH/dmu` in one state, without multipliers."""

    @abc.abstractmethod
    def discrete_gradient(
        self,
        derivative: AbstractDerivative,
        a: State,
        b: State,
        h: Scalar,
        increment: Increment,
    ) -> Gradient:
        """The discrete gradient over `a -> b` with the multipliers of `increment`."""

    @abc.abstractmethod
    def structure(
        self, a: State, b: State, h: Scalar, rate: Coordinates, gradient: Gradient
    ) -> tuple[Coordinates, Float[Array, " np"]]:
        """`S_q` and `S_mu/h`; `rate` is `(q_b - q_a)/h`, exact."""

    @abc.abstractmethod
    def node_momenta(
        self,
        unknowns: tuple[Float[Array, " np"], ...],
        velocities: Callable[[Reaction], tuple[Velocities, ...]],
    ) -> tuple[Velocities, ...]:
        """What the states at the nodes of a step hold as `v`.

        With constant inertia the velocities, which `velocities` finds from the rows `S_mu`
        given the reaction `M^-1 C^T eta`; with a Hamiltonian the momenta, which are among
        the unknowns.
        """

    @abc.abstractmethod
    def momentum_rows(self, rates: Velocities) -> Float[Array, " np"]:
        """The given entries where momenta are unknowns; else none, of shape `(0,)`."""

    @abc.abstractmethod
    def slope(self, state: State) -> Coordinates:
        """`dH/dq` less the applied forces `L^T f`."""

    @abc.abstractmethod
    def velocity(self, state: State) -> Velocities:
        """The velocities that forces are conjugate to: `L qdot` or `dH/dp`."""

    @abc.abstractmethod
    def velocity_change(
        self, change: Velocities, inverse_inertia: Float[Array, "nq nq"] | Symmetric
    ) -> Velocities:
        """The change of velocity of a change of `State.v`, with the given inertia."""

    @abc.abstractmethod
    def kinetic_change(self, a: State, b: State, gradient: Gradient) -> Scalar:
        """The change of the kinetic energy over `a -> b`: `Dmu H . (mu_b - mu_a)`."""

    @abc.abstractmethod
    def kinetic_of_jump(self, a: State, b: State) -> Scalar:
        """`(mu_b - mu_a) . (dH/dmu(b) - dH/dmu(a)) / 2`"""

    @abc.abstractmethod
    def push(self, qa: Coordinates, qb: Coordinates, rate: Coordinates) -> Velocities:
        """`Lm rate`"""

    @abc.abstractmethod
    def pull(self, qa: Coordinates, qb: Coordinates, force: Velocities) -> Coordinates:
        """`Lm^T force`"""

    @abc.abstractmethod
    def reaction_row(self, state: State, eta: JointMultipliers) -> Float[Array, " np"]:
        """`dpsi/dmu^T eta` as a part of the row `S_mu`; empty with constant inertia."""

    @abc.abstractmethod
    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        """The rates of the coordinates, `L(q)^+ v` or `dH/dp`."""

    @abc.abstractmethod
    def metric(self, state: State) -> Symmetric:
        """The inertia in the coordinates, regular."""

    @abc.abstractmethod
    def inverse_metric(self, state: State) -> Symmetric:
        """The inverse of the matrix that changes of `State.v` are measured in.

        `M^-1` for velocities. Momenta are measured in the inverse of the inertia, so for
        them it is the inertia.
        """

    @abc.abstractmethod
    def stiffness(
        self, state: State, multipliers: Multipliers
    ) -> tuple[Float[Array, "nq nq"] | Assembled, Symmetric]:
        """`K = Hess_q (H + lambda . Phi)`, by elements if it can be, and the inertia."""

    @abc.abstractmethod
    def augmented_energy(self, state: State, multipliers: Multipliers) -> Scalar:
        """`H + lambda . Phi(q, t)`, without a kinetic energy that `q` does not enter."""

    @abc.abstractmethod
    def skew_gradient(
        self,
        middle: State,
        multipliers: Multipliers,
        change: tuple[Coordinates, Velocities, Time],
        h: Scalar,
    ) -> Gradient:
        """`D J D (z1 - z0)`, the first part times `h`; `D = Hess(H + lambda . Phi)`.

        `change` is `z1 - z0` as `(q, v, t)`. The result is orthogonal to it, so it does no
        work. Time counts as a coordinate whose momentum nothing depends on. With constant
        inertia the second part is empty; `stiffness_product` gives it.
        """

    @abc.abstractmethod
    def constraint_matrix(self, q: Coordinates, t: Time) -> ConstraintMatrix:
        """`B M^-1 B^T` at a position, where `has_constraint_matrix`."""

    @abc.abstractmethod
    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        """`vdot` (or `pdot`) and `lambda` that satisfy the equations of motion."""

    @abc.abstractmethod
    def multipliers(self, state: State) -> Multipliers:
        """The multipliers `lambda` of `accelerations`."""

    @abc.abstractmethod
    def constraint(self, q: Coordinates, t: Time) -> Multipliers:
        """`Phi(q, t)`: joints first, then coordinate constraints."""

    def stiffness_product(
        self, state: State, multipliers: Multipliers, along: tuple[Coordinates, Time]
    ) -> tuple[Coordinates, Time]:
        """`K` times a vector in coordinates and time, with its row and column of time."""
        energy = lambda q, t: self.augmented_energy(State(q, state.v, t), multipliers)
        gradient = jax.grad(energy, argnums=(0, 1))
        return jax.jvp(gradient, (state.q, state.t), along)[1]

    def constraint_force(
        self, q: Coordinates, t: Time, multipliers: Multipliers
    ) -> Coordinates:
        """`B(q, t)^T multipliers`, shape `(nq,)`."""
        _, transpose = jax.vjp(lambda q: self.constraint(q, t), q)
        return transpose(multipliers)[0]

    def fixed(self, q: Coordinates) -> Float[Array, " nf"]:
        """The joints that do not depend on time."""
        if self.system.constraint is None:
            return jnp.zeros((0,), q.dtype)
        return self.system.constraint(q, self.args)

    def driven(self, q: Coordinates, t: Time) -> Float[Array, " nd"]:
        """The driven constraints, which depend on time."""
        if self.system.driven is None:
            return jnp.zeros((0,), q.dtype)
        assert t is not None
        return self.system.driven(q, t, self.args)

    def joint(self, q: Coordinates, t: Time) -> JointMultipliers:
        """The constraints that are imposed at velocity level too: fixed, then driven."""
        if self.system.driven is None:
            return self.fixed(q)
        return jnp.concatenate([self.fixed(q), self.driven(q, t)])

    def joint_rate(self, q: Coordinates, v: Velocities, t: Time) -> JointMultipliers:
        """`psi(q, v, t) = dPhi/dt` of the joints."""
        return jax.jvp(self.joint, (q, t), (self.lift(q, v), time_rate(t)))[1]

    def symmetry_momenta(self, state: State) -> Float[Array, " ns"]:
        """The momenta of the symmetries that the user has named."""
        symmetry = self.system.symmetry
        none = jnp.zeros((0,), state.q.dtype)
        return symmetry(state.q, self.args) @ self.momentum(state) if symmetry else none

    def split(self, increment: Increment) -> tuple[Increment, Increment]:
        """The increment with the multipliers of the constraints that do not depend on time,
        and with those of the driven constraints."""
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
        """`h (lambda . g + eta . dg/dt)` of the driven constraints `g`."""
        constraint, psi = jax.jvp(self.driven, (q, t), (rate, time_rate(t)))
        out = driven.impulse @ constraint
        if driven.velocity_impulse.size > 0:
            out = out + h * driven.velocity_impulse @ psi
        return out

    def force(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        """`f(q, v, t)` of a system that has forces."""
        assert self.system.force is not None
        assert t is not None
        return self.system.force(q, v, t, self.args)

    def damping(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        """The part of `f` that changes sign with the velocity."""
        return 0.5 * (self.force(q, v, t) - self.force(q, -v, t))

    def regularisation(self, count: int, dtype: Any) -> Float[Array, " count"] | None:
        """What makes equations for `count` scaled multipliers regular.

        Small numbers for the diagonal; `None` for a system whose constraints are declared
        independent of each other.
        """
        if not self.system.redundant:
            return None
        return jnp.full((count,), -(float(jnp.finfo(dtype).eps) ** 0.5), dtype)

    def regularisation_after(self, x: Array, count: int) -> Float[Array, " n"] | None:
        """The same for equations in `x`, which needs none, and in `count` multipliers."""
        numbers = self.regularisation(count, x.dtype)
        return None if numbers is None else jnp.concatenate([jnp.zeros_like(x), numbers])

    def energy_scale(self, state: State, h: Scalar) -> Scalar:
        """An energy that is typical of a step of length `h`; never zero, no derivative.

        The largest of the kinetic energy, and of the kinetic energies that the forces and
        the driven constraints, acting for `h`, would give to a body at rest.
        """
        gained = h * self.slope(state) / self.scales.coordinate
        size = jnp.maximum(2 * self.kinetic(state), gained @ gained)
        if self.system.driven is not None:
            q, t = state.q, state.t
            assert t is not None
            moved = (self.constraint(q, t + h) - self.constraint(q, t)) / h
            size = jnp.maximum(size, jnp.sum((moved / self.scales.constraint) ** 2))
        return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))

    def force_size(self, state: State) -> Coordinates:
        """How large the terms of `dH/dq` and of the applied forces are, each coordinate.

        Where springs balance each other or a weight, the forces vanish. What is computed
        there is the round-off of their terms, the machine epsilon times this size.
        """
        return _term_size(lambda model, state: model.slope(state), self, state)

    def action_size(
        self,
        derivative: AbstractDerivative,
        state: State,
        h: Scalar,
        increment: Increment,
    ) -> Scalar | float:
        """How large the terms of `h V + impulse . Phi` are, for corrected derivatives.

        Other discrete derivatives do not need it, and it is zero.
        """
        if not isinstance(derivative, AbstractCorrected):
            return 0.0
        energy = _term_size(lambda model, state: model.potential(state), self, state)
        pull = jnp.abs(increment.impulse) @ self.scales.constraint_size
        size = jax.lax.stop_gradient(jnp.abs(h) * energy + pull)
        return _OPERATIONS_PER_TERM * size

    def _scales(self, state: State) -> Scales:
        """The scales at `q`.

        They are part of Newton's tests. A solution depends on them only where constraints
        are redundant: they define the norm in which the multipliers are smallest.
        """
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


# Every term costs a few operations, each with a rounding error of its own.
_OPERATIONS_PER_TERM = 4.0


def _term_size(
    fn: Callable[[AbstractModel, State], Array], model: AbstractModel, state: State
) -> Array:
    """How far `fn` would change if each of its inputs were wrong by its own size.

    The inputs are varied by unequal parts, so that terms that cancel in `fn` do not cancel
    here.
    """
    inputs, rest = eqx.partition((state.q, model.args), eqx.is_inexact_array)
    is_none = lambda x: x is None

    def of(inputs: PyTree[Array]) -> Array:
        q, args = eqx.combine(inputs, rest)
        other = eqx.tree_at(lambda model: model.args, model, args, is_leaf=is_none)
        return fn(other, State(q, state.v, state.t))

    inputs = jax.lax.stop_gradient(inputs)
    flat, unravel = ravel_pytree(inputs)
    # Multiples of the golden ratio are never equal modulo one.
    parts = 0.5 + (0.618034 * jnp.arange(1, flat.size + 1, dtype=flat.dtype)) % 1
    value, change = jax.jvp(of, (inputs,), (unravel(parts * flat),))
    # Where `args` enter through a function without a derivative their part is unknown.
    size = jnp.abs(value) + jnp.where(jnp.isfinite(change), jnp.abs(change), 0)
    return jax.lax.stop_gradient(size)
