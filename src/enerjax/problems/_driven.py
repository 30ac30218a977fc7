"""Mechanisms that are moved."""

import jax.numpy as jnp

from .._system import System
from .._types import Args, Coordinates, Multipliers, Scalar, Velocities
from ._base import Problem, problem


def _axle_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * args["m"] * v @ v


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
    """The axle of a car on a bumpy road: two wheels on stiff springs, one mount shaken.

    `q` holds the points (x, y) of the left wheel, the right wheel and the mount of the
    right spring, which is driven at `w = 10`; the left mount is the origin. The axle
    keeps its length and the left spring stays perpendicular to the line of the mounts.
    Masses are 5e-4 (that of the mount moves nothing but the work of the drive), springs
    of stiffness 1. Gravity acts along -y.

    **Source:** Test Set for IVP Solvers, release 2.4, car axis problem; E. Hairer,
    C. Lubich and M. Roche (1989).
    """
    args = dict(m=5e-4, k=1.0, l=1.0, l0=0.5, g=1.0, r=0.1, w=10.0)
    system = System(_axle_kinetic, _axle_potential, _axle_joints, driven=_axle_mount)
    q = [0.0, 0.5, 1.0, 0.5, 1.0, 0.0]
    return problem(system, q, [-0.5, 0.0, -0.5, 0.0, 0.0, 1.0], args)
