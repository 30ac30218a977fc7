"""Rigid bodies in space, which a step moves by a translation and a rotation.

A body has twelve coordinates: its mass centre `x` and its axes `d_i = R e_i`, the
directors. Its velocities in a step are `xdot` and the angular velocity `W` in body axes. A
step has six unknowns, a translation and a rotation vector `Theta` in body axes, and the
rotation is Cayley's:

    R_b = R_a cay(t),   cay(t) = (I - t^)^-1 (I + t^),   t = Theta/2

It leaves the directors orthonormal, so they need no constraints. With `dm_i`, the mean of a
director at both ends, and the rotation vector in space, `theta = R_a Theta = R_b Theta`,

    d_i_b - d_i_a = theta x dm_i

exactly. A gradient `D` of any function of the directors, with `D . (q_b - q_a)` equal to
the difference of its values, therefore has the torque `sum dm_i x D_i`: its product with
`theta` is that difference, and it vanishes for a function that rotations do not change, so
that energy and angular momentum are conserved (J. C. Simo and K. K. Wong, Int. J. Numer.
Methods Eng. 31 (1991) 19-52). The change of momentum is that of `R J W` in space. All rows
are in the axes of the body at the start of the step.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._solvers import hessian, is_positive_definite
from ..._types import Coordinates, Increments, Velocities
from .base import AbstractKinematics
from .rigid_bodies import RigidBodies
from .vectors import (
    all_in_axes,
    cross,
    dot,
    in_axes,
    rates_of_directors,
    sum_of_products,
    Vector3,
)


class RigidKinematics(AbstractKinematics):
    """`v = (xdot, W)` of rigid bodies; the other velocities are rates of coordinates."""

    bodies: RigidBodies = eqx.field(static=True)

    @property
    def has_canonical_rates(self):
        return False

    @property
    def has_own_velocities(self):
        return True

    def has_inertia(self, energy, inertia):
        # The energy must depend on velocities in body axes alone, as it does for a body
        # with its mass centre at `x`. It is compared with that of randomly rotated bodies.
        bodies, random, dtype = self.bodies, np.random.default_rng(0), inertia.dtype
        probe = jnp.cos(jnp.arange(1, bodies.num_velocities + 1, dtype=dtype))

        def rates() -> Velocities:
            axes, _ = np.linalg.qr(random.normal(size=(len(bodies.q), 3, 3)))
            axes = axes * np.linalg.det(axes)[:, None, None]
            q = np.zeros(bodies.num_coordinates)
            q[bodies.q[:, 3:]] = axes.reshape(-1, 9)
            return self.user_velocity(jnp.asarray(q, dtype), probe)

        a, b = rates(), rates()
        size = jnp.abs(a) @ jax.tree.map(jnp.abs, inertia) @ jnp.abs(a)
        return jnp.abs(energy(a) - energy(b)) <= 1e3 * jnp.finfo(dtype).eps * size

    def is_definite(self, inertia, rounding):
        return is_positive_definite(inertia)

    def is_regular(self, inertia, rounding):
        return jnp.array(True)

    def describe(self, q, v):
        others = self.bodies.other_q.size
        return (
            f"{len(self.bodies.q)} rigid bodies, each moved by a translation and a rotation"
            + (f", and {others} others" if others > 0 else "")
        )

    def with_rotations(self, q, dimensions):
        return self

    def with_blocks(self, q, relations, args):
        return self

    def constraint(self, q):
        return q[:0]

    def velocity(self, q, v):
        bodies, (moved, rates) = self.bodies, self.bodies.pose(v)
        _, axes = bodies.pose(q)
        spin = 0.5 * in_axes(axes, sum_of_products(axes, rates))
        return bodies.velocities(moved, spin, bodies.others(v))

    def user_velocity(self, q, v):
        bodies, (_, axes) = self.bodies, self.bodies.pose(q)
        moved, turned = bodies.vectors(v)
        rates = rates_of_directors(axes, turned)
        return bodies.coordinates((moved, rates), bodies.other_rates(v))

    def inertia(self, of_user, energy, dtype):
        bodies = self.bodies
        q = bodies.at_rest(dtype)
        together = np.arange(bodies.num_velocities)
        together[bodies.v] = bodies.v[:, :1]
        at_rest = jnp.zeros((bodies.num_velocities,), dtype)
        return hessian(lambda v: energy(self.user_velocity(q, v)), at_rest, together)

    def regular_inertia(self, q, inertia):
        return inertia

    def metric(self, q, inertia, relations, args):
        return inertia

    def velocity_scale(self, inertia):
        return jnp.sqrt(inertia.diagonal())

    def step_scale(self, q, inertia, relations, args):
        return self.velocity_scale(inertia)

    def coordinate_scale(self, step):
        # That of a director is the root of the polar moment, the sum of second moments.
        bodies = self.bodies
        moved, turned = bodies.vectors(step)
        polar = jnp.sqrt(0.5 * dot(turned, turned))
        axes = jnp.broadcast_to(polar, (3, 3, polar.size))
        return bodies.coordinates((moved, axes), bodies.other_rates(step))

    def by_inertia(self, q, change, inertia, args):
        # That of the directors `d_j` is the sum of `E_jk d_j . d_k / 2` with the second
        # moments `E = tr(J)/2 - J`.
        bodies, (moved, axes) = self.bodies, self.bodies.pose(change)
        none, others = jnp.zeros_like(moved), bodies.others(change)
        momentum = inertia @ bodies.velocities(moved, none, others)
        turns = [none.at[k].set(1) for k in range(3)]
        of_turn = lambda x: inertia @ bodies.velocities(none, x, jnp.zeros_like(others))
        moments = jnp.stack([bodies.vectors(of_turn(x))[1] for x in turns])
        polar = 0.5 * jnp.trace(moments)[None, None]
        second = jnp.eye(3, dtype=change.dtype)[:, :, None] * polar - moments
        turned = jnp.sum(second[:, :, None] * axes[None], axis=1)
        pose = bodies.vectors(momentum)[0], turned
        return bodies.coordinates(pose, bodies.other_rates(momentum))

    def frames(self, q, jacobian, args):
        return None

    def displacement(self, q, step):
        bodies, (_, axes) = self.bodies, self.bodies.pose(q)
        moved, turned = bodies.vectors(step)
        half = 0.5 * turned
        once = rates_of_directors(axes, half)
        twice = rates_of_directors(once, half)
        factor = 2 / (1 + dot(half, half))
        change = factor[None, None] * (once + twice)
        return bodies.coordinates((moved, change), bodies.other_rates(step))

    def pull_back(self, qa, qb, step, gradient):
        return self.pull(qa, qb, gradient, None)

    def chain_rule(self, step):
        return None

    def push(self, qa, qb, step, args):
        return step

    def pull(self, qa, qb, force, args):
        bodies, others = self.bodies, self.bodies.others(force)
        moved, torques = bodies.pose(force)
        (_, first), (_, last) = bodies.pose(qa), bodies.pose(qb)
        torque = in_axes(first, sum_of_products(0.5 * (first + last), torques))
        return bodies.velocities(moved, torque, others)

    def rates(self, q, v, jacobian, args):
        return v

    def lift(self, q, v, jacobian, args):
        return self.user_velocity(q, v)

    def momentum_rows(self, q, momentum, args):
        return momentum

    def momentum_change(self, qa, qb, change, mean, step, args):
        bodies = self.bodies
        half = 0.5 * bodies.vectors(step)[1]
        end = bodies.vectors(mean + 0.5 * change)[1]
        once = cross(half, end)
        factor = 2 / (1 + dot(half, half))
        rotated = factor[None] * (once + cross(half, once))
        return change + self._rotational(rotated, qa)

    def gyroscopic(self, q, momentum, rates, args):
        bodies = self.bodies
        torque = cross(bodies.vectors(rates)[1], bodies.vectors(momentum)[1])
        return self._rotational(torque, q)

    def _rotational(self, torque: Vector3, q: Coordinates) -> Increments:
        """Rows with these torques, and zeros otherwise."""
        others = jnp.zeros_like(self.bodies.others(q))
        return self.bodies.velocities(jnp.zeros_like(torque), torque, others)

    # For rotations the discrete gradients of `psi`, where `S` is the one with respect to
    # the rates, rest on the identity, for the rates `Y_i = R (W x e_i)` of the directors,
    #
    #     Y_i_b - Y_i_a = theta x Ym_i + Rm^-T ((W_b - W_a) x e_i),
    #
    # and the result conserves angular momentum, because it is equivariant under rotations.

    def mean_rates(self, a, b, lift, by_rates):
        mean = 0.5 * (self.user_velocity(a.q, a.v) + self.user_velocity(b.q, b.v))
        (_, by_a), (_, by_b) = by_rates()
        return lambda q: mean, self.spin_rows(a.q, mean, 0.5 * (by_a + by_b))

    def momentum_of_rates(self, a, b, step, lowered):
        # In the rotations it is `sum e_i x Rm^-1 S_i`.
        (qa, by_a), (_, by_b) = a, b
        bodies, (_, axes) = self.bodies, self.bodies.pose(qa)
        moved, of_rates = bodies.pose(0.5 * (by_a + by_b))
        half = 0.5 * bodies.vectors(step)[1]
        # In body axes `Rm^-1 S_i` is `y_i - t x y_i` with `y_i = R_a^T S_i`.
        y = all_in_axes(axes, of_rates)
        z = y - cross(half[None], y)
        skew = z - jnp.swapaxes(z, 0, 1)
        spin = jnp.stack([skew[1, 2], skew[2, 0], skew[0, 1]])
        return bodies.velocities(moved, spin, bodies.others(0.5 * (by_a + by_b)))

    def spin_rows(
        self, qa: Coordinates, mean_rate: Coordinates, by_rate: Coordinates
    ) -> Increments:
        """The rows `sum Ym_i x S_i`."""
        bodies, (_, axes) = self.bodies, self.bodies.pose(qa)
        (_, rates), (_, of_rates) = bodies.pose(mean_rate), bodies.pose(by_rate)
        torque = in_axes(axes, sum_of_products(rates, of_rates))
        return self._rotational(torque, qa)
