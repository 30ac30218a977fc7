"""The discrete operators of a system, from which every scheme is composed.

The residual of the equations of motion over an interval `a -> b`, with a gradient `w`, is

    S_q  = Lm^T (mu_b - mu_a) + G(q_m, mu_m) (q_b - q_a) + h w_q
    S_mu = Lm (q_b - q_a) - h w_mu

at `q_m = (q_a + q_b)/2`, `mu_m = (mu_a + mu_b)/2`. One `L` and one skew `G` serve the whole
interval, so that the two rows together imply the energy identity. `w` is the discrete
gradient of

    H + lambda . Phi(q) + eta . psi(q, mu),      psi = dPhi/dt

Nonholonomic constraints `A(q) qdot = 0` have terms `eta . A(q) qdot` in `psi`. There is no
function whose gradient is their force, so it is `A(q_m)^T lambda` over the whole interval.
It does no work, and energy is conserved, because the step satisfies

    A(q_m) (q_b - q_a) = 0

beside `A(q_b) qdot_b = 0`. For `A = dPhi/dq` this is the step of a joint, except that the
matrix in the middle takes the place of the discrete gradient of `Phi`.

Forces `f` add `-h Lm^T f` to the first row. For driven constraints, `Phi(q, t)`, the
discrete gradient is taken with respect to `q` and `t` jointly, and its `t` component is the
power that they supply.

There are two models. A `SeparableModel` has constant inertia, and its velocities follow
from `S_mu` in closed form. A `CanonicalModel` has an arbitrary Hamiltonian, and its momenta
are unknowns of the step.
"""

import abc
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._discrete import AbstractCorrected, AbstractDerivative
from .._programs import call_traced_once
from .._solvers import Assembled, RowPattern, SchurTables, Symmetric
from .._system import AbstractSystem, State
from .._types import (
    Args,
    Coordinates,
    Increments,
    JointMultipliers,
    Multipliers,
    Scalar,
    Velocities,
)
from .delassus import DelassusMatrix
from .interval import Gradient, Increment, Scales, Time, time_rate


# The function `reaction(a, b, eta)`, where `a` and `b` are positions `(q, t)`, for the mean
# of `M^-1 C(q, t)^T eta` over the interval between them: the velocity that velocity-level
# multipliers add.
Position: TypeAlias = tuple[Coordinates, Time]
Reaction: TypeAlias = Callable[[Position, Position, JointMultipliers], Velocities]


