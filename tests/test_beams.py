"""Beams: statics, modes and motions of geometrically exact beams in scenes."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import enerjax as ej

from .helpers import EPS
from .references import cantilever_by_shooting, four_bar_of_beams


SOFT = ej.Section(EA=1e4, GA=1e4, EI=100.0, GJ=100.0, rhoA=1.0, rhoI=10.0)


def _cantilever(axis, section, elements, *parts, **options):
    beam = ej.bodies.Beam("beam", axis, section, elements, **options)
    clamp = ej.joints.Fixed("clamp", "ground", beam.start)
    return beam, ej.Scene([beam, clamp, *parts])


# Statics ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def in_plane():
    """A function that bends a cantilever of four elements from a straight pose."""
    beam, scene = _cantilever(
        [[0.0, 0.0], [1.0, 0.0]],
        SOFT,
        4,
        ej.forces.ConstantForce("force", "beam:end", [0.0, 0.0]),
        ej.forces.ConstantTorque("torque", "beam:end", 0.0),
    )
    start = scene.start()

    def solved(length, force=(0.0, 0.0), torque=0.0, **section):
        elements = jnp.full((4,), length / 4)
        unloaded = scene.args.set("beam", length=elements, **section)
        args = unloaded.set("force", force=jnp.array(force)).set("torque", torque=torque)
        # The straight beam of this length: the sections start where they are without loads.
        q = start.q.reshape(5, 3) * jnp.array([[length, 1.0, 1.0]])
        found = ej.equilibrium(
            scene.system, ej.State(q.ravel(), start.v), args, from_args=unloaded, steps=10
        )
        moved = scene.position(found.state, beam.end) - jnp.array([length, 0.0])
        return moved, scene.section_forces(found, "beam", args)

    return solved


def test_an_end_moment_rolls_a_beam_up(in_plane):
    """Exact for any number of elements: `2 pi EI / L` closes a circle."""
    moment = 2 * np.pi * 500.0 / 10
    moved, inner = in_plane(10.0, torque=moment, EI=500.0)
    np.testing.assert_allclose(moved, [-10.0, 0.0], atol=1e-11)  # solver
    np.testing.assert_allclose(inner.moment, moment, rtol=1e-11)
    np.testing.assert_allclose(inner.energies["bending"], moment**2 * 10 / 1e3, rtol=1e-11)
    np.testing.assert_allclose(inner.arc_length, [1.25, 3.75, 6.25, 8.75])


def test_a_thick_cantilever_has_the_digits_of_the_same_element(in_plane):
    """Those of EXUDYN's two-node element with four elements."""
    height, width, E, nu = 0.5, 0.1, 2.07e11, 0.3
    section = ej.Section.rectangle(height, width, E=E, nu=nu, rho=1.0)
    numbers = section.in_dimension("beam", 2)
    stiffness = {key: numbers[key] for key in ("EA", "GA", "EI")}
    moved, inner = in_plane(2.0, force=(0.0, -5e8 * height**3), **stiffness)
    np.testing.assert_allclose(-moved, [0.14641168, 0.70292850], rtol=0, atol=1e-8)
    # The force in the first element is the load in its axes.
    load = jnp.linalg.norm(inner.force[0])
    np.testing.assert_allclose(load, 5e8 * height**3, rtol=1e-9)


def test_a_small_force_bends_and_shears_as_timoshenko_says(in_plane):
    """The error of the elements is that of bending, a part `1/(4 n^2)` of it."""
    length, EI, GA, force = 3.0, 3.07e3, 1.9e3, 1e-6
    moved, _ = in_plane(length, force=(0.0, force), EA=2e5, GA=GA, EI=EI)
    bending, shear = force * length**3 / (3 * EI), force * length / GA
    expected = bending * (1 - 1 / (4 * 4**2)) + shear
    np.testing.assert_allclose(moved[1], expected, rtol=1e-8)


def test_load_steps_tell_how_far_they_came(in_plane):
    with pytest.raises(ValueError, match="The part 0 of the way"):
        in_plane(1.0, torque=1.0, EI=0.0)


