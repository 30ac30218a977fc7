"""Starts of scenes: prescribed velocities are kept, the others follow from the joints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej


Point, Planar, Rod = ej.bodies.PointMass, ej.bodies.PlanarBody, ej.bodies.PlanarBody.rod
Revolute = ej.joints.Revolute
CRANK, COUPLER, ROCKER, BASE = 0.4, 0.9, 0.8, np.array([1.0, 0.0])
ANGLE, SPEED = 1.1, 3.0


def knee(angle):
    """Where coupler and rocker meet, by the law of cosines."""
    top = CRANK * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    span = jnp.sqrt(jnp.sum((BASE - top) ** 2))
    along = (BASE - top) / span
    reach = (span**2 + COUPLER**2 - ROCKER**2) / (2 * span)
    rise = jnp.sqrt(COUPLER**2 - reach**2)
    return top + reach * along + rise * jnp.stack([-along[1], along[0]])


def four_bar(off):
    """Its coupler is told a little away from where it is."""
    top = CRANK * np.array([np.cos(ANGLE), np.sin(ANGLE)])
    joint = np.asarray(knee(jnp.asarray(ANGLE)))
    bar = lambda name, a, b: Planar(name, 1.0, 0.1, (a + b) / 2 + off, turn(b - a))
    turn = lambda x: np.arctan2(x[1], x[0])
    return ej.Scene(
        [
            Rod("crank", 1.0, [0.0, 0.0], top, angular_velocity=SPEED),
            bar("coupler", top, joint),
            Rod("rocker", 1.0, BASE, joint),
            Revolute("A", "ground", "crank", [0.0, 0.0]),
            Revolute("B", "crank", "coupler", [CRANK / 2, 0.0], [-COUPLER / 2, 0.0]),
            Revolute("C", "coupler", "rocker", [COUPLER / 2, 0.0], [ROCKER / 2, 0.0]),
            Revolute("D", "ground", "rocker", BASE),
        ]
    )


def test_velocities_that_are_left_out_follow_from_the_others():
    """A crank that is told to turn turns so, and takes the other bars along."""
    for off in (0.0, 1e-3):
        scene = four_bar(off)
        start = scene.start()
        # Solver, here and below.
        assert float(start.v[2]) == pytest.approx(SPEED, rel=1e-12)
        velocity = scene.velocity(start, "rocker", [ROCKER / 2, 0.0])
        exact = SPEED * jax.jacfwd(knee)(jnp.asarray(start.q[2]))
        np.testing.assert_allclose(velocity, exact, rtol=0, atol=1e-11)


def pendulum(velocity, spin):
    rod = Rod("rod", 1.0, [0.0, 0.0], [1.0, 0.0], velocity, spin)
    return ej.Scene([rod, Revolute("pin", "ground", "rod", [0.0, 0.0])])


def test_velocities_that_joints_do_not_admit_are_refused():
    with pytest.raises(ValueError, match="do not fit 'pin'.*grow at 2"):
        pendulum([0.0, 3.0], 2.0).start()
    # Rounded to two digits, they are repaired, by the least kinetic energy.
    rounded = pendulum([0.0, 1.01], 2.0).start().v
    np.testing.assert_allclose(rounded, [0.0, 1.0075, 2.015], rtol=0, atol=1e-14)


# Quaternions, of any length; half a turn has no scalar part.
TURNS = [
    [0.3, -0.2, 0.5, 0.4],
    [0.0, -4.0, 1.2, 0.5],
    [0.0, 0.3, 2.0, 0.4],
    [1e-9, 0.3, -0.5, 2.0],
]


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("body", [ej.bodies.RigidBody, ej.bodies.QuaternionBody])
def test_a_body_in_space_starts_as_it_is_told(body, turn):
    """Its axes, the velocities of its points, and its energy, by formulas of mechanics."""
    a, x, y, z = np.array(turn) / np.linalg.norm(turn)
    # Rodrigues' formula, with the sine and cosine of half of the angle.
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + 2 * a * skew + 2 * skew @ skew
    inertia = np.array([[0.6, 0.1, -0.05], [0.1, 0.5, 0.08], [-0.05, 0.08, 0.7]])
    place, velocity, spin = np.array([[1.0, 2.0, -1.0], [0.4, -0.3, 0.2], [1.0, 3.0, -2.0]])
    box = body(
        "box",
        2.0,
        inertia,
        place,
        rotation,
        velocity=velocity,
        angular_velocity=spin,
    )
    scene = ej.Scene([box])
    system, start, args = scene.build()
    point = np.array([0.2, -0.1, 0.3])
    arm = rotation @ point
    # Round-off.
    near = lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-14)
    near(scene.direction(start, "box", point), arm)
    near(scene.position(start, "box", point), place + arm)
    near(scene.velocity(start, "box", point), velocity + np.cross(spin, arm))
    in_space = rotation @ inertia @ rotation.T
    energy = 0.5 * (2.0 * velocity @ velocity + spin @ in_space @ spin)
    np.testing.assert_allclose(system.energy(start, args), energy, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    "body",
    [
        ej.bodies.RigidBody,
        ej.bodies.QuaternionBody,
    ],
)
def test_starts_in_space(body):
    """The spin that is told is kept, of a body whose place follows from its drive."""
    up = [0.0, 0.0, 1.0]
    door = body("door", 1.0, [0.3, 0.4, 0.5], [1.0, 0.0, 0.0], angular_velocity=[0, 0, 2])
    hinge = Revolute("hinge", "ground", "door", [0.0, 0.0, 0.0], axis=up)
    angle = lambda t, args: args["offset"] + 2 * t
    motor = ej.drives.Angle("motor", "ground", "door", angle, axis=up)
    scene = ej.Scene([door, hinge, motor], args=dict(offset=0.0))
    start = scene.start(t=0.01)
    turn = np.array([np.cos(0.02), np.sin(0.02), 0.0])
    near = lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-12)
    near(scene.position(start, "door"), turn)
    near(scene.velocity(start, "door"), np.cross([0.0, 0.0, 2.0], turn))
    with pytest.raises(ValueError, match="'motor' is off by 3.14"):
        scene.start(scene.args.set(offset=np.pi))


def test_an_axis_is_common_along_a_shaft_of_several_hinges():
    up = [0.0, 0.0, 1.0]
    disc = lambda name, z: ej.bodies.RigidBody(name, 1.0, [0.3, 0.4, 0.5], [0, 0, z])
    parts = [disc("low", 0.0), disc("high", 1.0)]
    parts += [
        ej.joints.Cylindrical(f"{x} pin", "ground", x, axis=up) for x in ("low", "high")
    ]
    shaft = ej.forces.TorsionSpring("shaft", "low", "high", 5.0, axis=up)
    assert "shaft" in str(ej.Scene([*parts, shaft]))


def test_reports_use_the_requested_time_and_numbers():
    bead = Point("bead", 1.0, [1.0, 0.0])
    ram = ej.drives.Distance("ram", "ground", "bead", lambda t, args: args["l"] + t)
    scene = ej.Scene([bead, ram], args=dict(l=1.0))
    longer = scene.args.set(l=1.02)
    start = scene.start(longer, t=0.01)
    assert max(scene.report(start, longer, t=0.01)["ram"]) <= 1e-14  # round-off
    assert scene.report(start)["ram"].position == pytest.approx(0.03, rel=1e-12)
    jerk = lambda t, args: 0.5 + jnp.sqrt(0.25 - t)
    late = ej.Scene([bead, ej.drives.Distance("ram", "ground", "bead", jerk)])
    with pytest.raises(ValueError, match="finite value and rate at the start, t = 0.25"):
        late.start(t=0.25)


@pytest.mark.slow
def test_reactions_in_an_equilibrium_and_in_a_batch():
    load = Point("load", 2.0, [0.3, -1.0])
    own = ej.joints.Constraint("own", lambda view, args: view.position("free")[:1])
    parts = [load, Point("free", 1.0, [0.0, 0.0]), own]
    parts += [ej.joints.Distance("rope", "ground", "load", length=1.0)]
    spring = ej.forces.Spring("spring", "ground", "free", 10.0, 1.0, [0.0, 2.0])
    scene = ej.Scene([*parts, spring], gravity=[0.0, -9.81])
    system, start, args = scene.build()
    rest = ej.equilibrium(system, start, args)
    force = scene.reaction(rest, "rope").force
    np.testing.assert_allclose(force, [0.0, 2 * 9.81], rtol=0, atol=1e-10)  # solver
    with pytest.raises(ValueError, match="'own' is a constraint of your own"):
        scene.reaction(rest, "own")
    batch = jax.tree.map(lambda x: jnp.stack([x] * 6).reshape(3, 2, -1), rest)
    assert scene.position(batch.state, "load").shape == (3, 2, 2)
    forces = scene.reaction(batch, "rope").force
    np.testing.assert_array_equal(forces, jnp.broadcast_to(force, (3, 2, 2)))
