"""A system with its `args` bound and its inertia evaluated: what the schemes see."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._kinematics import IdentityKinematics
from ._system import State, System
from ._types import (
    Args,
    Coordinates,
    JointMultipliers,
    Multipliers,
    Scalar,
    Velocities,
)


class Scales(eqx.Module):
    """How large a unit of each unknown is in the square root of an energy.

    `coordinate`: of a rate of change of each coordinate (square root of a mass).
    `constraint`: of the rate of change of each constraint, in the same measure; so
    `rate * coordinate`, `constraint rate / constraint` and
    `impulse * constraint` all have the dimension of the square root of an energy.
    """

    coordinate: Float[Array, " nq"]
    constraint: Float[Array, " nc"]
    # What the constraints are differences of: their round-off, divided by eps.
    constraint_size: Float[Array, " nc"]


class Model(eqx.Module):
    """The functions of a `System` at fixed `args`, and those derived from them."""

    system: System
    args: Args
    inertia: Float[Array, "nv nv"]
    inverse_inertia: Float[Array, "nv nv"]
    scales: Scales

    def __init__(self, system: System, state: State, args: Args):
        self.system = system
        self.args = args
        if callable(system.kinetic):
            rest = jnp.zeros_like(state.v)
            self.inertia = jax.hessian(
                lambda v: system.kinetic_energy(State(state.q, v), args)
            )(rest)
        else:
            self.inertia = system.kinetic.astype(state.v.dtype)
        # Scaled to a unit diagonal first: a diagonal inertia is then inverted to the last
        # digit, whatever the mass ratios are.
        root = jnp.sqrt(jnp.diagonal(self.inertia))
        scale = jnp.outer(root, root)
        self.inverse_inertia = jnp.linalg.inv(self.inertia / scale) / scale
        self.scales = self._scales(state.q)

    def kinetic(self, v: Velocities) -> Scalar:
        return 0.5 * v @ self.inertia @ v

    def potential(self, q: Coordinates) -> Scalar:
        return self.system.potential(q, self.args)

    def potential_gradient(self, q: Coordinates) -> Coordinates:
        return jax.grad(self.potential)(q)

    def joint(self, q: Coordinates) -> JointMultipliers:
        """The constraints that are held at velocity level too."""
        if self.system.constraint is None:
            return jnp.zeros((0,), q.dtype)
        return self.system.constraint(q, self.args)

    def coordinate(self, q: Coordinates) -> Float[Array, " ncc"]:
        """The relations between redundant coordinates."""
        if self.system.coordinate_constraint is None:
            return jnp.zeros((0,), q.dtype)
        return self.system.coordinate_constraint(q, self.args)

    def constraint(self, q: Coordinates) -> Multipliers:
        """`Phi(q)`: joints first, then coordinate constraints."""
        return jnp.concatenate([self.joint(q), self.coordinate(q)])

    def constraint_jacobian(self, q: Coordinates) -> Float[Array, "nc nq"]:
        return jax.jacfwd(self.constraint)(q)

    def joint_rate(self, q: Coordinates, v: Velocities) -> JointMultipliers:
        """`psi(q, v) = dPhi/dt` of the joints, linear in `v`."""
        return jax.jvp(self.joint, (q,), (self.lift(q, v),))[1]

    def push(self, q: Coordinates, rate: Coordinates) -> Velocities:
        """`L(q) rate`"""
        return self.system.kinematics.push(q, rate, self.args)

    def pull(self, q: Coordinates, momentum: Velocities) -> Coordinates:
        """`L(q)^T momentum`"""
        return self.system.kinematics.pull(q, momentum, self.args)

    def lift(self, q: Coordinates, v: Velocities) -> Coordinates:
        """`L(q)^+ v`, the rates of the coordinates."""
        return self.system.kinematics.lift(q, v, jax.jacfwd(self.coordinate), self.args)

    def gyroscopic(
        self, q: Coordinates, v: Velocities, dq: Coordinates
    ) -> Coordinates | None:
        """`G(q, M v) dq`, or `None` where `L` is constant."""
        return self.system.kinematics.gyroscopic(q, self.inertia @ v, dq, self.args)

    @property
    def has_identity_kinematics(self) -> bool:
        return isinstance(self.system.kinematics, IdentityKinematics)

    def metric(self, q: Coordinates) -> Float[Array, "nq nq"]:
        """The inertia in the coordinates, made regular where they are redundant.

        `L^T M L + sum_i g_i b_i b_i^T` with the gradients `b_i` of the coordinate
        constraints, Euclidean along them: `g_i` gives them the mean inertia of a
        coordinate, so the choice is independent of the units of the constraint.
        """
        if self.has_identity_kinematics:
            return self.inertia
        pull = jax.vmap(self.pull, in_axes=(None, 0))
        inertia = pull(q, pull(q, self.inertia).T)
        rows = jax.jacfwd(self.coordinate)(q)
        unit = rows / jnp.linalg.norm(rows, axis=1, keepdims=True)
        return inertia + jnp.trace(inertia) / q.size * (unit.T @ unit)

    def _scales(self, q: Coordinates) -> Scales:
        """The scales at `q`. They steer Newton's tests and never enter a solution."""
        coordinate = jnp.sqrt(jnp.diagonal(self.metric(q)))
        jacobian = self.constraint_jacobian(q)
        squares = (jacobian / coordinate[None, :]) ** 2
        constraint = jnp.sqrt(jnp.sum(squares, axis=1))
        # A gradient that vanishes makes the step equations singular, which is reported
        # as such; it must not turn the scaling into a division by zero.
        constraint = jnp.where(constraint > 0, constraint, 1.0)
        size = jnp.abs(jacobian) @ jnp.abs(q)
        return jax.lax.stop_gradient(Scales(coordinate, constraint, size))

    def energy_scale(self, state: State, h: Scalar) -> Scalar:
        """An energy that a step of length `h` handles; never zero, no derivative.

        The larger of the kinetic energy and of what the potential forces, acting for `h`
        on a body at rest, would make of it.
        """
        pushed = h * self.potential_gradient(state.q) / self.scales.coordinate
        size = jnp.maximum(2 * self.kinetic(state.v), pushed @ pushed)
        return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))

    def accelerations(self, state: State) -> tuple[Velocities, Multipliers]:
        """`vdot` and `lambda` that satisfy the equations of motion in `state`.

        The constraints enter twice differentiated; coordinate constraints have no
        acceleration level of their own (their multipliers close the `nq` rows).
        """
        q, v = state.q, state.v
        qdot = self.lift(q, v)
        pull = jax.vmap(self.pull, in_axes=(None, 0))
        force = -self.potential_gradient(q)
        gyroscopic = self.gyroscopic(q, v, qdot)
        if gyroscopic is not None:
            force = force - gyroscopic
        jacobian = self.constraint_jacobian(q)
        rate_jacobian = jax.jacfwd(self.joint_rate, argnums=1)(q, v)
        _, drift = jax.jvp(lambda x: self.joint_rate(x, v), (q,), (qdot,))
        num_joints = rate_jacobian.shape[0]
        corner = jnp.zeros((num_joints, jacobian.shape[0]), q.dtype)
        matrix = jnp.block([[pull(q, self.inertia).T, jacobian.T], [rate_jacobian, corner]])
        scales = self.scales
        rows = jnp.concatenate([1 / scales.coordinate, 1 / scales.constraint[:num_joints]])
        columns = jnp.concatenate(
            [1 / jnp.sqrt(jnp.diagonal(self.inertia)), 1 / scales.constraint]
        )
        scaled = rows[:, None] * matrix * columns[None, :]
        right = rows * jnp.concatenate([force, -drift])
        solution = columns * jnp.linalg.solve(scaled, right)
        return solution[: v.size], solution[v.size :]