class AbstractModel(eqx.Module):
    """The functions of a system for fixed `args`, and the operators derived from them.

    The field `v` of a model's state contains velocities where the inertia is constant, and
    the momenta `p` where the system has a Hamiltonian.
    """

    system: eqx.AbstractVar[AbstractSystem]
    args: eqx.AbstractVar[Args]
    scales: eqx.AbstractVar[Scales]
    # The index tables of `delassus_matrix`; `None` where there is none, or no joints.
    constraint_tables: eqx.AbstractVar[SchurTables | None]

    @property
    @abc.abstractmethod
    def has_own_momenta(self) -> bool:
        """Whether momenta are unknowns of the step; `State.v` is then `p`."""

    @property
    @abc.abstractmethod
    def has_delassus_matrix(self) -> bool:
        """Whether the chord method can be used, so that `delassus_matrix` exists."""

    @property
    @abc.abstractmethod
    def has_canonical_rates(self) -> bool:
        """Whether `L = I`: the velocities, or `dH/dp`, are the rates of the coordinates."""

    @abc.abstractmethod
    def to_internal(self, state: State) -> State:
        """The state of the model that corresponds to a user's state `(q, v)`."""

    @abc.abstractmethod
    def to_user(self, state: State) -> State:
        """The user's state `(q, v)` that corresponds to a state of the model; no time."""

    @property
    @abc.abstractmethod
    def in_rates(self) -> "AbstractModel":
        """The model without rotations, whose velocities are the rates of coordinates.

        It is the model itself, except for rigid bodies that are moved by rotations.
        """

    @abc.abstractmethod
    def to_rates(self, state: State) -> State:
        """The state of `in_rates` that corresponds to a state of this model."""

    @abc.abstractmethod
    def user_multipliers(self, multipliers: Multipliers) -> Multipliers:
        """The multipliers of the user's rows, which are those of `in_rates`."""

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
        """`h dH/dq` and `dH/dmu` at a state, without multipliers."""

    @abc.abstractmethod
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
        """The discrete gradient over `a -> b` with the multipliers of `increment`.

        With `is_step`, the rate of this increment leads from `a` to `b`.
        """

    @abc.abstractmethod
    def structure(
        self, a: State, b: State, h: Scalar, rate: Increments, gradient: Gradient
    ) -> tuple[Increments, Float[Array, " np"]]:
        """`S_q` and `S_mu/h`; `rate` is that of the increment from `a` to `b`."""

    @abc.abstractmethod
    def node_momenta(
        self,
        unknowns: tuple[Float[Array, " np"], ...],
        velocities: Callable[[Reaction], tuple[Velocities, ...]],
        derivative: AbstractDerivative,
        step: Increments | None,
    ) -> tuple[Velocities, ...]:
        """The field `v` of the states at the nodes of a step.

        With constant inertia these are the velocities. `velocities` computes them from the
        rows `S_mu`, and its argument is the function for the mean of `M^-1 C^T eta`. With a
        Hamiltonian these are the momenta, which are the `unknowns`. If the step is a single
        interval, `step` is its displacement.
        """

    @abc.abstractmethod
    def momentum_rows(self, rates: Velocities) -> Float[Array, " np"]:
        """`rates` itself where momenta are unknowns, else an array of shape `(0,)`."""

    @abc.abstractmethod
    def slope(self, state: State) -> Increments:
        """The rows of `dH/dq` less the applied forces `L^T f`."""

    @abc.abstractmethod
    def velocity(self, state: State) -> Velocities:
        """The velocities whose product with the forces is power: `L qdot` or `dH/dp`."""

    @abc.abstractmethod
    def velocity_change(
        self, change: Velocities, inverse_inertia: Float[Array, "nq nq"] | Symmetric
    ) -> Velocities:
        """The change of the velocities that corresponds to a change of `State.v`."""

    @abc.abstractmethod
    def kinetic_change(self, a: State, b: State, gradient: Gradient) -> Scalar:
        """The change of the kinetic energy over `a -> b`: `Dmu H . (mu_b - mu_a)`."""

    @abc.abstractmethod
    def kinetic_of_jump(self, a: State, b: State) -> Scalar:
        """`(mu_b - mu_a) . (dH/dmu(b) - dH/dmu(a)) / 2`"""

    @abc.abstractmethod
    def push(self, qa: Coordinates, qb: Coordinates, rate: Increments) -> Velocities:
        """`Lm rate`"""

    @abc.abstractmethod
    def pull(self, qa: Coordinates, qb: Coordinates, force: Velocities) -> Increments:
        """`Lm^T force`"""

    @abc.abstractmethod
    def displacement(self, q: Coordinates, step: Increments) -> Coordinates:
        """The change of the coordinates in a step from `q`."""

    @abc.abstractmethod
    def rates(self, q: Coordinates, v: Velocities) -> Increments:
        """The rates of an increment, in the limit of short steps, of a motion with `v`."""

    @abc.abstractmethod
    def reaction_row(self, state: State, eta: JointMultipliers) -> Float[Array, " np"]:
        """The term `dpsi/dmu^T eta` of the row `S_mu`; empty with constant inertia."""

    @abc.abstractmethod
    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        """The rates of the coordinates, `L(q)^+ v` or `dH/dp`."""

    @abc.abstractmethod
    def metric(self, state: State) -> Symmetric:
        """A regular inertia matrix for the rates of the coordinates."""

    @abc.abstractmethod
    def inverse_metric(self, state: State) -> Symmetric:
        """The inverse of the metric of `State.v`.

        The metric of velocities is the inertia `M`, so this is `M^-1`. The metric of
        momenta is `M^-1`, so this is `M`.
        """

    @abc.abstractmethod
    def inverse_regular_metric(self, state: State) -> Symmetric:
        """The inverse of a regular metric of `State.v`.

        It is the metric for those `State.v` that the constraints between the axes of rigid
        bodies admit. The metric itself is singular for a flat body.
        """

    @abc.abstractmethod
    def stiffness(
        self, state: State, multipliers: Multipliers
    ) -> tuple[Float[Array, "nq nq"] | Assembled, Symmetric]:
        """`K = Hess_q (H + lambda . Phi)`, assembled if possible, and the inertia."""

    @abc.abstractmethod
    def augmented_energy(self, state: State, multipliers: Multipliers) -> Scalar:
        """`H + lambda . Phi(q, t)`; with constant inertia without the kinetic energy."""

    @abc.abstractmethod
    def skew_gradient(
        self,
        middle: State,
        multipliers: Multipliers,
        change: tuple[Coordinates, Velocities, Time],
        h: Scalar,
    ) -> Gradient:
        """`D J D (z1 - z0)` with `D = Hess(H + lambda . Phi)`.

        The rows of the coordinates are multiplied by `h`. `change` is `z1 - z0` as
        `(q, v, t)`. The result is orthogonal to `z1 - z0`, so it does no work. Time is
        treated as a coordinate whose momentum does not enter the Hamiltonian. With constant
        inertia the rows of the momenta are empty; `stiffness_product` gives them.
        """

    @abc.abstractmethod
    def delassus_matrix(self, state: State, h: Scalar | None = None) -> DelassusMatrix:
        """`B M^-1 B^T` at a state. It exists only if `has_delassus_matrix`.

        With a length of time `h` it includes the stiffness of strains, `h^2/4 K`, if any.
        """

    @abc.abstractmethod
    def neglected_by_chord(self, state: State, v: Velocities, h: Scalar) -> Velocities:
        """The velocities that stiffness, damping and the change of the inertia cause in a
        step with the velocities `v`: the chord method neglects them."""

    @abc.abstractmethod
    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        """`vdot` (or `pdot`) and `lambda` that satisfy the equations of motion."""

    def multipliers(self, state: State) -> Multipliers:
        """The multipliers `lambda` of `accelerations`."""
        return self.accelerations(state)[1]

    @abc.abstractmethod
    def coordinate(self, q: Coordinates) -> Float[Array, " ncc"]:
        """The coordinate constraints, which relate redundant coordinates of a body."""

    @abc.abstractmethod
    def constraint(self, q: Coordinates, t: Time) -> Float[Array, " nh"]:
        """`Phi(q, t)`: the joints, followed by the coordinate constraints."""

    def nonholonomic(self, q: Coordinates) -> Float[Array, "k nq"]:
        """The matrix `A(q)`."""
        if self.system.nonholonomic is None:
            return jnp.zeros((0, q.size), q.dtype)
        return call_traced_once(self.system.nonholonomic, q, self.args)

    def joint_near(
        self, at: Coordinates, t: Time
    ) -> Callable[[Coordinates], JointMultipliers]:
        """The joints near a position, with `A(at) (q - at)` for nonholonomic constraints.

        The derivatives at this position are the rows of the constraint Jacobian.
        """
        if self.system.nonholonomic is None:
            return lambda q: self.joint(q, t)
        matrix = self.nonholonomic(at)
        return lambda q: jnp.concatenate([self.joint(q, t), matrix @ (q - at)])

    def constraint_near(
        self, at: Coordinates, t: Time
    ) -> Callable[[Coordinates], Multipliers]:
        """`joint_near`, followed by the coordinate constraints."""
        if self.system.nonholonomic is None:
            return lambda q: self.constraint(q, t)
        joint = self.joint_near(at, t)
        return lambda q: jnp.concatenate([joint(q), self.coordinate(q)])

    def holonomic(self, rows: Multipliers) -> Float[Array, " nh"]:
        """The entries of holonomic constraints; `rows` has one for each multiplier."""
        if self.system.nonholonomic is None:
            return rows
        first, last = self._nonholonomic_range(self.scales.coordinate)
        return jnp.concatenate([rows[:first], rows[last:]])

    def _nonholonomic_range(self, q: Coordinates) -> tuple[int, int]:
        """The range of the nonholonomic constraints among the multipliers."""
        t = jnp.zeros((), q.dtype) if self.system.is_timed else None
        first = jax.eval_shape(lambda q: self.joint(q, t), q).size
        return first, first + jax.eval_shape(lambda q: self.nonholonomic(q), q).shape[0]

    def stiffness_product(
        self, state: State, multipliers: Multipliers, along: tuple[Coordinates, Time]
    ) -> tuple[Coordinates, Time]:
        """`K`, extended by a row and a column for the time, times a vector `(q, t)`."""
        energy = lambda q, t: self.augmented_energy(State(q, state.v, t), multipliers)
        gradient = jax.grad(energy, argnums=(0, 1))
        return jax.jvp(gradient, (state.q, state.t), along)[1]

    def constraint_force(
        self, q: Coordinates, t: Time, multipliers: Multipliers
    ) -> Coordinates:
        """`B(q, t)^T multipliers`, shape `(nq,)`."""
        _, transpose = jax.vjp(self.constraint_near(q, t), q)
        return transpose(multipliers)[0]

    @abc.abstractmethod
    def fixed(self, q: Coordinates) -> Float[Array, " nf"]:
        """The scleronomic joints, which do not depend on time."""

    def all_fixed(self, q: Coordinates) -> Float[Array, " nf+ncc"]:
        """`fixed`, followed by the coordinate constraints."""
        return jnp.concatenate([self.fixed(q), self.coordinate(q)])

    @abc.abstractmethod
    def force(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        """`f(q, v, t)` of a system that has forces."""

    def user_constraint(self, q: Coordinates) -> Float[Array, " nf"]:
        """The constraint of the user; it does not depend on time."""
        if self.system.constraint is None:
            return jnp.zeros((0,), q.dtype)
        return call_traced_once(self.system.constraint, q, self.args)

    def driven(self, q: Coordinates, t: Time) -> Float[Array, " nd"]:
        """The driven (rheonomic) constraints, which depend on time."""
        if self.system.driven is None:
            return jnp.zeros((0,), q.dtype)
        assert t is not None
        return call_traced_once(self.system.driven, q, t, self.args)

    def joint(self, q: Coordinates, t: Time) -> JointMultipliers:
        """The constraints that can be imposed at velocity level: fixed, then driven."""
        if self.system.driven is None:
            return self.fixed(q)
        return jnp.concatenate([self.fixed(q), self.driven(q, t)])

    def joint_rate(self, q: Coordinates, v: Velocities, t: Time) -> JointMultipliers:
        """`psi(q, v, t)`: `dPhi/dt` of the joints, and `A(q) qdot`."""
        rates = self.lift(q, v)
        rows = jax.jvp(self.joint, (q, t), (rates, time_rate(t)))[1]
        if self.system.nonholonomic is None:
            return rows
        return jnp.concatenate([rows, self.nonholonomic(q) @ rates])

    def symmetry_momenta(self, state: State) -> Float[Array, " ns"]:
        """The momentum maps of the symmetries that the user has declared."""
        symmetry = self.system.symmetry
        none = jnp.zeros((0,), state.q.dtype)
        return symmetry(state.q, self.args) @ self.momentum(state) if symmetry else none

    def split(
        self, increment: Increment, q: Coordinates
    ) -> tuple[Increment, Increment, Increment]:
        """Three increments, each with the multipliers of some constraints only: of the
        holonomic ones that do not depend on time, of the driven ones, and of the
        nonholonomic ones; `q` is any position."""
        if self.system.driven is None and self.system.nonholonomic is None:
            return increment, increment, increment
        first = jax.eval_shape(self.fixed, q).size
        middle, last = self._nonholonomic_range(q)

        def parts(x: Array) -> tuple[Array, Array, Array]:
            fixed = jnp.concatenate([x[:first], x[last:]])
            return fixed, x[first:middle], x[middle:last]

        multipliers = lambda z: (z.impulse, z.velocity_impulse)
        those = zip(*map(parts, multipliers(increment)), strict=True)
        fixed, driven, nonholonomic = (
            eqx.tree_at(multipliers, increment, some) for some in those
        )
        return fixed, driven, nonholonomic

    def slip(
        self, qa: Coordinates, qb: Coordinates, displacement: Coordinates
    ) -> Float[Array, " k"]:
        """`A(q_m) displacement`, which nonholonomic constraints forbid over `a -> b`."""
        return self.nonholonomic(0.5 * (qa + qb)) @ displacement

    def nonholonomic_impulse(
        self, gradient: Coordinates, a: State, b: State, increment: Increment
    ) -> Coordinates:
        """A gradient plus `A(q_m)^T impulse`; `increment` has only these multipliers."""
        if self.system.nonholonomic is None:
            return gradient
        force = increment.impulse @ self.nonholonomic(0.5 * (a.q + b.q))
        return gradient + force if gradient.size > 0 else force

    def has_slip_rate(self, increment: Increment) -> bool:
        """Whether nonholonomic constraints have multipliers at velocity level."""
        return self.system.nonholonomic is not None and increment.velocity_impulse.size > 0

    def driven_action(
        self, q: Coordinates, rate: Coordinates, t: Time, h: Scalar, driven: Increment
    ) -> Scalar:
        """`h (lambda . g + eta . dg/dt)` of the driven constraints `g`."""
        constraint, psi = jax.jvp(self.driven, (q, t), (rate, time_rate(t)))
        out = driven.impulse @ constraint
        if driven.velocity_impulse.size > 0:
            out = out + h * driven.velocity_impulse @ psi
        return out

    def user_force(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        """`f(q, v, t)` at the velocities of the user."""
        assert self.system.force is not None
        assert t is not None
        return call_traced_once(self.system.force, q, v, t, self.args)

    def damping(self, q: Coordinates, v: Velocities, t: Time) -> Velocities:
        """The part of `f` that is odd in the velocity."""
        return 0.5 * (self.force(q, v, t) - self.force(q, -v, t))

    def regularisation(self, count: int, dtype: Any) -> Float[Array, " count"] | None:
        """The regularisation of equations for `count` scaled multipliers.

        These are small numbers that are added to the diagonal of the Jacobian. `None` for a
        system whose constraints are declared to be independent.
        """
        if not self.system.redundant:
            return None
        return jnp.full((count,), -(float(jnp.finfo(dtype).eps) ** 0.5), dtype)

    @property
    def num_joints(self) -> int:
        """The number of constraints that do not relate redundant coordinates."""
        scales = self.scales
        relations = jax.eval_shape(self.coordinate, scales.coordinate).size
        return scales.constraint.size - relations

    @property
    def delassus_regularisation(self) -> JointMultipliers | None:
        """What is added to the diagonal of the Delassus matrix; `None` for a system whose
        constraints are declared to be independent.

        At the start it is a small part of the diagonal. The multipliers have the same norm
        as with `regularisation`.
        """
        if not self.system.redundant:
            return None
        joints = self.scales.constraint[: self.num_joints]
        eps = float(jnp.finfo(joints.dtype).eps)
        return eps**_REGULARISATION * joints**2

    def regularisation_after(self, x: Array, count: int) -> Float[Array, " n"] | None:
        """The regularisation of equations for `x`, where it is zero, and multipliers."""
        numbers = self.regularisation(count, x.dtype)
        return None if numbers is None else jnp.concatenate([jnp.zeros_like(x), numbers])

    def energy_scale(self, state: State, h: Scalar) -> Scalar:
        """A typical energy of a step of length `h`; positive, with zero derivatives.

        It is twice the largest of three energies: the kinetic energy, and the kinetic
        energies that bodies at rest would gain in the time `h` from the forces and from the
        driven constraints. It is one if all three are zero.
        """
        gained = h * self.slope(state) / self.scales.step
        size = jnp.maximum(2 * self.kinetic(state), gained @ gained)
        if self.system.driven is not None:
            q, t = state.q, state.t
            assert t is not None
            moved = (self.constraint(q, t + h) - self.constraint(q, t)) / h
            unit = self.holonomic(self.scales.constraint)
            size = jnp.maximum(size, jnp.sum((moved / unit) ** 2))
        return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))

    def force_size(self, state: State) -> Increments:
        """The size of the terms of `dH/dq` and of the applied forces, row by row.

        In an equilibrium the sum of the forces is zero, but the forces of the springs and
        the weights are not. The computed sum is then round-off: the machine epsilon times
        this size.
        """
        return _term_size(lambda model, state: model.slope(state), self, state)

    def action_size(
        self,
        derivative: AbstractDerivative,
        state: State,
        h: Scalar,
        increment: Increment,
    ) -> Scalar | float:
        """The size of the terms of `h V + impulse . Phi`.

        Only discrete derivatives with a correction term use it; for others it is zero.
        """
        if not isinstance(derivative, AbstractCorrected):
            return 0.0
        energy = _term_size(lambda model, state: model.potential(state), self, state)
        pull = jnp.abs(increment.impulse) @ self.scales.constraint_size
        size = jax.lax.stop_gradient(jnp.abs(h) * energy + pull)
        return _OPERATIONS_PER_TERM * size

    def _scales(self, state: State) -> Scales:
        """The scales at a state.

        They enter the convergence tests of Newton's method. Solutions depend on them only
        where constraints are redundant: the scales then define the norm that the
        multipliers minimise.
        """
        q = state.q
        step = self.step_scale(state)
        coordinate = self.coordinate_scale(step)
        constraint, size = row_scales(self.constraint_near(q, state.t), q, coordinate)
        if self.system.nonholonomic is not None:
            # They have no terms in the position.
            first, last = self._nonholonomic_range(q)
            size = size.at[first:last].set(0)
        # A zero gradient makes the step equations singular, which is reported as a failure.
        # The scaling must not divide by zero before that.
        constraint = jnp.where(constraint > 0, constraint, 1.0)
        scales = Scales(coordinate, step, constraint, size)
        return scales if self.system.redundant else jax.lax.stop_gradient(scales)

    @abc.abstractmethod
    def step_scale(self, state: State) -> Increments:
        """The scales of the rates of an increment."""

    @abc.abstractmethod
    def coordinate_scale(self, step: Increments) -> Coordinates:
        """The scales of the coordinates, given those of the rates of an increment."""


