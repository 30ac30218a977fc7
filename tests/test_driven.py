"""Constraints that depend on time: order, both levels, and the work of the drive."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import enerjax as ej

from .driven_pendulum import (
    ARGS,
    DRIVEN_PENDULUM,
    driven_start,
    kinetic,
    pivot,
    potential,
    SCHEMES,
)
from .helpers import follow, long, slopes


T0, T1 = 0.2, 2.2


@functools.cache
def driven_reference():
    """Of the angle from +y, seen from the pivot: its acceleration acts as a force."""
    r, w, g = (ARGS[name] for name in "rwg")
    rates = lambda t, y: [
        y[1],
        -g * np.sin(y[0]) + r * w**2 * np.sin(w * t) * np.cos(y[0]),
    ]
    run = solve_ivp(rates, (T0, T1), [np.pi / 2, 0.0], "DOP853", rtol=1e-13, atol=1e-14)
    angle = run.y[0, -1]
    return np.array([np.sin(angle) + r * np.sin(w * T1), np.cos(angle)])


@pytest.mark.parametrize(
    "scheme", long(SCHEMES, "preserving gonzalez", "consistent damped")
)
@pytest.mark.slow_for("decaying", "consistent")
def test_a_pendulum_on_a_moving_pivot(scheme):
    method, order = SCHEMES[scheme]
    start = driven_start()
    found, leaks = [], []
    for n in (50, 100):
        h = (T1 - T0) / n
        state, leak, _ = follow(DRIVEN_PENDULUM, method, start, ARGS, h=h, steps=n, t0=T0)
        found.append(np.max(np.abs(state.q - driven_reference())))
        leaks.append(float(leak))
    np.testing.assert_allclose(slopes(found), order, atol=0.25)
    # Solver, against a turnover of 15; a composition adds up its stages.
    assert max(leaks) <= 1e-12


@functools.cache
def driven_run(every=1):
    return ej.simulate(
        DRIVEN_PENDULUM,
        ej.EnergyDecaying(1.0),
        driven_start(),
        ARGS,
        h=0.02,
        num_steps=100,
        t0=T0,
        saveat=ej.SaveAt(every=every),
    )


def test_both_levels_hold_at_the_times_of_the_rows():
    run = driven_run()
    np.testing.assert_allclose(run.ts, T0 + 0.02 * np.arange(101), rtol=1e-14)
    r, w, t = ARGS["r"], ARGS["w"], np.asarray(run.ts)
    at = r * np.stack([np.sin(w * t), 0 * t], axis=1)
    rate = r * w * np.stack([np.cos(w * t), 0 * t], axis=1)
    rod, slip = run.ys.q - at, run.ys.v - rate
    # Solver.
    assert np.max(np.abs(np.linalg.norm(rod, axis=1) - 1)) <= 1e-13
    assert np.max(np.abs(np.sum(rod * slip, axis=1))) <= 1e-12
    assert np.max(np.abs(run.audit.constraint)) <= 1e-13
    assert np.max(np.abs(run.audit.constraint_rate)) <= 1e-12


def test_both_levels_hold_within_steps_too():
    ts = jnp.array([0.213, 0.2777, 0.301])
    run = ej.simulate(
        DRIVEN_PENDULUM,
        ej.EnergyPreserving(),
        driven_start(),
        ARGS,
        h=0.05,
        t0=T0,
        t1=T0 + 0.15,
        saveat=ej.SaveAt(ts=ts),
    )
    at = ARGS["r"] * np.stack([np.sin(ARGS["w"] * ts), 0 * ts], axis=1)
    # Solver.
    assert np.max(np.abs(np.linalg.norm(run.ys.q - at, axis=1) - 1)) <= 1e-13
    assert np.max(np.abs(run.audit.constraint_rate)) <= 1e-12


def test_the_energy_balance_includes_the_work_of_the_drive():
    audit = driven_run().audit
    change = audit.work + audit.drive_work - audit.dissipated
    leak = np.diff(audit.energy) - change[1:]
    # Solver, against a turnover of 15.
    assert np.max(np.abs(leak)) <= 1e-12
    assert np.max(audit.drive_work) > 0.1
    assert np.all(audit.work == 0)


@pytest.mark.slow
def test_rows_further_apart_sum_the_work():
    run, thin = driven_run(), driven_run(every=5)
    sums = run.audit.drive_work[1:].reshape(-1, 5).sum(axis=1)
    np.testing.assert_allclose(thin.audit.drive_work[1:], sums, rtol=0, atol=1e-12)


# Closed forms --------------------------------------------------------------------------


def bead_on_line(q, t, args):
    turned = args["w"] * t
    return jnp.array([q[1] * jnp.cos(turned) - q[0] * jnp.sin(turned)])


def test_a_bead_on_a_rod_of_prescribed_angle():
    """`r = cosh(w t)`; the drive brings in what the bead gains."""
    bead = ej.System(jnp.eye(2), lambda q, args: 0.0 * q[0], driven=bead_on_line)
    args, t1, scheme = dict(w=2.0), 1.0, ej.EnergyConsistent(0.0)
    start = ej.initial_state(bead, [1.0, 0.0], [0.0, 2.0], args)
    run = ej.simulate(bead, scheme, start, args, h=t1 / 50, num_steps=50)
    radius, rate = np.cosh(2 * t1), 2 * np.sinh(2 * t1)
    truth = radius * np.array([np.cos(2 * t1), np.sin(2 * t1)])
    # Truncation, of order 4.
    np.testing.assert_allclose(run.ys.q[-1], truth, rtol=0, atol=1e-5)
    gained = 0.5 * (rate**2 + (2 * radius) ** 2) - 2.0
    np.testing.assert_allclose(run.audit.drive_work.sum(), gained, rtol=1e-5)


def test_multipliers_stand_in_the_order_of_joints_then_drives():
    """A weight on a lift between walls: wall and floor bear what they must."""
    lift = ej.System(
        kinetic,
        potential,
        lambda q, args: jnp.array([q[0] - 1.0]),
        driven=lambda q, t, args: jnp.array([q[1] - args["r"] * jnp.sin(args["w"] * t)]),
        force=lambda q, v, t, args: jnp.array([3.0, -0.5]) * t,
    )
    t, (m, g, r, w) = 0.7, (ARGS[name] for name in "mgrw")
    height, speed = r * np.sin(w * t), r * w * np.cos(w * t)
    start = ej.consistent_start(lift, [1.0, height], [0.0, 0.0], ARGS, t=t)
    np.testing.assert_allclose(start.state.v, [0.0, speed], atol=1e-14)
    lifted = -r * w**2 * np.sin(w * t)
    np.testing.assert_allclose(start.accelerations, [0.0, lifted], atol=1e-13)
    # The force of a constraint is minus its multiplier.
    floor = m * (lifted - g) + 0.5 * t
    np.testing.assert_allclose(start.multipliers, [3.0 * t, -floor], atol=1e-12)


@pytest.mark.slow
def test_a_top_on_a_lift_moves_like_one_with_an_inertial_force():
    """Driven at its joint, and at rest under the force that a lift's frame adds."""
    system, start, args = ej.problems.heavy_top()
    top: Any = system
    lift = lambda t: 0.05 * jnp.sin(40.0 * t)
    up, shape = jnp.eye(6)[2], dict(kinetic=top.kinetic, potential=top.potential)
    shape["kinematics"] = top.kinematics.matrix
    shape["coordinate_constraint"] = top.coordinate_constraint
    moved = ej.System(
        driven=lambda q, t, args: top.constraint(q, args) - lift(t) * up[:3],
        **shape,
    )
    push = lambda q, v, t, args: -args["m"] * jax.grad(jax.grad(lift))(t) * up
    still = ej.System(constraint=top.constraint, force=push, **shape)
    rising = ej.State(start.q, start.v + 2.0 * up)
    differences = []
    for n in (25, 50):
        numbers = dict(h=0.05 / n, steps=n)
        scheme = ej.EnergyPreserving()
        one, leak, _ = follow(moved, scheme, rising, args, **numbers)
        other, _, _ = follow(still, scheme, start, args, **numbers)
        differences.append(np.max(np.abs(one.q - lift(0.05) * jnp.eye(7)[2] - other.q)))
        # Solver, against an energy of 5436.
        assert leak <= 1e-9
    # Both of order 2, with different errors.
    np.testing.assert_allclose(slopes(differences), 2, atol=0.2)
    assert differences[-1] <= 1e-3


