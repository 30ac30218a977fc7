"""Bodies in the plane: energy, linear and angular momentum of schemes that keep them."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import enerjax as ej
from enerjax._discrete import ANGLE, OTHER, RotationRule
from enerjax._programs import Indices

from .helpers import EPS, follow, slopes


# The chain rule over a rotation -----------------------------------------------------------


def axes(angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c, s]), jnp.stack([-s, c])


def across(u, v):
    return u[0] * v[1] - u[1] * v[0]


PAIRS = np.array([[2, 5], [5, 2]])
# Functions of two bodies `(x, y, angle)` that do not change when both turn together.
INVARIANTS = dict(
    points=lambda q: jnp.sum((q[3:5] - q[:2] + axes(q[5])[0] - axes(q[2])[1]) ** 2),
    distance=lambda q: jnp.sqrt(jnp.sum((q[3:5] + 3 * axes(q[5])[0] - q[:2]) ** 2)),
    slide=lambda q: across(q[3:5] - q[:2], axes(q[2])[0]) ** 3,
    angle=lambda q: jnp.cos(3 * (q[5] - q[2] - 0.4)),
    far=lambda q: (q[2] - (q[5] + 2.0)) ** 2 * jnp.sum(axes(q[5])[0] * axes(q[2])[1]),
    middle=lambda q: jnp.sum(axes(0.5 * (q[2] + q[5]))[0] * (q[3:5] - q[:2])),
    turned_round=lambda q: jnp.cosh(0.3 - q[2] + q[5]) * (-(0.5 * q[2]) + q[5] / 2),
    halves=lambda q: jnp.sum(axes(0.5 * q[2] + 0.5 * q[5])[1] * (q[3:5] - q[:2])),
    tables=lambda q: jnp.sum(jnp.diff(q.reshape(2, 3)[:, 2]) ** 2),
    indices=lambda q: jnp.sum((q[np.array([5, 2])] - q[np.array([2, 5])]) ** 3),
    lanes=lambda q: jnp.sum(jax.vmap(lambda x: jnp.cosh(x[0] - x[1]))(q[PAIRS])),
    elements=lambda q: ej.Elements(lambda x, k, _: (x[1] - x[0]) ** 4, PAIRS)(q, None),
)
# Others, for which the rule is right but turns nothing together.
OTHERS = dict(
    angle=lambda q: q[2] ** 2 * q[0],
    multiple=lambda q: jnp.sin(2 * q[2] + q[1] / 3) * jnp.exp(-q[5]),
    all_at_once=lambda q: jnp.sum(jnp.tanh(q)) * jnp.dot(q, q),
    mean_of_three=lambda q: jnp.cos((q[2] + q[5] + q[0]) / 3),
)
BODIES = Indices(np.array([OTHER, OTHER, ANGLE] * 2))


def motions(size, seed=0):
    random = np.random.default_rng(seed)
    a, b, va, vb = random.normal(size=(4, 6))
    step = size * random.normal(size=6)
    half = np.where(BODIES.array == ANGLE, step / 2, 0.0)
    b = a + np.where(BODIES.array == ANGLE, 2 * np.arctan(half), step)
    return (a, va, None), (b, vb, None), step, half


def with_rates(function):
    """A function and its rate, with unequal weights."""
    both = lambda q, rates: jax.jvp(function, (q,), (rates,))
    return lambda x: 0.3 * both(*x[:2])[0] + both(*x[:2])[1]


@eqx.filter_jit
def gradients(fn, a, b, half):
    rule = RotationRule(BODIES, half)
    return rule.gradient(fn, a, b), rule.gradient_by_rates(fn, a[::2], b[::2]), fn(a), fn(b)


@pytest.mark.parametrize("name", [*INVARIANTS, *(f"other {x}" for x in OTHERS)])
def test_the_rule_has_the_change_of_the_function_and_no_torque(name):
    function = (INVARIANTS | {f"other {k}": f for k, f in OTHERS.items()})[name]
    fn = with_rates(function)
    for size in (1e-8, 0.1, 2.0, 50.0):
        a, b, step, half = motions(size)
        (rows, by_rates, _), alone, *values = gradients(fn, a, b, half)
        work = rows @ step + by_rates @ (b[1] - a[1])
        scale = np.sum(np.abs(rows * step)) + np.sum(np.abs(by_rates * (b[1] - a[1])))
        scale += np.abs(values).sum()
        near = functools.partial(np.testing.assert_allclose, rtol=0)
        near(work, values[1] - values[0], atol=200 * EPS * scale)
        near(alone, by_rates, atol=100 * EPS * scale)
        if name not in INVARIANTS:
            continue
        x, v = 0.5 * (a[0] + b[0]).reshape(2, 3), 0.5 * (a[1] + b[1]).reshape(2, 3)
        force, impulse = np.reshape(rows, (2, 3)), np.reshape(by_rates, (2, 3))
        lever = lambda x, f: x[:, 0] * f[:, 1] - x[:, 1] * f[:, 0]
        torque = np.sum(lever(x, force) + force[:, 2] + lever(v, impulse))
        sizes = (1 + np.abs(x).sum()) * np.abs(force).sum()
        sizes += np.abs(v).sum() * np.abs(impulse).sum()
        near(torque, 0.0, atol=100 * EPS * sizes)


@pytest.mark.parametrize("name", INVARIANTS)
def test_the_rule_is_symmetric_and_tends_to_the_gradient(name):
    fn, (a, b, _, half) = with_rates(INVARIANTS[name]), motions(0.3)
    there, back = gradients(fn, a, b, half)[0], gradients(fn, b, a, -half)[0]
    for x, y in zip(there[:2], back[:2], strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=200 * EPS * (1 + np.abs(x).max()))
    here = gradients(fn, a, a, 0 * half)[0]
    for x, y in zip(here[:2], jax.jit(jax.grad(fn))(a)[:2], strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=200 * EPS * (1 + np.abs(y).max()))


# Scenes ----------------------------------------------------------------------------------


def everything():
    """A free group of bodies with every kind of joint and spring, and a beam."""
    body, rod = ej.bodies.PlanarBody, ej.bodies.PlanarBody.rod
    turn, x0, v0 = 2.0, np.array([0.4, 0.3]), np.array([0.3, -0.2])
    at = lambda x, y: v0 + turn * np.array([x0[1] - y, x - x0[0]])
    section = ej.Section(EA=400.0, GA=200.0, EI=5.0, rhoA=0.5, rhoI=0.01)
    beam = ej.bodies.Beam(
        "beam", [[3.0, 1.0], [5.0, 1.0]], section, 2,
        velocity=at(4.0, 1.0), angular_velocity=turn,
    )  # fmt: skip
    moving: Any = lambda x, y: dict(velocity=at(x, y), angular_velocity=turn)
    parts = [
        rod("a", 1.0, [0.0, 0.0], [1.0, 0.0], **moving(0.5, 0.0)),
        rod("b", 2.0, [1.0, 0.0], [2.0, 0.0], velocity=at(1.5, 0.0) + [0.0, 0.5],
            angular_velocity=turn + 1.0),
        body("c", 0.7, 0.1, [1.7, 0.0], velocity=at(1.7, 0.0) + [0.4, 0.7],
             angular_velocity=turn + 1.0),
        body("d", 0.5, 0.2, [2.0, 1.0], 0.3, velocity=at(2.0, 1.0) + [-0.6, 1.0],
             angular_velocity=turn + 1.0),
        body("e", 1.5, 0.3, [3.0, 1.0], -1.0, **moving(3.0, 1.0)),
        ej.bodies.PointMass("point", 0.4, [0.0, 2.0], velocity=at(0.0, 2.0)),
        beam,
        ej.joints.Revolute("hinge", "a", "b", [0.5, 0.0]),
        ej.joints.Prismatic("slide", "b", "c", axis=[1.0, 0.0]),
        ej.joints.Fixed("weld", "c", "d", [0.0, 0.5]),
        ej.joints.Revolute("pin", "e", beam.start, [0.0, 0.0]),
        ej.joints.Distance("rope", "point", "a", point_b=[-0.5, 0.0]),
        ej.forces.TorsionSpring("coil", "a", "b", 3.0, angle=0.5),
        ej.forces.Spring("spring", "d", "e", 20.0, point_a=[0.1, 0.2], point_b=[0.2, 0.0]),
    ]  # fmt: skip
    return ej.Scene(parts)


def momenta(system, ys, args):
    """Linear and angular momentum about the origin of bodies `(x, y, angle)` and of points,
    and the sum of the sizes of the terms of the latter."""
    p = jax.vmap(
        lambda q, v: jax.grad(lambda v: system.kinetic_energy(ej.State(q, v), args))(v)
    )(ys.q, ys.v)
    names = system.names.coordinates
    x, y = (
        [k for k, name in enumerate(names) if name.endswith(end)] for end in (".x", ".y")
    )
    angles = [k for k, name in enumerate(names) if name.endswith(".angle")]
    terms = ys.q[:, x] * p[:, y] - ys.q[:, y] * p[:, x]
    angular = np.sum(terms, axis=1) + np.sum(p[:, angles], axis=1)
    size = np.abs(terms).sum(axis=1).max()
    return np.stack([p[:, x].sum(axis=1), p[:, y].sum(axis=1)]), angular, size


def run_of_everything(scheme, h=0.02):
    system, start, args = everything().build()
    sol = ej.simulate(system, scheme, start, args, h=h, num_steps=60)
    return system, args, sol


def check_momenta(system, args, sol):
    linear, angular, size = momenta(system, sol.ys, args)
    # Newton's tolerance and round-off; the angular momentum of the flat step is 1e-3 off.
    np.testing.assert_allclose(np.ptp(linear, axis=1), 0.0, atol=1e-13 * size)
    np.testing.assert_allclose(np.ptp(angular), 0.0, atol=1e-13 * size)
    assert size > 10


@pytest.mark.slow
def test_energy_and_momenta_of_joined_bodies_are_kept():
    system, args, sol = run_of_everything(ej.EnergyPreserving())
    check_momenta(system, args, sol)
    energy = np.asarray(sol.audit.energy)
    np.testing.assert_allclose(np.ptp(energy), 0.0, atol=1e-13 * np.abs(energy).max())
    np.testing.assert_allclose(sol.audit.constraint, 0.0, atol=1e-12)  # solver
    np.testing.assert_allclose(sol.audit.constraint_rate, 0.0, atol=1e-11)  # solver


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheme",
    [
        ej.EnergyPreserving("index3"),
        ej.Composed(ej.EnergyPreserving(), 4),
        ej.EnergyMomentumDecaying(0.0),
        ej.EnergyMomentumDecaying(0.5),
    ],
    ids=str,
)
def test_other_schemes_keep_momenta_and_their_law_of_the_energy(scheme):
    system, args, sol = run_of_everything(scheme)
    check_momenta(system, args, sol)
    size = np.abs(np.asarray(sol.audit.energy)).max()
    np.testing.assert_allclose(sol.audit.leak, 0.0, atol=1e-13 * size)  # Newton, round-off


@pytest.mark.slow
@pytest.mark.parametrize("formulation", ["ggl", "index3"])
def test_energy_decaying_keeps_its_law_of_the_energy(formulation):
    _, _, sol = run_of_everything(ej.EnergyDecaying(0.5, formulation), h=0.01)
    size = np.abs(np.asarray(sol.audit.energy)).max()
    np.testing.assert_allclose(sol.audit.leak, 0.0, atol=1e-13 * size)  # Newton, round-off
    assert np.all(np.asarray(sol.audit.dissipated) > -1e-13 * size)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [ej.Gonzalez(), ej.MeanValue()], ids=str)
def test_other_discrete_gradients_keep_the_energy(derivative):
    _, _, sol = run_of_everything(ej.EnergyPreserving(derivative=derivative))
    size = np.abs(np.asarray(sol.audit.energy)).max()
    np.testing.assert_allclose(np.ptp(sol.audit.energy), 0.0, atol=1e-12 * size)


# Two rods on a pin, which fly freely ------------------------------------------------------

HALF = np.array([0.5, 0.8])
MASS, INERTIA = np.array([1.0, 2.0]), np.array([0.1, 0.4])


def rods():
    table = [[0, 1, 2], [3, 4, 5]]
    kinetic = jnp.diag(jnp.asarray(np.stack([MASS, MASS, INERTIA], axis=1).ravel()))

    def potential(q, args):
        return 0.5 * args["k"] * (q[5] - q[2] - 0.3) ** 2

    def pin(q, args):
        first = q[:2] + HALF[0] * axes(q[2])[0]
        return first - (q[3:5] - HALF[1] * axes(q[5])[0])

    return ej.System(kinetic, potential, pin, rigid_bodies=table)


def placed(angles, rates):
    """Positions and velocities of the rods with their mass centre at rest at the origin."""
    (a, b), total = angles, MASS.sum()
    arm = HALF[0] * np.array([np.cos(a), np.sin(a)])
    arm = arm + HALF[1] * np.array([np.cos(b), np.sin(b)])
    rate = HALF[0] * rates[0] * np.array([-np.sin(a), np.cos(a)])
    rate = rate + HALF[1] * rates[1] * np.array([-np.sin(b), np.cos(b)])
    parts = -MASS[1] / total, MASS[0] / total
    q = np.concatenate([[*(parts[k] * arm), angles[k]] for k in (0, 1)])
    return q, np.concatenate([[*(parts[k] * rate), rates[k]] for k in (0, 1)])


@functools.cache
def exact(t, k):
    """The angles and their rates, by an explicit method of order 8."""
    reduced = MASS.prod() / MASS.sum()
    own = INERTIA + reduced * HALF**2

    def rates(_, y):
        a, b, da, db = y
        coupling = reduced * HALF.prod() * np.array([np.cos(a - b), np.sin(a - b)])
        matrix = [[own[0], coupling[0]], [coupling[0], own[1]]]
        torque = k * (b - a - 0.3)
        right = [torque - coupling[1] * db**2, -torque + coupling[1] * da**2]
        return [da, db, *np.linalg.solve(matrix, right)]

    run = solve_ivp(rates, (0, t), [0.2, 1.0, 3.0, -2.0], "DOP853", rtol=1e-13, atol=1e-13)
    return run.y[:, -1]


@pytest.fixture(scope="module")
def two_rods():
    system, args = rods(), dict(k=4.0)
    return system, ej.initial_state(system, *placed([0.2, 1.0], [3.0, -2.0]), args), args


@pytest.mark.parametrize(
    ("scheme", "order", "steps"),
    [
        (ej.EnergyPreserving(), 2, (40, 80, 160)),
        pytest.param(
            ej.Composed(ej.EnergyPreserving(), 4), 4, (20, 40, 80), marks=pytest.mark.slow
        ),
    ],
    ids=["2", "4"],
)
def test_a_run_converges_to_the_motion_in_minimal_coordinates(
    two_rods, scheme, order, steps
):
    system, start, args = two_rods
    expected = exact(2.0, 4.0)
    errors = []
    for n in steps:
        end, leak, _ = follow(system, scheme, start, args, h=2.0 / n, steps=n)
        errors.append(np.abs(np.concatenate([end.q[2::3], end.v[2::3]]) - expected).max())
        assert leak < 1e-12  # Newton's tolerance
        q, p = end.q.reshape(2, 3), (end.v * np.diag(system.kinetic)).reshape(2, 3)
        found = np.sum(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0] + p[:, 2])
        (q, v) = placed([0.2, 1.0], [3.0, -2.0])
        p = (v * np.diag(system.kinetic)).reshape(2, 3)
        q = q.reshape(2, 3)
        angular = np.sum(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0] + p[:, 2])
        np.testing.assert_allclose(found, angular, rtol=0, atol=1e-12)  # solver
    assert np.all(np.abs(slopes(errors) - order) < 0.25), (
        errors,
        slopes(errors),
    )  # truncation


@pytest.mark.slow
def test_the_gradient_of_a_run_is_that_of_differences(two_rods):
    system, start, args = two_rods

    def end(k):
        sol = ej.simulate(
            system, ej.EnergyPreserving(), start, dict(k=k), h=0.05, num_steps=10
        )
        return sol.ys.q[-1] @ jnp.arange(1.0, 7.0)

    h = 1e-4
    differences = end(4.0 - 2 * h) - 8 * end(4.0 - h) + 8 * end(4.0 + h) - end(4.0 + 2 * h)
    # Differences of order 4 lose digits: round-off over the step.
    np.testing.assert_allclose(jax.grad(end)(4.0), differences / (12 * h), rtol=1e-9)


# One body --------------------------------------------------------------------------------


def free_body():
    kinetic = jnp.diag(jnp.array([2.0, 2.0, 0.3]))
    return ej.System(kinetic, lambda q, args: 0.0 * q[0], rigid_bodies=[[0, 1, 2]])


@pytest.mark.parametrize("spin", [0.1, 3.0, 7.0, 60.0])
@pytest.mark.slow_for("0.1", "7.0")
def test_a_body_that_turns_freely_is_late_by_the_formula_of_cayley(spin):
    # In the last cases it turns by more than half a turn, and by ten turns, in one step:
    # energy and momenta are still right, and the step turns it by less than half a turn.
    system = free_body()
    start = ej.State([1.0, 2.0, 0.5], [0.3, -0.4, spin])
    out = ej.step(system, ej.EnergyPreserving(), start, h=1.0)
    assert out.result == ej.RESULTS.successful
    np.testing.assert_allclose(out.state.v, start.v, rtol=10 * EPS)
    turned = 2 * np.arctan(spin / 2)
    np.testing.assert_allclose(out.state.q, [1.3, 1.6, 0.5 + turned], rtol=10 * EPS)
    if spin == 0.1:
        late = 1 - turned / spin
        np.testing.assert_allclose(late, spin**2 / 12, rtol=spin**2)  # truncation


@pytest.mark.slow
def test_a_drive_by_more_than_half_a_turn_in_a_step_fails():
    scene = ej.Scene(
        [
            ej.bodies.PlanarBody("wheel", 1.0, 0.3, [0.0, 0.0]),
            ej.joints.Revolute("axle", "ground", "wheel", [0.0, 0.0]),
            ej.drives.Angle("motor", "ground", "wheel", lambda t, args: args["speed"] * t),
        ],
        args={"speed": 1.0},
    )
    system, _, args = scene.build()
    ends = {}
    for speed in (2.0, 4.0):
        own = args.set(speed=speed)
        ends[speed] = ej.step(system, ej.EnergyPreserving(), scene.start(own), own, h=1.0)
    np.testing.assert_allclose(ends[2.0].state.q[2], 2.0, atol=1e-12)  # solver
    assert ends[2.0].result == ej.RESULTS.successful
    assert ends[4.0].result != ej.RESULTS.successful


def test_bodies_in_the_plane_are_checked():
    matrix = jnp.diag(jnp.array([1.0, 1.0, 0.3]))
    potential = lambda q, args: 0.0 * q[0]
    with pytest.raises(ValueError, match=r"\(bodies, 3\)"):
        ej.System(matrix, potential, rigid_bodies=[[0, 1]])
    for wrong in (matrix.at[0, 0].set(2.0), matrix.at[0, 2].set(0.1).at[2, 0].set(0.1)):
        system = ej.System(wrong, potential, rigid_bodies=[[0, 1, 2]])
        with pytest.raises(ValueError, match="mass centre"):
            ej.initial_state(system, jnp.zeros(3), jnp.zeros(3))
    system = ej.System(matrix, potential, rigid_bodies=[[0, 1, 3]])
    with pytest.raises(ValueError, match="index 3"):
        ej.initial_state(system, jnp.zeros(3), jnp.zeros(3))