@pytest.mark.slow
def test_bending_twists_a_beam_with_a_coupled_stiffness():
    stiffness = np.diag([1368.17e3, 88.56e3, 38.78e3, 16.96e3, 59.12e3, 141.47e3])
    stiffness[3, 4] = stiffness[4, 3] = 17.61e3
    stiffness[3, 5] = stiffness[5, 3] = -0.351e3
    stiffness[4, 5] = stiffness[5, 4] = -0.370e3
    section = ej.Section(stiffness=stiffness, rhoA=1.0, rhoI=1.0)
    load = ej.forces.ConstantForce("force", "beam:end", [0.0, 0.0, 150.0])
    axis = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]
    # Two codes agree on these digits for fine meshes.
    published = [-9.02726627566299e-2, -6.47488486259036e-2, 1.22973648292371]
    exact = cantilever_by_shooting(stiffness, 10.0, [0.0, 0.0, 150.0])
    np.testing.assert_allclose(exact, published, rtol=1e-7)
    moved = []
    for elements in (8, 16):
        beam, scene = _cantilever(axis, section, elements, load)
        found = ej.equilibrium(scene.system, scene.start(), scene.args)
        moved.append(scene.position(found.state, beam.end) - jnp.array(axis[1]))
        inner = scene.section_forces(found, "beam")
        potential = scene.system.potential_energy(found.state, scene.args)
        work = 150.0 * moved[-1][2]
        np.testing.assert_allclose(
            sum(inner.energies.values()), potential + work, rtol=1e-9
        )
        force = scene.reaction(found, "clamp").force
        np.testing.assert_allclose(force, [0.0, 0.0, -150.0], atol=1e-7)
    # Of second order: extrapolated, the error is a hundredth of that of 16 elements.
    np.testing.assert_allclose((4 * moved[1] - moved[0]) / 3, published, rtol=1e-4)


def test_strains_do_not_see_rigid_motions():
    _, scene = _cantilever([[0.0, 0.0, 0.0], [3.0, 0.0, 1.0]], SOFT, 3)
    random = np.random.default_rng(1)
    turned = scipy.spatial.transform.Rotation.from_rotvec(random.normal(size=(4, 3)))
    q = np.asarray(scene.q).reshape(4, 4, 3) + 0.1 * random.normal(size=(4, 4, 3))
    q[:, 1:] = np.swapaxes(turned.as_matrix(), 1, 2)
    rotation = scipy.spatial.transform.Rotation.from_rotvec([0.4, -2.0, 1.1]).as_matrix()
    moved = q @ rotation.T
    moved[:, 0] += np.array([3.0, -2.0, 5.0])
    a, b = (scene.section_forces(ej.State(x.ravel(), scene.v), "beam") for x in (q, moved))
    np.testing.assert_allclose(b.strain, a.strain, rtol=0, atol=100 * EPS)
    np.testing.assert_allclose(b.curvature, a.curvature, rtol=0, atol=100 * EPS)
    # The curvature is the rotation vector between the sections, over the length.
    relative = (turned[:-1].inv() * turned[1:]).as_rotvec()
    length = scene.args["beams"]["beam"]["length"][0]
    assert np.abs(relative).max() > 1
    np.testing.assert_allclose(a.curvature, relative / length, rtol=1e-6)


@pytest.mark.slow
def test_statics_in_space_meet_a_shooting_method():
    """The Princeton beam experiment; the error of the elements is of second order."""
    height, width = 12.3777e-3, 3.2024e-3
    second = height * width * (height**2 + width**2) / 12
    section = ej.Section.rectangle(
        height, width, E=71.7e9, nu=0.31, rho=1.0, shear_factor=1.0,
        torsion_constant=0.198 * second,
    )  # fmt: skip
    angle = np.radians(30.0)
    force = 13.345 * np.array([0.0, -np.cos(angle), np.sin(angle)])
    numbers = section.in_dimension("beam", 3)
    stiffness = np.diag(
        np.concatenate([[numbers["EA"]], numbers["GA"], [numbers["GJ"]], numbers["EI"]])
    )
    exact = cantilever_by_shooting(stiffness, 0.508, force)
    errors = []
    for elements in (8, 16):
        load = ej.forces.ConstantForce("force", "beam:end", force)
        beam, scene = _cantilever([[0, 0, 0], [0.508, 0, 0]], section, elements, load)
        unloaded = scene.args.set("force", force=jnp.zeros(3))
        found = ej.equilibrium(
            scene.system, scene.start(), scene.args, from_args=unloaded, steps=5
        )
        moved = scene.position(found.state, beam.end) - np.array([0.508, 0, 0])
        errors.append(np.abs(moved - exact).max())
    assert errors[1] < 2e-4
    assert 3.7 < errors[0] / errors[1] < 4.3


