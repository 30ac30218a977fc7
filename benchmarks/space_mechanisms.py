"""Mechanisms of rigid bodies in space, described once for all programs."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import enerjax as ej


Vector = NDArray[np.float64]
GROUND = -1
X, Y, Z = np.eye(3)


@dataclasses.dataclass(frozen=True)
class Body:
    """A body whose principal axes are those of space at the start.

    A `velocity` or `spin` that is left out follows from those of other bodies.
    """

    mass: float
    inertia: Vector
    position: Vector
    velocity: Vector | None = None
    spin: Vector | None = None


@dataclasses.dataclass(frozen=True)
class Joint:
    """A hinge at a `point` of space, or without an `axis` a ball joint.

    The numbers of its bodies are `first` and `second`. A hinge may have a torsion spring,
    which is relaxed at the start, a damper, and a motor of constant torque on `second`.
    """

    first: int
    second: int
    point: Vector
    axis: Vector | None = None
    stiffness: float = 0.0
    damping: float = 0.0
    torque: float = 0.0


@dataclasses.dataclass(frozen=True)
class Mechanism:
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    redundant: bool = False
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)

    def place(self, body: int) -> Vector:
        """The mass centre at the start; the origin for the ground."""
        return np.zeros(3) if body == GROUND else self.bodies[body].position

    def scene(self) -> ej.Scene:
        name = lambda k: "ground" if k == GROUND else f"body {k}"
        parts: list[Any] = []
        for k, body in enumerate(self.bodies):
            given: dict[str, Any] = dict(velocity=body.velocity, angular_velocity=body.spin)
            at = (body.mass, body.inertia, body.position)
            parts.append(ej.bodies.RigidBody(name(k), *at, **given))
        for k, joint in enumerate(self.joints):
            ends = name(joint.first), name(joint.second)
            point = joint.point - self.place(joint.first)
            if joint.axis is None:
                parts.append(ej.joints.Spherical(f"ball {k}", *ends, point))
                continue
            hinge = ej.joints.Revolute(f"hinge {k}", *ends, point, axis=joint.axis)
            parts += [hinge, *_torques(k, joint, ends)]
        motors = {f"torque {k}": joint.torque for k, joint in enumerate(self.joints)}
        args = motors if any(motors.values()) else {}
        gravity = list(self.gravity)
        return ej.Scene(parts, gravity=gravity, redundant=self.redundant, args=args)

    def in_motion(self) -> "Mechanism":
        """With the velocities of all bodies, for programs that do not complete them."""
        given = [body.velocity is not None for body in self.bodies]
        if all(given):
            return self
        rates = np.zeros((len(given), 4, 3))
        if any(given):
            _, start, _ = self.scene().build()
            rates = np.asarray(start.v).reshape(-1, 4, 3)
        # d/dt d_i = spin x d_i, and the axes d_i are those of space.
        spins = 0.5 * np.sum(np.cross(np.eye(3), rates[:, 1:]), axis=1)
        bodies = [
            dataclasses.replace(body, velocity=rate, spin=spin)
            for body, rate, spin in zip(self.bodies, rates[:, 0], spins, strict=True)
        ]
        return dataclasses.replace(self, bodies=tuple(bodies))


def _torques(number: int, joint: Joint, ends: tuple[str, str]) -> list[Any]:
    """The parts of a scene that turn a hinge."""
    parts: list[Any] = []
    around = dict(axis=joint.axis)
    if joint.stiffness:
        spring = ej.forces.TorsionSpring(
            f"spring {number}", *ends, joint.stiffness, **around
        )
        parts.append(spring)
    if joint.damping:
        parts.append(
            ej.forces.TorsionDamper(f"damper {number}", *ends, joint.damping, **around)
        )
    if joint.torque:
        torque = lambda t, args: args[f"torque {number}"] * jnp.ones_like(t)
        parts.append(ej.forces.TorsionActuator(f"motor {number}", *ends, torque, **around))
    return parts


def mass_centres(q: Any) -> Vector:
    """Those of all bodies, shape `(n, 3)`, from the coordinates of a scene."""
    return np.asarray(q).reshape(-1, 12)[:, :3]


def _rod(along: Vector, start: Vector) -> Body:
    """A rod of a metre and a kilogram."""
    return Body(1.0, np.where(along != 0, 0.01, 0.1), start + 0.5 * along)


def with_rates(mechanism: Mechanism, rates: Sequence[float]) -> Mechanism:
    """An open mechanism whose hinges turn; joint `k` must lead to body `k`."""
    bodies = []
    for body, joint, rate in zip(mechanism.bodies, mechanism.joints, rates, strict=True):
        assert joint.axis is not None
        spin, velocity = np.zeros(3), np.zeros(3)
        if joint.first != GROUND:
            before = bodies[joint.first]
            spin = before.spin
            velocity = before.velocity + np.cross(spin, joint.point - before.position)
        spin = spin + rate * joint.axis
        velocity = velocity + np.cross(spin, body.position - joint.point)
        bodies.append(dataclasses.replace(body, velocity=velocity, spin=spin))
    return dataclasses.replace(mechanism, bodies=tuple(bodies))


def chain(num_bodies: int, **of_hinges: float) -> Mechanism:
    """Rods on hinges, horizontal, whose axes point along y and z in turn."""
    bodies = tuple(_rod(X, k * X) for k in range(num_bodies))
    joints = tuple(
        Joint(k - 1, k, k * X, Y if k % 2 == 0 else Z, **of_hinges)
        for k in range(num_bodies)
    )
    return Mechanism(bodies, joints)


def whirling_chain(num_bodies: int, rate: float = 20.0) -> Mechanism:
    """The chain with all hinges turning.

    The signs are such that no body turns faster than the square root of two times `rate`.
    """
    signs = np.resize([1, 1, -1, -1, -1, -1, 1, 1], num_bodies)
    return with_rates(chain(num_bodies), (rate * signs).tolist())


def with_springs(mechanism: Mechanism, stiffness: float) -> Mechanism:
    """With torsion springs about all hinges."""
    joints = [
        joint if joint.axis is None else dataclasses.replace(joint, stiffness=stiffness)
        for joint in mechanism.joints
    ]
    return dataclasses.replace(mechanism, joints=tuple(joints))


def tree(num_bodies: int) -> Mechanism:
    """A binary tree of rods along the axes of space, on hinges."""
    axes, tips, bodies, joints = [0], [X], [_rod(X, 0 * X)], [Joint(GROUND, 0, 0 * X, Y)]
    for k in range(1, num_bodies):
        parent = (k - 1) // 2
        axis = (axes[parent] + (1 if k % 2 else 2)) % 3
        along, foot = np.eye(3)[axis], tips[parent]
        axes.append(axis)
        tips.append(foot + along)
        bodies.append(_rod(along, foot))
        joints.append(Joint(parent, k, foot, np.eye(3)[(axis + 1) % 3]))
    return Mechanism(tuple(bodies), tuple(joints))


def _crank(speed: float = 20.0) -> Body:
    """A flywheel that turns about x."""
    spin = speed * X
    return Body(2.0, np.array([4e-2, 3e-2, 3e-2]), 0 * X, velocity=0 * X, spin=spin)


def _coupler_and_rocker(
    first: int, pin: Vector, knee: Vector, base: Vector, axis: Vector
) -> tuple[tuple[Body, Body], tuple[Joint, Joint, Joint]]:
    """From a pin of the crank, body 0, to a pivot of the ground; `first` is the coupler."""
    coupler = Body(1.0, np.full(3, 5e-2), (pin + knee) / 2)
    rocker = Body(0.8, np.array([2e-2, 2e-2, 2e-3]), (knee + base) / 2)
    joints = (
        Joint(0, first, pin),
        Joint(first + 1, first, knee),
        Joint(GROUND, first + 1, base, axis),
    )
    return (coupler, rocker), joints


_PIN, _KNEE = np.array([0.0, 0.0, 0.15]), np.array([0.4, 0.5, 0.5])
_BASE = np.array([0.4, 0.5, 0.0])


def four_bar() -> Mechanism:
    """`problems.spatial_four_bar`: crank and rocker on skew hinges, a coupler on balls."""
    bodies, joints = _coupler_and_rocker(1, _PIN, _KNEE, _BASE, Y)
    shaft = Joint(GROUND, 0, 0 * X, X)
    return Mechanism((_crank(), *bodies), (shaft, *joints))


def two_loops() -> Mechanism:
    """Two spatial four-bars that share their crank."""
    back = np.array([-1.0, -1.0, 1.0])
    one, its_joints = _coupler_and_rocker(1, _PIN, _KNEE, _BASE, Y)
    other, other_joints = _coupler_and_rocker(3, _PIN, back * _KNEE, back * _BASE, Y)
    shaft = Joint(GROUND, 0, 0 * X, X)
    return Mechanism((_crank(), *one, *other), (shaft, *its_joints, *other_joints))


def bricard() -> Mechanism:
    """R. Bricard's orthogonal linkage: six rods along edges of a cube, one of them fixed.

    It moves although it has as many rows of constraints as its bodies have coordinates.
    """
    edges = (Y, Z, -X, -Y, -Z)
    corners = np.cumsum([X, *edges], axis=0)
    axes = (Z, X, Y, Z, X, Y)
    bodies = tuple(_rod(e, c) for e, c in zip(edges, corners, strict=False))
    ends = [GROUND, *range(5), GROUND]
    pairs = zip(ends, ends[1:], corners, axes, strict=False)
    joints = tuple(Joint(a, b, c, axis) for a, b, c, axis in pairs)
    return Mechanism(bodies, joints, redundant=True)


def arm_in_plane(num_rods: int) -> Mechanism:
    """Rods on hinges along y, horizontal and at rest; they stay in the plane of x and z."""
    chained = chain(num_rods)
    joints = (dataclasses.replace(joint, axis=Y) for joint in chained.joints)
    inertia = np.full(3, 1 / 12)
    bodies = (dataclasses.replace(body, inertia=inertia) for body in chained.bodies)
    return Mechanism(tuple(bodies), tuple(joints))


def arm() -> Mechanism:
    """Four rods on hinges with springs and dampers, and a motor at the first."""
    chained = chain(4, stiffness=30.0, damping=0.5)
    motor = dataclasses.replace(chained.joints[0], torque=-15.0)
    return dataclasses.replace(chained, joints=(motor, *chained.joints[1:]))


def top(across: float = 0.25) -> Mechanism:
    """A fast top on a ball joint; with `across = 0.234375` that of `problems.heavy_top`.

    That one is flat, which the bodies of a scene cannot be.
    """
    spin, inertia = np.array([0.0, 150.0, -4.61538]), np.array([across, 0.46875, across])
    body = Body(15.0, inertia, Y, velocity=np.cross(spin, Y), spin=spin)
    return Mechanism((body,), (Joint(GROUND, 0, 0 * X),))
