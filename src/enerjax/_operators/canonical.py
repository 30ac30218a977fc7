"""Any Hamiltonian `H(q, p)`, with `L = I`, `G = 0` and momenta as unknowns."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative
from .._solvers import affine_root, as_dense
from .._system import AbstractCanonicalSystem, State
from .._types import Args, Coordinates, JointMultipliers, Multipliers, Scalar, Velocities
from .base import AbstractModel
from .interval import Drive, Increment, lapse_of, Scales, Time
from .lapse import gradient_and_work
from .sizes import action_size


class CanonicalModel(AbstractModel):
    """A system with a Hamiltonian at fixed `args`; in its states `v` is `p`."""

    system: AbstractCanonicalSystem
    args: Args
    scales: Scales

    def __init__(self, system: AbstractCanonicalSystem, state: State, args: Args):
        self.system = system
        self.args = args
        self.scales = self._scales(self.enter(state))

    @property
    def has_own_momenta(self) -> bool:
        return True

    @property
    def has_canonical_rates(self) -> bool:
        return True

    def enter(self, state: State) -> State:
        return State(state.q, self.system.momentum(state, self.args), state.t)

    def leave(self, state: State) -> State:
        return State(state.q, self.system.velocity(state.q, state.v, self.args))

    def hamiltonian(self, q: Coordinates, p: Velocities) -> Scalar:
        return self.system.hamiltonian_and_rate(q, p, self.args)[0]

    def kinetic(self, state: State) -> Scalar:
        return self.hamiltonian(state.q, state.v) - self.potential(state)

    def potential(self, state: State) -> Scalar:
        return self.system.potential_energy(state, self.args)

    def constraint(self, q: Coordinates, t: Time) -> Multipliers:
        return self.joint(q, t)

    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        return self.system.hamiltonian_and_rate(q, v, self.args)[1]

    def momentum(self, state: State) -> Velocities:
        return state.v

    def gradient(self, state: State, h: Scalar) -> Drive:
        force, rate = jax.grad(self.hamiltonian, argnums=(0, 1))(state.q, state.v)
        return Drive(h * force, rate)

    def slope(self, state: State) -> Coordinates:
        slope, rate = jax.grad(self.hamiltonian, argnums=(0, 1))(state.q, state.v)
        if self.system.force is None:
            return slope
        return slope - self.force(state.q, rate, state.t)

    def velocity(self, state: State) -> Velocities:
        return self.lift(state.q, state.v)

    def push(self, qa: Coordinates, qb: Coordinates, rate: Coordinates) -> Velocities:
        return rate

    def pull(self, qa: Coordinates, qb: Coordinates, force: Velocities) -> Coordinates:
        return force

    def drive(
        self,
        derivative: AbstractDerivative,
        a: State,
        b: State,
        h: Scalar,
        increment: Increment,
    ) -> Drive:
        size = a.q.size
        fixed, driven = self.split(increment)

        def action(z: Float[Array, " nz"]) -> Scalar:
            q, p = z[:size], z[size:]
            energy, rate = self.system.hamiltonian_and_rate(q, p, self.args)
            out = h * energy
            if fixed.velocity_impulse.size > 0:
                constraint, psi = jax.jvp(self.fixed, (q,), (rate,))
                return out + fixed.impulse @ constraint + h * fixed.velocity_impulse @ psi
            if fixed.impulse.size > 0:
                out = out + fixed.impulse @ self.fixed(q)
            return out

        def moved(z: Float[Array, " nz"], t: Time) -> Scalar:
            q = z[:size]
            return self.driven_action(q, self.lift(q, z[size:]), t, h, driven)

        # Lengths of positions and momenta have no common measure but by a time.
        middle = 0.5 * (a.q + b.q), 0.5 * (a.v + b.v)
        masses = self.system.masses(*middle, self.args)
        weights = jnp.concatenate([masses, h**2 / masses])
        terms = action_size(self, derivative, a, h, increment)
        both, work = gradient_and_work(
            derivative,
            action,
            None if self.system.driven is None else moved,
            (jnp.concatenate([a.q, a.v]), a.t),
            (jnp.concatenate([b.q, b.v]), b.t),
            weights,
            terms,
        )
        return Drive(both[:size], both[size:] / h, work)

    def structure(
        self, a: State, b: State, h: Scalar, rate: Coordinates, drive: Drive
    ) -> Drive:
        return Drive(b.v - a.v + drive.impulse, rate - drive.drift)

    def reaction(self, state: State, eta: JointMultipliers) -> Velocities:
        _, transpose = jax.vjp(lambda p: self.joint_rate(state.q, p, state.t), state.v)
        return transpose(eta)[0]

    def metric(self, state: State) -> Float[Array, "nq nq"]:
        return as_dense(self.system.inertia(self.leave(state), self.args))

    def mobility(self, state: State) -> Float[Array, "nv nv"]:
        return self.metric(state)

    def stiffness(
        self, state: State, multipliers: Multipliers
    ) -> tuple[Float[Array, "nq nq"], Float[Array, "nq nq"]]:
        def energy(q: Coordinates) -> Scalar:
            constraint = self.constraint(q, state.t)
            return self.hamiltonian(q, state.v) + multipliers @ constraint

        return jax.hessian(energy)(state.q), self.metric(state)

    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        q, p, t = state.q, state.v, state.t
        slope, rate = jax.grad(self.hamiltonian, argnums=(0, 1))(q, p)
        if self.system.force is not None:
            slope = slope - self.force(q, rate, t)
        jacobian = jax.jacfwd(self.constraint)(q, t)
        if jacobian.shape[0] == 0:
            return -slope, jnp.zeros((0,), q.dtype)
        rates = jax.jacfwd(self.joint_rate, argnums=1)(q, p, t)
        _, change = jax.jvp(self.joint_rate, (q, p, t), (rate, -slope, lapse_of(t)))
        unit = 1 / self.scales.constraint
        matrix = unit[:, None] * (rates @ jacobian.T) * unit[None, :]
        balance = lambda x: unit * change - matrix @ x
        fill = self.fill(unit.size, unit.dtype)
        multipliers = unit * affine_root(balance, unit, fill)
        return -slope - multipliers @ jacobian, multipliers

    def multipliers(self, state: State) -> Multipliers:
        return self.accelerations(state)[1]
