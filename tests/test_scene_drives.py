"""Drives of scenes against the motions that they prescribe."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import on_host


Body, Rod = ej.bodies.PlanarBody, ej.bodies.PlanarBody.rod
R, L, SPEED, DAMPING = 0.15, 0.35, 40.0, 3.0


def constant_speed(t, args):
    return args["speed"] * t


def driven_slider_crank():
    pin, end = [R, 0.0], [R + L, 0.0]
    return ej.Scene(
        [
            Rod("crank", 1.0, [0.0, 0.0], pin),
            Rod("rod", 1.0, pin, end),
            Body("slider", 1.0, 1e-3, end),
            ej.joints.Revolute("shaft", "ground", "crank", [0.0, 0.0]),
            ej.joints.Revolute("big end", "crank", "rod", [R / 2, 0.0]),
            ej.joints.Revolute("small end", "slider", "rod", [0.0, 0.0]),
            ej.joints.Prismatic("guide", "ground", "slider", axis=[1.0, 0.0]),
            ej.forces.Damper("damper", "ground", "slider", DAMPING, [2.0, 0.0]),
            ej.drives.Angle("motor", "ground", "crank", constant_speed),
        ],
        gravity=[0.0, -9.81],
        args=dict(speed=SPEED),
    )


def stroke(t):
    """Where the slider is."""
    angle = SPEED * t
    return R * jnp.cos(angle) + jnp.sqrt(L**2 - (R * jnp.sin(angle)) ** 2)


def energy(t):
    """Of rods of 1 kg and a slider of 1 kg, from their places alone."""

    def places(t):
        angle = SPEED * t
        tip = R * jnp.array([jnp.cos(angle), jnp.sin(angle)])
        pin = jnp.stack([stroke(t), 0.0 * t])
        tilt = jnp.arcsin(-tip[1] / L)
        turns = jnp.array([R * angle, L * tilt]) / np.sqrt(12)
        return jnp.concatenate([tip / 2, (tip + pin) / 2, pin, turns])

    rates = jax.jacfwd(places)(t)
    return 0.5 * rates @ rates + 9.81 * (places(t)[1] + places(t)[3])


@functools.cache
def crank_run():
    scene = driven_slider_crank()
    system, start, args = scene.build()
    run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=5e-4, num_steps=400)
    return (
        scene,
        on_host(run),
        scene.reaction(run, "motor"),
        scene.multipliers(run, "motor"),
    )


@pytest.mark.slow
def test_a_driven_slider_crank_moves_as_its_closed_form():
    scene, run, *_ = crank_run()
    t = jnp.asarray(run.ts)
    # Solver: nothing is left to be integrated.
    near = functools.partial(np.testing.assert_allclose, rtol=0)
    near(scene.angle(run.ys, "crank"), SPEED * t, atol=1e-12)
    near(scene.position(run.ys, "slider")[:, 0], stroke(t), atol=1e-12)
    speed = jax.vmap(jax.grad(stroke))(t)
    near(scene.velocity(run.ys, "slider")[:, 0], speed, atol=1e-10)
    near(run.audit.energy, jax.vmap(energy)(t), atol=1e-10)


@pytest.mark.slow
def test_the_motor_of_a_slider_crank_gives_what_its_energy_and_the_damper_take():
    _, run, reaction, multipliers = crank_run()
    leak = np.diff(run.audit.energy) - run.audit.work[1:] - run.audit.drive_work[1:]
    assert np.max(np.abs(leak)) <= 1e-12  # solver, of an energy of 30
    assert np.all(run.audit.work <= 0)
    middle = jnp.asarray(run.ts[1:] + run.ts[:-1]) / 2
    power = jax.vmap(jax.grad(energy))(middle)
    power = power + DAMPING * jax.vmap(jax.grad(stroke))(middle) ** 2
    torque = reaction.torque[1:, 0]
    # Truncation, C h^2, of torques up to 60: means over steps.
    np.testing.assert_allclose(torque, power / SPEED, rtol=0, atol=0.05)
    np.testing.assert_array_equal(multipliers[1:, 0], -torque)


@pytest.mark.slow
def test_the_motor_of_a_crank_gives_what_gravity_and_a_brake_take():
    parts = [
        Rod("crank", 1.0, [0.0, 0.0], [2 * R, 0.0]),
        ej.joints.Revolute("shaft", "ground", "crank", [0.0, 0.0]),
        ej.forces.TorsionDamper("brake", "ground", "crank", DAMPING),
        ej.drives.Angle("motor", "ground", "crank", constant_speed),
    ]
    scene = ej.Scene(parts, [0.0, -9.81], dict(speed=SPEED))
    system, start, args = scene.build()
    run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=5e-4, num_steps=200)
    audit = run.audit
    angle = SPEED * np.asarray(run.ts)
    np.testing.assert_allclose(scene.angle(run.ys, "crank"), angle, rtol=0, atol=1e-12)
    height = R * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    near = functools.partial(np.testing.assert_allclose, rtol=0, atol=1e-12)  # solver
    near(scene.position(run.ys, "crank"), height)
    near(np.diff(audit.energy) - audit.work[1:] - audit.drive_work[1:], 0)
    near(np.diff(audit.energy), 9.81 * np.diff(height[:, 1]))
    torque = scene.reaction(run, "motor").torque[1:, 0]
    middle = SPEED * np.asarray(run.ts[1:] + run.ts[:-1]) / 2
    # The means of a step, in closed form. The turning rate of a step is the tangent of half
    # its angle (the Cayley map), and the brake takes its square; the motor's power is its
    # torque by the angle that it drives.
    half = SPEED * 5e-4 / 2
    rate = np.tan(half) / half * SPEED
    gravity = 9.81 * R * np.cos(middle) * np.sin(half) / half
    expected = gravity + DAMPING * rate**2 / SPEED
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-9)  # solver
    np.testing.assert_array_equal(scene.multipliers(run, "motor")[1:, 0], -torque)


@pytest.mark.slow
def test_drives_lead_points_along_their_paths():
    """In the plane: a place, a distance, and a slide along an axis that turns itself."""
    circle = lambda t, args: jnp.stack([jnp.cos(2 * t), args["r"] * jnp.sin(2 * t)])
    ram = lambda t, args: 2 + args["r"] * jnp.sin(3 * t)
    parts = [
        ej.bodies.PointMass("bead", 1.0, [1.0, 0.0]),
        ej.bodies.PointMass("load", 1.0, [2.0, 0.0]),
        Body("arm", 1.0, 0.1, [0.0, 0.0]),
        ej.bodies.PointMass("hand", 1.0, [0.5, 0.0]),
        ej.joints.Revolute("pin", "ground", "arm"),
        ej.joints.OnCurve("rail", "arm", "hand", lambda x, numbers: x[1:]),
        ej.drives.Position("path", "bead", circle),
        ej.drives.Distance("ram", "ground", "load", ram),
        ej.drives.Angle("motor", "ground", "arm", lambda t, args: t**2),
        ej.drives.Displacement(
            "slide", "arm", "hand", lambda t, args: 0.5 + t, axis=[1.0, 0.0]
        ),
    ]
    scene = ej.Scene(parts, [0.0, -9.81], dict(r=0.3))
    system, start, args = scene.build()
    run = on_host(
        ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=200)
    )
    t = run.ts
    near = functools.partial(np.testing.assert_allclose, rtol=0, atol=1e-11)  # solver
    bead = np.stack([np.cos(2 * t), 0.3 * np.sin(2 * t)], axis=1)
    near(scene.position(run.ys, "bead"), bead)
    rate = np.stack([-2 * np.sin(2 * t), 0.6 * np.cos(2 * t)], axis=1)
    near(scene.velocity(run.ys, "bead"), rate)
    distance = np.linalg.norm(scene.position(run.ys, "load"), axis=1)
    near(distance, 2 + 0.3 * np.sin(3 * t))
    hand = (0.5 + t)[:, None] * np.stack([np.cos(t**2), np.sin(t**2)], axis=1)
    near(scene.position(run.ys, "hand"), hand)
    leak = np.diff(run.audit.energy) - run.audit.drive_work[1:]
    assert np.max(np.abs(leak)) <= 1e-11


@pytest.mark.slow
@pytest.mark.parametrize(
    "body",
    [
        ej.bodies.RigidBody,
        ej.bodies.QuaternionBody,
    ],
)
def test_a_hinge_in_space_is_driven_over_full_turns(body):
    axis = np.array([0.0, 0.6, 0.8])
    scene = ej.Scene(
        [
            body("door", 2.0, [0.3, 0.4, 0.5], [1.0, 0.0, 0.0]),
            ej.joints.Revolute("hinge", "ground", "door", [0.0, 0.0, 0.0], axis=axis),
            ej.drives.Angle("motor", "ground", "door", lambda t, args: 2 * t**2, axis),
        ],
        gravity=[0.0, 0.0, -9.81],
    )
    system, start, args = scene.build()
    run = on_host(
        ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.02, num_steps=150)
    )
    turn = 2 * run.ts**2  # almost three turns
    side = np.cross(axis, [1.0, 0.0, 0.0])
    place = np.outer(np.cos(turn), [1.0, 0.0, 0.0]) + np.outer(np.sin(turn), side)
    np.testing.assert_allclose(scene.position(run.ys, "door"), place, rtol=0, atol=1e-11)
    leak = np.diff(run.audit.energy) - run.audit.drive_work[1:]
    assert np.max(np.abs(leak)) <= 1e-11 * np.max(run.audit.kinetic)


def test_scenes_without_forces_and_drives_have_neither():
    parts = [Rod("rod", 1.0, [0, 0], [1, 0]), ej.joints.Revolute("pin", "ground", "rod")]
    spring = ej.forces.TorsionSpring("coil", "ground", "rod", 1.0)
    system = ej.Scene([parts[0], spring]).system
    assert system.force is None
    assert system.driven is None
    assert not system.is_timed
