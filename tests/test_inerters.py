"""Inerters: kinetic energies of lengths and angles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import long


def accelerations(scene):
    system, start, args = scene.build()
    return ej.consistent_start(system, start.q, start.v, args)


def test_an_inerter_shares_a_force_among_two_masses():
    """Two points on a line, of which one is pushed: `m1 a1 = f - b (a1 - a2)` and
    `m2 a2 = b (a1 - a2)`. The force follows from the multiplier, to round-off."""
    m1, m2, b, f = 2.0, 3.0, 1.5, 4.0
    scene = ej.Scene(
        [
            ej.bodies.PointMass("left", m1, [0.0, 0.0]),
            ej.bodies.PointMass("right", m2, [1.0, 0.0]),
            ej.forces.Inerter("screw", "left", "right", b),
            ej.forces.ConstantForce("push", "left", [f, 0.0]),
        ]
    )
    found = accelerations(scene)
    matrix = np.array([[m1 + b, -b], [-b, m2 + b]])
    a1, a2 = np.linalg.solve(matrix, [f, 0.0])
    assert np.allclose(found.accelerations, [a1, 0, a2, 0, a2 - a1], rtol=1e-14, atol=1e-14)
    told = scene.measure(found, "screw")
    assert (float(told.value), float(told.rate)) == (1.0, 0.0)
    assert told.force is not None
    assert float(told.force) == pytest.approx(-b * (a2 - a1), rel=1e-13)
    assert np.allclose(scene.reaction(found, "screw").force, [m2 * a2, 0.0], atol=1e-14)


@pytest.mark.parametrize("in_space", long([False, True], False))
@pytest.mark.slow_for("True")
def test_a_rotor_shares_a_torque_among_two_bodies(in_space):
    """As above, for two wheels on one axle; and a derivative with respect to the rotor."""
    j1, j2, b, torque, axis = 2.0, 3.0, 1.5, 4.0, [0.0, 0.0, 1.0]
    push = lambda t, args: jnp.asarray(torque)

    def scene(b):
        if not in_space:
            wheel = lambda name, j: ej.bodies.PlanarBody(name, 1.0, j, [0.0, 0.0])
            hinge = lambda name, x: ej.joints.Revolute(name, "ground", x)
            rotor = ej.forces.TorsionInerter("rotor", "first", "second", b)
        else:
            moments = lambda j: [0.7 * j, 0.8 * j, j]
            wheel = lambda name, j: ej.bodies.RigidBody(name, 1.0, moments(j), [0.0] * 3)
            hinge = lambda name, x: ej.joints.Revolute(name, "ground", x, axis=axis)
            rotor = ej.forces.TorsionInerter("rotor", "first", "second", b, axis)
        motor = ej.forces.TorsionActuator(
            "motor", "ground", "first", push, axis if in_space else None
        )
        wheels = [wheel("first", j1), wheel("second", j2)]
        hinges = [hinge("h1", "first"), hinge("h2", "second")]
        return ej.Scene([*wheels, *hinges, rotor, motor])

    def growth(b):
        made = scene(b)
        found = ej.consistent_start(made.system, made.q, made.v, made.args)
        return found.accelerations[-1]  # of the angle between the wheels

    # (j1 + b) a1 - b a2 = torque, j2 a2 = b (a1 - a2): a2 - a1 = -torque j2 / d
    d = j1 * j2 + b * (j1 + j2)
    assert float(growth(b)) == pytest.approx(-torque * j2 / d, rel=1e-13)
    if not in_space:
        slope = float(jax.grad(growth)(b))
        assert slope == pytest.approx(torque * j2 * (j1 + j2) / d**2, rel=1e-11)


@pytest.mark.slow
def test_an_inerter_keeps_the_energy_over_full_turns():
    """A wheel that turns several times: the coordinate of the rotor counts the turns, as
    the angle along a run does. The energy is exact to Newton's method."""
    scene = ej.Scene(
        [
            ej.bodies.PlanarBody("wheel", 1.0, 0.3, [0.0, 0.0], angular_velocity=20.0),
            ej.bodies.PointMass("bob", 0.5, [0.0, -1.0]),
            ej.joints.Revolute("axle", "ground", "wheel"),
            ej.joints.Distance("rod", "ground", "bob"),
            ej.forces.Inerter("rack", "wheel", "bob", 0.2, point_a=[0.3, 0.0]),
            ej.forces.TorsionInerter("rotor", "ground", "wheel", 0.1),
        ],
        gravity=[0.0, -9.81],
    )
    assert "rotor  TorsionInerter  ground - wheel, q[6], constraint[" in str(scene)
    assert "2 degrees of freedom." in str(scene)
    system, start, args = scene.build()
    assert start.v[6] == pytest.approx(20.0)
    assert scene.report(start)["rotor"].position < 1e-14
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=100)
    assert np.ptp(sol.audit.energy) < 1e-12 * sol.audit.kinetic.max()
    angle = scene.measure(sol, "rotor").value
    assert angle[-1] > 4 * np.pi
    assert np.allclose(sol.ys.q[:, 6], angle, rtol=1e-12)
    power = scene.measure(sol, "rotor").rate
    kinetic = 0.5 * (0.3 + 0.1) * power**2
    assert float(kinetic[0]) == pytest.approx(80.0)
    assert jnp.ptp(kinetic) > 0.1  # the rack takes and gives energy


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_an_inertance_must_be_positive(value):
    bodies = [ej.bodies.PlanarBody("wheel", 1.0, 1.0, [0.0, 0.0])]
    rotor = ej.forces.TorsionInerter("rotor", "ground", "wheel", value)
    with pytest.raises(ValueError, match="`inertance` of 'rotor' must be positive"):
        ej.Scene([*bodies, rotor])


def test_a_rotor_in_space_needs_a_hinge():
    body = ej.bodies.RigidBody("wheel", 1.0, [1.0, 1.0, 1.0], [0.0, 0.0, 0.0])
    rotor = ej.forces.TorsionInerter("rotor", "ground", "wheel", 1.0, [0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="has an angle only with a joint"):
        ej.Scene([body, rotor])
