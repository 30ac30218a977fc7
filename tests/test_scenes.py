"""Scenes: their systems, their parameters, and their gaps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._programs.sparsity.pattern import jacobian_pattern
from enerjax._solvers.linear.block_diagonal import BlockDiagonal

from .helpers import solve


Point, Rod = ej.bodies.PointMass, ej.bodies.PlanarBody.rod
Body, Revolute = ej.bodies.RigidBody, ej.joints.Revolute


def pendulum_parts(*more):
    return [
        Point("inner", 1.0, [1.0, 0.0]),
        Point("outer", 1.0, [1.0, 1.0]),
        ej.joints.Distance("upper", "ground", "inner"),
        ej.joints.Distance("lower", "inner", "outer"),
        *more,
    ]


@functools.cache
def double_pendulum():
    scene = ej.Scene(pendulum_parts(), gravity=[0.0, 9.81])
    return scene, *scene.build()


def run(system, start, args, num_steps=200):
    return ej.simulate(
        system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=num_steps
    )


@pytest.mark.slow
def test_a_double_pendulum_of_parts_is_the_one_written_by_hand():
    scene, system, start, args = double_pendulum()
    ours, reference = (
        run(system, start, args),
        solve("double", "preserving", h=0.01, steps=200),
    )
    # Round-off and solver, that a double pendulum multiplies.
    np.testing.assert_allclose(ours.ys.q, reference.ys.q, rtol=0, atol=1e-11)
    np.testing.assert_allclose(ours.multipliers, reference.multipliers, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(scene.position(ours.ys, "outer"), ours.ys.q[:, 2:])
    np.testing.assert_array_equal(scene.velocity(ours.ys, "outer"), ours.ys.v[:, 2:])


def test_numbers_are_found_and_set_by_name_and_differentiated():
    _, system, start, args = double_pendulum()
    assert float(args["bodies"]["outer"]["mass"]) == 1.0
    assert float(args["joints"]["upper"]["length"]) == 1.0

    def tip(mass):
        return run(system, start, args.set("outer", mass=mass), 50).ys.q[-1, 3]

    slope, h = jax.jit(jax.grad(tip))(1.0), 1e-4
    difference = float(tip(1.0 + h) - tip(1.0 - h)) / (2 * h)
    assert float(slope) == pytest.approx(
        difference, rel=1e-6
    )  # truncation of the difference

    def energy(args):
        return system.energy(start, args)

    gradient = jax.grad(energy)(args)
    assert float(gradient["bodies"]["outer"]["mass"]) == pytest.approx(-9.81)
    assert float(gradient["bodies"]["inner"]["mass"]) == pytest.approx(0.0)
    np.testing.assert_allclose(gradient["gravity"], [-2.0, -1.0])
    energies = jax.vmap(lambda g: energy(args.set(gravity=g)))(jnp.eye(2))
    np.testing.assert_allclose(energies, [-2.0, -1.0])
    with pytest.raises(ValueError, match="'outer' has no `length`"):
        args.set("outer", length=1.0)
    with pytest.raises(ValueError, match="no part 'rod'"):
        args.set("rod", length=1.0)
    heavier = args.set("outer", mass=3.0) | {"gravity": [0.0, -1.0]}
    assert float(heavier["bodies"]["outer"]["mass"]) == 3.0
    np.testing.assert_array_equal(heavier["gravity"], [0.0, -1.0])
    with pytest.raises(ValueError, match="There is no `g`"):
        _ = args | {"g": 1.0}
    assert list(args)[: len(args.own)] == list(args.own)
    assert dict(args).keys() == {**args}.keys() == set(args.keys())
    assert "gravity" in args
    assert "g" not in args
    with pytest.raises(KeyError) as caught:
        _ = args["bodies"]["nobody"]
    assert "there are ['" in caught.value.__notes__[0]


def constraint(scene):
    assert scene.system.constraint is not None
    return scene.system.constraint


def count(jaxpr):
    """Equations of a program, with those inside of others."""
    inner = [x for eqn in jaxpr.eqns for x in jax.tree.leaves(list(eqn.params.values()))]
    bodies = [getattr(x, "jaxpr", x) for x in inner]
    return len(jaxpr.eqns) + sum(count(x) for x in bodies if hasattr(x, "eqns"))


def size(scene):
    """Equations of the functions of a system, one number for each."""
    system, args = scene.system, scene.args
    functions = dict(
        kinetic=lambda v: system.kinetic(v, args),
        potential=lambda q: system.potential(q, args),
    )
    if system.constraint is not None:
        functions["constraint"] = lambda q: system.constraint(q, args)
    where = dict(kinetic=scene.v)
    return {
        name: count(jax.make_jaxpr(f)(where.get(name, scene.q)).jaxpr)
        for name, f in functions.items()
    }


def rods(num, *more, gravity=(0.0, -9.81)):
    parts, before = [], "ground"
    for k in range(num):
        parts += [
            Rod(f"rod {k}", 1.0, [k, 0.0], [k + 1, 0.0]),
            Revolute(f"pin {k}", before, f"rod {k}", point_b=[-0.5, 0.0]),
        ]
        before = f"rod {k}"
    return ej.Scene([*parts, *more], gravity=gravity)


def test_a_hundred_rods_make_the_program_of_three():
    assert size(rods(100)) == size(rods(3))


def test_parts_that_are_removed_leave_nothing_behind():
    spring = ej.forces.Spring("spring", "ground", "rod 0", 10.0, point_a=[0.0, 1.0])
    bead = Point("bead", 1.0, [0.0, 2.0])
    bare = size(rods(3))
    assert size(rods(3, spring))["potential"] > bare["potential"]
    assert size(rods(3, bead))["kinetic"] > bare["kinetic"]
    weightless = size(rods(3, gravity=None))
    assert weightless["potential"] <= 1 < bare["potential"]
    assert weightless["constraint"] == bare["constraint"]
    free = ej.Scene([Point("a", 1.0, [0.0, 0.0, 0.0])]).system
    assert free.constraint is None
    assert free.coordinate_constraint is None


def test_large_scenes_are_sparse():
    scene = rods(100)
    system, args = scene.system, scene.args
    assert isinstance(system.inertia(ej.State(scene.q, scene.v), args), BlockDiagonal)
    pattern = jacobian_pattern(lambda q: constraint(scene)(q, args), scene.q)
    assert pattern is not None
    rows, columns = pattern.nonzero()
    assert np.max(np.abs(rows / 2 - columns / 3)) < 2  # of a body and the one before


def test_a_small_gap_is_reported_and_closed():
    parts = [
        Rod("rod", 1.0, [0.0, 0.0], [1.0, 0.0]),
        Revolute("pin", "ground", "rod", [0.0, 0.003], [-0.5, 0.004]),
    ]
    moving = ej.bodies.PlanarBody(
        "rod", 1.0, 1 / 12, [0.5, 0.0], velocity=[0.0, 0.51], angular_velocity=1.0
    )
    scene = ej.Scene([moving, parts[1]])
    gap = scene.report()["pin"]
    assert gap.position == pytest.approx(0.001, rel=1e-12)
    # The end of the rod, at (-0.5, 0.004), moves with v + omega x r.
    assert gap.velocity == pytest.approx(np.hypot(-0.004, 0.01), rel=1e-12)
    start = scene.start()
    end = scene.position(start, "rod", [-0.5, 0.004])
    np.testing.assert_allclose(end, [0.0, 0.003], rtol=0, atol=1e-14)
    gap = scene.report(start)["pin"]
    assert max(gap) <= 1e-14  # round-off


def test_a_gap_in_an_angle_is_the_length_of_its_arc():
    """At the end of a clamped rod, a quarter of a length from its mass centre."""
    parts = [
        Rod("rod", 1.0, [0.0, 0.0], [0.5, 0.0]),
        ej.joints.Fixed("clamp", "ground", "rod", [0.0, 0.0]),
    ]
    scene, angle = ej.Scene(parts), 1e-3
    tilted = 0.25 * np.array([np.cos(angle), np.sin(angle)])
    gap = scene.report(ej.State([*tilted, angle], [0.0] * 3))["clamp"]
    # Truncation, of order angle^2.
    assert gap.position == pytest.approx(0.25 * angle, rel=1e-5)


def test_forces_have_the_stated_energies():
    angle = 0.3
    turned = ej.bodies.PlanarBody("arm", 2.0, 0.1, [0.0, 0.0], angle)
    scene = ej.Scene(
        [
            turned,
            ej.forces.Spring("spring", "ground", "arm", 8.0, 0.5, [3.0, 0.0], [1.0, 0.0]),
            ej.forces.TorsionSpring("coil", "ground", "arm", 5.0, angle=0.1),
            ej.forces.ConstantForce("wind", "arm", [1.0, -2.0], [0.0, 1.0]),
            ej.forces.ConstantTorque("motor", "arm", 0.7),
            ej.forces.Potential("own", lambda view, args: args["k"] * view.angle("arm")),
        ],
        args=dict(k=3.0),
    )
    c, s = np.cos(angle), np.sin(angle)
    stretch = np.hypot(3 - c, s) - 0.5
    expected = 4 * stretch**2 + 2.5 * 0.2**2 - (-s - 2 * c) - 0.7 * angle + 3 * angle
    energy = scene.system.potential(scene.q, scene.args)
    assert float(energy) == pytest.approx(expected, rel=1e-14)


def test_a_torsion_spring_in_the_plane_is_relaxed_at_the_start():
    turned = ej.bodies.PlanarBody("arm", 2.0, 0.1, [0.0, 0.0], 0.3)
    scene = ej.Scene([turned, ej.forces.TorsionSpring("coil", "ground", "arm", 5.0)])
    for further in (0.0, 0.4):
        q = jnp.asarray(scene.q) + jnp.array([0.0, 0.0, further])
        energy = float(scene.system.potential(q, scene.args))
        assert energy == pytest.approx(2.5 * further**2, rel=1e-14)


def test_a_torsion_spring_in_space_measures_the_turn_about_its_axis():
    arm = Body("arm", 2.0, [0.3, 0.4, 0.5], [0.0, 0.0, 0.0])
    coil = ej.forces.TorsionSpring("coil", "ground", "arm", 5.0, axis=[0, 0, 1])
    hinge = Revolute("hinge", "ground", "arm", axis=[0, 0, 1])
    scene = ej.Scene([arm, coil, hinge])
    half = 1.2 / 2
    turned = Body(
        "arm", 2.0, [0.3, 0.4, 0.5], [0.0, 0, 0], [np.cos(half), 0, 0, np.sin(half)]
    )
    energy = scene.system.potential(jnp.asarray(turned.q), scene.args)
    assert float(energy) == pytest.approx(2.5 * 1.2**2, rel=1e-14)


def test_constraints_of_your_own_stand_beside_joints():
    level = ej.joints.Constraint(
        "level", lambda view, args: view.position("outer")[1:] - args["height"]
    )
    scene = ej.Scene(pendulum_parts(level), [0.0, 9.81], dict(height=1.0))
    values = constraint(scene)(scene.q, scene.args)
    np.testing.assert_allclose(values, 0, atol=1e-15)
    assert "constraint[2:3]" in str(scene)
    assert "1 degree of freedom" in str(scene)


def test_printing_a_scene_lists_its_parts():
    words = str(double_pendulum()[0])
    for part in (
        "plane",
        "2 degrees of freedom",
        "inner",
        "PointMass",
        "upper",
        "Distance",
    ):
        assert part in words
