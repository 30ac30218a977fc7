"""Unconstrained points: classical problems of numerical integration, in their own units."""

import jax.numpy as jnp
import numpy as np

from .._system import System
from .._types import Args, Coordinates, Real, Scalar, Velocities
from ._base import planar_points_kinetic, Problem, problem


def _unit_kinetic(v: Velocities, args: Args) -> Scalar:
    del args
    return 0.5 * v @ v


def _kepler_potential(q: Coordinates, args: Args) -> Scalar:
    return -args["mu"] / jnp.sqrt(q @ q)


def kepler(eccentricity: Real = 0.6, mu: Real = 1.0) -> Problem:
    """A planet (x, y) at its perihelion, on an ellipse of unit half-axis about the origin.

    Its period is `2 pi / sqrt(mu)`, energy `-mu/2`, angular momentum
    `sqrt(mu (1 - eccentricity^2))`.

    **Source:** E. Hairer, C. Lubich and G. Wanner, Geometric Numerical Integration,
    section I.2.3.
    """
    speed = jnp.sqrt(mu * (1 + eccentricity) / (1 - eccentricity))
    q, v = [1.0 - eccentricity, 0.0], [0.0, speed]
    return problem(System(_unit_kinetic, _kepler_potential), q, v, dict(mu=mu))


def _henon_heiles_potential(q: Coordinates, args: Args) -> Scalar:
    cubic = q[0] ** 2 * q[1] - q[1] ** 3 / 3
    return 0.5 * q @ q + args["strength"] * cubic


def henon_heiles(energy: Real = 1 / 12, strength: Real = 1.0) -> Problem:
    """A star (q1, q2) in a cubic potential, from (0, 0.1) with a velocity along q1.

    Regular at energy 1/12, partly chaotic at 1/8; beyond 1/6 the star can escape.

    **Source:** M. Henon and C. Heiles, The Astronomical Journal 69 (1964) 73-79.
    """
    args = dict(strength=strength)
    system = System(_unit_kinetic, _henon_heiles_potential)
    q = jnp.array([0.0, 0.1])
    speed = jnp.sqrt(2 * (energy - _henon_heiles_potential(q, args)))
    return problem(system, q, [speed, 0.0], args)


def _fput_potential(q: Coordinates, args: Args) -> Scalar:
    centre, stretch = q[: q.size // 2], q[q.size // 2 :]
    right = jnp.append(centre - stretch, 0.0)
    left = jnp.append(0.0, centre + stretch)
    stiff = 0.5 * args["omega"] ** 2 * stretch @ stretch
    return stiff + 0.25 * jnp.sum((right - left) ** 4)


def fput(omega: Real = 50.0) -> Problem:
    """Stiff harmonic springs between soft quartic ones (Fermi, Pasta, Ulam, Tsingou).

    Coordinates are the displaced centres of three stiff springs and their stretches, each
    divided by `sqrt(2)`. The sum of the energies of the stiff springs hardly changes while
    they exchange it in a time of order `omega`.

    **Source:** E. Hairer, C. Lubich and G. Wanner, Geometric Numerical Integration,
    section I.5.1.
    """
    q = [1.0, 0.0, 0.0, 1 / omega, 0.0, 0.0]
    v = [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    return problem(System(_unit_kinetic, _fput_potential), q, v, dict(omega=omega))


_FIRST, _SECOND = np.triu_indices(7, 1)


def _stars_potential(q: Coordinates, args: Args) -> Scalar:
    x, m = q.reshape(-1, 2), args["m"]
    distance = jnp.sqrt(jnp.sum((x[_FIRST] - x[_SECOND]) ** 2, axis=1))
    return -jnp.sum(m[_FIRST] * m[_SECOND] / distance)


def pleiades() -> Problem:
    """Seven stars in a plane, of masses 1 to 7, that come close to each other.

    Coordinates star by star, (x, y) each; gravity has unit strength.

    **Source:** E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential
    Equations I, section II.10.
    """
    x = [3.0, 3, -1, -3, 2, -2, 2]
    y = [3.0, -3, 2, 0, 0, -4, 4]
    vx = [0.0, 0, 0, 0, 0, 1.75, -1.5]
    vy = [0.0, 0, 0, -1.25, 1, 0, 0]
    q, v = (np.stack(pair, axis=1).ravel() for pair in ((x, y), (vx, vy)))
    args = dict(m=jnp.arange(1.0, 8.0))
    return problem(System(planar_points_kinetic, _stars_potential), q, v, args)
