"""The paper's test cases and benchmark mechanisms, as `(system, start, args)`.

Each function builds a `Problem`; calls with other numbers share one compiled program.
Units are SI. In the plane gravity acts along +y; in space along -z.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._initial import initial_state
from ._system import State, System
from ._types import Args, Coordinates, Multipliers, Real, Scalar, Vector, Velocities


class Problem(NamedTuple):
    """A system, a consistent start and its arguments: `simulate(*problem)` but the scheme.

    Use as `system, start, args = pendulum()`.
    """

    system: System
    start: State
    args: Args


def _problem(system: System, q: Vector, v: Vector, args: Args) -> Problem:
    return Problem(system, initial_state(system, q, v, args), args)


# Pendulums in the plane ---------------------------------------------------------------


def _angle_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * args["m"] * args["l"] ** 2 * v @ v


def _angle_potential(q: Coordinates, args: Args) -> Scalar:
    return args["m"] * args["g"] * args["l"] * (1 - jnp.cos(q[0]))


def pendulum_angle(m: Real = 1.0, l: Real = 1.0, g: Real = 9.81) -> Problem:
    """Case a: a simple pendulum in its angle, released from the horizontal at rest.

    **Source:** E. Lens and A. Cardona, section 3 a.
    """
    args = dict(m=m, l=l, g=g)
    return _problem(System(_angle_kinetic, _angle_potential), [jnp.pi / 2], [0.0], args)


def _point_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * args["m"] * v @ v


def _point_potential(q: Coordinates, args: Args) -> Scalar:
    return -args["m"] * args["g"] * q[1]


def _rod(q: Coordinates, args: Args) -> Multipliers:
    return jnp.array([q @ q - args["l"] ** 2])


def pendulum(m: Real = 1.0, l: Real = 1.0, g: Real = 9.81) -> Problem:
    """Case b: the pendulum of case a as a point (x, y) on a rod; the same motion.

    **Source:** E. Lens and A. Cardona, section 3 b.
    """
    args = dict(m=m, l=l, g=g)
    return _problem(
        System(_point_kinetic, _point_potential, _rod), [l, 0.0], [0.0, 0.0], args
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
    return _problem(system, [l1, 0.0, l1, l2], [0.0] * 4, args)


def stiff_double_pendulum() -> Problem:
    """Case d: the double pendulum of case c with an inner mass 200 times lighter.

    **Source:** E. Lens and A. Cardona, section 3 d.
    """
    return double_pendulum(m1=0.005)


def _chain_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * args["m"] @ jnp.sum(v.reshape(-1, 2) ** 2, axis=1)


def _chain_potential(q: Coordinates, args: Args) -> Scalar:
    return -args["g"] * args["m"] @ q[1::2]


def _chain_rods(q: Coordinates, args: Args) -> Multipliers:
    points = jnp.concatenate([jnp.zeros((1, 2), q.dtype), q.reshape(-1, 2)])
    links = points[1:] - points[:-1]
    return jnp.sum(links**2, axis=1) - args["l"] ** 2


def chain(num_links: int, length: Real = 1.0, mass: Real = 1.0, g: Real = 9.81) -> Problem:
    """A chain of equal rods and points, straight and horizontal, held at one end.

    The fall ends in a whip: the free end reaches speeds far beyond free fall.
    """
    each = jnp.full((num_links,), 1 / num_links)
    args = dict(m=mass * each, l=length * each, g=g)
    x = length * jnp.arange(1, num_links + 1) / num_links
    q = jnp.stack([x, jnp.zeros_like(x)], axis=1).reshape(-1)
    system = System(_chain_kinetic, _chain_potential, _chain_rods)
    return _problem(system, q, jnp.zeros_like(q), args)


# Springs ------------------------------------------------------------------------------


def _spring_potential(q: Coordinates, args: Args) -> Scalar:
    stretch = jnp.sqrt(q @ q) - args["l"]
    return 0.5 * args["k"] * stretch**2 - args["m"] * args["g"] * q[1]


def spring_pendulum(
    m: Real = 1.0, l: Real = 1.0, k: Real = 100.0, g: Real = 9.81
) -> Problem:
    """A point (x, y) on an elastic rod: unconstrained, with a nonlinear potential."""
    args = dict(m=m, l=l, k=k, g=g)
    return _problem(System(_point_kinetic, _spring_potential), [l, 0.0], [0.0, 0.0], args)


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
    return _problem(system, q, v, args)


# Rigid bodies in Euler parameters, scalar first, rotating body axes into space ----------


def _rotation(p: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """The rotation matrix, quadratic in `p` (orthogonal where `|p| = 1`)."""
    scalar, vector = p[0], p[1:]
    x, y, z = vector
    cross = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    isotropic = (scalar**2 - vector @ vector) * jnp.eye(3, dtype=p.dtype)
    return isotropic + 2 * (jnp.outer(vector, vector) + scalar * cross)


def _body_rates(p: Float[Array, "4"]) -> Float[Array, "3 4"]:
    """`2 E(p)` in `Omega = 2 E(p) pdot`, the angular velocity in body axes."""
    e0, e1, e2, e3 = p
    return 2 * jnp.array([[-e1, e0, e3, -e2], [-e2, -e3, e0, e1], [-e3, e2, -e1, e0]])


def _unit(q: Coordinates, args: Args) -> Multipliers:
    return jnp.array([q[-4:] @ q[-4:] - 1])


def _spin_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * v @ (args["J"] * v)


def _no_potential(q: Coordinates, args: Args) -> Scalar:
    return jnp.zeros((), q.dtype)


def _spin_rates(q: Coordinates, args: Args) -> Float[Array, "3 4"]:
    return _body_rates(q)


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
    return _problem(system, [1.0, 0, 0, 0], [10.0, 20, 20], args)


def _top_kinetic(v: Velocities, args: Args) -> Scalar:
    return 0.5 * (args["m"] * v[:3] @ v[:3] + v[3:] @ (args["J"] * v[3:]))


def _top_potential(q: Coordinates, args: Args) -> Scalar:
    return args["m"] * args["g"] * q[2]


def _top_joint(q: Coordinates, args: Args) -> Multipliers:
    return q[:3] - _rotation(q[3:]) @ args["centre"]


def _top_rates(q: Coordinates, args: Args) -> Float[Array, "6 7"]:
    eye = jnp.eye(3, dtype=q.dtype)
    off = jnp.zeros((3, 4), q.dtype)
    return jnp.block([[eye, off], [off[:, :3], _body_rates(q[3:])]])


def heavy_top() -> Problem:
    """A fast heavy top on a spherical joint at the origin.

    `q = (x, p)`: mass centre and unit quaternion; `v = (xdot, Omega)`, the angular
    velocity in body axes. The multipliers of the joint are minus the force on the top.

    **Source:** O. Bruls, A. Cardona and M. Arnold, Mech. Mach. Theory 48 (2012) 121-137.
    """
    args = dict(
        m=15.0,
        g=9.81,
        J=jnp.array([0.234375, 0.46875, 0.234375]),
        centre=jnp.array([0.0, 1.0, 0.0]),
    )
    system = System(
        _top_kinetic,
        _top_potential,
        _top_joint,
        kinematics=_top_rates,
        coordinate_constraint=_unit,
    )
    spin = [0.0, 150.0, -4.61538]
    return _problem(system, [0.0, 1, 0, 1, 0, 0, 0], [4.61538, 0.0, 0.0, *spin], args)
