"""Parts of scenes outside of the package that are written with public names are like all
others."""

import re
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import enerjax as ej

from .helpers import code_of, EPS, HERE, imported
from .third_party_parts import cuboid, Drag, Gravitation, HardeningSpring, Rolling


SLOPE, RADIUS, MASS, INERTIA, G = 0.3, 0.5, 2.0, 0.4, 9.81


def test_they_import_public_names_alone():
    modules = {"enerjax", "enerjax.scenes", "jax", "jax.numpy", "dataclasses"}
    assert imported("third_party_parts.py") == modules


def test_the_tutorial_shows_this_file():
    shown = {block.strip() for block in code_of("write-your-own.md")}
    for part in re.split(r"\n\n\n(?=@dataclass|def )", third_party_source())[1:]:
        assert any(part.strip() in block for block in shown), part


def third_party_source():
    return (HERE / "third_party_parts.py").read_text()


# A joint --------------------------------------------------------------------------------


def incline(off=0.0):
    """A wheel on a slope, at rest at the start."""
    along, normal = [np.cos(SLOPE), -np.sin(SLOPE)], [np.sin(SLOPE), np.cos(SLOPE)]
    centre = (RADIUS + off) * np.array(normal)
    return ej.Scene(
        [
            ej.bodies.PlanarBody("wheel", MASS, INERTIA, centre),
            Rolling("contact", "ground", "wheel", RADIUS, along),
        ],
        gravity=[0.0, -G],
    )


def roll(args=None):
    scene = incline()
    system, start, own = scene.build()
    args = own if args is None else args
    scheme = ej.EnergyConsistent(0.0)  # its steps are those of the angle
    return ej.simulate(system, scheme, start, args, h=0.01, num_steps=50)


def test_a_joint_of_ones_own_moves_and_reacts_as_it_must():
    """A wheel that rolls down a slope has a constant acceleration."""
    scene, sol = incline(), roll()
    acceleration = G * np.sin(SLOPE) / (1 + INERTIA / (MASS * RADIUS**2))
    rolled = acceleration * sol.ts**2 / 2
    angle = scene.measure(sol, "contact")
    # Solver: the scheme is exact for constant accelerations.
    np.testing.assert_allclose(angle.value, -rolled / RADIUS, atol=1e-11)
    np.testing.assert_allclose(angle.rate, -acceleration * sol.ts / RADIUS, atol=1e-11)
    reaction = scene.reaction(sol, "contact")
    friction = INERTIA * acceleration / RADIUS**2
    up, normal = [-np.cos(SLOPE), np.sin(SLOPE)], [np.sin(SLOPE), np.cos(SLOPE)]
    force = friction * np.array(up) + MASS * G * np.cos(SLOPE) * np.array(normal)
    expected = np.broadcast_to(force, (50, 2))
    np.testing.assert_allclose(reaction.force[1:], expected, atol=1e-9)  # solver
    torque = np.full((50, 1), -friction * RADIUS)
    np.testing.assert_allclose(reaction.torque[1:], torque, atol=1e-9)  # solver


def test_its_gap_is_told_and_closed():
    scene = incline(off=1e-3)
    gap = scene.report()["contact"]
    assert gap.position == pytest.approx(1e-3, rel=1e-9)  # round-off
    closed = scene.report(scene.start())["contact"]
    assert closed.position <= 1e3 * EPS  # solver
    assert scene.mobility().degrees_of_freedom == 1
    with pytest.raises(ValueError, match="'contact' is off by"):
        incline(off=0.2)


@pytest.mark.slow
def test_it_is_differentiated_and_mapped():
    """How far the wheel has come, by its inertia, in closed form."""
    args = incline().args

    def height(inertia):
        return roll(args.set("wheel", inertia=inertia)).ys.q[-1, 1]

    def expected(inertia):
        acceleration = G * np.sin(SLOPE) / (1 + inertia / (MASS * RADIUS**2))
        return RADIUS * np.cos(SLOPE) - np.sin(SLOPE) * acceleration * 0.5**2 / 2

    slope = jax.grad(expected)(INERTIA)
    assert jax.grad(height)(INERTIA) == pytest.approx(float(slope), rel=1e-9)  # solver
    inertias = jnp.array([0.2, 0.4])
    lanes = jax.vmap(height)(inertias)
    np.testing.assert_allclose(lanes, expected(inertias), rtol=1e-10)  # solver


