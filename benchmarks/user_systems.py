"""Systems as users write them: with plain functions, without a scene."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from space_mechanisms import chain

import enerjax as ej


# An arm of rods in the plane, in its joint angles: gravity acts along -y.


def _centres(q: jax.Array, args: Any) -> jax.Array:
    """The mass centres of the rods."""
    angles = jnp.cumsum(q)
    along = args["l"][:, None] * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    return jnp.cumsum(along, axis=0) - 0.5 * along


def _arm_kinetic(q: jax.Array, qdot: jax.Array, args: Any) -> jax.Array:
    _, rates = jax.jvp(lambda q: _centres(q, args), (q,), (qdot,))
    turning = args["m"] * args["l"] ** 2 / 12 * jnp.cumsum(qdot) ** 2
    return 0.5 * jnp.sum(args["m"] * jnp.sum(rates**2, axis=1) + turning)


def _arm_potential(q: jax.Array, args: Any) -> jax.Array:
    return args["g"] * args["m"] @ _centres(q, args)[:, 1]


def arm_in_angles(num_rods: int) -> ej.problems.Problem:
    """Rods of a metre and a kilogram, horizontal and at rest."""
    system = ej.System.from_lagrangian(_arm_kinetic, _arm_potential)
    rest = jnp.zeros(num_rods)
    args = dict(m=jnp.ones(num_rods), l=jnp.ones(num_rods), g=9.81)
    return ej.problems.Problem(system, ej.State(rest, rest), args)


def arm_centres(q: jax.Array) -> np.ndarray:
    return np.asarray(_centres(q, dict(l=jnp.ones(q.size))))


# The chain of hinged bodies of `space_mechanisms` in Euler parameters: for each body the
# mass centre and a unit quaternion; velocities are those of the mass centre and the angular
# velocity in body axes.


def _axes(p: jax.Array) -> jax.Array:
    """The rotation matrix of a quaternion, scalar first."""
    a, b, c, d = p
    return jnp.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d],
        ]
    )


def _quaternion_kinetic(v: jax.Array, args: Any) -> jax.Array:
    rates = v.reshape(-1, 6)
    moving = args["m"] * jnp.sum(rates[:, :3] ** 2, axis=1)
    return 0.5 * jnp.sum(moving + jnp.sum(args["J"] * rates[:, 3:] ** 2, axis=1))


def _quaternion_potential(q: jax.Array, args: Any) -> jax.Array:
    return args["g"] * args["m"] @ q.reshape(-1, 7)[:, 2]


def _quaternion_hinges(q: jax.Array, args: Any) -> jax.Array:
    """Each hinge joins an end of a body to the body before, or to the ground."""
    bodies = q.reshape(-1, 7)
    place, axes = bodies[:, :3], jax.vmap(_axes)(bodies[:, 3:])
    half = 0.5 * axes[:, :, 0]
    before = jnp.concatenate([jnp.zeros((1, 3)), (place + half)[:-1]])
    gaps = place - half - before
    own = jnp.einsum("kij,kj->ki", axes, args["axis"])
    others = jnp.concatenate([jnp.eye(3)[None], axes[:-1]])
    sides = jnp.einsum("kij,ksj->ksi", others, args["sides"])
    return jnp.concatenate([gaps, jnp.einsum("ki,ksi->ks", own, sides)], axis=1).ravel()


def _quaternion_rates(q: jax.Array, args: Any) -> jax.Array:
    """`L` in `v = L qdot`: identities, and `2 E(p)` for the angular velocities."""

    def block(p: jax.Array) -> jax.Array:
        a, b, c, d = p
        turn = 2 * jnp.array([[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]])
        return jnp.zeros((6, 7)).at[:3, :3].set(jnp.eye(3)).at[3:, 3:].set(turn)

    blocks = jax.vmap(block)(q.reshape(-1, 7)[:, 3:])
    count = blocks.shape[0]
    return jnp.einsum("kij,kl->kilj", blocks, jnp.eye(count)).reshape(6 * count, -1)


def _unit(q: jax.Array, args: Any) -> jax.Array:
    return jnp.sum(q.reshape(-1, 7)[:, 3:] ** 2, axis=1) - 1


def chain_in_euler_parameters(num_bodies: int) -> ej.problems.Problem:
    mechanism = chain(num_bodies)
    system = ej.System(
        _quaternion_kinetic,
        _quaternion_potential,
        _quaternion_hinges,
        kinematics=_quaternion_rates,
        coordinate_constraint=_unit,
    )
    axes = np.array([joint.axis for joint in mechanism.joints])
    sides = np.stack([np.roll(axes, 1, axis=1), np.roll(axes, 2, axis=1)], axis=1)
    args = dict(
        m=jnp.array([body.mass for body in mechanism.bodies]),
        J=jnp.array([body.inertia for body in mechanism.bodies]),
        axis=jnp.array(axes),
        sides=jnp.array(sides),
        g=9.81,
    )
    poses = [[*body.position, 1.0, 0.0, 0.0, 0.0] for body in mechanism.bodies]
    q, v = np.ravel(poses), np.zeros(6 * num_bodies)
    return ej.problems.Problem(system, ej.initial_state(system, q, v, args), args)


def quaternion_centres(q: Any) -> np.ndarray:
    return np.asarray(q).reshape(-1, 7)[:, :3]
