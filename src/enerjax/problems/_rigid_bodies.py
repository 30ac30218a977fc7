"""Rigid bodies in Euler parameters (scalar first; from body axes to space) or directors."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._system import System
from .._types import Args, Coordinates, Multipliers, Scalar, Velocities
from ..scenes import quaternion_rates, rotation
from ._base import Problem, problem


def _unit(q: Coordinates, args: Args) -> Multipliers:
    return jnp.array([q[-4:] @ q[-4:] - 1])


def _spin_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * v @ (args["J"] * v)


def _no_potential(q: Coordinates, args: Args) -> Scalar:
    return jnp.zeros((), q.dtype)


def _spin_rates(q: Coordinates, args: Args) -> Float[Array, "3 4"]:
    return quaternion_rates(q)


def free_rigid_body() -> Problem:
    """An asymmetric body that turns freely about its mass centre.

    `q` is the unit quaternion, `v` the angular velocity in body axes. The kinetic energy
    is 2500, the angular momentum in space (60, 160, 60).

    **Source:** P. L. Kinon and P. Betsch, Multibody Syst. Dyn. (2024).
    """
    args = dict(J=jnp.array([6.0, 8.0, 3.0]))
    system = System(
        _spin_kinetic, _no_potential, kinematics=_spin_rates, coordinate_constraint=_unit
    )
    return problem(system, [1.0, 0, 0, 0], [10.0, 20, 20], args)


def _top_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * (args["m"] * v[:3] @ v[:3] + v[3:] @ (args["J"] * v[3:]))


def _top_potential(q: Coordinates, args: Args) -> Scalar:
    return args["m"] * args["g"] * q[2]


def _top_joint(q: Coordinates, args: Args) -> Multipliers:
    return q[:3] - rotation(q[3:]) @ args["centre"]


def _top_rates(q: Coordinates, args: Args) -> Float[Array, "6 7"]:
    eye = jnp.eye(3, dtype=q.dtype)
    off = jnp.zeros((3, 4), q.dtype)
    return jnp.block([[eye, off], [off[:, :3], quaternion_rates(q[3:])]])


_TOP_SPIN = (0.0, 150.0, -4.61538)


def _top_args() -> dict[str, Any]:
    return dict(
        m=15.0,
        g=9.81,
        J=jnp.array([0.234375, 0.46875, 0.234375]),
        centre=jnp.array([0.0, 1.0, 0.0]),
    )


def heavy_top() -> Problem:
    """A fast heavy top on a spherical joint at the origin.

    `q = (x, p)`: mass centre and unit quaternion; `v = (xdot, Omega)`, the angular
    velocity in body axes. The multipliers of the joint are minus the force on the top.

    **Source:** O. Bruls, A. Cardona and M. Arnold, Mech. Mach. Theory 48 (2012) 121-137.
    """
    system = System(
        _top_kinetic,
        _top_potential,
        _top_joint,
        kinematics=_top_rates,
        coordinate_constraint=_unit,
    )
    v = [4.61538, 0.0, 0.0, *_TOP_SPIN]
    return problem(system, [0.0, 1, 0, 1, 0, 0, 0], v, _top_args())


def _about_joint(args: Args) -> Float[Array, "3 3"]:
    """The inertia about the fixed point (Steiner)."""
    centre = args["centre"]
    away = centre @ centre * jnp.eye(3, dtype=centre.dtype) - jnp.outer(centre, centre)
    return jnp.diag(args["J"]) + args["m"] * away


def _director_kinetic(v: Velocities, args: Args) -> Scalar:
    rates, inertia = v.reshape(3, 3), _about_joint(args)
    euler = 0.5 * jnp.trace(inertia) * jnp.eye(3, dtype=v.dtype) - inertia
    return 0.5 * jnp.sum(euler * (rates @ rates.T))


def _director_potential(q: Coordinates, args: Args) -> Scalar:
    return args["m"] * args["g"] * args["centre"] @ q.reshape(3, 3)[:, 2]


def _orthonormal(q: Coordinates, args: Args) -> Multipliers:
    directors = q.reshape(3, 3)
    products = directors @ directors.T - jnp.eye(3, dtype=q.dtype)
    return products[jnp.array([0, 1, 2, 1, 2, 2]), jnp.array([0, 1, 2, 0, 0, 1])]


def heavy_top_directors() -> Problem:
    """The top of `heavy_top` in its three body axes, as vectors in space.

    `q` holds the axes one after another, `v` their rates; the mass centre is
    `centre @ q.reshape(3, 3)`. With velocities that are rates of the coordinates, and
    constraints that are products of vectors, the spatial angular momentum about the
    vertical is kept to round-off.
    """
    args = _top_args()
    system = System(_director_kinetic, _director_potential, _orthonormal)
    rates = jnp.cross(jnp.array(_TOP_SPIN), jnp.eye(3))
    return problem(system, jnp.eye(3).reshape(-1), rates.reshape(-1), args)


def _quaternion_hamiltonian(q: Coordinates, p: Coordinates, args: Args) -> Scalar:
    momentum = 0.25 * quaternion_rates(q) @ p
    spin = jnp.linalg.solve(_about_joint(args), momentum)
    height = rotation(q)[2] @ args["centre"]
    # The energy of the redundant momentum, which is zero in a motion.
    stretching = 0.5 * (q @ p) ** 2
    return 0.5 * momentum @ spin + stretching + args["m"] * args["g"] * height


def _canonical_unit(q: Coordinates, args: Args) -> Multipliers:
    return jnp.array([0.5 * (q @ q - 1)])


def heavy_top_canonical() -> Problem:
    """The top of `heavy_top` as a unit quaternion `q` and its momentum `p`.

    `p = 2 E(q)^T J Omega` with the inertia `J` about the fixed point; `State.v` is `p`.
    """
    args = _top_args()
    system = System.from_hamiltonian(_quaternion_hamiltonian, _canonical_unit)
    q = jnp.array([1.0, 0, 0, 0])
    p = quaternion_rates(q).T @ _about_joint(args) @ jnp.array(_TOP_SPIN)
    return problem(system, q, p, args)
