"""Any Hamiltonian `H(q, p)`, with `L = I`, `G = 0` and momenta as unknowns."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._discrete import AbstractDerivative
from .._linear import as_dense
from .._system import AbstractCanonicalSystem, State
from .._types import (
    Args,
    Coordinates,
    JointMultipliers,
    Multipliers,
    Scalar,
    Velocities,
)
from .base import AbstractModel, Drive, Increment, Scales


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
        return State(state.q, self.system.momentum(state, self.args))

    def leave(self, state: State) -> State:
        return State(state.q, self.system.velocity(state.q, state.v, self.args))

    def hamiltonian(self, q: Coordinates, p: Velocities) -> Scalar:
        return self.system.hamiltonian_and_rate(q, p, self.args)[0]

    def kinetic(self, state: State) -> Scalar:
        return self.hamiltonian(state.q, state.v) - self.potential(state)

    def potential(self, state: State) -> Scalar:
        return self.system.potential_energy(state, self.args)

    def constraint(self, q: Coordinates) -> Multipliers:
        return self.joint(q)

    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        return self.system.hamiltonian_and_rate(q, v, self.args)[1]

    def gradient(self, state: State, h: Scalar) -> Drive:
        force, rate = jax.grad(self.hamiltonian, argnums=(0, 1))(state.q, state.v)
        return Drive(h * force, rate)

    def drive(
        self,
        derivative: AbstractDerivative,
        a: State,
        b: State,
        h: Scalar,
        increment: Increment,
    ) -> Drive:
        size = a.q.size

        def action(z: Float[Array, " nz"]) -> Scalar:
            q, p = z[:size], z[size:]
            energy, rate = self.system.hamiltonian_and_rate(q, p, self.args)
            out = h * energy
            if increment.velocity_impulse.size > 0:
                constraint, psi = jax.jvp(self.joint, (q,), (rate,))
                return (
                    out
                    + increment.impulse @ constraint
                    + h * increment.velocity_impulse @ psi
                )
            if increment.impulse.size > 0:
                out = out + increment.impulse @ self.constraint(q)
            return out

        # Lengths of positions and momenta have no common measure but by a time.
        middle = 0.5 * (a.q + b.q), 0.5 * (a.v + b.v)
        masses = self.system.masses(*middle, self.args)
        weights = jnp.concatenate([masses, h**2 / masses])
        ends = (jnp.concatenate([x.q, x.v]) for x in (a, b))
        both = derivative.gradient(action, *ends, weights=weights)
        return Drive(both[:size], both[size:] / h)

    def structure(
        self, a: State, b: State, h: Scalar, rate: Coordinates, drive: Drive
    ) -> Drive:
        return Drive(b.v - a.v + drive.impulse, rate - drive.drift)

    def reaction(self, state: State, eta: JointMultipliers) -> Velocities:
        _, transpose = jax.vjp(lambda p: self.joint_rate(state.q, p), state.v)
        return transpose(eta)[0]

    def metric(self, state: State) -> Float[Array, "nq nq"]:
        return as_dense(self.system.inertia(self.leave(state), self.args))

    def mobility(self, state: State) -> Float[Array, "nv nv"]:
        return self.metric(state)

    def stiffness(
        self, state: State, multipliers: Multipliers
    ) -> tuple[Float[Array, "nq nq"], Float[Array, "nq nq"]]:
        def energy(q: Coordinates) -> Scalar:
            return self.hamiltonian(q, state.v) + multipliers @ self.constraint(q)

        return jax.hessian(energy)(state.q), self.metric(state)

    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        q, p = state.q, state.v
        force, rate = jax.grad(self.hamiltonian, argnums=(0, 1))(q, p)
        jacobian = jax.jacfwd(self.constraint)(q)
        if jacobian.shape[0] == 0:
            return -force, jnp.zeros((0,), q.dtype)
        rates = jax.jacfwd(self.joint_rate, argnums=1)(q, p)
        _, change = jax.jvp(self.joint_rate, (q, p), (rate, -force))
        unit = 1 / self.scales.constraint
        matrix = unit[:, None] * (rates @ jacobian.T) * unit[None, :]
        multipliers = unit * jnp.linalg.solve(matrix, unit * change)
        return -force - multipliers @ jacobian, multipliers

    def multipliers(self, state: State) -> Multipliers:
        return self.accelerations(state)[1]
