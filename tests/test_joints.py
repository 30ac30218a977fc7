"""Every joint, between two bodies in free flight, and holding one against gravity."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej


X, Y, Z = np.eye(3)
CURVE = lambda x, numbers: jnp.stack(
    [x[2] - numbers["depth"] * x[0] ** 2, x[1] - jnp.sin(x[0])]
)
# How a joint is made between two bodies, from a point on the first; and the motions that
# it leaves to the second body at that point, (velocity, angular velocity), where both are
# parallel to space.
JOINTS = {
    "spherical": (
        lambda name, a, b, at: ej.joints.Spherical(name, a, b, at),
        [(0 * X, X), (0 * X, Y), (0 * X, Z)],
    ),
    "revolute": (
        lambda name, a, b, at: ej.joints.Revolute(name, a, b, at, axis=Z),
        [(0 * X, Z)],
    ),
    "universal": (
        lambda name, a, b, at: ej.joints.Universal(name, a, b, at, axis=Z, axis_b=Y),
        [(0 * X, Z), (0 * X, Y)],
    ),
    "prismatic": (
        lambda name, a, b, at: ej.joints.Prismatic(name, a, b, at, axis=X),
        [(X, 0 * X)],
    ),
    "cylindrical": (
        lambda name, a, b, at: ej.joints.Cylindrical(name, a, b, at, axis=X),
        [(X, 0 * X), (0 * X, X)],
    ),
    "planar": (
        lambda name, a, b, at: ej.joints.Planar(name, a, b, at, axis=Z),
        [(X, 0 * X), (Y, 0 * X), (0 * X, Z)],
    ),
    "fixed": (lambda name, a, b, at: ej.joints.Fixed(name, a, b, at), []),
    "distance": (
        lambda name, a, b, at: ej.joints.Distance(name, a, b, at + Z, length=1.0),
        [(X, 0 * X), (Y, 0 * X), (0 * X, X), (0 * X, Y), (0 * X, Z)],
    ),
    "curve": (
        lambda name, a, b, at: ej.joints.OnCurve(name, a, b, CURVE, dict(depth=0.7)),
        [(X + Y, 0 * X), (0 * X, X), (0 * X, Y), (0 * X, Z)],
    ),
}
BODIES = {"directors": ej.bodies.RigidBody, "quaternions": ej.bodies.QuaternionBody}
MASS = {"a": 1.3, "b": 0.7}
INERTIA = {"a": (0.3, 0.4, 0.5), "b": (0.2, 0.25, 0.15)}


def on_ground(name):
    """A body straight below its joint with the ground; parallel to space, and at rest."""
    make, _ = JOINTS[name]
    centre = np.zeros(3) if name in ("curve", "distance") else np.array([0.0, 0.0, -0.4])
    body = ej.bodies.RigidBody("b", MASS["b"], INERTIA["b"], centre)
    joint = make("joint", "ground", "b", np.zeros(3))
    return ej.Scene([body, joint], gravity=[0.0, 0.0, -9.81])


@pytest.mark.parametrize("name", JOINTS)
@pytest.mark.slow_for("spherical")
def test_a_joint_leaves_its_degrees_of_freedom_and_carries_all_other_loads(name):
    scene, motions = on_ground(name), JOINTS[name][1]
    system, q, args = scene.system, scene.q, scene.args
    assert system.constraint is not None
    of_joint = jax.jacfwd(system.constraint)(q, args)
    jacobian = np.concatenate([of_joint, jax.jacfwd(system.kinematics.constraint)(q)])
    # Those of the joint, and six constraints of the directors.
    assert np.linalg.matrix_rank(jacobian) == len(jacobian) == 6 - len(motions) + 6
    for velocity, spin in motions:
        # Of the mass centre, where the joint's point, the origin, moves so.
        velocity = velocity + np.cross(spin, q[:3])
        moving = ej.bodies.RigidBody(
            "b", 1.0, INERTIA["b"], q[:3], velocity=velocity, angular_velocity=spin
        )
        np.testing.assert_allclose(jacobian @ moving.v, 0, rtol=0, atol=1e-14)
    if name == "curve":  # inclined at the start: nothing to rest on
        return
    weight = np.asarray(jax.grad(lambda q: system.potential(q, args))(q))
    multipliers = np.linalg.lstsq(jacobian.T, -weight)[0]
    # Round-off, here and below.
    np.testing.assert_allclose(jacobian.T @ multipliers, -weight, rtol=0, atol=1e-12)
    none = jnp.zeros((0,))
    rest = ej.ConsistentStart(
        ej.State(q, scene.v), 0 * scene.v, jnp.asarray(multipliers), none, none, none, none
    )
    found = scene.reaction(rest, "joint")
    np.testing.assert_allclose(found.force, MASS["b"] * 9.81 * Z, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.torque, 0, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_clamp_carries_the_weight_and_its_moment_about_the_clamp():
    parts = [
        ej.bodies.PlanarBody.rod("arm", 2.0, [1.0, 0.0], [1.6, 0.0]),
        ej.joints.Fixed("clamp", "ground", "arm", [1.0, 0.0]),
    ]
    scene = ej.Scene(parts, gravity=[0.0, -9.81])
    rest = ej.consistent_start(scene.system, scene.q, scene.v, scene.args)
    found = scene.reaction(rest, "clamp")
    np.testing.assert_allclose(found.force, [0.0, 2 * 9.81], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.torque, [2 * 9.81 * 0.3], rtol=0, atol=1e-12)


def two_bodies(kind, name):
    """Two bodies, turned anyhow, that fly and tumble freely."""
    cls, turn = BODIES[kind], np.array([0.8, -0.4, 0.1, np.sqrt(1 - 0.81)])
    first, at = np.array([0.1, 0.2, -0.1]), np.array([0.3, 0.1, 0.2])
    # Where the second body must be to fit what is told in both.
    fitting = {
        "universal": at,
        "curve": np.array([0.5, np.sin(0.5), 0.7 * 0.25]),
        "distance": at + Z + X,
    }
    centre = first + rotated(turn, fitting[name]) if name in fitting else [0.4, 0.5, 0.5]
    second_turn = turn if name in fitting else [1.0, 0.0, 0.0, 0.0]
    parts = [
        cls(
            "a", MASS["a"], INERTIA["a"], first, turn,
            velocity=[0.3, -0.2, 0.1], angular_velocity=[1.0, 2.0, -1.5],
        ),
        cls(
            "b", MASS["b"], INERTIA["b"], centre, second_turn,
            velocity=[-0.3, 0.5, 0.2], angular_velocity=[-2.0, 1.0, 0.5],
        ),
        JOINTS[name][0]("joint", "a", "b", at),
    ]  # fmt: skip
    return ej.Scene(parts)


@functools.cache
def flight(kind, name):
    scene = two_bodies(kind, name)
    system, args = scene.system, scene.args
    # The nearest motion that the joint admits: theirs do not fit.
    start = ej.initial_state(system, scene.q, scene.v, args)
    run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=100)
    return scene, run


def rotated(p, x):
    skew = np.array([[0, -p[3], p[2]], [p[3], 0, -p[1]], [-p[2], p[1], 0]])
    return x + 2 * p[0] * skew @ x + 2 * skew @ skew @ x


@functools.cache
def motion(kind, name):
    """Energy, linear and angular momentum along the run."""
    scene, run = flight(kind, name)
    energy, linear, angular = 0.0, 0.0, 0.0
    for x in "ab":
        place, speed = (np.asarray(f(run.ys, x)) for f in (scene.position, scene.velocity))
        moments = 0.5 * np.sum(INERTIA[x]) - np.array(INERTIA[x])
        # The body as four points: the mass centre, and one on each axis.
        points = [(MASS[x], place, speed)]
        for moment, axis in zip(moments, np.eye(3), strict=True):
            rate = np.asarray(scene.velocity(run.ys, x, axis)) - speed
            points.append((moment, np.asarray(scene.direction(run.ys, x, axis)), rate))
        linear = linear + MASS[x] * speed
        for mass, r, v in points:
            energy = energy + 0.5 * mass * np.sum(v**2, axis=1)
            angular = angular + mass * np.cross(r, v)
    return energy, linear, angular


def drift(x):
    return np.max(np.abs(x - x[0])) / np.max(np.abs(x[0]))


@pytest.mark.parametrize("name", JOINTS)
def test_a_joint_of_two_bodies_admits_their_motion_as_one(name):
    """Its forces are in balance: they give the two neither momentum nor spin."""
    scene = two_bodies("directors", name)
    centre = scene.position(ej.State(scene.q, scene.v), "b")
    shift, spin = np.array([0.3, -0.7, 0.5]), np.array([0.4, 1.1, -0.6])
    velocity = np.concatenate(
        [
            np.concatenate([shift + np.cross(spin, at), np.cross(spin, axes).ravel()])
            for at, axes in (
                (scene.q[:3], np.reshape(scene.q[3:12], (3, 3))),
                (centre, np.reshape(scene.q[15:], (3, 3))),
            )
        ]
    )
    constraint = scene.system.constraint
    assert constraint is not None
    rows = lambda q: constraint(q, scene.args)
    rate = jax.jit(lambda q, v: jax.jvp(rows, (q,), (v,))[1])(scene.q, velocity)
    np.testing.assert_allclose(rate, 0, rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("name", JOINTS)
def test_bodies_that_a_joint_connects_keep_energy_and_momenta(name):
    scene, run = flight("directors", name)
    # Round-off and solver, of a hundred steps.
    assert max(map(drift, motion("directors", name))) <= 1e-11
    assert np.max(np.abs(run.audit.constraint)) <= 1e-12
    if name in ("spherical", "revolute", "universal", "fixed"):
        joint = scene.args["joints"]["joint"]
        a, b = (scene.position(run.ys, x, joint[f"point_{x}"]) for x in "ab")
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", JOINTS)
def test_bodies_in_quaternions_keep_the_angular_momentum_to_second_order(name):
    energy, linear, angular = motion("quaternions", name)
    assert max(drift(energy), drift(linear)) <= 1e-11
    # Truncation: 1e-5 = C h^2 with C = 0.2.
    assert drift(angular) <= 1e-4


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_fixed_body_keeps_the_pose_of_the_start_without_points(dimension):
    at = [0.3, -0.2, 0.1][:dimension]
    body = (
        ej.bodies.PlanarBody("arm", 1.0, 0.1, at, 0.4)
        if dimension == 2
        else ej.bodies.RigidBody("arm", 1.0, [0.1, 0.2, 0.15], at)
    )
    scene = ej.Scene([body, ej.joints.Fixed("clamp", "ground", "arm")])
    np.testing.assert_allclose(scene.start().q, scene.q, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(scene.args["joints"]["clamp"]["point_a"], at)
    assert max(scene.report(scene.start())["clamp"]) <= 1e-15  # round-off
