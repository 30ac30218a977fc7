"""Systems with constant inertia; their velocities are eliminated from the step equations.

The momentum component of the discrete gradient is `M^-1` times the mean momentum, plus the
contribution of `psi`. As `psi = C(q) v` is linear in `v`, its difference is the sum of a
term in the positions and a term in the velocities, and no metric on `(q, v)` is needed:

    psi_b - psi_a = [D_q (C v_m)] (q_b - q_a) + 1/2 (C_a + C_b) (v_b - v_a),

(For driven constraints `D_q` includes the time, and `psi` is affine in `v`.) Only the mean
of the velocities at the ends of an interval enters `S_mu`, so the schemes solve this row
for the velocities in closed form.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractCorrected, AbstractDerivative
from .._solvers import (
    affine_root,
    as_dense,
    Assembled,
    inverse_of,
    product,
    row_hessians,
    schur,
    schur_tables,
    SchurTables,
    solve,
    Symmetric,
)
from .._system import AbstractKinematics, IdentityKinematics, State, System
from .._types import Args, Coordinates, JointMultipliers, Multipliers, Scalar, Velocities
from .base import AbstractModel, Reaction
from .constraint_matrix import ConstraintMatrix
from .elements import (
    element_energies,
    gradient_and_work_by_rows,
    has_linear_potential,
    Summands,
)
from .interval import Gradient, gradient_and_work, Increment, Scales, Time, time_rate


class SeparableModel(AbstractModel):
    """A `System` for fixed `args`; the `v` of its states are the velocities."""

    system: System
    args: Args
    inertia: Symmetric
    inverse_inertia: Symmetric
    scales: Scales
    # Whether the potential is linear; always false for small systems.
    has_linear_potential: bool = eqx.field(static=True)
    kinematics: AbstractKinematics
    # The index tables of `constraint_matrix`; `None` where there is none.
    constraint_tables: SchurTables | None = eqx.field(static=True)

    def __init__(self, system: System, state: State, args: Args):
        self.system = system
        self.args = args
        self.has_linear_potential = has_linear_potential(system, state.q, args)
        self.kinematics = system.kinematics.with_blocks(state.q, self.coordinate, args)
        self.inertia = system.inertia(state, args)
        self.inverse_inertia = inverse_of(self.inertia)
        self.scales = self._scales(state)
        self.constraint_tables = self._constraint_tables(state)

    @property
    def has_own_momenta(self) -> bool:
        return False

    @property
    def has_canonical_rates(self) -> bool:
        return isinstance(self.kinematics, IdentityKinematics)

    def to_internal(self, state: State) -> State:
        return state

    def to_user(self, state: State) -> State:
        return State(state.q, state.v)

    def kinetic(self, state: State) -> Scalar:
        return 0.5 * state.v @ self.inertia @ state.v

    def kinetic_change(self, a: State, b: State, gradient: Gradient) -> Scalar:
        return self.kinetic(b) - self.kinetic(a)

    def kinetic_of_jump(self, a: State, b: State) -> Scalar:
        dv = b.v - a.v
        return 0.5 * dv @ self.inertia @ dv

    def potential(self, state: State) -> Scalar:
        return self._potential(state.q)

    def _potential(self, q: Coordinates) -> Scalar:
        return self.system.potential(q, self.args)

    def momentum(self, state: State) -> Velocities:
        return self.inertia @ state.v

    def gradient(self, state: State, h: Scalar) -> Gradient:
        return Gradient(h * jax.grad(self._potential)(state.q), jnp.zeros((0,), h.dtype))

    def coordinate(self, q: Coordinates) -> Float[Array, " ncc"]:
        """The coordinate constraints, which relate redundant coordinates of a body."""
        if self.system.coordinate_constraint is None:
            return jnp.zeros((0,), q.dtype)
        return self.system.coordinate_constraint(q, self.args)

    def constraint(self, q: Coordinates, t: Time) -> Multipliers:
        return jnp.concatenate([self.joint(q, t), self.coordinate(q)])

    def slope(self, state: State) -> Coordinates:
        slope = jax.grad(self._potential)(state.q)
        if self.system.force is None:
            return slope
        return slope - self._pull(state.q, self.force(state.q, state.v, state.t))

    def velocity(self, state: State) -> Velocities:
        return state.v

    def velocity_change(
        self, change: Velocities, inverse_inertia: Float[Array, "nq nq"] | Symmetric
    ) -> Velocities:
        return change

    def node_momenta(
        self,
        unknowns: tuple[Float[Array, " np"], ...],
        velocities: Callable[[Reaction], tuple[Velocities, ...]],
    ) -> tuple[Velocities, ...]:
        return velocities(self.reaction_at)

    def momentum_rows(self, rates: Velocities) -> Float[Array, " np"]:
        return rates[:0]

    def push(self, qa: Coordinates, qb: Coordinates, rate: Coordinates) -> Velocities:
        return self.kinematics.push(0.5 * (qa + qb), rate, self.args)

    def pull(self, qa: Coordinates, qb: Coordinates, force: Velocities) -> Coordinates:
        return self._pull(0.5 * (qa + qb), force)

    def _pull(self, q: Coordinates, momentum: Velocities) -> Coordinates:
        return self.kinematics.pull(q, momentum, self.args)

    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        relations = jax.jacfwd(self.coordinate)
        return self.kinematics.lift(q, v, relations, self.args)

    def discrete_gradient(
        self,
        derivative: AbstractDerivative,
        a: State,
        b: State,
        h: Scalar,
        increment: Increment,
    ) -> Gradient:
        mean_velocity = 0.5 * (a.v + b.v)
        fixed, driven = self.split(increment)

        constraint = lambda q: jnp.concatenate([self.fixed(q), self.coordinate(q)])
        rate = lambda q: jax.jvp(self.fixed, (q,), (self.lift(q, mean_velocity),))[1]

        def action(q: Coordinates) -> Scalar:
            out = h * self._potential(q)
            if fixed.impulse.size > 0:
                out = out + fixed.impulse @ constraint(q)
            if fixed.velocity_impulse.size > 0:
                out = out + h * fixed.velocity_impulse @ rate(q)
            return out

        def driven_action(q: Coordinates, t: Time) -> Scalar:
            return self.driven_action(q, self.lift(q, mean_velocity), t, h, driven)

        with_time = None if self.system.driven is None else driven_action
        ends, none = ((a.q, a.t), (b.q, b.t)), jnp.zeros((0,), h.dtype)
        energies = self._element_energies(a.q)
        if energies is None or not isinstance(derivative, AbstractCorrected):
            size = self.action_size(derivative, a, h, increment)
            impulse, work = gradient_and_work(
                derivative, action, with_time, *ends, size=size
            )
            return Gradient(impulse, none, work)
        rows: list[Summands] = [lambda q, fn=fn: h * fn(q) for fn in energies]
        rows += [lambda q: fixed.impulse * constraint(q)]
        if fixed.velocity_impulse.size > 0:
            rows += [lambda q: h * fixed.velocity_impulse * rate(q)]
        impulse, work = gradient_and_work_by_rows(derivative, rows, with_time, *ends)
        if self.has_linear_potential:
            impulse = impulse + h * jax.grad(self._potential)(a.q)
        return Gradient(impulse, none, work)

    def structure(
        self, a: State, b: State, h: Scalar, rate: Coordinates, gradient: Gradient
    ) -> tuple[Coordinates, Float[Array, " np"]]:
        middle = 0.5 * (a.q + b.q)
        change = self._pull(middle, self.inertia @ (b.v - a.v))
        momentum = self.inertia @ (0.5 * (a.v + b.v))
        gyroscopic = self.kinematics.gyroscopic(middle, momentum, h * rate, self.args)
        if gyroscopic is not None:
            change = change + gyroscopic
        return change + gradient.impulse, gradient.rate

    def reaction_row(self, state: State, eta: JointMultipliers) -> Float[Array, " np"]:
        return jnp.zeros((0,), state.q.dtype)

    def reaction_at(self, q: Coordinates, t: Time, eta: JointMultipliers) -> Velocities:
        """`M^-1 C(q, t)^T eta`; as `psi` is affine in `v`, the same for every `v`."""
        rest = jnp.zeros((self.inertia.shape[0],), q.dtype)
        if eta.size == 0:
            return rest
        _, transpose = jax.vjp(lambda v: self.joint_change(q, v, t), rest)
        return self.inverse_inertia @ transpose(eta)[0]

    def joint_change(self, q: Coordinates, v: Velocities, t: Time) -> JointMultipliers:
        """`C(q, t) v`, the part of `psi` that is linear in `v`."""
        return jax.jvp(lambda q: self.joint(q, t), (q,), (self.lift(q, v),))[1]

    def metric(self, state: State) -> Symmetric:
        """The inertia matrix of the coordinates, regular also where they are redundant.

        It is `L^T M L + m sum_i b_i b_i^T`, with the normalised gradients `b_i` of the
        coordinate constraints. `m` is the mean inertia of a coordinate, so the result does
        not depend on the units of the constraints.
        """
        if self.has_canonical_rates:
            return self.inertia
        q = state.q
        pull = jax.vmap(self._pull, in_axes=(None, 0))
        inertia = pull(q, pull(q, as_dense(self.inertia)).T)
        rows = jax.jacfwd(self.coordinate)(q)
        unit = rows / jnp.linalg.norm(rows, axis=1, keepdims=True)
        return inertia + jnp.trace(inertia) / q.size * (unit.T @ unit)

    def inverse_metric(self, state: State) -> Symmetric:
        return self.inverse_inertia

    def stiffness(
        self, state: State, multipliers: Multipliers
    ) -> tuple[Float[Array, "nq nq"] | Assembled, Symmetric]:
        energies = self._element_energies(state.q)
        if energies is None:
            energy = lambda q: self.augmented_energy(
                State(q, state.v, state.t), multipliers
            )
            return jax.hessian(energy)(state.q), as_dense(self.inertia)
        of_constraints = lambda q: multipliers * self.constraint(q, state.t)
        fns = [*energies, of_constraints]
        return Assembled(tuple(row_hessians(fn, state.q) for fn in fns)), self.inertia

    def _element_energies(self, q: Coordinates) -> list[Summands] | None:
        """The summands of the potential of a large system, or `None`; see `elements.py`."""
        if self.has_linear_potential:
            return []
        return element_energies(self.system, q, self.args)

    def augmented_energy(self, state: State, multipliers: Multipliers) -> Scalar:
        return self._potential(state.q) + multipliers @ self.constraint(state.q, state.t)

    def skew_gradient(
        self,
        middle: State,
        multipliers: Multipliers,
        change: tuple[Coordinates, Velocities, Time],
        h: Scalar,
    ) -> Gradient:
        _, dv, _ = change
        no_time = jax.tree.map(jnp.zeros_like, middle.t)
        force, power = self.stiffness_product(middle, multipliers, (dv, no_time))
        power = None if power is None else h * power
        return Gradient(h * force, dv[:0], power)

    @property
    def has_constraint_matrix(self) -> bool:
        return self.constraint_tables is not None

    def constraint_matrix(self, q: Coordinates, t: Time) -> ConstraintMatrix:
        assert self.constraint_tables is not None
        inverse_inertia, joint = self.inverse_inertia, lambda q: self.joint(q, t)
        rows = schur(self.constraint_tables, joint, q, inverse_inertia)
        return ConstraintMatrix(inverse_inertia, rows)

    def _constraint_tables(self, state: State) -> SchurTables | None:
        # Redundant constraints make the matrix singular.
        is_flat = self.has_canonical_rates and self.system.coordinate_constraint is None
        if not is_flat or self.system.redundant:
            return None
        t = jnp.zeros((), state.q.dtype) if self.system.is_timed else None
        joint = lambda q: self.joint(q, t)
        return schur_tables(joint, state.q, self.inverse_inertia)

    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        """Solves the equations of motion with the joints at acceleration level.

        Coordinate constraints are not differentiated, because the rates `L^+ v` satisfy
        them for every `v`. Their multipliers enter the `nq` rows of the balance of
        momentum.
        """
        q, v, t, scales = state.q, state.v, state.t, self.scales
        qdot = self.lift(q, v)
        slope = self.slope(state)
        gyroscopic = self.kinematics.gyroscopic(q, self.inertia @ v, qdot, self.args)
        if gyroscopic is not None:
            slope = slope + gyroscopic
        free_rate = self._free_joint_acceleration(state, qdot)
        unit = 1 / jnp.sqrt(self.inertia.diagonal())

        def conditions(x: Array) -> Array:
            acceleration, multipliers = unit * x[: v.size], x[v.size :] / scales.constraint
            # Evaluated in this function, because the sparsity pattern is found from index
            # arrays that are constants of the traced function.
            pulled = self.pull(q, q, self.inertia @ acceleration)
            pulled = pulled + self.constraint_force(q, t, multipliers)
            rate = self.joint_change(q, acceleration, t) + free_rate
            rows = (
                (pulled + slope) / scales.coordinate,
                rate / scales.constraint[: rate.size],
            )
            return jnp.concatenate(rows)

        count = scales.constraint.size
        like = jnp.zeros((v.size + count,), q.dtype)
        x = affine_root(conditions, like, self.regularisation_after(v, count))
        return unit * x[: v.size], x[v.size :] / scales.constraint

    def multipliers(self, state: State) -> Multipliers:
        """With `L = I` the multipliers are found from the smaller matrix `B M^-1 B^T`."""
        inverse_inertia = self.inverse_inertia
        is_plain = self.has_canonical_rates and isinstance(inverse_inertia, Array)
        if not is_plain or self.system.redundant:
            return self.accelerations(state)[1]
        rows = jax.jacfwd(self.constraint)(state.q, state.t)
        rows = rows / self.scales.constraint[:, None]
        free = inverse_inertia @ self.slope(state)
        right = self._free_joint_acceleration(state, state.v) / self.scales.constraint
        matrix = product(product(rows, inverse_inertia), rows.T)
        return solve(matrix, right - rows @ free) / self.scales.constraint

    def _free_joint_acceleration(self, state: State, qdot: Coordinates) -> JointMultipliers:
        """`dpsi/dt` of a motion with constant velocities `v`."""
        rates = lambda q, t: self.joint_rate(q, state.v, t)
        return jax.jvp(rates, (state.q, state.t), (qdot, time_rate(state.t)))[1]
