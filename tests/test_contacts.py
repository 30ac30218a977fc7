"""Contacts as parts of scenes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax import contacts


GRAVITY = [0.0, -9.81]


def run(parts, gravity, h=0.01, num_steps=120, **options: Any) -> tuple[ej.Scene, Any]:
    scene = ej.Scene(parts, gravity=gravity)
    system, start, args = scene.build()
    options = dict(h=h, num_steps=num_steps, **options)
    return scene, ej.simulate(system, ej.EnergyPreserving(), start, args, **options)


def bar(law):
    """A bar of length 1 that falls from the horizontal onto a stop at -1 rad."""
    return [
        ej.bodies.PlanarBody("bar", 1.0, 0.1, [0.5, 0.0]),
        ej.joints.Revolute("pin", "ground", "bar", [0.0, 0.0]),
        contacts.AngleStop("stop", "ground", "bar", -1.0, law, lower=True),
    ]


# Of the bar about its pin, and its angular velocity at the stop.
INERTIA = 0.1 + 0.25
SPEED = np.sqrt(2 * 9.81 * 0.5 * np.sin(1.0) / INERTIA)


@pytest.mark.slow
def test_a_bar_hits_a_stop_and_comes_to_rest():
    scene, sol = run(bar(contacts.Restitution(0.5)), GRAVITY, num_steps=160)
    count = int(sol.events.count)
    # In minimal coordinates each hit leaves half of the speed.
    before = np.asarray(sol.events.before.v[: count - 1, 2])
    np.testing.assert_allclose(before, -SPEED * 0.5 ** np.arange(count - 1), rtol=1e-11)
    assert np.asarray(sol.events.closed[:count, 0]).tolist() == [False] * (count - 1) + [
        True
    ]
    # The stop carries the moment of the weight; its force is a torque.
    moment = 9.81 * 0.5 * np.cos(1.0)
    np.testing.assert_allclose(sol.events.contact_forces[-1, 0], moment, rtol=1e-9)
    np.testing.assert_allclose(sol.audit.impact.sum(), 9.81 * 0.5 * np.sin(1), rtol=1e-12)
    assert np.abs(sol.audit.leak).max() < 1e-13
    gap = scene.measure(sol, "stop")
    assert gap.value.min() > -1e-14
    assert sol.multipliers.shape[1] == 2  # of the pin alone


@pytest.mark.slow
def test_elastic_hits_of_a_sphere_in_a_bowl_keep_the_energy():
    parts = [
        ej.bodies.RigidBody("ball", 1.0, [0.1, 0.1, 0.1], [0.3, 0.0, 0.2]),
        contacts.OnSphere(
            "bowl", "ground", "ball", contacts.Restitution(), 1.0, 0.2, inside=True
        ),
    ]
    scene, sol = run(parts, [0.0, 0.0, -9.81], num_steps=200)
    assert int(sol.events.count) > 3
    assert np.abs(sol.audit.energy - sol.audit.energy[0]).max() < 1e-12  # round-off
    centre = np.asarray(scene.position(sol.ys, "ball"))
    assert np.linalg.norm(centre, axis=1).max() < 0.8 + 1e-13
    # The hits are in the plane of the start.
    assert np.abs(centre[:, 1]).max() < 1e-14


@pytest.mark.slow
def test_a_penalty_has_an_exact_balance_and_approaches_the_impact():
    law = contacts.Penalty(1e5, exponent=1.5, damping=0.2)
    scene, sol = run(bar(law), GRAVITY, h=1e-3, num_steps=900)
    assert sol.events is None
    assert np.abs(sol.audit.leak).max() < 1e-12  # round-off
    # Dampers act in the contact only, and remove energy.
    damped = np.asarray(sol.audit.damped)
    assert damped.min() >= 0
    assert np.all(damped[1:][np.asarray(scene.measure(sol, "stop").value)[1:] > 1e-3] == 0)
    # Hertz: the deepest penetration d with k d^2.5/2.5 about the energy of the hit.
    energy = 0.5 * INERTIA * SPEED**2
    deepest = -scene.measure(sol, "stop").value.min()
    assert 0.8 < deepest / (2.5 * energy / 1e5) ** 0.4 < 1.0


def test_a_penalty_without_a_damper_is_a_potential():
    """Compositions, some of whose stages go back in time, can be used with it."""
    law, scheme = contacts.Penalty(1e5, exponent=5.0), ej.Composed(ej.EnergyPreserving(), 4)
    system, start, args = ej.Scene(bar(law), gravity=GRAVITY).build()
    assert system.force is None
    ends = [
        ej.simulate(system, scheme, start, args, h=0.9 / n, num_steps=n).ys.q[-1]
        for n in (225, 450, 900)
    ]
    # Truncation, of order 4: with this exponent the force is smooth enough.
    assert jnp.linalg.norm(ends[1] - ends[0]) > 8 * jnp.linalg.norm(ends[2] - ends[1])


def test_the_integer_one_is_an_elastic_impact():
    built = [ej.Scene(bar(contacts.Restitution(*x))).build() for x in ((), (1,), (1.0,))]
    one, default, number = built
    assert jax.tree.structure(one) == jax.tree.structure(default)
    assert jax.tree.structure(one) != jax.tree.structure(number)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: bar(0.5), "`law` of 'stop' must be"),
        (lambda: bar(contacts.Restitution(1.5)), "1 - `coefficient`"),
        (lambda: bar(contacts.Restitution(-0.5)), "`coefficient` of 'stop'"),
        (lambda: bar(contacts.Penalty(0.0)), "`stiffness` of 'stop'"),
        (lambda: bar(contacts.Penalty(1.0, 0.5)), "`exponent` of 'stop'"),
    ],
)
def test_wrong_contacts_are_refused(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        ej.Scene(make(), gravity=GRAVITY)


def test_step_refuses_a_system_with_events():
    system, start, args = ej.Scene(bar(contacts.Restitution()), gravity=GRAVITY).build()
    with pytest.raises(ValueError, match="does not look for events"):
        ej.step(system, ej.EnergyPreserving(), start, args, h=0.01)


@pytest.mark.slow
def test_the_restitution_of_a_contact_is_found_from_bounces():
    system, start, args = ej.Scene(
        [
            ej.bodies.PointMass("ball", 1.0, [0.0, 1.0]),
            contacts.OnPlane("floor", "ground", "ball", [0, 1], contacts.Restitution(0.8)),
        ],
        gravity=GRAVITY,
    ).build()

    def height(e):
        changed = args.set("floor", restitution=e)
        scheme = ej.EnergyPreserving()
        sol = ej.simulate(system, scheme, start, changed, h=0.01, t1=1.0, max_steps=100)
        return sol.ys.q[-1, 1]

    value, slope = jax.jit(lambda e: jax.jvp(height, (e,), (jnp.ones(()),)))(0.8)
    first = np.sqrt(2 / 9.81)
    since = 1 - first
    np.testing.assert_allclose(
        value, 0.8 * 9.81 * first * since - 4.905 * since**2, rtol=1e-12
    )
    np.testing.assert_allclose(slope, 9.81 * first * since, rtol=1e-12)


@pytest.mark.slow
def test_a_thousand_elastic_hits_of_a_slider_crank_keep_the_energy():
    parts = [
        ej.bodies.PlanarBody(
            "crank", 1.0, 0.02, [0.0, 0.15], angle=0.5 * np.pi, angular_velocity=-10.0
        ),
        ej.bodies.PlanarBody("rod", 1.0, 0.05, [0.2, 0.15], angle=-np.arctan2(0.3, 0.4)),
        ej.bodies.PlanarBody("slider", 2.0, 0.01, [0.4, 0.0]),
        ej.joints.Revolute("shaft", "ground", "crank", [0.0, 0.0]),
        ej.joints.Revolute("big end", "crank", "rod", point_a=[0.15, 0.0]),
        ej.joints.Revolute("small end", "rod", "slider", point_b=[0.0, 0.0]),
        ej.joints.Prismatic("guide", "ground", "slider", axis=[1.0, 0.0]),
        contacts.SlideStop(
            "stop", "ground", "slider", 0.55, contacts.Restitution(), axis=[1.0, 0.0]
        ),
    ]
    _, sol = run(parts, GRAVITY, h=2e-3, num_steps=150000, max_events=4000)
    audit = sol.audit
    assert int(sol.events.count) > 1000
    # Round-off of all steps.
    assert np.abs(audit.energy - audit.energy[0]).max() < 1e-10
    assert np.abs(audit.constraint).max() < 1e-12
    assert np.abs(audit.constraint_rate).max() < 1e-11