@pytest.mark.slow
def test_an_arc_that_is_bent_out_of_its_plane_meets_a_shooting_method():
    """The arc of K.-J. Bathe and S. Bolourchi (1979), on a parabola through three points.

    The equilibrium of the rod by shooting (explicit Runge-Kutta of order 8, tolerance
    1e-11). Two codes print (-23.646, 13.721, 53.578), 0.4 % off.
    """
    points = np.array([[0, 0, 0], [38.2683, -7.61205, 0], [70.7107, -29.2893, 0]])
    exact = [-23.55478146, 13.57863935, 53.45111098]

    def axis(u):
        shares = [2 * (u - 0.5) * (u - 1), -4 * u * (u - 1), 2 * u * (u - 0.5)]
        return jnp.stack(shares) @ points

    section = ej.Section(EA=1e7, GA=41.6667e5, EI=8.333e5, GJ=8.333e5, rhoA=1.0, rhoI=1.0)
    load = ej.forces.ConstantForce("force", "beam:end", [0.0, 0.0, 600.0])
    moved = []
    for elements in (8, 16):
        beam, scene = _cantilever(axis, section, elements, load)
        unloaded = scene.args.set("force", force=jnp.zeros(3))
        found = ej.equilibrium(
            scene.system, scene.start(), scene.args, from_args=unloaded, steps=4
        )
        moved.append(scene.position(found.state, beam.end) - points[2])
    # Of second order: extrapolated, the error is a hundredth of that of 16 elements.
    np.testing.assert_allclose((4 * moved[1] - moved[0]) / 3, exact, rtol=1e-4)
    errors = [np.abs(x - np.array(exact)).max() for x in moved]
    assert 3.7 < errors[0] / errors[1] < 4.3


@pytest.mark.slow
@pytest.mark.parametrize("law", [ej.forces.Torque, ej.forces.FollowerTorque])
def test_end_moments_roll_a_beam_up_in_space(law):
    torque = law("torque", "beam:end", lambda t, args: args["moment"] * jnp.eye(3)[2])
    beam = ej.bodies.Beam("beam", [[0, 0, 0], [10.0, 0, 0]], SOFT, 6)
    clamp = ej.joints.Fixed("clamp", "ground", beam.start)
    scene = ej.Scene([beam, clamp, torque], args={"moment": 20 * np.pi})
    found = ej.equilibrium(
        scene.system, scene.start(), scene.args, from_args=scene.args.set(moment=0.0),
        steps=10,
    )  # fmt: skip
    np.testing.assert_allclose(scene.position(found.state, beam.end), 0.0, atol=1e-10)


# Motions ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def spaghetti():
    """J. C. Simo and L. Vu-Quoc's flying beam in the plane, until after its loads."""
    beam = ej.bodies.Beam("beam", [[0.0, 8.0], [6.0, 0.0]], SOFT, 16)
    on = lambda t: jnp.where(t < 2.5, 1.0, 0.0)
    scene = ej.Scene(
        [
            beam,
            ej.forces.Load("push", beam.end, lambda t, args: jnp.stack([8 * on(t), 0 * t])),
            ej.forces.TorsionActuator(
                "turn", "ground", beam.end, lambda t, args: -80 * on(t)
            ),
        ]
    )
    system, start, args = scene.build()
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=300)
    return beam, scene, sol


@pytest.mark.slow
def test_a_flying_beam_keeps_its_balances(spaghetti):
    _, scene, sol = spaghetti
    size = float(jnp.abs(sol.audit.energy).max())
    np.testing.assert_allclose(sol.audit.leak, 0.0, atol=1e3 * EPS * size)  # round-off
    first = np.array([3 / 8, 7 / 6, 23 / 24])  # of Gregory's quadrature
    weights = np.concatenate([first, np.ones(11), first[::-1]]) / 16
    middle = jnp.einsum("n,tni->ti", weights, scene.centreline(sol, "beam"))
    t = sol.ts
    x = jnp.where(t < 2.5, 3 + 0.4 * t**2, 5.5 + 2 * (t - 2.5))
    np.testing.assert_allclose(middle, jnp.stack([x, 0 * t + 4], axis=1), atol=1e-11)
    # After the loads the angular momentum about the origin is kept: solver and round-off.
    inertia = scene.system.inertia(scene.start(), scene.args).diagonal().reshape(-1, 3)
    q, v = (x[t > 2.51].reshape(-1, 17, 3) for x in (sol.ys.q, sol.ys.v))
    p = inertia[None] * v
    turning = q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0] + p[..., 2]
    angular = np.sum(turning, axis=1)
    np.testing.assert_allclose(angular, angular[0], rtol=1e-14 * len(angular))


