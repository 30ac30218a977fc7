"""Systems with an arbitrary Hamiltonian `H(q, p)`; the momenta are unknowns of a step.

In the notation of `base.py`, `L = I` and `G = 0`.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative, ChainRule
from .._solvers import (
    affine_root,
    as_dense,
    schur,
    schur_tables,
    SchurTables,
    solve_definite,
    Symmetric,
)
from .._system import AbstractCanonicalSystem, LagrangianSystem, State
from .._types import Args, Coordinates, JointMultipliers, Multipliers, Scalar, Velocities
from .base import AbstractModel, Reaction
from .delassus import DelassusMatrix
from .interval import Gradient, gradient_and_work, Increment, Scales, Time, time_rate


class CanonicalModel(AbstractModel):
    """A system with a Hamiltonian for fixed `args`; the `v` of its states is `p`."""

    system: AbstractCanonicalSystem
    args: Args
    scales: Scales
    # The index tables of `delassus_matrix`; `None` where there is none.
    constraint_tables: SchurTables | None = eqx.field(static=True)

    def __init__(self, system: AbstractCanonicalSystem, state: State, args: Args):
        self.system = system
        self.args = args
        state = self.to_internal(state)
        self.scales = self._scales(state)
        self.constraint_tables = self._tables(state)

    @property
    def has_own_momenta(self) -> bool:
        return True

    @property
    def has_canonical_rates(self) -> bool:
        return True

    def to_internal(self, state: State) -> State:
        return State(state.q, self.system.momentum(state, self.args), state.t)

    def to_user(self, state: State) -> State:
        return State(state.q, self.system.velocity(state.q, state.v, self.args))

    def hamiltonian(self, q: Coordinates, p: Velocities) -> Scalar:
        return self.system.hamiltonian_at(q, p, self.args)

    def kinetic(self, state: State) -> Scalar:
        return self.hamiltonian(state.q, state.v) - self.potential(state)

    def kinetic_change(self, a: State, b: State, gradient: Gradient) -> Scalar:
        return gradient.rate @ (b.v - a.v)

    def kinetic_of_jump(self, a: State, b: State) -> Scalar:
        rate = jax.grad(self.hamiltonian, argnums=1)
        return 0.5 * (b.v - a.v) @ (rate(b.q, b.v) - rate(a.q, a.v))

    def potential(self, state: State) -> Scalar:
        return self.system.potential_energy(state, self.args)

    def coordinate(self, q: Coordinates) -> Float[Array, " ncc"]:
        return q[:0]

    def constraint(self, q: Coordinates, t: Time) -> Multipliers:
        return self.joint(q, t)

    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        return self.system.rate(q, v, self.args)

    def momentum(self, state: State) -> Velocities:
        return state.v

    def gradient(self, state: State, h: Scalar) -> Gradient:
        force, rate = jax.grad(self.hamiltonian, argnums=(0, 1))(state.q, state.v)
        return Gradient(h * force, rate)

    def slope(self, state: State) -> Coordinates:
        slope, rate = jax.grad(self.hamiltonian, argnums=(0, 1))(state.q, state.v)
        if self.system.force is None:
            return slope
        return slope - self.force(state.q, rate, state.t)

    def velocity(self, state: State) -> Velocities:
        return self.lift(state.q, state.v)

    def velocity_change(
        self, change: Velocities, inverse_inertia: Float[Array, "nq nq"] | Symmetric
    ) -> Velocities:
        return inverse_inertia @ change

    def node_momenta(
        self,
        unknowns: tuple[Float[Array, " np"], ...],
        velocities: Callable[[Reaction], tuple[Velocities, ...]],
        derivative: AbstractDerivative,
        step: Coordinates | None,
    ) -> tuple[Velocities, ...]:
        return unknowns

    def momentum_rows(self, rates: Velocities) -> Float[Array, " np"]:
        return rates

    @property
    def in_rates(self) -> "CanonicalModel":
        return self

    def to_rates(self, state: State) -> State:
        return state

    def user_multipliers(self, multipliers: Multipliers) -> Multipliers:
        return multipliers

    def fixed(self, q: Coordinates) -> Float[Array, " nf"]:
        return self.user_constraint(q)

    def force(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        return self.user_force(q, v, t)

    def displacement(self, q: Coordinates, step: Coordinates) -> Coordinates:
        return step

    def rates(self, q: Coordinates, v: Velocities) -> Coordinates:
        return self.lift(q, v)

    def coordinate_scale(self, step: Coordinates) -> Coordinates:
        return step

    def push(self, qa: Coordinates, qb: Coordinates, rate: Coordinates) -> Velocities:
        return rate

    def pull(self, qa: Coordinates, qb: Coordinates, force: Velocities) -> Coordinates:
        return force

    def discrete_gradient(
        self,
        derivative: AbstractDerivative,
        a: State,
        b: State,
        h: Scalar,
        increment: Increment,
        *,
        is_step: bool,
    ) -> Gradient:
        size = a.q.size
        fixed, driven, nonholonomic = self.split(increment, a.q)
        has_slip_rate = self.has_slip_rate(nonholonomic)

        # The product rule gives that of the kinetic energy without derivatives of inverses.
        by_product_rule = isinstance(derivative, ChainRule) and isinstance(
            self.system, LagrangianSystem
        )

        def action(z: Float[Array, " nz"]) -> Scalar:
            q, p = z[:size], z[size:]
            potential = lambda: self.potential(State(q, p))
            out = h * (potential() if by_product_rule else self.hamiltonian(q, p))
            if has_slip_rate:
                slip_rate = self.nonholonomic(q) @ self.lift(q, p)
                out = out + h * nonholonomic.velocity_impulse @ slip_rate
            if fixed.velocity_impulse.size > 0:
                constraint, psi = jax.jvp(self.fixed, (q,), (self.lift(q, p),))
                return out + fixed.impulse @ constraint + h * fixed.velocity_impulse @ psi
            if fixed.impulse.size > 0:
                out = out + fixed.impulse @ self.fixed(q)
            return out

        def driven_action(z: Float[Array, " nz"], t: Time) -> Scalar:
            q = z[:size]
            return self.driven_action(q, self.lift(q, z[size:]), t, h, driven)

        # The metric on positions and momenta needs a time to make the units equal: `h`.
        middle = 0.5 * (a.q + b.q), 0.5 * (a.v + b.v)
        masses = self.system.masses(*middle, self.args)
        weights = jnp.concatenate([masses, h**2 / masses])
        terms = self.action_size(derivative, a, h, increment)
        both, work = gradient_and_work(
            derivative,
            action,
            None if self.system.driven is None else driven_action,
            (jnp.concatenate([a.q, a.v]), a.t),
            (jnp.concatenate([b.q, b.v]), b.t),
            weights,
            terms,
        )
        impulse = self.nonholonomic_impulse(both[:size], a, b, nonholonomic)
        gradient = Gradient(impulse, both[size:] / h, work)
        if not by_product_rule:
            return gradient
        force, rate = self._kinetic_gradient(derivative, a, b)
        return Gradient(gradient.impulse + h * force, gradient.rate + rate, work)

    def _kinetic_gradient(
        self, derivative: AbstractDerivative, a: State, b: State
    ) -> tuple[Coordinates, Coordinates]:
        """The discrete gradient of `T = p . v / 2` with `M(q) v = p`, by the product rule.

        With means over the two states and `w = mean(M)^-1 mean(p)`,

            T_b - T_a = (mean(v) + w) / 2 . (p_b - p_a) - w . (M_b - M_a) mean(v) / 2
        """
        system = self.system
        assert isinstance(system, LagrangianSystem)
        inertias = [system.inertia(state, self.args) for state in (a, b)]
        before, after = (
            solve_definite(matrix, state.v)
            for matrix, state in zip(inertias, (a, b), strict=True)
        )
        mean = 0.5 * (before + after)
        inner = solve_definite(0.5 * (inertias[0] + inertias[1]), 0.5 * (a.v + b.v))

        def product(q: Coordinates) -> Scalar:
            momentum = lambda v: jax.grad(system.kinetic, argnums=1)(q, v, self.args)
            return inner @ momentum(mean)

        force = -0.5 * derivative.gradient(product, a.q, b.q)
        return force, 0.5 * (mean + inner)

    def structure(
        self, a: State, b: State, h: Scalar, rate: Coordinates, gradient: Gradient
    ) -> tuple[Coordinates, Float[Array, " np"]]:
        balance = b.v - a.v + gradient.impulse
        if gradient.rows is not None:
            balance = balance + gradient.rows
        return balance, rate - gradient.rate

    def reaction_row(self, state: State, eta: JointMultipliers) -> Float[Array, " np"]:
        _, transpose = jax.vjp(lambda p: self.joint_rate(state.q, p, state.t), state.v)
        return transpose(eta)[0]

    def metric(self, state: State) -> Float[Array, "nq nq"]:
        return as_dense(self.system.inertia(self.to_user(state), self.args))

    def step_scale(self, state: State) -> Coordinates:
        return jnp.sqrt(self.metric(state).diagonal())

    def inverse_metric(self, state: State) -> Float[Array, "nv nv"]:
        return self.metric(state)

    def inverse_regular_metric(self, state: State) -> Float[Array, "nv nv"]:
        return self.inverse_metric(state)

    def stiffness(
        self, state: State, multipliers: Multipliers
    ) -> tuple[Float[Array, "nq nq"], Float[Array, "nq nq"]]:
        energy = lambda q: self.augmented_energy(State(q, state.v, state.t), multipliers)
        return jax.hessian(energy)(state.q), self.metric(state)

    def augmented_energy(self, state: State, multipliers: Multipliers) -> Scalar:
        constraint = self.constraint(state.q, state.t)
        energy = self.hamiltonian(state.q, state.v)
        return energy + self.holonomic(multipliers) @ constraint

    def skew_gradient(
        self,
        middle: State,
        multipliers: Multipliers,
        change: tuple[Coordinates, Velocities, Time],
        h: Scalar,
    ) -> Gradient:
        def action(q: Coordinates, p: Velocities, t: Time) -> Scalar:
            return h * self.augmented_energy(State(q, p, t), multipliers)

        at = middle.q, middle.v, middle.t
        no_time = jax.tree.map(jnp.zeros_like, middle.t)
        gradient = jax.grad(action, argnums=(0, 1, 2))
        # Each product is with `h D`; the result needs a factor `h` in the rows of `q` only.
        _, (force, rate, _) = jax.jvp(gradient, at, change)
        _, (force, rate, power) = jax.jvp(gradient, at, (rate / h, -force / h, no_time))
        return Gradient(force, rate / h, power)

    def neglected_by_chord(self, state: State, v: Velocities, h: Scalar) -> Velocities:
        moved, force = 0.5 * h * v, self.metric(state) @ v
        rows = lambda q, p: (self.slope(State(q, p, state.t)), self.lift(q, p))
        slope, rate = jax.jvp(rows, (state.q, state.v), (moved, force))[1]
        inverse = self.system.inverse_inertia(state.q, state.v, self.args)
        # The chord method has the part `M^-1 p` of the rate.
        return 0.5 * h * (inverse @ slope) - (rate - v)

    @property
    def has_delassus_matrix(self) -> bool:
        return self.scales.constraint.size == 0 or self.constraint_tables is not None

    def delassus_matrix(self, state: State, h: Scalar | None = None) -> DelassusMatrix:
        weight = self.system.inverse_inertia(state.q, state.v, self.args)
        if self.constraint_tables is None:
            return DelassusMatrix(weight, None, None)
        rest = jnp.zeros_like(state.q)
        added, rates = self.delassus_regularisation, self._rates_of_joints(state)
        products = self.constraint_tables.products(rates, rest)
        rows = schur(self.constraint_tables, products, weight, added)
        return DelassusMatrix(weight, rows, None, added)

    def _tables(self, state: State) -> SchurTables | None:
        rest = jnp.zeros_like(state.q)
        return schur_tables(self._rates_of_joints(state), rest, self.metric(state))

    def _rates_of_joints(self, state: State) -> Callable[[Array], JointMultipliers]:
        """The rates of the joints, as a linear function of those of the coordinates."""
        joint = self.joint_near(state.q, state.t)
        return lambda rates: jax.jvp(joint, (state.q,), (rates,))[1]

    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        q, p, t = state.q, state.v, state.t
        slope, rate = jax.grad(self.hamiltonian, argnums=(0, 1))(q, p)
        if self.system.force is not None:
            slope = slope - self.force(q, rate, t)
        jacobian = jax.jacfwd(self.constraint_near(q, t))(q)
        if jacobian.shape[0] == 0:
            return -slope, jnp.zeros((0,), q.dtype)
        rates = jax.jacfwd(self.joint_rate, argnums=1)(q, p, t)
        _, change = jax.jvp(self.joint_rate, (q, p, t), (rate, -slope, time_rate(t)))
        unit = 1 / self.scales.constraint
        matrix = unit[:, None] * (rates @ jacobian.T) * unit[None, :]
        balance = lambda x: unit * change - matrix @ x
        regularisation = self.regularisation(unit.size, unit.dtype)
        multipliers = unit * affine_root(balance, unit, regularisation)
        return -slope - multipliers @ jacobian, multipliers
