"""Servos and measures of parts, against minimal coordinates and by hand."""

import functools
import inspect
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import enerjax as ej

from .helpers import slopes


Rod = ej.bodies.PlanarBody.rod


def force_of(seen):
    assert seen.force is not None
    return seen.force


def servo(view, t, args):
    return args["p"] * (args["aim"] - view.angle("arm")) - args["d"] * view.rate("pin")


def arm():
    """A rod of 1 kg and 1 m that a servo lifts on its pin, from below."""
    return ej.Scene(
        [
            Rod("arm", 1.0, [0.0, 0.0], [0.0, -1.0]),
            ej.joints.Revolute("pin", "ground", "arm", [0.0, 0.0]),
            ej.forces.TorsionActuator("motor", "ground", "arm", servo),
        ],
        gravity=[0.0, -9.81],
        args=dict(p=40.0, d=4.0, aim=0.5),
    )


@pytest.mark.slow
def test_a_servo_moves_an_arm_as_in_its_minimal_coordinate():
    scene = arm()
    system, start, args = scene.build()

    def torque(angle, rate):
        return 40.0 * (0.5 - angle) - 4.0 * rate

    def rates(_, y):
        return [y[1], (torque(*y) - 9.81 * 0.5 * np.cos(y[0])) * 3]

    exact = solve_ivp(rates, (0, 2), [-np.pi / 2, 0.0], rtol=1e-11, atol=1e-12).y[:, -1]
    error = []
    for n in (200, 400):
        run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=2 / n, num_steps=n)
        seen = scene.measure(run, "motor")
        error.append(abs(seen.value[-1] - exact[0]) + abs(seen.rate[-1] - exact[1]))
        energy, work = run.audit.energy, run.audit.work
        # Solver and round-off, of an energy of 5.
        assert np.max(np.abs(np.diff(energy) - work[1:])) <= 1e-12
        given = torque(seen.value, seen.rate)
        np.testing.assert_allclose(force_of(seen), given, rtol=0, atol=1e-12)
        pin = scene.measure(run, "pin")
        np.testing.assert_array_equal(pin.value, scene.angle(run.ys, "arm"))
        assert pin.force is None
    assert error[1] <= 1e-5  # truncation
    assert slopes(error)[0] == pytest.approx(2, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("body", [ej.bodies.RigidBody, ej.bodies.QuaternionBody])
def test_a_hinge_in_space_counts_its_turns(body):
    """A constant torque, and one that falls with the rate; rows are more than a turn
    apart."""
    axis, inertia, torque, first = np.array([0.6, 0.0, 0.8]), 0.4, 1.2, 2.0
    law = lambda view, t, args: torque - args["c"] * view.rate("hinge")
    scene = ej.Scene(
        [
            body("disc", 2.0, [inertia] * 3, [0.0] * 3, angular_velocity=-first * axis),
            ej.joints.Revolute("hinge", "ground", "disc", [0.0] * 3, axis=axis),
            ej.forces.TorsionActuator("motor", "ground", "disc", law, axis),
        ],
        args=dict(c=0.0),
    )
    system, start, args = scene.build()
    simulate = functools.partial(
        ej.simulate, h=2e-3, num_steps=2500, saveat=ej.SaveAt(every=500)
    )
    near = functools.partial(np.testing.assert_allclose, rtol=0, atol=2e-3)  # truncation
    for c in (0.0, 0.1):
        now = args.set(c=c)
        run = simulate(system, ej.EnergyPreserving(), start, now)
        t = np.asarray(run.ts)
        rate, turn = torque / inertia * t - first, torque / inertia * t**2 / 2 - first * t
        if c:
            fall, last = np.exp(-c / inertia * t), torque / c
            rate = last - (last + first) * fall
            turn = last * t - (last + first) * (1 - fall) * inertia / c
        assert np.max(np.abs(np.diff(turn))) > 2 * np.pi
        for name in ("hinge", "motor"):
            seen = scene.measure(run, name, now)
            near(seen.value, turn)
            near(seen.rate, rate)
        given = torque - c * seen.rate
        np.testing.assert_allclose(force_of(seen), given, rtol=0, atol=1e-13)
        # Of a state alone full turns are not known.
        alone = scene.measure(ej.State(run.ys.q[-1], run.ys.v[-1]), "hinge", now).value
        assert abs(alone) <= np.pi
        near([np.cos(alone), np.sin(alone)], [np.cos(turn[-1]), np.sin(turn[-1])])


def test_turns_between_rows_are_counted_with_the_mean_rate():
    """Rows of a motion under a constant torque, in which the rate gains 20 per row."""
    disc = ej.bodies.RigidBody("disc", 2.0, [0.4] * 3, [0.0] * 3)
    hinge = ej.joints.Revolute("hinge", "ground", "disc", [0.0] * 3, axis=[0.0, 0.0, 1.0])
    scene = ej.Scene([disc, hinge])
    ts = np.arange(5.0)
    turns, rates = 10 * ts**2 - 3 * ts, 20 * ts - 3
    bodies = [
        ej.bodies.RigidBody(
            "disc", 2.0, [0.4] * 3, [0.0] * 3, [np.cos(a / 2), 0.0, 0.0, np.sin(a / 2)],
            angular_velocity=[0.0, 0.0, rate],
        )
        for a, rate in zip(turns, rates, strict=True)
    ]  # fmt: skip
    states = ej.State(np.stack([b.q for b in bodies]), np.stack([b.v for b in bodies]))
    rows = SimpleNamespace(ys=states, ts=ts, multipliers=np.zeros((5, 11)))
    seen = scene.measure(rows, "hinge")  # pyright: ignore
    # Round-off.
    np.testing.assert_allclose(seen.value, turns, rtol=0, atol=1e-12)
    np.testing.assert_allclose(seen.rate, rates, rtol=0, atol=1e-12)


def points():
    """A point at (3, 4) that moves along x, with all that it may hang on; a pendulum."""
    forces, force = ej.forces, lambda view, t, args: args["k"] * view.length("spring") + t
    return ej.Scene(
        [
            ej.bodies.PointMass("dot", 2.0, [3.0, 4.0], [1.0, 0.0]),
            ej.bodies.PointMass("bob", 3.0, [10.0, 0.0], [0.0, 1.0]),
            ej.joints.Distance("tie", "ground", "bob"),
            forces.Spring("spring", "ground", "dot", 10.0, 4.5),
            forces.Damper("damper", "ground", "dot", 2.0, [3.0, 0.0]),
            forces.Damper("other", "ground", "dot", 7.0),
            forces.Actuator("ram", "ground", "dot", force, [0.0, 4.0]),
            forces.Load("drag", "dot", lambda view, t, args: -view.velocity("dot")),
            forces.ConstantForce("pull", "dot", [0.0, 5.0]),
            ej.drives.Displacement(
                "slide", "ground", "dot", lambda t, args: 3 + t, axis=[1.0, 0.0]
            ),
        ],
        args=dict(k=0.4),
    )


@pytest.mark.slow
def test_lengths_and_forces_equal_those_computed_by_hand():
    scene = points()
    start = scene.start()
    near = functools.partial(np.testing.assert_allclose, rtol=1e-13, atol=1e-13)
    for name, value, rate, force in (
        ("spring", 5.0, 0.6, -5.0),
        ("damper", 4.0, 0.0, 0.0),
        ("other", 5.0, 0.6, -4.2),
        ("ram", 3.0, 1.0, 2.5),
        ("drag", [3.0, 4.0], [1.0, 0.0], [-1.0, 0.0]),
        ("pull", [3.0, 4.0], [1.0, 0.0], [0.0, 5.0]),
    ):
        seen = scene.measure(start, name, t=0.5)
        near(seen.value, value)
        near(seen.rate, rate)
        near(force_of(seen), force)
    # All along x that the drive must hold up: it moves without an acceleration.
    held = ej.consistent_start(scene.system, start.q, start.v, scene.args)
    others = -5.0 * 0.6 - 4.2 * 0.6 + 2.0 - 1.0
    near(force_of(scene.measure(held, "slide")), -others)
    near(force_of(scene.measure(held, "tie")), -0.3)
    with pytest.raises(ValueError, match=r"'dot' is no part with a length.*'spring'"):
        scene.measure(start, "dot")


def test_lengths_along_an_axis_in_space():
    """Of a slider that a joint keeps on an oblique axis, and of a point that is led."""
    axis, away = np.array([2.0, -1.0, 2.0]) / 3, np.array([1.0, 2.0, 0.5])
    box = ej.bodies.RigidBody("box", 1.0, [0.3, 0.4, 0.5], 0.7 * axis, velocity=1.5 * axis)
    led = ej.bodies.PointMass("led", 1.0, away, 3 * away)
    drive = lambda t, args: args["far"] * (1 + 3 * t)
    scene = ej.Scene(
        [
            box,
            led,
            ej.joints.Prismatic("guide", "ground", "box", axis=axis),
            ej.drives.Displacement("ram", "ground", "led", drive, axis=axis),
        ],
        args=dict(far=axis @ away),
    )
    start = scene.start()
    far = float(axis @ away)
    for name, value, rate in (("guide", 0.7, 1.5), ("ram", far, 3 * far)):
        seen = scene.measure(start, name)
        # Round-off.
        np.testing.assert_allclose([seen.value, seen.rate], [value, rate], rtol=1e-13)


def test_a_law_of_another_signature_is_refused_by_its_name():
    for part in (ej.forces.TorsionActuator, ej.forces.Actuator):
        with pytest.raises(
            TypeError,
            match=r"of 'motor' must be a function of \(t, args\) or of \(view, t, args\)",
        ):
            part("motor", "ground", "arm", lambda t: t)  # type: ignore
    for law in (
        lambda view, t, args: view.angle("pni"),
        lambda view, t, args: view.length("motor"),
        lambda view, t, args: view.rate("pni"),
    ):
        motor = ej.forces.TorsionActuator("motor", "ground", "arm", law)
        with pytest.raises(ValueError, match="'(pni|motor)' (has no|is no part)"):
            ej.Scene([Rod("arm", 1.0, [0.0, 0.0], [1.0, 0.0]), motor])


@pytest.mark.parametrize("module", [ej.bodies, ej.joints, ej.forces, ej.drives])
def test_modules_of_parts_list_only_parts(module):
    assert dir(module)
    for name in dir(module):
        part = getattr(module, name)
        assert inspect.isclass(part)
        assert not name.startswith("Abstract")
        assert part.__module__.startswith("enerjax.scenes")
        assert "name" in inspect.signature(part).parameters