@pytest.mark.slow
def test_a_flying_beam_moves_as_published(spaghetti):
    """Displacements of a spectral solution; the error is that of 16 elements."""
    beam, scene, sol = spaghetti
    place = lambda name, k: scene.position(sol.ys, name)[k]
    moved = lambda name, k: place(name, k) - place(name, 0)
    np.testing.assert_allclose(moved(beam.end, 100), [-1.6730, 0.4077], atol=0.03)
    np.testing.assert_allclose(moved(beam.start, 100), [0.3702, -0.2040], atol=0.01)
    np.testing.assert_allclose(moved(beam.start, 250), [3.583, -1.888], atol=0.02)


@pytest.fixture(scope="module")
def free():
    """A free beam in space that tumbles and vibrates."""
    section = ej.Section(EA=1e4, GA=1e4, EI=[100.0, 50.0], GJ=40.0, rhoA=1.0, rhoI=0.1)
    beam = ej.bodies.Beam(
        "beam", [[0, 0, 0], [3.0, 0, 4.0]], section, 4, velocity=[1.0, 0, 0],
        angular_velocity=[0.5, 1.0, 0.2],
    )  # fmt: skip
    scene = ej.Scene([beam])
    start = scene.start()
    tip = start.v.reshape(-1, 12).at[-1, 0].add(2.0)
    return scene, ej.State(start.q, tip.ravel())


def _momenta(scene, sol):
    """Momentum, and angular momentum about the origin."""
    q, v = (x.reshape(len(sol.ts), -1, 4, 3) for x in (sol.ys.q, sol.ys.v))
    numbers = scene.args["beams"]["beam"]
    parts = np.array([3 / 8, 7 / 6, 11 / 12, 7 / 6, 3 / 8]) / 4  # of four elements
    own = jnp.asarray(parts) * jnp.sum(numbers["length"])
    second = 0.5 * jnp.trace(numbers["rhoI"]) * jnp.eye(3) - numbers["rhoI"]
    momentum = numbers["rhoA"] * own[None, :, None] * v[:, :, 0]
    halves = np.array([0.5, 1, 1, 1, 0.5]) / 4 * jnp.sum(numbers["length"])
    spin = jnp.einsum("n,ij,tnia->tnja", halves, second, v[:, :, 1:])
    turning = jnp.cross(q[:, :, 1:], spin).sum(axis=2)
    angular = jnp.cross(q[:, :, 0], momentum) + turning
    return momentum.sum(axis=1), angular.sum(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheme", [ej.EnergyPreserving(), ej.Composed(ej.EnergyPreserving(), 4)]
)
def test_a_free_beam_in_space_keeps_energy_and_momenta(free, scheme):
    scene, start = free
    sol = ej.simulate(scene.system, scheme, start, scene.args, h=0.02, num_steps=200)
    for found in (sol.audit.energy, *_momenta(scene, sol)):
        size = float(jnp.abs(found).max())
        assert float(jnp.abs(found - found[:1]).max()) < 2e3 * EPS * size  # round-off