@dataclass(frozen=True)
class CrossRows(ej.scenes.AbstractConstraintLaw):
    def __call__(self, a, b, numbers):
        apart = b.point(numbers["point_b"]) - a.point(numbers["point_a"])
        x, y = a.rotation @ numbers["axis_a"], b.rotation @ numbers["axis_b"]
        return jnp.append(apart, x @ y)


class Cross(ej.joints.AbstractJoint):
    """A universal joint."""

    point_a: list[float]
    axis: list[float]
    axis_b: list[float]

    def resolve(self, ends):
        ends.only_in_space("A universal joint")
        axes = dict(axis_a=self.axis, axis_b=self.axis_b)
        return CrossRows(), ends.points(self.point_a, None) | axes


@pytest.mark.slow
def test_a_universal_joint_is_the_built_in_one():
    runs, x, y = [], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    for joint in (Cross, ej.joints.Universal):
        scene = ej.Scene(
            [
                ej.bodies.RigidBody("arm", 1.5, [0.2, 0.3, 0.25], [0.0, 0.3, -0.4]),
                joint("cross", "ground", "arm", [0.0] * 3, axis=x, axis_b=y),
            ],
            gravity=[1.0, 0.0, -G],
        )
        system, start, args = scene.build()
        scheme = ej.EnergyPreserving()
        sol = ej.simulate(system, scheme, start, args, h=0.01, num_steps=50)
        runs.append((sol.ys.q, scene.reaction(sol, "cross")))
        assert np.ptp(sol.audit.energy) <= 1e-12  # round-off
    own, built_in = runs
    np.testing.assert_allclose(own[0], built_in[0], atol=1e-11)  # solver
    for one, other in zip(own[1], built_in[1], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)  # solver, over h


@dataclass(frozen=True)
class PinRows(CrossRows):
    keeps = "axis"
    measure = ej.scenes.Turn()

    def __call__(self, a, b, numbers):
        apart = b.point(numbers["point_b"]) - a.point(numbers["point_a"])
        along = a.direction(numbers["frame_a"][2])
        across = [along @ b.direction(numbers["frame_b"][k]) for k in (0, 1)]
        return jnp.append(apart, jnp.stack(across))


class Pin(ej.joints.AbstractJoint):
    """A hinge in space."""

    axis: list[float]

    def resolve(self, ends):
        return PinRows(), ends.points([0.0] * 3, None) | ends.axes(self.axis)


@pytest.mark.slow
def test_a_hinge_of_ones_own_takes_torsion_springs_and_drives():
    """A torsion balance, in closed form: the axis is vertical and through the centre."""
    inertia, stiffness = 0.25, 3.0
    scene = ej.Scene(
        [
            ej.bodies.RigidBody(
                "bar", 1.0, [0.2, 0.3, inertia], [0.0] * 3, angular_velocity=[0, 0, 0.1]
            ),
            Pin("hinge", "ground", "bar", [0.0, 0.0, 1.0]),
            ej.forces.TorsionSpring("wire", "ground", "bar", stiffness, axis=[0, 0, 1]),
        ]
    )
    system, start, args = scene.build()
    scheme = ej.EnergyConsistent(0.0)
    sol = ej.simulate(system, scheme, start, args, h=0.02, num_steps=50)
    frequency = np.sqrt(stiffness / inertia)
    expected = 0.1 * np.sin(frequency * sol.ts) / frequency
    read = scene.measure(sol, "hinge").value
    np.testing.assert_allclose(read, expected, atol=1e-7)  # truncation, of order 4