def arm_kinetic(q, qdot, args):
    """Of a double pendulum of unit rods and masses, in its angles from +y."""
    a, b = qdot
    return 0.5 * (2 * a**2 + b**2) + jnp.cos(q[1] - q[0]) * a * b


def arm_potential(q, args):
    return -9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damping", "order"), [pytest.param(0.3, 2, marks=pytest.mark.slow), (0.0, 4)]
)
def test_an_arm_with_a_motor_and_a_damper_in_its_joints(damping, order):
    """In angles, with varying inertia; the damper limits the order."""
    arm = ej.System.from_lagrangian(
        arm_kinetic,
        arm_potential,
        driven=lambda q, t, args: q[:1] - 0.4 * jnp.sin(3 * t),
        force=None if damping == 0 else lambda q, qdot, t, args: -damping * qdot,
    )

    def rates(t, y):
        a, da, dda = 0.4 * np.sin(3 * t), 1.2 * np.cos(3 * t), -3.6 * np.sin(3 * t)
        swirl = np.cos(y[0] - a) * dda + np.sin(y[0] - a) * da**2
        return [y[1], -damping * y[1] - 9.81 * np.sin(y[0]) - swirl]

    run = solve_ivp(rates, (0, 1.5), [0.5, 0.0], "DOP853", rtol=1e-13, atol=1e-14)
    truth = np.array([0.4 * np.sin(4.5), run.y[0, -1]])
    start = ej.State([0.0, 0.5], [1.2, 0.0])
    found = []
    for n in (50, 100):
        scheme = ej.EnergyConsistent(0.0)
        state, leak, _ = follow(arm, scheme, start, None, h=1.5 / n, steps=n)
        found.append(np.max(np.abs(state.q - truth)))
        # Solver, against an energy of 29.
        assert leak <= 1e-12
    np.testing.assert_allclose(slopes(found), order, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["preserving", "decaying"])