@pytest.mark.slow
def test_energy_and_momenta_of_a_free_beam_change_by_a_random_walk(free):
    """In 1e5 steps they change by round-off that grows like the square root of the steps.

    The mass centre is at rest: far from the origin the coordinates lose digits.
    """
    scene, start = free
    parts = jnp.array([3 / 8, 7 / 6, 11 / 12, 7 / 6, 3 / 8]) / 4
    v = start.v.reshape(5, 4, 3)
    v = v.at[:, 0].add(-parts @ v[:, 0])
    steps, every = 100_000, 100
    sol = ej.simulate(
        scene.system, ej.EnergyPreserving(), ej.State(start.q, v.ravel()), scene.args,
        h=0.02, num_steps=steps, saveat=ej.SaveAt(every=every),
    )  # fmt: skip
    momentum, angular = _momenta(scene, sol)
    typical = jnp.sum(parts * jnp.linalg.norm(v[:, 0], axis=1)) * 5.0
    energy = sol.audit.energy[:, None]
    sizes = (energy[0, 0], typical, jnp.linalg.norm(angular[0]))
    for found, size in zip((energy, momentum, angular), sizes, strict=True):
        of_steps = lambda n, x=found: float(
            jnp.sqrt(jnp.mean(jnp.sum((x[n // every :] - x[: -n // every]) ** 2, axis=1)))
        )
        # A walk of 64 times as many steps goes 8 times as far, and a drift 64 times.
        assert of_steps(64 * every) < 16 * of_steps(every)
        change = float(jnp.abs(found - found[:1]).max())
        assert change < 50 * EPS * np.sqrt(steps) * float(size)  # round-off


@pytest.mark.slow
def test_a_free_beam_keeps_its_momenta_while_it_is_damped(free):
    scene, start = free
    scheme = ej.EnergyMomentumDecaying(0.5)
    sol = ej.simulate(scene.system, scheme, start, scene.args, h=0.02, num_steps=200)
    for found in _momenta(scene, sol):
        size = float(jnp.abs(found).max())
        assert float(jnp.abs(found - found[:1]).max()) < 2e3 * EPS * size  # round-off
    energy = float(sol.audit.energy[0])
    np.testing.assert_allclose(sol.audit.leak, 0.0, atol=1e3 * EPS * energy)  # round-off
    assert jnp.all(sol.audit.dissipated[1:] > 0)
    assert float(jnp.sum(sol.audit.dissipated)) > 1e-3 * energy


@pytest.mark.slow
def test_a_decaying_scheme_damps_a_free_beam(free):
    scene, start = free
    sol = ej.simulate(
        scene.system, ej.EnergyDecaying(1.0), start, scene.args, h=0.02, num_steps=200
    )
    energy = sol.audit.energy
    assert float(jnp.diff(energy).max()) <= 1e3 * EPS * float(energy[0])
    assert float(energy[-1]) < 0.97 * float(energy[0])
    np.testing.assert_allclose(sol.audit.leak, 0.0, atol=1e3 * EPS * float(energy[0]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "order", "bound"),
    [
        (ej.EnergyPreserving(), 2, 1e-4),
        (ej.EnergyMomentumDecaying(0.5), 2, 1e-5),
        (ej.Composed(ej.EnergyPreserving(), 4), 4, 1e-7),
        (ej.EnergyConsistent(0.0), 4, 1e-7),
    ],
)  # fmt: skip
def test_the_order_on_a_four_bar_of_beams(scheme, order, bound):
    """Beside an explicit method of order 8, of the same elements without constraints."""
    pins = np.array([[0.0, 0.0], [2.0, 1.0], [3.5, 1.0], [2.5, 0.0]])
    numbers = dict(EA=8e4, GA=3e4, EI=300.0, rhoA=100.0, rhoI=1.0)
    section, names = ej.Section(**numbers), ("crank", "coupler", "rocker")
    bars = crank, coupler, rocker = [
        ej.bodies.Beam(name, pins[k : k + 2], section, 2) for k, name in enumerate(names)
    ]
    scene = ej.Scene(
        [
            *bars,
            ej.joints.Revolute("A", "ground", crank.start),
            ej.joints.Revolute("B", crank.end, coupler.start),
            ej.joints.Revolute("C", coupler.end, rocker.start),
            ej.joints.Revolute("D", "ground", rocker.end, pins[3]),
        ],
        gravity=[0.0, -9.81],
    )
    system, start, args = scene.build()
    t, errors = 0.3, []
    exact = four_bar_of_beams(t, pins, **numbers)
    assert np.abs(exact - start.q).max() > 0.5
    for steps in (120, 240):
        # Beyond the time `t` with the longer steps: the runs share a program.
        sol = ej.simulate(
            system, scheme, start, args, h=t / steps, num_steps=240, throw=False
        )
        errors.append(float(np.abs(sol.ys.q[steps] - exact).max()))
    assert errors[1] < bound  # truncation
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)


@pytest.mark.slow
def test_a_motion_has_gradients_by_stiffness_load_and_mass():
    """Of a cantilever with a weight at its tip, beside differences of the same program."""
    section = ej.Section(EA=1e3, GA=1e3, EI=2.0, rhoA=1.0, rhoI=1e-2)
    beam, scene = _cantilever(
        [[0.0, 0.0], [1.0, 0.0]],
        section,
        4,
        ej.bodies.PointMass("weight", 0.3, [1.0, 0.0]),
        ej.joints.Spherical("screw", "beam:end", "weight"),
        ej.forces.ConstantForce("load", "beam:end", [0.0, 0.0]),
    )
    system, start, args = scene.build()

    @jax.jit
    @jax.value_and_grad
    def tip(x):
        EI, load, mass = x
        loaded = args.set("load", force=load * jnp.array([0.0, 1.0]))
        moved = loaded.set("beam", EI=EI).set("weight", mass=mass)
        sol = ej.simulate(
            system, ej.EnergyPreserving(), start, moved, h=0.02, num_steps=50, throw=False
        )
        return scene.position(sol.ys, beam.end)[-1, 1]

    at = np.array([2.0, -1.0, 0.3])
    slopes = tip(at)[1]
    for k, slope in enumerate(slopes):
        step = 1e-4 * abs(at[k]) * np.eye(3)[k]
        difference = lambda step: float(tip(at + step)[0] - tip(at - step)[0])
        # Two quotients, without the error of second order.
        expected = (8 * difference(step) - difference(2 * step)) / (12 * step[k])
        np.testing.assert_allclose(slope, expected, rtol=1e-7)  # round-off of differences


# Modes ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_axial_vibrations_of_a_clamped_beam():
    """The error is that of the elements, `(k l)^2 / 24` for the wave number `k`."""
    section = ej.Section(EA=80.0, GA=30.0, EI=4.0, rhoA=2.0, rhoI=0.1)
    _, scene = _cantilever([[0.0, 0.0], [0.0, 2.0]], section, 10)
    found = ej.modes(scene.system, scene.start(), scene.args).frequencies
    exact = np.pi / 4 * np.sqrt(80.0 / 2.0)
    error = (np.pi / 4 * 0.2) ** 2 / 24
    nearest = found[jnp.argmin(jnp.abs(found - exact))]
    assert float(jnp.abs(nearest / exact - 1)) == pytest.approx(error, rel=0.2)


def _frequencies_under_load(section, length, force, count):
    """Of a beam on a pin and a roller: one half wave, and more, in closed form.

    The beam can be sheared, and its axial force turns with the sections. Without shear and
    inertia of rotation these are `(n pi / L)^2 sqrt(EI / rhoA) sqrt(1 + N L^2 / (n^2 pi^2
    EI))`.
    """
    EA, GA, EI, rhoA, rhoI = (
        section.numbers[k] for k in ("EA", "GA", "EI", "rhoA", "rhoI")
    )
    stretch, found = 1 + force / EA, []
    for n in range(1, count + 1):
        k = n * np.pi / length
        both = (force - GA * stretch) * k
        turning = GA * stretch**2 + EI * k**2 - force * stretch
        stiffness = np.array([[GA * k**2, both], [both, turning]])
        squares = scipy.linalg.eigh(stiffness, np.diag([rhoA, rhoI]), eigvals_only=True)
        found.append(np.sqrt(squares[0]))
    return np.array(found)


@pytest.mark.slow
def test_modes_about_a_loaded_equilibrium():
    """A pull and half of the critical load, on a beam on a pin and a roller."""
    section = ej.Section(EA=2e4, GA=8e3, EI=50.0, rhoA=2.0, rhoI=0.01)
    length, errors = 4.0, []
    critical = np.pi**2 * 50.0 / length**2
    for elements in (16, 32):
        beam = ej.bodies.Beam("beam", [[0.0, 0.0], [length, 0.0]], section, elements)
        scene = ej.Scene([
            beam,
            ej.joints.Revolute("pin", "ground", beam.start),
            ej.joints.OnCurve("roller", "ground", beam.end, lambda x, numbers: x[1:]),
            ej.forces.ConstantForce("load", beam.end, [0.0, 0.0]),
        ])  # fmt: skip
        for force in (200.0, -0.5 * critical):
            args = scene.args.set("load", force=jnp.array([force, 0.0]))
            found = ej.equilibrium(scene.system, scene.start(), args)
            frequencies = ej.modes(scene.system, found.state, args).frequencies[:2]
            exact = _frequencies_under_load(section, length, force, 2)
            errors.append(frequencies / exact - 1)
    errors = np.array(errors).reshape(2, 2, 2)
    # The load halves the lowest frequency and more, and triples it.
    alone = _frequencies_under_load(section, length, 0.0, 1)[0]
    assert _frequencies_under_load(section, length, 200.0, 1)[0] > 2.5 * alone
    assert _frequencies_under_load(section, length, -0.5 * critical, 1)[0] < 0.75 * alone
    assert np.abs(errors[1]).max() < 2.5e-3  # truncation
    ratios = errors[0, :, 0] / errors[1, :, 0]
    np.testing.assert_allclose(ratios, 4.0, rtol=0.05)  # of second order


def _frequencies_of_a_ring(section, n):
    """Of `n` waves out of the plane and in it, for a ring of radius one that is a straight
    rod without stress, in closed form; the section has equal stiffnesses of bending."""
    EA, GA, EI, GJ, rhoA, rhoI = (
        section.numbers[k] for k in ("EA", "GA", "EI", "GJ", "rhoA", "rhoI")
    )  # fmt: skip
    square = lambda x: np.outer(x, x)
    lowest = lambda K, M: np.sqrt(scipy.linalg.eigh(K, np.diag(M), eigvals_only=True)[0])
    # Deflection, twist, and rotation about the radius. The last terms are those of the
    # moment of the bent rod.
    w, twist, turn = np.eye(3)
    stiffness = (
        GA * square(turn - n * w)
        + GJ * square(n * twist + turn)
        + EI * square(n * turn + twist)
        - EI * (square(twist) + square(turn))
        - EI * n * (np.outer(twist, turn) + np.outer(turn, twist))
    )
    out_of_plane = lowest(stiffness, [rhoA, 2 * rhoI, rhoI])
    # Displacements along the ring and inwards, and the rotation.
    u, v, turn = np.eye(3)
    stiffness = (
        EA * square(n * u - v) + GA * square(u - n * v - turn) + EI * square(n * turn)
    )
    return np.array([out_of_plane, lowest(stiffness, [rhoA, rhoA, rhoI])])


@pytest.mark.slow
def test_modes_of_a_straight_rod_that_is_bent_to_a_ring():
    """Its moment changes the frequencies out of the plane, and it can be turned inside
    out without energy."""
    section = ej.Section(EA=2e5, GA=8e4, EI=50.0, GJ=40.0, rhoA=2.0, rhoI=0.02)
    axis = lambda u: jnp.stack([jnp.cos(2 * np.pi * u), jnp.sin(2 * np.pi * u), 0.0 * u])
    exact, errors = _frequencies_of_a_ring(section, 2), []
    for elements in (16, 32):
        beam = ej.bodies.Beam("beam", axis, section, elements)
        scene = ej.Scene([beam, ej.joints.Fixed("weld", beam.end, beam.start)])
        straight = scene.args["beams"]["beam"]["reference"].at[:, 3:].set(0.0)
        args = scene.args.set("beam", reference=straight)
        found = ej.modes(scene.system, scene.start(), args).frequencies
        # Six rigid motions, and the ring turned inside out.
        assert jnp.abs(found[:7]).max() < 1e-2  # the root of round-off
        in_plane, out_of_plane = jnp.mean(found[7:9]), jnp.mean(found[9:11])
        errors.append(np.array([out_of_plane, in_plane]) / exact - 1)
    assert np.abs(errors[1]).max() < 0.015  # truncation
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.05)  # of second order


def test_a_straight_beam_has_the_inertia_of_a_rod():
    """Whatever the places of its sections: mass, mass centre and moment of inertia."""
    section = ej.Section(EA=1.0, GA=1.0, EI=1.0, rhoA=3.0, rhoI=0.1)
    for elements in (2, 3, 7, [0.0, 0.1, 0.25, 0.45, 0.7, 1.0]):
        beam = ej.bodies.Beam(
            "beam", [[0.0, 0.0], [2.0, 0.0]], section, elements, angular_velocity=2.0
        )
        scene = ej.Scene([beam], gravity=[1.0, 0.0])
        state = ej.State(scene.q, scene.v)
        kinetic = eqx.filter_jit(scene.system.kinetic_energy)(state, scene.args)
        potential = eqx.filter_jit(scene.system.potential_energy)(state, scene.args)
        np.testing.assert_allclose(kinetic, 2 * (6.0 * 2**2 / 12 + 0.1 * 2), rtol=1e-13)
        np.testing.assert_allclose(potential, -6.0 * 1.0, rtol=1e-13)


# Curves, sections and bad input -----------------------------------------------------------


def test_a_curved_beam_has_sections_at_equal_arc_lengths():
    """A helix in a parametrisation of its own; its curvature and torsion are constant."""
    radius, pitch, turns = 2.0, 1.0, 0.75

    def helix(u):
        angle = 2 * jnp.pi * turns * (u + u**2) / 2
        return jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), pitch * angle])

    beam = ej.bodies.Beam("helix", helix, SOFT, 24, normal=[-1.0, 0.0, 0.0], twist=0.3)
    total = 2 * np.pi * turns * np.hypot(radius, pitch)
    np.testing.assert_allclose(beam.numbers["length"], total / 24, rtol=1e-10)
    bent = np.linalg.norm(beam.numbers["reference"][:, 4:], axis=1)
    squared = radius**2 + pitch**2
    np.testing.assert_allclose(bent, radius / squared, rtol=0.01)  # truncation
    # Without the twist, sections do not turn about the tangent.
    np.testing.assert_allclose(beam.numbers["reference"][:, 3], 0.3 / total, atol=1e-3)
    axes = np.array([node.q for node in beam.nodes]).reshape(-1, 4, 3)[:, 1:]
    products = np.einsum("nik,njk->nij", axes, axes)
    np.testing.assert_allclose(products - np.eye(3)[None], 0.0, atol=1e-13)
    assert beam.at(total / 2) == beam.node(12) == "helix:12"


