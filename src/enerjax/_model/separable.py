"""Constant inertia: velocities are eliminated by hand, and cost no unknowns.

The drive in the momenta is `M^-1` times the mean momentum, and what `psi` adds. With
`psi = C(q) v` linear in `v` its joint difference splits without any metric between
positions and momenta,

    psi_b - psi_a = [D_q (C v_m)] (q_b - q_a) + 1/2 (C_a + C_b) (v_b - v_a),

which leaves `S_mu` free of the velocities at its end but for their mean: schemes solve it
for them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractCorrected, AbstractDerivative
from .._kinematics import IdentityKinematics
from .._linear import (
    affine_root,
    as_dense,
    Assembled,
    inverse_of,
    row_hessians,
    solve,
    Symmetric,
)
from .._system import State, System
from .._types import (
    Args,
    Coordinates,
    JointMultipliers,
    Multipliers,
    Scalar,
    Velocities,
)
from .base import AbstractModel, Drive, Increment, Scales
from .elements import (
    discrete_gradient_by_rows,
    element_energies,
    is_weight,
    Summands,
)


class SeparableModel(AbstractModel):
    """A `System` at fixed `args`; in its states `v` are the velocities."""

    system: System
    args: Args
    inertia: Symmetric
    inverse_inertia: Symmetric
    scales: Scales
    # Asked of large systems only.
    is_weight: bool = eqx.field(static=True)

    def __init__(self, system: System, state: State, args: Args):
        self.system = system
        self.args = args
        self.is_weight = is_weight(system, state.q, args)
        self.inertia = system.inertia(state, args)
        self.inverse_inertia = inverse_of(self.inertia)
        self.scales = self._scales(state)

    @property
    def has_own_momenta(self) -> bool:
        return False

    @property
    def has_canonical_rates(self) -> bool:
        return isinstance(self.system.kinematics, IdentityKinematics)

    def enter(self, state: State) -> State:
        return state

    def leave(self, state: State) -> State:
        return state

    def kinetic(self, state: State) -> Scalar:
        return self.kinetic_of(state.v)

    def kinetic_of(self, v: Velocities) -> Scalar:
        return 0.5 * v @ self.inertia @ v

    def potential(self, state: State) -> Scalar:
        return self._potential(state.q)

    def _potential(self, q: Coordinates) -> Scalar:
        return self.system.potential(q, self.args)

    def gradient(self, state: State, h: Scalar) -> Drive:
        return Drive(h * jax.grad(self._potential)(state.q), jnp.zeros((0,), h.dtype))

    def coordinate(self, q: Coordinates) -> Float[Array, " ncc"]:
        """The relations between redundant coordinates."""
        if self.system.coordinate_constraint is None:
            return jnp.zeros((0,), q.dtype)
        return self.system.coordinate_constraint(q, self.args)

    def constraint(self, q: Coordinates) -> Multipliers:
        return jnp.concatenate([self.joint(q), self.coordinate(q)])

    def push(self, qa: Coordinates, qb: Coordinates, rate: Coordinates) -> Velocities:
        """`Lm rate`"""
        return self.system.kinematics.push(0.5 * (qa + qb), rate, self.args)

    def _pull(self, q: Coordinates, momentum: Velocities) -> Coordinates:
        return self.system.kinematics.pull(q, momentum, self.args)

    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        return self.system.kinematics.lift(q, v, jax.jacfwd(self.coordinate), self.args)

    def drive(
        self,
        derivative: AbstractDerivative,
        a: State,
        b: State,
        h: Scalar,
        increment: Increment,
    ) -> Drive:
        mean_velocity = 0.5 * (a.v + b.v)

        def action(q: Coordinates) -> Scalar:
            out = h * self._potential(q)
            if increment.impulse.size > 0:
                out = out + increment.impulse @ self.constraint(q)
            if increment.velocity_impulse.size > 0:
                rate = self.joint_rate(q, mean_velocity)
                out = out + h * increment.velocity_impulse @ rate
            return out

        none = jnp.zeros((0,), h.dtype)
        energies = self._element_energies(a.q)
        if energies is None or not isinstance(derivative, AbstractCorrected):
            return Drive(derivative.gradient(action, a.q, b.q), none)
        rows: list[Summands] = [lambda q, fn=fn: h * fn(q) for fn in energies]
        rows += [lambda q: increment.impulse * self.constraint(q)]
        if increment.velocity_impulse.size > 0:
            eta = h * increment.velocity_impulse
            rows += [lambda q: eta * self.joint_rate(q, mean_velocity)]
        impulse = discrete_gradient_by_rows(derivative, rows, a.q, b.q)
        if self.is_weight:
            impulse = impulse + h * jax.grad(self._potential)(a.q)
        return Drive(impulse, none)

    def structure(
        self, a: State, b: State, h: Scalar, rate: Coordinates, drive: Drive
    ) -> Drive:
        middle = 0.5 * (a.q + b.q)
        change = self._pull(middle, self.inertia @ (b.v - a.v))
        momentum = self.inertia @ (0.5 * (a.v + b.v))
        gyroscopic = self.system.kinematics.gyroscopic(
            middle, momentum, h * rate, self.args
        )
        if gyroscopic is not None:
            change = change + gyroscopic
        return Drive(change + drive.impulse, drive.drift)

    def reaction(self, state: State, eta: JointMultipliers) -> Velocities:
        return self.reaction_at(state.q, eta)

    def reaction_at(self, q: Coordinates, eta: JointMultipliers) -> Velocities:
        """`M^-1 C(q)^T eta`; as `psi` is linear in `v`, the same for every `v`."""
        rest = jnp.zeros((self.inertia.shape[0],), q.dtype)
        if eta.size == 0:
            return rest
        _, transpose = jax.vjp(lambda v: self.joint_rate(q, v), rest)
        return self.inverse_inertia @ transpose(eta)[0]

    def mean_reaction(
        self, qa: Coordinates, qb: Coordinates, eta: JointMultipliers
    ) -> Velocities:
        """`D_mu (eta . psi) = 1/2 M^-1 (C_a + C_b)^T eta`"""
        return 0.5 * (self.reaction_at(qa, eta) + self.reaction_at(qb, eta))

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
            strain = jax.hessian(lambda q: self.strain(q, multipliers))
            return strain(state.q), as_dense(self.inertia)
        of_constraints = lambda q: multipliers * self.constraint(q)
        fns = [*energies, of_constraints]
        return Assembled(tuple(row_hessians(fn, state.q) for fn in fns)), self.inertia

    def _element_energies(self, q: Coordinates) -> list[Summands] | None:
        """All of the potential of a large system that bends, if its elements are known."""
        return [] if self.is_weight else element_energies(self.system, q, self.args)

    def strain(self, q: Coordinates, multipliers: Multipliers) -> Scalar:
        """`V + lambda . Phi`, the energy whose Hessian is the stiffness."""
        return self._potential(q) + multipliers @ self.constraint(q)

    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        """The constraints enter twice differentiated; coordinate constraints have no
        acceleration level of their own (their multipliers close the `nq` rows).
        """
        q, v, scales = state.q, state.v, self.scales
        qdot = self.lift(q, v)
        force = jax.grad(self._potential)(q)
        gyroscopic = self.system.kinematics.gyroscopic(q, self.inertia @ v, qdot, self.args)
        if gyroscopic is not None:
            force = force + gyroscopic
        _, drift = jax.jvp(lambda x: self.joint_rate(x, v), (q,), (qdot,))
        _, transpose = jax.vjp(self.constraint, q)
        unit = 1 / jnp.sqrt(self.inertia.diagonal())

        def conditions(x: Array) -> Array:
            acceleration, multipliers = unit * x[: v.size], x[v.size :] / scales.constraint
            pulled = self._pull(q, self.inertia @ acceleration) + transpose(multipliers)[0]
            rate = self.joint_rate(q, acceleration) + drift
            rows = (
                (pulled + force) / scales.coordinate,
                rate / scales.constraint[: rate.size],
            )
            return jnp.concatenate(rows)

        x = affine_root(conditions, jnp.zeros((v.size + scales.constraint.size,), q.dtype))
        return unit * x[: v.size], x[v.size :] / scales.constraint

    def multipliers(self, state: State) -> Multipliers:
        """By the constraints alone where `L = I`: a smaller matrix."""
        inverse_inertia = self.inverse_inertia
        if not self.has_canonical_rates or not isinstance(inverse_inertia, Array):
            return self.accelerations(state)[1]
        q, v = state.q, state.v
        rows = jax.jacfwd(self.constraint)(q) / self.scales.constraint[:, None]
        _, drift = jax.jvp(lambda x: self.joint_rate(x, v), (q,), (v,))
        push = inverse_inertia @ jax.grad(self._potential)(q)
        right = drift / self.scales.constraint - rows @ push
        mobility = rows @ inverse_inertia @ rows.T
        return solve(mobility, right) / self.scales.constraint
