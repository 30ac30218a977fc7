"""Dampers, actuators and loads of scenes: closed forms, and energy that only falls."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import follow, on_host, slopes


Body, Rod = ej.bodies.PlanarBody, ej.bodies.PlanarBody.rod


def wheel():
    """A flywheel on a pin, with a spring and a damper about its angle."""
    return ej.Scene(
        [
            Body("wheel", 1.0, 1.0, [0.0, 0.0], 1.0, angular_velocity=1.0),
            ej.joints.Revolute("pin", "ground", "wheel"),
            ej.forces.TorsionSpring("coil", "ground", "wheel", 1.0, 0.0),
            ej.forces.TorsionDamper("brake", "ground", "wheel", 1.0),
        ]
    )


OMEGA = np.logspace(-3, 4, 8)


@pytest.mark.parametrize(
    "scheme",
    [
        ej.EnergyPreserving(),
        ej.EnergyDecaying(0.5),
        ej.EnergyDecaying(0.0),
        ej.EnergyDecaying(1.0),
    ],
)
@pytest.mark.slow_for("scheme1", "scheme2", "scheme3")
def test_a_torsion_damper_never_creates_energy_in_steps_of_any_length(scheme):
    """`h = 1` and frequencies from 1e-3 to 1e4; critical dampers and weak ones."""
    system, start, args = wheel().build()

    def run(omega, share):
        numbers = args.set("coil", stiffness=omega**2)
        numbers = numbers.set("brake", damping=2 * share * omega)
        _, leak, most = follow(system, scheme, start, numbers, h=1.0, steps=20)
        return leak / (1 + omega**2), most / (1 + omega**2)

    omega, share = (jnp.asarray(x.ravel()) for x in np.meshgrid(OMEGA, [0.01, 1.0, 50.0]))
    leak, most = jax.vmap(run)(omega, share)
    # Solver, and round-off of the work, against the energy of the start.
    assert np.max(leak) <= 1e-11
    assert np.max(most) <= 1e-15


def damped_pendulum(damping):
    """Two rods; a damper from the ground to the end, whose direction turns."""
    return ej.Scene(
        [
            Rod("upper", 1.0, [0.0, 0.0], [1.0, 0.0]),
            Rod("lower", 1.0, [1.0, 0.0], [1.0, -1.0]),
            ej.joints.Revolute("shoulder", "ground", "upper", [0.0, 0.0]),
            ej.joints.Revolute("elbow", "upper", "lower", [0.5, 0.0]),
            ej.forces.Damper("damper", "ground", "lower", damping, [3.0, 1.0], [0.5, 0.0]),
        ],
        gravity=[0.0, -9.81],
    )


@pytest.mark.parametrize(
    "scheme",
    [
        ej.EnergyPreserving(),
        pytest.param(ej.EnergyConsistent(0.5), marks=pytest.mark.slow),
    ],
)
@pytest.mark.slow_for("scheme0")
def test_a_turning_damper_removes_energy_in_every_step(scheme):
    system, start, args = damped_pendulum(1.0).build()

    def run(h, damping):
        numbers = args.set("damper", damping=damping)
        return follow(system, scheme, start, numbers, h=h, steps=60)[1:]

    h, damping = (x.ravel() for x in jnp.meshgrid(jnp.array([0.01, 0.05]), OMEGA[2:6]))
    leak, most = jax.vmap(run)(h, damping)
    # Solver, against a turnover of 20.
    assert np.max(leak) <= 1e-11
    assert np.max(most) <= 0


def test_dampers_have_the_stated_power():
    system, start, args = damped_pendulum(2.0).build()
    v = ej.initial_state(system, start.q, [0, 0.5, 1, 1, 0, -2], args).v
    assert system.force is not None
    power = v @ system.force(start.q, v, jnp.array(0.0), args)
    scene, state = damped_pendulum(2.0), ej.State(start.q, v)
    away = np.array([3.0, 1.0]) - scene.position(state, "lower", [0.5, 0.0])
    rate = -away @ scene.velocity(state, "lower", [0.5, 0.0]) / np.linalg.norm(away)
    assert float(power) == pytest.approx(-2.0 * float(rate) ** 2, rel=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    "body",
    [
        ej.bodies.RigidBody,
        ej.bodies.QuaternionBody,
    ],
)
def test_a_hinge_with_a_damper_in_space_slows_down_exponentially(body):
    """Over more than half a turn, where the angle itself jumps."""
    axis, inertia, c, t = np.array([0.6, 0.0, 0.8]), 0.4, 0.3, 1.0
    scene = ej.Scene(
        [
            body("disc", 2.0, [inertia] * 3, [0.0, 0.0, 0.0], angular_velocity=8 * axis),
            ej.joints.Revolute("hinge", "ground", "disc", [0.0, 0.0, 0.0], axis=axis),
            ej.forces.TorsionDamper("brake", "ground", "disc", c, axis),
        ]
    )
    system, start, args = scene.build()
    error = []
    for n in (25, 50):
        state, leak, most = follow(
            system, ej.EnergyPreserving(), start, args, h=t / n, steps=n
        )
        energy = float(system.kinetic_energy(state, args))
        error.append(abs(energy - 12.8 * np.exp(-2 * c / inertia * t)))
        assert float(leak) <= 1e-12
        assert float(most) < 0
    assert error[1] <= 2e-3  # truncation
    assert slopes(error)[0] == pytest.approx(2, abs=0.1)


def pushed():
    """Four independent bodies, each with its own force."""
    swing = lambda t, args: args["force"] * jnp.sin(3 * t)
    vector = lambda t, args: jnp.stack([0 * t, args["force"] * t])
    return ej.Scene(
        [
            Body("wheel", 1.0, 0.5, [0.0, 0.0]),
            ej.bodies.PointMass("cart", 2.0, [5.0, 0.0]),
            ej.bodies.PointMass("stone", 2.0, [0.0, 1.0]),
            Body("rocket", 2.0, 0.5, [0.0, 2.0], angular_velocity=3.0),
            ej.forces.TorsionActuator("motor", "ground", "wheel", swing),
            ej.forces.Actuator("ram", "ground", "cart", swing, [1.0, 0.0]),
            ej.forces.Load("wind", "stone", vector),
            ej.forces.Follower("thrust", "rocket", lambda t, args: jnp.array([0.8, 0.0])),
        ],
        args=dict(force=0.7),
    )


def test_forces_that_functions_define_follow_closed_forms():
    scene = pushed()
    system, start, args = scene.build()
    run = on_host(
        ej.simulate(system, ej.EnergyPreserving(), start, args, h=2.5e-3, num_steps=800)
    )
    t = run.ts
    sine = 0.7 / 3 * (t - np.sin(3 * t) / 3)
    near = functools.partial(np.testing.assert_allclose, rtol=0, atol=1e-5)  # truncation
    near(scene.angle(run.ys, "wheel"), sine / 0.5)
    near(scene.position(run.ys, "cart")[:, 0], 5 + sine / 2)
    near(scene.position(run.ys, "stone")[:, 1], 1 + 0.7 / 2 * t**3 / 6)
    turn = 0.8 / 2 / 3 * np.stack([np.sin(3 * t), 1 - np.cos(3 * t)], axis=1)
    near(scene.velocity(run.ys, "rocket"), turn)
    # Solver.
    work = np.diff(run.audit.energy) - run.audit.work[1:]
    assert np.max(np.abs(work)) <= 1e-14


def test_work_is_differentiated_with_respect_to_the_numbers_of_a_force():
    swing = lambda t, args: args["force"] * jnp.sin(3 * t)
    cart = ej.bodies.PointMass("cart", 2.0, [5.0, 0.0], [1.0, 0.0])
    ram = ej.forces.Actuator("ram", "ground", "cart", swing)
    system, start, args = ej.Scene([cart, ram], args=dict(force=0.7)).build()

    def work(force):
        numbers = args.set(force=force)
        run = ej.simulate(
            system, ej.EnergyPreserving(), start, numbers, h=0.02, num_steps=50
        )
        return jnp.sum(run.audit.work)

    # Along a line the velocity is 1 + u force, and the work 2 (u force) + (u force)^2.
    slope, u = float(jax.jit(jax.grad(work))(0.7)), (1 - np.cos(3.0)) / 6
    assert slope == pytest.approx(2 * u + 2 * u**2 * 0.7, rel=1e-3)  # truncation


@pytest.mark.parametrize(
    "scheme", [ej.EnergyPreserving(), ej.EnergyDecaying(0.5), ej.EnergyConsistent(0.0)]
)
@pytest.mark.slow_for("scheme1", "scheme2")
def test_an_angle_in_space_that_passes_half_a_turn_is_a_failure(scheme):
    """There the energy of its spring is not smooth; without stiffness nothing happens."""
    axis, ends = [0.0, 0.0, 1.0], ("ground", "rotor")
    rotor = ej.bodies.RigidBody(
        "rotor", 1.0, [1.0, 1.0, 1.0], [0.0, 0.0, 0.0], angular_velocity=[0.0, 0.0, 2.0]
    )
    pin = ej.joints.Revolute("pin", *ends, axis=axis)
    spring = ej.forces.TorsionSpring("coil", *ends, 0.1, axis=axis)
    system, start, args = ej.Scene([rotor, pin, spring]).build()

    def run(stiffness):
        numbers = args.set("coil", stiffness=stiffness)
        sol = ej.simulate(
            system, scheme, start, numbers, h=0.02, num_steps=100, throw=False
        )
        return sol.result, sol.stats.completed_steps

    # The angle is `2/w sin(w t)` with `w^2 = k`, at most `2/w`. Truncation.
    result, completed = jax.vmap(run)(jnp.array([0.0, 0.1, 0.5, 1.0]))
    passes = np.arcsin(0.5 * np.pi * np.sqrt([0.1])) / np.sqrt([0.1])
    assert np.array_equal(completed, [100, passes[0] // 0.02, 100, 100])
    assert list(result == ej.RESULTS.angle_jumped) == [False, True, False, False]