def test_a_large_system_is_driven_and_damped(scheme):
    """A chain on a moving pivot, in a medium: 40 links, solved by bands."""
    chain, _, args = ej.problems.chain(40)
    links: Any = chain
    args = args | dict(r=0.1, w=4.0)

    def top(q, t, args):
        link = q[:2] - pivot(t, args)
        return jnp.array([link @ link - args["l"][0] ** 2])

    system = ej.System(
        links.kinetic,
        links.potential,
        lambda q, args: links.constraint(q, args)[1:],
        force=lambda q, v, t, args: -0.02 * v * jnp.repeat(args["m"], 2),
        driven=top,
    )
    hanging = jnp.stack([jnp.zeros(40), jnp.arange(1.0, 41.0) / 40], axis=1)
    with_pivot = jnp.tile(jnp.array([0.4, 0.0]), 40)
    start = ej.initial_state(system, hanging.ravel(), with_pivot, args)
    method, _ = SCHEMES[scheme]
    run = ej.simulate(system, method, start, args, h=0.005, num_steps=60)
    change = run.audit.work + run.audit.drive_work - run.audit.dissipated
    # Solver, against a turnover of 10.
    assert np.max(np.abs(np.diff(run.audit.energy) - change[1:])) <= 1e-12
    assert np.max(np.abs(run.audit.constraint)) <= 1e-13
    assert np.max(np.abs(run.audit.constraint_rate)) <= 1e-12
    assert np.min(run.audit.work[1:]) < 0
    assert np.max(np.abs(run.audit.drive_work)) > 1e-6
