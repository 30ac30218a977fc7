"""Points on springs; gravity acts along +y in the plane, and -z in space."""

import jax.numpy as jnp

from .._system import System
from .._types import Args, Coordinates, Multipliers, Real, Scalar, Velocities
from ._base import equal_masses_kinetic, Problem, problem


def _spring_potential(q: Coordinates, args: Args) -> Scalar:
    stretch = jnp.sqrt(q @ q) - args["l"]
    return 0.5 * args["k"] * stretch**2 - args["m"] * args["g"] * q[1]


def spring_pendulum(
    m: Real = 1.0, l: Real = 1.0, k: Real = 100.0, g: Real = 9.81
) -> Problem:
    """A point (x, y) on an elastic rod: unconstrained, with a nonlinear potential."""
    args = dict(m=m, l=l, k=k, g=g)
    system = System(equal_masses_kinetic, _spring_potential)
    return problem(system, [l, 0.0], [0.0, 0.0], args)


def _particles_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * args["m"] @ jnp.sum(v.reshape(-1, 3) ** 2, axis=1)


def _particles_potential(q: Coordinates, args: Args) -> Scalar:
    x = q.reshape(-1, 3)
    springs = x[jnp.array([2, 3])] - x[jnp.array([0, 1])]
    return 0.5 * args["k"] @ (jnp.sum(springs**2, axis=1) - 1) ** 2


def _particles_rods(q: Coordinates, args: Args) -> Multipliers:
    x = q.reshape(-1, 3)
    rods = x[jnp.array([1, 3])] - x[jnp.array([0, 2])]
    return jnp.sum(rods**2, axis=1) - 1


def four_particles() -> Problem:
    """Four points in space, two rigid rods and two quartic springs, free of gravity.

    Energy, linear momentum (0, 0, 2) and angular momentum (2, -2, 0) are conserved.

    **Source:** O. Gonzalez, Physica D 132 (1999) 165-174.
    """
    masses = jnp.array([1.0, 3.0, 2.3, 1.7])
    args = dict(m=masses, k=jnp.array([50.0, 500.0]))
    q = [0.0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0]
    v = jnp.zeros(12).at[11].set(2 / masses[3])
    system = System(_particles_kinetic, _particles_potential, _particles_rods)
    return problem(system, q, v, args)


def _elastic_potential(q: Coordinates, args: Args) -> Scalar:
    stretch = jnp.linalg.norm(q) - args["l"]
    return 0.5 * args["k"] * stretch**2 + args["m"] * args["g"] * q[2]


def elastic_pendulum(
    m: Real = 1.0, l: Real = 1.0, k: Real = 100.0, g: Real = 9.81
) -> Problem:
    """A point in space on an elastic rod, that circles about the vertical.

    Energy and the angular momentum about the vertical are conserved.
    """
    args = dict(m=m, l=l, k=k, g=g)
    system = System(equal_masses_kinetic, _elastic_potential)
    return problem(system, [l, 0.0, 0.0], [0.0, 2.0, 0.5], args)


def _ring_potential(q: Coordinates, args: Args) -> Scalar:
    x = q.reshape(-1, 3)
    lengths = jnp.linalg.norm(x - jnp.roll(x, 1, axis=0), axis=1)
    return 0.5 * args["k"] @ (lengths - args["l"]) ** 2


def spring_ring(num_points: int = 6, k: Real = 100.0) -> Problem:
    """Points of mass 1 in space on a ring of springs of length 1, that flies freely.

    It turns about an inclined axis and waves across its plane. Energy, linear and angular
    momentum are conserved.
    """
    angle = 2 * jnp.pi * jnp.arange(num_points, dtype=float) / num_points
    radius = 0.5 / jnp.sin(jnp.pi / num_points)
    x = radius * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=1)
    wave = jnp.stack([0 * angle, 0 * angle, 0.3 * jnp.cos(2 * angle)], axis=1)
    v = jnp.cross(jnp.array([0.2, 0.0, 1.0]), x) + wave + jnp.array([[0.1, 0.0, 0.2]])
    each = jnp.ones((num_points,))
    args = dict(m=each, k=k * each, l=each)
    return problem(
        System(_particles_kinetic, _ring_potential), x.reshape(-1), v.reshape(-1), args
    )


def _axle_potential(q: Coordinates, args: Args) -> Scalar:
    left, right, mount = q.reshape(3, 2)
    lengths = jnp.linalg.norm(jnp.stack([left, right - mount]), axis=1)
    springs = 0.5 * args["k"] * jnp.sum((lengths - args["l0"]) ** 2)
    return springs + args["m"] * args["g"] * (left[1] + right[1])


def _axle_joints(q: Coordinates, args: Args) -> Multipliers:
    left, right, mount = q.reshape(3, 2)
    axle = left - right
    return jnp.array([left @ mount, axle @ axle - args["l"] ** 2])


def _axle_mount(q: Coordinates, t: Scalar, args: Args) -> Multipliers:
    height = args["r"] * jnp.sin(args["w"] * t)
    return q[4:] - jnp.stack([jnp.sqrt(args["l"] ** 2 - height**2), height])


def car_axis() -> Problem:
    """The axle of a car on a bumpy road: two wheels on stiff springs, with a driven mount.

    `q` are the positions (x, y) of the left wheel, the right wheel and the mount of the
    right spring, which is driven at `w = 10`; the left mount is the origin. The axle keeps
    its length, and the left spring stays perpendicular to the line between the mounts. The
    masses are 5e-4 (that of the mount affects only the work of the drive), and the springs
    have stiffness 1. Gravity acts along -y.

    **Source:** Test Set for IVP Solvers, release 2.4, car axis problem; E. Hairer,
    C. Lubich and M. Roche (1989).
    """
    args = dict(m=5e-4, k=1.0, l=1.0, l0=0.5, g=1.0, r=0.1, w=10.0)
    system = System(equal_masses_kinetic, _axle_potential, _axle_joints, driven=_axle_mount)
    q = [0.0, 0.5, 1.0, 0.5, 1.0, 0.0]
    return problem(system, q, [-0.5, 0.0, -0.5, 0.0, 0.0, 1.0], args)
