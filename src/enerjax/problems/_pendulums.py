"""Pendulums and chains in the plane; gravity acts along +y."""

import jax.numpy as jnp

from .._system import System
from .._types import Args, Coordinates, Multipliers, Real, Scalar, Velocities
from ._base import equal_masses_kinetic, planar_points_kinetic, Problem, problem


def _angle_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * args["m"] * args["l"] ** 2 * v @ v


def _angle_potential(q: Coordinates, args: Args) -> Scalar:
    return args["m"] * args["g"] * args["l"] * (1 - jnp.cos(q[0]))


def pendulum_angle(m: Real = 1.0, l: Real = 1.0, g: Real = 9.81) -> Problem:
    """Case a: a simple pendulum in its angle, released from the horizontal at rest.

    **Source:** E. Lens and A. Cardona, section 3 a.
    """
    args = dict(m=m, l=l, g=g)
    return problem(System(_angle_kinetic, _angle_potential), [jnp.pi / 2], [0.0], args)


def _point_potential(q: Coordinates, args: Args) -> Scalar:
    return -args["m"] * args["g"] * q[1]


def _rod(q: Coordinates, args: Args) -> Multipliers:
    return jnp.array([q @ q - args["l"] ** 2])


def pendulum(m: Real = 1.0, l: Real = 1.0, g: Real = 9.81) -> Problem:
    """Case b: the pendulum of case a as a point (x, y) on a rod; the same motion.

    **Source:** E. Lens and A. Cardona, section 3 b.
    """
    args = dict(m=m, l=l, g=g)
    return problem(
        System(equal_masses_kinetic, _point_potential, _rod), [l, 0.0], [0.0, 0.0], args
    )


def _double_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * (args["m1"] * v[:2] @ v[:2] + args["m2"] * v[2:] @ v[2:])


def _double_potential(q: Coordinates, args: Args) -> Scalar:
    return -args["g"] * (args["m1"] * q[1] + args["m2"] * q[3])


def _double_rods(q: Coordinates, args: Args) -> Multipliers:
    inner, outer = q[:2], q[2:] - q[:2]
    return jnp.array([inner @ inner - args["l1"] ** 2, outer @ outer - args["l2"] ** 2])


def double_pendulum(
    m1: Real = 1.0, m2: Real = 1.0, l1: Real = 1.0, l2: Real = 1.0, g: Real = 9.81
) -> Problem:
    """Case c: a double pendulum of two points (x1, y1, x2, y2), at rest.

    The inner rod starts horizontal, the outer one hangs.

    **Source:** E. Lens and A. Cardona, section 3 c.
    """
    args = dict(m1=m1, m2=m2, l1=l1, l2=l2, g=g)
    system = System(_double_kinetic, _double_potential, _double_rods)
    return problem(system, [l1, 0.0, l1, l2], [0.0] * 4, args)


def _double_angle_kinetic(q: Coordinates, qdot: Velocities, args: Args) -> Scalar:
    a, b = args["l1"] * qdot[0], args["l2"] * qdot[1]
    outer = a**2 + b**2 + 2 * jnp.cos(q[1] - q[0]) * a * b
    return 0.5 * (args["m1"] * a**2 + args["m2"] * outer)


def _double_angle_potential(q: Coordinates, args: Args) -> Scalar:
    inner = args["l1"] * jnp.cos(q[0])
    outer = inner + args["l2"] * jnp.cos(q[1])
    return -args["g"] * (args["m1"] * inner + args["m2"] * outer)


def double_pendulum_angles(
    m1: Real = 1.0, m2: Real = 1.0, l1: Real = 1.0, l2: Real = 1.0, g: Real = 9.81
) -> Problem:
    """Case c in its two angles from the vertical: no constraint, inertia that varies.

    The same motion as `double_pendulum`, with `x1 = l1 sin(q[0])`, `y1 = l1 cos(q[0])`.
    """
    args = dict(m1=m1, m2=m2, l1=l1, l2=l2, g=g)
    system = System.from_lagrangian(_double_angle_kinetic, _double_angle_potential)
    return problem(system, [jnp.pi / 2, 0.0], [0.0, 0.0], args)


def stiff_double_pendulum() -> Problem:
    """Case d: the double pendulum of case c with an inner mass 200 times lighter.

    **Source:** E. Lens and A. Cardona, section 3 d.
    """
    return double_pendulum(m1=0.005)


def _chain_potential(q: Coordinates, args: Args) -> Scalar:
    return -args["g"] * args["m"] @ q[1::2]


def _chain_rods(q: Coordinates, args: Args) -> Multipliers:
    points = jnp.concatenate([jnp.zeros((1, 2), q.dtype), q.reshape(-1, 2)])
    links = points[1:] - points[:-1]
    return jnp.sum(links**2, axis=1) - args["l"] ** 2


def chain(num_links: int, length: Real = 1.0, mass: Real = 1.0, g: Real = 9.81) -> Problem:
    """A chain of equal rods and points, straight and horizontal, fixed at one end.

    At the end of the fall the chain cracks like a whip: its free end becomes far faster
    than in free fall.
    """
    each = jnp.full((num_links,), 1 / num_links)
    args = dict(m=mass * each, l=length * each, g=g)
    x = length * jnp.arange(1, num_links + 1, dtype=float) / num_links
    q = jnp.stack([x, jnp.zeros_like(x)], axis=1).reshape(-1)
    system = System(planar_points_kinetic, _chain_potential, _chain_rods)
    return problem(system, q, jnp.zeros_like(q), args)