# Forces ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_spring_of_ones_own_is_the_built_in_one_and_reads_its_force():
    """Without its cubic term; with it the force is that of its definition."""
    ends = []
    for spring in (
        HardeningSpring("spring", "ground", "ball", 30.0, 0.0, 1.0),
        ej.forces.Spring("spring", "ground", "ball", 30.0, 1.0),
    ):
        ball = ej.bodies.PointMass("ball", 2.0, [1.2, 0.0], [0.0, 0.5])
        scene = ej.Scene([ball, spring], gravity=[0.0, -G])
        system, start, args = scene.build()
        scheme = ej.EnergyPreserving()
        sol = ej.simulate(system, scheme, start, args, h=0.01, num_steps=50)
        ends.append(sol.ys.q)
    np.testing.assert_allclose(*ends, atol=1e-12)  # solver
    spring = HardeningSpring("spring", "ground", "ball", 30.0, 7.0, 1.0)
    scene = ej.Scene([ej.bodies.PointMass("ball", 2.0, [1.2, 0.0]), spring])
    found = scene.measure(scene.start(), "spring")
    assert found.value == pytest.approx(1.2, rel=4 * EPS)
    expected = -(30.0 * 0.2 + 7.0 * 0.2**3)
    assert found.force == pytest.approx(expected, rel=100 * EPS)  # round-off


def test_a_potential_of_two_frames_holds_a_planet_on_its_circle():
    first, second, strength = 3.0, 1.0, 6.0
    speed = np.sqrt(strength / (first * second / (first + second)))  # at the distance 1
    share = second / (first + second)
    scene = ej.Scene(
        [
            ej.bodies.PointMass("sun", first, [-share, 0.0], [0.0, -share * speed]),
            ej.bodies.PointMass(
                "planet", second, [1 - share, 0.0], [0.0, (1 - share) * speed]
            ),
            Gravitation("pull", "sun", "planet", strength),
        ]
    )
    system, start, args = scene.build()
    scheme = ej.EnergyConsistent(0.0)
    sol = ej.simulate(system, scheme, start, args, h=0.01, num_steps=200)
    apart = scene.position(sol.ys, "planet") - scene.position(sol.ys, "sun")
    angle = speed * sol.ts
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    np.testing.assert_allclose(apart, circle, atol=2e-6)  # truncation, of order 4
    assert np.ptp(sol.audit.energy) <= 1e-13  # round-off


def test_a_drag_of_ones_own_slows_down_and_its_work_is_in_the_audit():
    mass, coefficient, speed = 2.0, 0.7, 3.0
    scene = ej.Scene(
        [
            ej.bodies.PointMass("ball", mass, [0.0] * 3, [0.0, speed, 0.0]),
            Drag("air", "ground", "ball", coefficient),
        ]
    )
    system, start, args = scene.build()
    h, num_steps = 0.01, 100
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=num_steps)
    decay = coefficient * speed / mass
    expected = speed / (1 + decay * sol.ts)
    found = scene.velocity(sol.ys, "ball")
    # Truncation, of order 2.
    np.testing.assert_allclose(found[:, 1], expected, atol=0.2 * speed * (decay * h) ** 2)
    lost = sol.audit.energy[0] - sol.audit.energy[-1]
    assert -np.sum(sol.audit.work) == pytest.approx(float(lost), rel=1e-12)  # round-off
    read = scene.measure(sol, "air")
    assert read.force is not None
    drag = -coefficient * found[:, 1] ** 2
    np.testing.assert_allclose(read.force[:, 1], drag, rtol=1e-12)  # round-off


