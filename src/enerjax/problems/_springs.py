"""Points on springs."""

import jax.numpy as jnp

from .._system import System
from .._types import Args, Coordinates, Multipliers, Real, Scalar, Velocities
from ._base import Problem, problem


def _spring_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * args["m"] * v @ v


def _spring_potential(q: Coordinates, args: Args) -> Scalar:
    stretch = jnp.sqrt(q @ q) - args["l"]
    return 0.5 * args["k"] * stretch**2 - args["m"] * args["g"] * q[1]


def spring_pendulum(
    m: Real = 1.0, l: Real = 1.0, k: Real = 100.0, g: Real = 9.81
) -> Problem:
    """A point (x, y) on an elastic rod: unconstrained, with a nonlinear potential."""
    args = dict(m=m, l=l, k=k, g=g)
    return problem(System(_spring_kinetic, _spring_potential), [l, 0.0], [0.0, 0.0], args)


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
