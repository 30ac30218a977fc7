"""Systems with constant inertia; their velocities are eliminated from the step equations.

The momentum component of the discrete gradient is `M^-1` times the mean momentum, plus the
contribution of `psi`. As `psi = C(q) v` is linear in `v`, its difference is the sum of a
term in the positions and a term in the velocities, and no metric on `(q, v)` is needed:

    psi_b - psi_a = [D_q (C v_m)] (q_b - q_a) + 1/2 (C_a + C_b) (v_b - v_a),

(For driven constraints `D_q` includes the time, and `psi` is affine in `v`.) Only the mean
of the velocities at the ends of an interval enters `S_mu`, so the schemes solve this row
for the velocities in closed form.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import (
    AbstractCorrected,
    AbstractDerivative,
    ChainRule,
    RotationRule,
)
from .._programs import call_traced_once
from .._solvers import (
    affine_root,
    as_dense,
    Assembled,
    inverse_of,
    padded,
    row_hessians,
    schur,
    schur_tables,
    SchurTables,
    Symmetric,
)
from .._system import (
    AbstractKinematics,
    ByRates,
    Frames,
    mean_momentum,
    Rates,
    State,
    System,
)
from .._types import (
    Args,
    Coordinates,
    Increments,
    JointMultipliers,
    Multipliers,
    Scalar,
    Velocities,
)
from .action import action_of, gradient_in_rows
from .base import AbstractModel, Position, Reaction
from .delassus import DelassusMatrix
from .elastic import (
    ChordTerms,
    elastic_rates,
    elastic_tables,
    Elasticity,
    elasticity,
    ElasticTables,
    resistance,
)
from .elements import (
    element_energies,
    gradient_and_work_by_rows,
    has_linear_potential,
    Summands,
)
from .interval import Gradient, gradient_and_work, Increment, Scales, Time, time_rate


# Up to this number of coordinates systems without constraints need no chord method: the
# inverse Jacobian of Newton's method is extrapolated from step to step, which is as fast.
# Fifteen coordinates take 7 us a step with it, and 4 with the chord method; sixty take 410
# and 30 us.
FEW_FREE = 8


class SeparableModel(AbstractModel):
    """A `System` for fixed `args`; the `v` of its states are the velocities.

    Rigid bodies in the dimensions `rotates_in` (2 in the plane, 3 in space) are moved by
    rotations, and velocities and constraints are those of this kind of coordinates.
    Otherwise the velocities are those of the user.
    """

    system: System
    args: Args
    inertia: Symmetric
    inverse_inertia: Symmetric
    scales: Scales
    # Whether the potential is linear; always false for small systems.
    has_linear_potential: bool = eqx.field(static=True)
    kinematics: AbstractKinematics
    # The index tables of `delassus_matrix`; `None` where there is none.
    constraint_tables: SchurTables | None = eqx.field(static=True)
    # The same with the rows of strains and dampers; `None` where the chord method has none.
    elastic_tables: ElasticTables | None = eqx.field(static=True)
    # The model with the velocities of the user, if those of this one are others.
    without_rotations: "SeparableModel | None"

    def __init__(
        self,
        system: System,
        state: State,
        args: Args,
        *,
        rotates_in: tuple[int, ...] = (),
        chord_terms: tuple[ChordTerms, ...] = (),
    ):
        self.system = system
        self.args = args
        self.has_linear_potential = has_linear_potential(system, state.q, args)
        kind = system.kinematics.with_rotations(state.q, rotates_in)
        self.without_rotations = (
            SeparableModel(system, state, args) if kind.has_own_velocities else None
        )
        self.kinematics = kind.with_blocks(state.q, self.coordinate, args)
        self.inertia = kind.inertia(
            lambda: system.inertia(state, args),
            lambda v: system.kinetic_energy(State(state.q, v), args),
            state.q.dtype,
        )
        self.inverse_inertia = inverse_of(self.inertia)
        self.scales = self._scales(state)
        self.constraint_tables = self._constraint_tables(state)
        tables = (self._elastic_tables(state, terms) for terms in chord_terms)
        self.elastic_tables = next((x for x in tables if x is not None), None)

    @property
    def has_own_momenta(self) -> bool:
        return False

    @property
    def has_canonical_rates(self) -> bool:
        return self.kinematics.has_canonical_rates

    def to_internal(self, state: State) -> State:
        return State(state.q, self.kinematics.velocity(state.q, state.v), state.t)

    def to_user(self, state: State) -> State:
        return State(state.q, self.kinematics.user_velocity(state.q, state.v))

    @property
    def in_rates(self) -> "SeparableModel":
        return self if self.without_rotations is None else self.without_rotations

    def to_rates(self, state: State) -> State:
        velocity = self.kinematics.user_velocity(state.q, state.v)
        return State(state.q, velocity, state.t)

    def user_multipliers(self, multipliers: Multipliers) -> Multipliers:
        """With zeros for the constraints that rotations satisfy by themselves."""
        if self.without_rotations is None:
            return multipliers
        q = self.scales.coordinate
        own, all_rows = (
            jax.eval_shape(model.fixed, q).size for model in (self, self.in_rates)
        )
        none = jnp.zeros((all_rows - own,), multipliers.dtype)
        return jnp.concatenate([multipliers[:own], none, multipliers[own:]])

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
        return call_traced_once(self.system.potential, q, self.args)

    def momentum(self, state: State) -> Velocities:
        return self.inertia @ state.v

    def gradient(self, state: State, h: Scalar) -> Gradient:
        return Gradient(h * jax.grad(self._potential)(state.q), jnp.zeros((0,), h.dtype))

    def coordinate(self, q: Coordinates) -> Float[Array, " ncc"]:
        if self.system.coordinate_constraint is None:
            return jnp.zeros((0,), q.dtype)
        return self.system.coordinate_constraint(q, self.args)

    def fixed(self, q: Coordinates) -> Float[Array, " nf"]:
        joints, own = self.user_constraint(q), self.kinematics.constraint(q)
        return jnp.concatenate([joints, own]) if own.size > 0 else joints

    def constraint(self, q: Coordinates, t: Time) -> Multipliers:
        return jnp.concatenate([self.joint(q, t), self.coordinate(q)])

    def force(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        return self.user_force(q, self.kinematics.user_velocity(q, v), t)

    def _pull_back_at(self, q: Coordinates, gradient: Coordinates) -> Increments:
        """The rows of a gradient for a step of zero length."""
        at_rest = jnp.zeros_like(self.scales.step)
        return self.kinematics.pull_back(q, q, at_rest, gradient)

    def slope(self, state: State) -> Increments:
        q = state.q
        slope = self._pull_back_at(q, jax.grad(self._potential)(q))
        if self.system.force is None:
            return slope
        return slope - self.pull(q, q, self.force(q, state.v, state.t))

    def neglected_by_chord(self, state: State, v: Velocities, h: Scalar) -> Velocities:
        def acceleration(q: Coordinates, v: Velocities) -> Velocities:
            rows = self.slope(State(q, v, state.t))
            is_rotated = self.without_rotations is not None
            force = rows if is_rotated else self._lowered(q, rows)
            return self.inverse_inertia @ force

        moved = 0.5 * h * self.lift(state.q, v)
        change = 0.5 * h * jax.jvp(acceleration, (state.q, state.v), (moved, v))[1]
        if self.elastic_tables is None:
            return change
        # The chord method does not neglect the part that strains and dampers cause.
        rates = self._rates_of_strains(state, h, self.elastic_tables.terms)
        of_strains, transpose = jax.vjp(rates, v)
        return change - self.inverse_inertia @ transpose(of_strains)[0]

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
        derivative: AbstractDerivative,
        step: Increments | None,
    ) -> tuple[Velocities, ...]:
        return velocities(functools.partial(self._reaction, derivative, step))

    def momentum_rows(self, rates: Velocities) -> Float[Array, " np"]:
        return rates[:0]

    def displacement(self, q: Coordinates, step: Increments) -> Coordinates:
        return self.kinematics.displacement(q, step)

    def rates(self, q: Coordinates, v: Velocities) -> Increments:
        return self.kinematics.rates(q, v, jax.jacfwd(self.coordinate), self.args)

    def push(self, qa: Coordinates, qb: Coordinates, rate: Increments) -> Velocities:
        return self.kinematics.push(qa, qb, rate, self.args)

    def pull(self, qa: Coordinates, qb: Coordinates, force: Velocities) -> Increments:
        return self.kinematics.pull(qa, qb, force, self.args)

    def _momentum_rows(self, q: Coordinates, momentum: Velocities) -> Increments:
        return self.kinematics.momentum_rows(q, momentum, self.args)

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
        *,
        is_step: bool,
    ) -> Gradient:
        step = h * increment.rate if is_step else None
        rule = self.chain_rule(derivative, step)
        if rule is not None:
            return gradient_in_rows(self, rule, a, b, h, increment)
        fixed, driven, nonholonomic = self.split(increment, a.q)
        mean_rate, torque = self._mean_rates(a, b, h, increment, is_step)
        action_of_rates = action_of(self, h, fixed, nonholonomic)
        action = lambda q: action_of_rates(q, mean_rate(q))
        driven_action = lambda q, t: self.driven_action(q, mean_rate(q), t, h, driven)

        with_time = None if self.system.driven is None else driven_action
        ends, none = ((a.q, a.t), (b.q, b.t)), jnp.zeros((0,), h.dtype)
        rows = self._rows_of_action(a.q, h, fixed, nonholonomic, mean_rate)
        if rows is None or not isinstance(derivative, AbstractCorrected):
            weights = self._weights(derivative, 0.5 * (a.q + b.q))
            size = self.action_size(derivative, a, h, increment)
            impulse, work = gradient_and_work(
                derivative, action, with_time, *ends, weights, size
            )
            impulse = self.nonholonomic_impulse(impulse, a, b, nonholonomic)
            return Gradient(impulse, none, work, torque)
        scales = self.kinematics.velocity_scale(self.inertia)
        masses = scales**2 if scales.size == a.q.size else jnp.ones_like(a.q)
        impulse, work = gradient_and_work_by_rows(
            derivative, rows, with_time, *ends, masses
        )
        if self.has_linear_potential:
            impulse = impulse + h * jax.grad(self._potential)(a.q)
        impulse = self.nonholonomic_impulse(impulse, a, b, nonholonomic)
        return Gradient(impulse, none, work, torque)

    def _weights(self, derivative: AbstractDerivative, q: Coordinates) -> Any:
        """The metric of a correction: that of the inertia at `q`.

        In this metric a correction accelerates all bodies along their own steps, so a heavy
        body does not drive a light one.
        """
        if not isinstance(derivative, AbstractCorrected):
            return 1.0
        return lambda d: self.kinematics.by_inertia(q, d, self.inertia, self.args)

    def _rows_of_action(
        self,
        q: Coordinates,
        h: Scalar,
        fixed: Increment,
        nonholonomic: Increment,
        mean_rate: Callable[[Coordinates], Coordinates],
    ) -> list[Summands] | None:
        """The action as a sum of rows that depend on few coordinates each.

        `None` where the summands of the potential are unknown; see `elements.py`.
        """
        energies = self._element_energies(q)
        if energies is None:
            return None
        rows: list[Summands] = [lambda q, fn=fn: h * fn(q) for fn in energies]
        rows += [lambda q: fixed.impulse * self.all_fixed(q)]
        if fixed.velocity_impulse.size > 0:
            eta = fixed.velocity_impulse
            rows += [lambda q: h * eta * jax.jvp(self.fixed, (q,), (mean_rate(q),))[1]]
        if self.has_slip_rate(nonholonomic):
            slip = nonholonomic.velocity_impulse
            rows += [lambda q: h * slip * (self.nonholonomic(q) @ mean_rate(q))]
        return rows

    def structure(
        self, a: State, b: State, h: Scalar, rate: Increments, gradient: Gradient
    ) -> tuple[Increments, Float[Array, " np"]]:
        balance = self.kinematics.momentum_change(
            a.q,
            b.q,
            self.inertia @ (b.v - a.v),
            self.inertia @ (0.5 * (a.v + b.v)),
            h * rate,
            self.args,
        )
        if gradient.impulse.size > 0:
            pulled = self.kinematics.pull_back(a.q, b.q, h * rate, gradient.impulse)
            balance = balance + pulled
        if gradient.rows is not None:
            balance = balance + gradient.rows
        return balance, gradient.rate

    def reaction_row(self, state: State, eta: JointMultipliers) -> Float[Array, " np"]:
        return jnp.zeros((0,), state.q.dtype)

    def chain_rule(
        self, derivative: AbstractDerivative, step: Increments | None
    ) -> RotationRule | None:
        """The chain rule with respect to the rows, where a kind of coordinates has one and
        the discrete gradients are those of a step by the chain rule; else `None`."""
        if step is None or not isinstance(derivative, ChainRule):
            return None
        return self.kinematics.chain_rule(step)

    def _mean_rates(
        self, a: State, b: State, h: Scalar, increment: Increment, is_step: bool
    ) -> tuple[Rates, Increments | None]:
        """The rates in the gradient of `psi` with respect to `q`, and further rows."""
        eta = increment.velocity_impulse
        if not is_step or eta.size == 0:
            mean = 0.5 * (a.v + b.v)
            return lambda q: self.lift(q, mean), None
        at = lambda state: self._by_rates((state.q, state.t), eta)
        by_rates = lambda: (at(a), at(b))
        rates, rows = self.kinematics.mean_rates(a, b, self.lift, by_rates)
        return rates, None if rows is None else h * rows

    def _reaction(
        self,
        derivative: AbstractDerivative,
        step: Increments | None,
        a: Position,
        b: Position,
        eta: JointMultipliers,
    ) -> Velocities:
        """The reaction over an interval, which is that of `step` if this is not `None`."""
        if eta.size == 0:
            return jnp.zeros((self.inertia.shape[0],), eta.dtype)
        rule = self.chain_rule(derivative, step)
        if rule is not None:
            energy = lambda x: eta @ self.joint_rate(*x)
            return self.inverse_inertia @ rule.gradient_by_rates(energy, a, b)
        ends = self._by_rates(a, eta), self._by_rates(b, eta)
        if step is None:
            momentum = mean_momentum(*ends, self._lowered)
        else:
            momentum = self.kinematics.momentum_of_rates(*ends, step, self._lowered)
        return self.inverse_inertia @ momentum

    def _by_rates(self, position: Position, eta: JointMultipliers) -> ByRates:
        """`B^T eta` of the joints: the gradient of `eta . psi` with respect to the rates
        of the coordinates."""
        q, t = position
        _, transpose = jax.vjp(self.joint_near(q, t), q)
        return q, transpose(eta)[0]

    def _lowered(self, q: Coordinates, force: Coordinates) -> Velocities:
        """`L^+(q)^T force`, the momentum of a gradient with respect to the rates."""
        rest = jnp.zeros((self.inertia.shape[0],), q.dtype)
        _, transpose = jax.vjp(lambda v: self.lift(q, v), rest)
        return transpose(force)[0]

    def reaction_at(self, q: Coordinates, t: Time, eta: JointMultipliers) -> Velocities:
        """`M^-1 C(q, t)^T eta`; as `psi` is affine in `v`, the same for every `v`."""
        if eta.size == 0:
            return jnp.zeros((self.inertia.shape[0],), q.dtype)
        return self.inverse_inertia @ self._lowered(*self._by_rates((q, t), eta))

    def joint_change(self, q: Coordinates, v: Velocities, t: Time) -> JointMultipliers:
        """`C(q, t) v`, the part of `psi` that is linear in `v`."""
        return jax.jvp(self.joint_near(q, t), (q,), (self.lift(q, v),))[1]

    def metric(self, state: State) -> Symmetric:
        return self.kinematics.metric(state.q, self.inertia, self.coordinate, self.args)

    def inverse_metric(self, state: State) -> Symmetric:
        return self.inverse_inertia

    def inverse_regular_metric(self, state: State) -> Symmetric:
        regular = self.kinematics.regular_inertia(state.q, self.inertia)
        return self.inverse_inertia if regular is self.inertia else inverse_of(regular)

    def step_scale(self, state: State) -> Increments:
        kind, relations = self.kinematics, self.coordinate
        return kind.step_scale(state.q, self.inertia, relations, self.args)

    def coordinate_scale(self, step: Increments) -> Coordinates:
        return self.kinematics.coordinate_scale(step)

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
        holonomic = self.holonomic(multipliers)
        return self._potential(state.q) + holonomic @ self.constraint(state.q, state.t)

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
    def has_delassus_matrix(self) -> bool:
        """Also without constraints, unless there are few coordinates."""
        is_free = self.scales.constraint.size == 0
        has_many = self.inverse_inertia.shape[0] > FEW_FREE
        return self.constraint_tables is not None or (is_free and has_many)

    def delassus_matrix(self, state: State, h: Scalar | None = None) -> DelassusMatrix:
        tables, q = self.constraint_tables, state.q
        weight, added = self._weight(), self.delassus_regularisation
        rest = jnp.zeros((weight.shape[0],), q.dtype)
        if h is not None and self.elastic_tables is not None:
            tables = self.elastic_tables
            rates = self._rates_with_strains(state, h, tables.terms)
            both = tables.schurs(rates, rest, weight, added)
            return DelassusMatrix(
                self.inverse_inertia, both[0], None, added, both[1], tables.num_strains
            )
        if tables is None:
            return DelassusMatrix(self.inverse_inertia, None, None)
        frames = self._frames(q)
        products = tables.products(self._rates_of_joints(q, state.t, frames), rest)
        rows = schur(tables, products, weight, added)
        return DelassusMatrix(self.inverse_inertia, rows, frames, added)

    def _rates_with_strains(
        self, state: State, h: Scalar, terms: ChordTerms
    ) -> Callable[[Velocities], Float[Array, " rows"]]:
        """The rates of the joints, followed by the rows of strains and dampers."""
        joints = self._rates_of_joints(state.q, state.t, None)
        strains = self._rates_of_strains(state, h, terms)
        return lambda v: jnp.concatenate([joints(v), strains(v)])

    def _rates_of_strains(
        self, state: State, h: Scalar, terms: ChordTerms
    ) -> Callable[[Velocities], Float[Array, " rows"]]:
        """The rows of strains and dampers, of those that `terms` contains."""
        strains = self._strains(state, h, terms)
        return elastic_rates(strains, state.q, h, lambda v: self.lift(state.q, v))

    def _strains(self, state: State, h: Scalar, terms: ChordTerms) -> Elasticity:
        found = Elasticity(lambda q: [], [])
        if "strains" in terms:
            found = elasticity(self.system.potential, state.q, self.args)
        if "dampers" in terms:
            user = self.to_rates(state)
            found = found.with_others(resistance(self.system, user, self.args, h))
        return found

    def _elastic_tables(self, state: State, terms: ChordTerms) -> ElasticTables | None:
        """The tables of joints and of the rows of these terms together.

        `None` where one of the terms has no rows, where coordinates are redundant, where
        there are more rows than velocities, and where the elimination would be long: the
        exact Jacobian is better then.
        """
        q, rest = state.q, jnp.zeros_like(self.inertia.diagonal())
        if not self.has_delassus_matrix or self._frames(q) is not None:
            return None
        t = jnp.zeros((), rest.dtype) if self.system.is_timed else None
        still, unit = State(q, rest, t), jnp.ones((), rest.dtype)
        counts = [self._strains(still, unit, (term,)).num_strains for term in terms]
        if min(counts) == 0 or sum(counts) > rest.size:
            return None
        rates = self._rates_with_strains(still, unit, terms)
        joints = self.constraint_tables
        num_joints = 0 if joints is None else joints.num_rows
        tables = elastic_tables(rates, num_joints, rest, self.inverse_inertia)
        if tables is None:
            return None
        num_strains = dict(zip(terms, counts, strict=True)).get("strains", 0)
        return ElasticTables(*tables, terms, num_strains)

    def _frames(self, q: Coordinates) -> Frames | None:
        """`L` stacked on `B_c`, where coordinates are redundant."""
        return self.kinematics.frames(q, jax.jacfwd(self.coordinate), self.args)

    def _rates_of_joints(
        self, q: Coordinates, t: Time, frames: Frames | None
    ) -> Callable[[Array], JointMultipliers]:
        """The rates of the joints, as a linear function of velocities and of the rates of
        the coordinate constraints."""
        rates = lambda v: self.lift(q, v) if frames is None else frames.rates(v)
        return lambda v: jax.jvp(self.joint_near(q, t), (q,), (rates(v),))[1]

    def _weight(self) -> Symmetric:
        """The inverse inertia, with zeros for the rates of the coordinate constraints."""
        rest = jnp.zeros((self.scales.coordinate.size,), self.inverse_inertia.dtype)
        num_relations = jax.eval_shape(lambda q: self.coordinate(q), rest).size
        return padded(self.inverse_inertia, num_relations)

    def _constraint_tables(self, state: State) -> SchurTables | None:
        t = jnp.zeros((), state.q.dtype) if self.system.is_timed else None
        weight = self._weight()
        rates = self._rates_of_joints(state.q, t, self._frames(state.q))
        rest = jnp.zeros((weight.shape[0],), state.q.dtype)
        return schur_tables(rates, rest, weight)

    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        """Solves the equations of motion with the joints at acceleration level.

        Coordinate constraints are not differentiated, because the rates `L^+ v` satisfy
        them for every `v`. Their multipliers enter the `nq` rows of the balance of
        momentum.
        """
        q, v, t, scales = state.q, state.v, state.t, self.scales
        qdot, rates = self.lift(q, v), self.rates(q, v)
        slope = self.slope(state)
        gyroscopic = self.kinematics.gyroscopic(q, self.inertia @ v, rates, self.args)
        if gyroscopic is not None:
            slope = slope + gyroscopic
        free_rate = self._free_joint_acceleration(state, qdot)
        if self._has_independent_accelerations(q):
            return self._independent_accelerations(state, slope, free_rate)
        unit = 1 / self.kinematics.velocity_scale(self.inertia)

        # The multipliers of the relations come first: what is added to the diagonal pairs
        # each multiplier of a joint with the row of this joint.
        count, num_joints = scales.constraint.size, self.num_joints
        first = v.size + count - num_joints

        def parts(x: Array) -> tuple[Velocities, Multipliers]:
            multipliers = jnp.concatenate([x[first:], x[v.size : first]])
            return unit * x[: v.size], multipliers / scales.constraint

        def conditions(x: Array) -> Array:
            acceleration, multipliers = parts(x)
            # Evaluated in this function, because the sparsity pattern is found from index
            # arrays that are constants of the traced function.
            pulled = self._momentum_rows(q, self.inertia @ acceleration)
            joints = self.constraint_force(q, t, multipliers)
            pulled = pulled + self._pull_back_at(q, joints)
            rate = self.joint_change(q, acceleration, t) + free_rate
            rows = (
                (pulled + slope) / scales.step,
                rate / scales.constraint[: rate.size],
            )
            return jnp.concatenate(rows)

        like = jnp.zeros((v.size + count,), q.dtype)
        added = self.regularisation_after(like[:first], num_joints)
        return parts(affine_root(conditions, like, added))

    def _has_independent_accelerations(self, q: Coordinates) -> bool:
        """Whether accelerations follow from the inverse inertia and the Delassus matrix.

        Not so where the axes of bodies are coordinates, because a flat body has no inertia
        along one of them; nor where constraints may be redundant, because the part of the
        Delassus matrix that makes it regular may exceed its small eigenvalues.
        """
        has_axes = jax.eval_shape(self.kinematics.constraint, q).size > 0
        is_regular = self.has_delassus_matrix and not self.system.redundant
        return is_regular and not has_axes and self._frames(q) is None

    def _independent_accelerations(
        self, state: State, slope: Increments, free_rate: JointMultipliers
    ) -> tuple[Velocities, Multipliers]:
        """The same for coordinates that are not redundant, by the smaller matrix
        `C M^-1 C^T`.

        `slope` are the forces that the accelerations balance, and `free_rate` the rates of
        the joints without accelerations.
        """
        q, t, count = state.q, state.t, state.v.size
        # Derivatives are those of the linear equations, and not of the elimination.
        delassus = jax.lax.stop_gradient(self.delassus_matrix(state))

        def product(x: Array) -> Array:
            acceleration, multipliers = x[:count], x[count:]
            reaction = self._lowered(*self._by_rates((q, t), multipliers))
            force = self.inertia @ acceleration + reaction
            return jnp.concatenate([force, self.joint_change(q, acceleration, t)])

        def solve(of: Callable, right: Array) -> Array:
            del of
            acceleration = delassus.inverse_inertia @ right[:count]
            multipliers = jnp.zeros_like(right[count:])
            # The second pass repairs the round-off of the first, which is large where
            # constraints are nearly dependent.
            for _ in range(2):
                change = delassus.product(acceleration) - right[count:]
                (more,) = delassus.solve(change[None])
                acceleration = acceleration - delassus.velocity(more)
                multipliers = multipliers + more
            return jnp.concatenate([acceleration, multipliers])

        right = -jnp.concatenate([slope, free_rate])
        found = jax.lax.custom_linear_solve(product, right, solve, symmetric=True)
        return found[:count], found[count:]

    def _free_joint_acceleration(self, state: State, qdot: Coordinates) -> JointMultipliers:
        """`dpsi/dt` of a motion with constant velocities `v`."""
        rates = lambda q, t: self.joint_rate(q, state.v, t)
        return jax.jvp(rates, (state.q, state.t), (qdot, time_rate(state.t)))[1]