# A body ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_body_from_its_sides_tumbles_as_euler_says():
    spin = [0.1, 2.0, 0.2]
    box = cuboid("box", 3.0, [0.2, 0.5, 0.9], [0.0] * 3, angular_velocity=spin)
    scene = ej.Scene([box])
    system, start, args = scene.build()
    scheme = ej.EnergyConsistent(0.0)
    sol = ej.simulate(system, scheme, start, args, h=0.01, num_steps=100)
    inertia = np.array([0.5**2 + 0.9**2, 0.9**2 + 0.2**2, 0.2**2 + 0.5**2])

    def euler(t, w):
        return np.cross(inertia * w, w) / inertia

    exact = scipy.integrate.solve_ivp(euler, (0, 1), spin, rtol=1e-11, atol=1e-12).y[:, -1]
    axes, rates = (x[-1, 3:].reshape(3, 3) for x in (sol.ys.q, sol.ys.v))
    # The rate of a body axis is the angular velocity times it.
    spins = [rates[j] @ axes[k] for j, k in ((1, 2), (2, 0), (0, 1))]
    np.testing.assert_allclose(spins, exact, atol=1e-6)  # truncation, of order 4
    assert args["bodies"]["box"]["mass"] == pytest.approx(3.0 * 0.2 * 0.5 * 0.9)


# Errors ---------------------------------------------------------------------------------


def law_of(base, returned, method="__call__", **fields):
    """A law of a kind that returns this, whatever it is asked."""
    answer = lambda self, *inputs: returned
    cls = type("Wrong", (base,), {method: answer, **fields})
    return dataclass(frozen=True)(cls)()


class AnyJoint(ej.joints.AbstractJoint):
    found: Any

    def resolve(self, ends):
        return self.found


class AnyForce(ej.forces.AbstractForce):
    found: Any

    def resolve(self, ends):
        return self.found


ROWS, ENERGY = ej.scenes.AbstractConstraintLaw, ej.scenes.AbstractPotentialLaw
FORCE, PLACE = ej.scenes.AbstractForceLaw, ej.scenes.Place()
POINT = dict(point_b=[0.0, 0.0])


@dataclass(frozen=True)
class WithList(ENERGY):
    weights: list

    def __call__(self, a, b, numbers):
        return jnp.zeros(())


@pytest.mark.parametrize(
    ("kind", "found", "error", "message"),
    [
        (AnyJoint, None, TypeError, "`resolve` of 'own' must return a law and its numbers"),
        (AnyJoint, (np.sum, {}), TypeError, "must return an `AbstractConstraintLaw`"),
        (AnyForce, (np.sum, {}), TypeError, "`AbstractSpringLaw` or `AbstractForceLaw`"),
        (AnyJoint, (law_of(ROWS, 0), [1.0]), TypeError, "numbers as a dictionary"),
        (
            AnyJoint,
            (law_of(ROWS, 0), dict(a="b")),
            TypeError,
            "`a` of 'own' must",
        ),
        (AnyForce, (WithList([1]), {}), TypeError, "'own' cannot be compared"),
        (
            AnyJoint,
            (law_of(ROWS, jnp.array(1.0)), {}),
            ValueError,
            r"a vector .*shape \(\)",
        ),
        (AnyJoint, (law_of(ROWS, None), {}), TypeError, "a vector .*got a NoneType"),
        (AnyJoint, (law_of(ROWS, jnp.array([1])), {}), TypeError, "of floats; got int"),
        (
            AnyJoint,
            (law_of(ROWS, jnp.ones(1), keeps="axis"), {}),
            ValueError,
            "`frame_a` and `frame_b`",
        ),
        (
            AnyForce,
            (law_of(ENERGY, jnp.ones(2)), {}),
            ValueError,
            "a scalar, the energy",
        ),
        (
            AnyForce,
            (law_of(FORCE, jnp.ones(3), "force", measure=PLACE), POINT),
            ValueError,
            r"`Wrong.force` of 'own' must return shape \(2,\), .* got shape \(3,\)",
        ),
        (
            AnyForce,
            (law_of(FORCE, None, "force", measure=PLACE), POINT),
            TypeError,
            "`Wrong.force` of 'own' .* got a NoneType",
        ),
    ],
)
def test_what_a_part_must_return_is_told(kind, found, error, message):
    ball = ej.bodies.PointMass("ball", 2.0, [1.2, 0.0])
    with pytest.raises(error, match=message):
        ej.Scene([ball, kind("own", "ground", "ball", found)])
