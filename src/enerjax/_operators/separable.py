"""Constant inertia: velocities are eliminated by hand, and cost no unknowns.

The drive in the momenta is `M^-1` times the mean momentum, and what `psi` adds. With
`psi = C(q) v` linear in `v` its joint difference splits without any metric between
positions and momenta,

    psi_b - psi_a = [D_q (C v_m)] (q_b - q_a) + 1/2 (C_a + C_b) (v_b - v_a),

(with `D_q` over positions and time where constraints are driven, and `psi` affine in `v`)
which leaves `S_mu` free of the velocities at its end but for their mean: schemes solve it
for them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractCorrected, AbstractDerivative
from .._solvers import as_dense, Assembled, inverse_of, row_hessians, Symmetric
from .._system import AbstractKinematics, IdentityKinematics, State, System
from .._types import Args, Coordinates, JointMultipliers, Multipliers, Scalar, Velocities
from .balance import accelerations, multipliers
from .base import AbstractModel
from .elements import element_energies, gradient_and_work_by_rows, is_weight, Summands
from .interval import Drive, Increment, Scales, Time
from .lapse import gradient_and_work
from .sizes import action_size


class SeparableModel(AbstractModel):
    """A `System` at fixed `args`; in its states `v` are the velocities."""

    system: System
    args: Args
    inertia: Symmetric
    inverse_inertia: Symmetric
    scales: Scales
    # Asked of large systems only.
    is_weight: bool = eqx.field(static=True)
    kinematics: AbstractKinematics

    def __init__(self, system: System, state: State, args: Args):
        self.system = system
        self.args = args
        self.is_weight = is_weight(system, state.q, args)
        self.kinematics = system.kinematics.in_parts(state.q, self.coordinate, args)
        self.inertia = system.inertia(state, args)
        self.inverse_inertia = inverse_of(self.inertia)
        self.scales = self._scales(state)

    @property
    def has_own_momenta(self) -> bool:
        return False

    @property
    def has_canonical_rates(self) -> bool:
        return isinstance(self.kinematics, IdentityKinematics)

    def enter(self, state: State) -> State:
        return state

    def leave(self, state: State) -> State:
        return State(state.q, state.v)

    def kinetic(self, state: State) -> Scalar:
        return self.kinetic_of(state.v)

    def kinetic_of(self, v: Velocities) -> Scalar:
        return 0.5 * v @ self.inertia @ v

    def potential(self, state: State) -> Scalar:
        return self._potential(state.q)

    def _potential(self, q: Coordinates) -> Scalar:
        return self.system.potential(q, self.args)

    def momentum(self, state: State) -> Velocities:
        return self.inertia @ state.v

    def gradient(self, state: State, h: Scalar) -> Drive:
        return Drive(h * jax.grad(self._potential)(state.q), jnp.zeros((0,), h.dtype))

    def coordinate(self, q: Coordinates) -> Float[Array, " ncc"]:
        """The relations between redundant coordinates."""
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

    def push(self, qa: Coordinates, qb: Coordinates, rate: Coordinates) -> Velocities:
        return self.kinematics.push(0.5 * (qa + qb), rate, self.args)

    def pull(self, qa: Coordinates, qb: Coordinates, force: Velocities) -> Coordinates:
        return self._pull(0.5 * (qa + qb), force)

    def _pull(self, q: Coordinates, momentum: Velocities) -> Coordinates:
        return self.kinematics.pull(q, momentum, self.args)

    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        relations = jax.jacfwd(self.coordinate)
        return self.kinematics.lift(q, v, relations, self.args)

    def drive(
        self,
        derivative: AbstractDerivative,
        a: State,
        b: State,
        h: Scalar,
        increment: Increment,
    ) -> Drive:
        mean_velocity = 0.5 * (a.v + b.v)
        fixed, driven = self.split(increment)

        held = lambda q: jnp.concatenate([self.fixed(q), self.coordinate(q)])
        rate = lambda q: jax.jvp(self.fixed, (q,), (self.lift(q, mean_velocity),))[1]

        def action(q: Coordinates) -> Scalar:
            out = h * self._potential(q)
            if fixed.impulse.size > 0:
                out = out + fixed.impulse @ held(q)
            if fixed.velocity_impulse.size > 0:
                out = out + h * fixed.velocity_impulse @ rate(q)
            return out

        def moved(q: Coordinates, t: Time) -> Scalar:
            return self.driven_action(q, self.lift(q, mean_velocity), t, h, driven)

        with_time = None if self.system.driven is None else moved
        ends, none = ((a.q, a.t), (b.q, b.t)), jnp.zeros((0,), h.dtype)
        energies = self._element_energies(a.q)
        if energies is None or not isinstance(derivative, AbstractCorrected):
            size = action_size(self, derivative, a, h, increment)
            impulse, work = gradient_and_work(
                derivative, action, with_time, *ends, size=size
            )
            return Drive(impulse, none, work)
        rows: list[Summands] = [lambda q, fn=fn: h * fn(q) for fn in energies]
        rows += [lambda q: fixed.impulse * held(q)]
        if fixed.velocity_impulse.size > 0:
            rows += [lambda q: h * fixed.velocity_impulse * rate(q)]
        impulse, work = gradient_and_work_by_rows(derivative, rows, with_time, *ends)
        if self.is_weight:
            impulse = impulse + h * jax.grad(self._potential)(a.q)
        return Drive(impulse, none, work)

    def structure(
        self, a: State, b: State, h: Scalar, rate: Coordinates, drive: Drive
    ) -> Drive:
        middle = 0.5 * (a.q + b.q)
        change = self._pull(middle, self.inertia @ (b.v - a.v))
        momentum = self.inertia @ (0.5 * (a.v + b.v))
        gyroscopic = self.kinematics.gyroscopic(middle, momentum, h * rate, self.args)
        if gyroscopic is not None:
            change = change + gyroscopic
        return Drive(change + drive.impulse, drive.drift)

    def reaction(self, state: State, eta: JointMultipliers) -> Velocities:
        return self.reaction_at(state.q, state.t, eta)

    def reaction_at(self, q: Coordinates, t: Time, eta: JointMultipliers) -> Velocities:
        """`M^-1 C(q, t)^T eta`; as `psi` is affine in `v`, the same for every `v`."""
        rest = jnp.zeros((self.inertia.shape[0],), q.dtype)
        if eta.size == 0:
            return rest
        _, transpose = jax.vjp(lambda v: self.joint_change(q, v, t), rest)
        return self.inverse_inertia @ transpose(eta)[0]

    def mean_reaction(
        self, qa: Coordinates, ta: Time, qb: Coordinates, tb: Time, eta: JointMultipliers
    ) -> Velocities:
        """`D_mu (eta . psi) = 1/2 M^-1 (C_a + C_b)^T eta`"""
        return 0.5 * (self.reaction_at(qa, ta, eta) + self.reaction_at(qb, tb, eta))

    def joint_change(self, q: Coordinates, v: Velocities, t: Time) -> JointMultipliers:
        """`C(q, t) v`, the part of `psi` that is linear in `v`."""
        return jax.jvp(lambda q: self.joint(q, t), (q,), (self.lift(q, v),))[1]

    def metric(self, state: State) -> Symmetric:
        """The inertia in the coordinates, made regular where they are redundant.

        `L^T M L + sum_i g_i b_i b_i^T` with the gradients `b_i` of the coordinate
        constraints, Euclidean along them: `g_i` gives them the mean inertia of a
        coordinate, so the choice is independent of the units of the constraint.
        """
        if self.has_canonical_rates:
            return self.inertia
        q = state.q
        pull = jax.vmap(self._pull, in_axes=(None, 0))
        inertia = pull(q, pull(q, as_dense(self.inertia)).T)
        rows = jax.jacfwd(self.coordinate)(q)
        unit = rows / jnp.linalg.norm(rows, axis=1, keepdims=True)
        return inertia + jnp.trace(inertia) / q.size * (unit.T @ unit)

    def mobility(self, state: State) -> Symmetric:
        return self.inverse_inertia

    def stiffness(
        self, state: State, multipliers: Multipliers
    ) -> tuple[Float[Array, "nq nq"] | Assembled, Symmetric]:
        energies = self._element_energies(state.q)
        if energies is None:
            strain = jax.hessian(lambda q: self.strain(q, state.t, multipliers))
            return strain(state.q), as_dense(self.inertia)
        of_constraints = lambda q: multipliers * self.constraint(q, state.t)
        fns = [*energies, of_constraints]
        return Assembled(tuple(row_hessians(fn, state.q) for fn in fns)), self.inertia

    def _element_energies(self, q: Coordinates) -> list[Summands] | None:
        """All of the potential of a large system that bends, if its elements are known."""
        return [] if self.is_weight else element_energies(self.system, q, self.args)

    def strain(self, q: Coordinates, t: Time, multipliers: Multipliers) -> Scalar:
        """`V + lambda . Phi`, the energy whose Hessian is the stiffness."""
        return self._potential(q) + multipliers @ self.constraint(q, t)

    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        return accelerations(self, state)

    def multipliers(self, state: State) -> Multipliers:
        return multipliers(self, state)