def test_sections_of_a_material():
    tube = ej.Section.tube(0.3, 0.2, E=7.0, nu=0.25, rho=2.0).numbers
    area, moment = np.pi * (0.3**2 - 0.2**2), np.pi / 4 * (0.3**4 - 0.2**4)
    assert tube["EA"] == pytest.approx(7 * area)
    assert tube["GJ"] == pytest.approx(2.8 * 2 * moment)
    np.testing.assert_allclose(tube["EI"], 7 * moment)
    square = ej.Section.rectangle(0.4, 0.4, E=1.0, nu=0.0, rho=1.0).numbers
    # S. Timoshenko and J. Goodier: 0.1406 a^4 for a square.
    assert square["GJ"] / 0.5 / 0.4**4 == pytest.approx(0.140577, abs=1e-6)
    assert square["GA"] == pytest.approx(10 / 12 * 0.5 * 0.16)


_PAIR = [[0.0, 0.0], [1.0, 0.0]]
_IN_SPACE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
_FLAT = dict(rhoA=1.0, rhoI=1.0)
_NO_SECTION: Any = 3.0
_BEAM = ej.bodies.Beam("arm", _PAIR, SOFT, 4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ej.Section(EA=1.0, EI=1.0, **_FLAT), "needs `GA`"),
        (lambda: ej.Section(EA=-1.0, GA=1.0, EI=1.0, **_FLAT), "`EA` .* positive"),
        (lambda: ej.Section(EA=1.0, GA=1.0, EI=0.0, **_FLAT), "`EI` .* positive"),
        (lambda: ej.Section(EA=1.0, GA=1.0, EI=1.0, rhoA=1.0, rhoI=0.0), "rhoI"),
        (lambda: ej.Section(stiffness=np.diag([1.0, 1, -1]), **_FLAT), "not positive def"),
        (lambda: ej.Section(stiffness=np.eye(3), EA=1.0, **_FLAT), "in place of"),
        (lambda: ej.bodies.Beam("x", [[1.0, 2]] * 2, SOFT), "coincide"),
        (lambda: ej.bodies.Beam("x", _PAIR, SOFT, 0), "at least one element"),
        (lambda: ej.bodies.Beam("x", _PAIR, SOFT, [0, 0.6, 0.5, 1]), "must increase"),
        (lambda: ej.bodies.Beam("x", _PAIR, _NO_SECTION), "must be an `ej.Section`"),
        (lambda: ej.bodies.Beam("x", _PAIR, SOFT, twist=1.0), "in the plane"),
        (
            lambda: ej.bodies.Beam("x", _IN_SPACE, ej.Section(EA=1, GA=1, EI=1, **_FLAT)),
            "needs `GJ`",
        ),
        (lambda: ej.bodies.Beam("x", _IN_SPACE, SOFT, normal=[2.0, 0, 0]), "across"),
        (
            lambda: ej.bodies.Beam(
                "x", lambda u: jnp.stack([jnp.cos(6.28 * u), jnp.sin(6.28 * u)]), SOFT, 1
            ),
            "turn by 360 degrees",
        ),
        (lambda: ej.bodies.Beam("x", lambda u: jnp.stack([u**2, u]) * u, SOFT), "still"),
        (lambda: _BEAM.at(1.1), "not on 'arm'"),
        (lambda: _BEAM.at(0.3), "nearest is at 0.25"),
        (
            lambda: ej.Scene([_BEAM, ej.joints.Fixed("clamp", "ground", "arm")]),
            "'arm:start' or 'arm:end'",
        ),
        (
            lambda: ej.Scene([_BEAM, ej.forces.LineLoad("wind", "leg", [0.0, 1.0])]),
            "no such beam",
        ),
        (lambda: ej.Scene([_BEAM]).centreline(ej.State([0.0], [0.0]), "leg"), "no beam"),
    ],
)  # fmt: skip
def test_bad_input_raises_one_error(call, message):
    with pytest.raises((TypeError, ValueError), match=message):
        call()