def row_scales(
    rows: Callable[[Coordinates], Array], q: Coordinates, coordinate: Coordinates
) -> tuple[Array, Array]:
    """The norm of the gradient of each row of a function, and the size of its terms.

    `coordinate` are the scales of the coordinates.
    """
    pattern = RowPattern(rows, q)
    entries, columns = pattern.derivative(rows, q), pattern.columns
    # A bound on the size of the terms. The terms themselves may be zero at the start,
    # as those of the product of two perpendicular axes.
    length = lambda rows: jnp.sqrt(jnp.sum(rows**2, axis=1))
    norm = length(entries / coordinate[columns])
    return norm, norm * length(pattern.own(coordinate * q))


# The evaluation of a term takes a few operations, each with a rounding error.
_OPERATIONS_PER_TERM = 4.0
# The power of the machine epsilon by which the Delassus matrix is regularised. The number
# must be far below the eigenvalues, and round-off is divided by its square.
_REGULARISATION = 0.375
# The number of changes of the inputs from which the size of a term is estimated.
_DRAWS = 3


def _term_size(
    fn: Callable[[AbstractModel, State], Array], model: AbstractModel, state: State
) -> Array:
    """The first-order change of `fn` if each input changed by its own size.

    The inputs are changed by unequal fractions of their sizes, so that terms that cancel
    in `fn` do not cancel here.
    """
    inputs, rest = eqx.partition((state.q, model.args), eqx.is_inexact_array)
    is_none = lambda x: x is None

    def of(inputs: PyTree[Array]) -> Array:
        q, args = eqx.combine(inputs, rest)
        other = eqx.tree_at(lambda model: model.args, model, args, is_leaf=is_none)
        return fn(other, State(q, state.v, state.t))

    inputs = jax.lax.stop_gradient(inputs)
    flat, unravel = ravel_pytree(inputs)
    # Random fractions, because those of a regular sequence cancel in second differences,
    # such as the forces between the nodes of a beam, and several, because those of one
    # draw nearly cancel in some rows of many.
    parts = np.random.default_rng(0).uniform(0.5, 1.5, (_DRAWS, flat.size))
    parts = jax.vmap(unravel)(jnp.asarray(parts, flat.dtype))
    # One array after the other, so that products with `args`, which are the same in all
    # steps, are computed before the loop over the steps.
    moved = jax.tree.map(lambda part, x: part * x[None], parts, inputs)
    value, change_by = jax.linearize(of, inputs)
    change = jnp.max(jnp.abs(jax.vmap(change_by)(moved)), axis=0)
    # The derivative can be non-finite if `fn` is not differentiable in `args`.
    size = jnp.abs(value) + jnp.where(jnp.isfinite(change), change, 0)
    return jax.lax.stop_gradient(size)
