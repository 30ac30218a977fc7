"""`EnergyMomentumDecaying`: decay that keeps linear and angular momentum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import EPS, follow, problem, slopes


def stretch(x, k, args):
    apart = x[:3] - x[3:]
    return jnp.sqrt(jnp.sum(apart**2)) - args["rest"][k]


def stiffness(k, args):
    return args["k"][k]


MASSES = np.array([1.0, 2.0, 1.0, 2.0])
RODS = np.array([[0, 1], [2, 3]])
PAIRS = np.array([[1, 2], [0, 2], [1, 3], [0, 3]])
PLACES = np.array([[0, 0, 0], [1, 0.2, 0.1], [2, 0, 0.4], [3, 0.2, 0.9]])


def points(rods, redundant=False, **options):
    """Four free points in space with springs, and rods between some of them."""
    index = np.arange(12).reshape(4, 3)
    table = np.hstack([index[PAIRS[:, 0]], index[PAIRS[:, 1]]])
    lengths = lambda x, pairs: jnp.sum((x[pairs[:, 0]] - x[pairs[:, 1]]) ** 2, axis=1)

    def constraint(q, args):
        rows = lengths(q.reshape(4, 3), RODS) - lengths(PLACES, RODS)
        return jnp.concatenate([rows, 2 * rows[:1]]) if redundant else rows

    return ej.System(
        jnp.diag(jnp.repeat(jnp.asarray(MASSES), 3)),
        ej.Elements.from_strains(stretch, stiffness, table),
        constraint if rods else None,
        redundant=redundant,
        **options,
    )


def numbers(k):
    apart = PLACES[PAIRS[:, 0]] - PLACES[PAIRS[:, 1]]
    rest = jnp.linalg.norm(jnp.asarray(apart), axis=1)
    return dict(k=k * jnp.array([1.0, 0.7, 1.3, 0.4]), rest=rest)


def spinning(system, args):
    random = np.random.default_rng(1).normal(size=(4, 3))
    v = np.cross([0.0, 0.7, 2.0], PLACES) + 0.5 * random
    return ej.initial_state(system, PLACES.ravel(), v.ravel(), args)


def momenta(ys):
    q, v = (np.asarray(x).reshape(-1, 4, 3) for x in (ys.q, ys.v))
    p = MASSES[:, None] * v
    return p.sum(axis=1), np.cross(q, p).sum(axis=1)


FREE, LINKED = points(rods=False), points(rods=True)
# Two points in the plane with a spring of length one between them.
PAIR = ej.System(
    jnp.eye(4),
    ej.Elements.from_strains(
        lambda x, k, args: jnp.sqrt(jnp.sum((x[:2] - x[2:]) ** 2)) - 1,
        lambda k, args: args,
        [[0, 1, 2, 3]],
    ),
)
PAIR_START = ej.State(jnp.array([0.5, 0, -0.5, 0]), jnp.array([0, 0.5, 0, -0.5]))
OSCILLATOR = ej.System(
    jnp.eye(1), ej.Elements.from_strains(lambda x, k, args: x, lambda k, args: 1e8, [[0]])
)


@jax.jit
def run_of_linked(alpha, k):
    args = numbers(k)
    start = spinning(LINKED, args)
    scheme = ej.EnergyMomentumDecaying(alpha)
    return ej.simulate(LINKED, scheme, start, args, h=4e-3, num_steps=60, throw=False)


@pytest.mark.parametrize("k", [50.0, 1e6])
@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_energy_law_momenta_and_constraints_hold_to_round_off(alpha, k):
    sol = run_of_linked(alpha, k)
    energy, momentum = 20.0, 20.0
    assert np.max(np.abs(sol.audit.leak)) <= 500 * EPS * energy
    for found in momenta(sol.ys):
        assert np.max(np.abs(found)) > 1
        assert np.max(np.abs(found - found[0])) <= 100 * EPS * momentum
    assert np.max(np.abs(sol.audit.constraint)) <= 100 * EPS
    assert np.max(np.abs(sol.audit.constraint_rate)) <= 1e3 * EPS
    assert np.all(sol.audit.dissipated[1:] >= 0)
    # The springs are slack at the start, and swing: stiff ones much faster than the step.
    lost = float(np.sum(sol.audit.dissipated))
    assert lost == 0 if alpha == 0 else lost > (1e-3 if k > 1e3 else 1e-8)


@pytest.mark.slow
def test_energy_decaying_loses_angular_momentum_there():
    args = numbers(1e6)
    start, scheme = spinning(LINKED, args), ej.EnergyDecaying(0.5)
    sol = ej.simulate(LINKED, scheme, start, args, h=4e-3, num_steps=60)
    _, angular = momenta(sol.ys)
    assert np.max(np.abs(angular - angular[0])) > 1e-4


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_the_spectral_radius_of_an_oscillator(alpha):
    """Amplitudes of an oscillation that is 1e4 times faster than the step."""
    start = ej.State(jnp.ones(1), jnp.zeros(1))
    scheme = ej.EnergyMomentumDecaying(alpha)
    sol = ej.simulate(OSCILLATOR, scheme, start, h=1.0, num_steps=2)
    sizes = np.hypot(1e4 * np.asarray(sol.ys.q)[:, 0], np.asarray(sol.ys.v)[:, 0])
    expected = (1 - alpha) / (1 + alpha)
    assert sizes[2] / sizes[1] == pytest.approx(expected, abs=4e-4)  # of order 1/(h w)
    of_radius = ej.EnergyMomentumDecaying.from_spectral_radius(expected)
    assert float(of_radius.alpha) == pytest.approx(alpha, abs=4 * EPS)


def test_the_spectral_radius_where_a_constraint_holds():
    """The spring moves two points that a rod keeps together, so its mobility is halved."""
    system = ej.System(
        jnp.eye(2),
        ej.Elements.from_strains(lambda x, k, args: x, lambda k, args: 2e8, [[0]]),
        lambda q, args: q[:1] - q[1:],
    )
    start = ej.State(jnp.ones(2), jnp.zeros(2))
    sol = ej.simulate(system, ej.EnergyMomentumDecaying(0.5), start, h=1.0, num_steps=2)
    sizes = np.hypot(1e4 * np.asarray(sol.ys.q)[:, 0], np.asarray(sol.ys.v)[:, 0])
    assert sizes[2] / sizes[1] == pytest.approx(1 / 3, abs=4e-4)  # of order 1/(h w)


@pytest.mark.slow
def test_on_a_linear_oscillator_it_is_energy_consistent():
    """Two coupled oscillators with a full stiffness matrix, at order one times `h w`."""
    matrix = np.array([[3.0, -1.0], [-1.0, 2.0]])
    system = ej.System(
        jnp.diag(jnp.array([1.0, 2.0])),
        ej.Elements.from_strains(lambda x, k, args: x, lambda k, args: matrix, [[0, 1]]),
    )
    start = ej.State(jnp.array([1.0, -0.5]), jnp.array([0.2, 0.3]))
    ends = [
        ej.simulate(system, scheme(0.6), start, h=0.9, num_steps=5).ys
        for scheme in (ej.EnergyMomentumDecaying, ej.EnergyConsistent)
    ]
    np.testing.assert_allclose(ends[0].q, ends[1].q, rtol=0, atol=100 * EPS)
    np.testing.assert_allclose(ends[0].v, ends[1].v, rtol=0, atol=100 * EPS)


def test_the_order_is_two():
    """Against `EnergyConsistent(0)`, of order 4, with a third of the shortest step."""
    start = ej.State(PAIR_START.q * 1.1, PAIR_START.v * 2)

    def end(scheme, steps):
        return follow(PAIR, scheme, start, 50.0, h=0.4 / steps, steps=steps)[0].q

    exact = end(ej.EnergyConsistent(0.0, ej.MeanValue()), 240)
    scheme = ej.EnergyMomentumDecaying(0.7)
    errors = [float(jnp.max(jnp.abs(end(scheme, n) - exact))) for n in (20, 40, 80)]
    assert errors[-1] < 1e-4
    np.testing.assert_allclose(slopes(errors), 2.0, atol=0.15)


@pytest.mark.slow
def test_the_order_is_two_however_stiff_springs_are():
    """Here `h w` is between 50 and 1000. `EnergyDecaying` is of order 1 and less."""
    args = numbers(1e8)
    v = np.cross([0.0, 0.7, 2.0], PLACES)
    start = ej.initial_state(FREE, PLACES.ravel(), v.ravel(), args)
    errors = {}
    for make in (ej.EnergyMomentumDecaying, ej.EnergyDecaying):
        ends = [
            follow(FREE, make(0.5), start, args, h=0.32 / n, steps=n)[0].q
            for n in (20, 40, 80, 160)
        ]
        errors[make] = [float(jnp.max(jnp.abs(x))) for x in np.diff(ends, axis=0)]
    orders = slopes(errors[ej.EnergyMomentumDecaying])
    np.testing.assert_allclose(orders, 2.0, atol=0.1)
    assert np.all(slopes(errors[ej.EnergyDecaying]) < 1.2)


@pytest.mark.slow
def test_stiff_parts_that_turn_lose_nothing():
    """Two points with a spring of `h w = 1400` that turn about their middle: one by hand.

    The exact motion turns by one radian, and the spring oscillates by `1/(4 k)` of its
    length. `EnergyConsistent` takes its jump from the linear force, and stops the motion.
    """
    lost, angles = {}, {}
    for make in (ej.EnergyMomentumDecaying, ej.EnergyConsistent):
        sol = ej.simulate(PAIR, make(1.0), PAIR_START, 1e8, h=0.1, num_steps=10)
        lost[make] = 1 - float(sol.audit.energy[-1] / sol.audit.energy[0])
        angles[make] = float(jnp.arctan2(sol.ys.q[-1, 1], sol.ys.q[-1, 0]))
    assert 0 < lost[ej.EnergyMomentumDecaying] < 1e-8
    # The error of the rotation of a rigid body in each step is that of `2 atan(h w / 2)`.
    expected = 20 * np.arctan(0.05)
    assert angles[ej.EnergyMomentumDecaying] == pytest.approx(expected, abs=1e-6)
    assert lost[ej.EnergyConsistent] > 0.9
    assert angles[ej.EnergyConsistent] < 0.5


def gradients_agree(end, p, steps, rtol):
    """In both modes, and against central differences with these steps."""
    value, rows = jax.jit(end), np.diag(steps)
    reverse, forward = jax.jit(jax.grad(end))(p), jax.jit(jax.jacfwd(end))(p)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)  # solver
    by_differences = [(value(p + x) - value(p - x)) / (2 * x.sum()) for x in rows]
    assert np.min(np.abs(reverse)) > 1e-7
    np.testing.assert_allclose(reverse, by_differences, rtol=rtol)  # truncation


@pytest.mark.slow
def test_gradients_of_a_run():
    """By alpha, the stiffness, the start and the step."""

    def end(p):
        alpha, k, push, h = p
        start = ej.State(PAIR_START.q * 1.1, PAIR_START.v.at[0].add(push))
        scheme = ej.EnergyMomentumDecaying(alpha)
        sol = ej.simulate(PAIR, scheme, start, k, h=h, num_steps=10, throw=False)
        return sol.ys.q[-1] @ jnp.arange(1.0, 5.0)

    p = jnp.array([0.5, 400.0, 0.1, 0.05])
    gradients_agree(end, p, [1e-4, 1e-2, 1e-4, 1e-6], rtol=1e-5)


@pytest.mark.slow
def test_gradients_of_a_run_with_constraints():
    """The start is moved along the constraints."""
    begin = spinning(LINKED, numbers(400.0))

    def end(p):
        alpha, k, push = p
        args, v = numbers(k), begin.v.at[0].add(push)
        start = ej.initial_state(LINKED, begin.q, v, args)
        scheme = ej.EnergyMomentumDecaying(alpha)
        sol = ej.simulate(LINKED, scheme, start, args, h=0.02, num_steps=10, throw=False)
        return jnp.sum(sol.ys.q[-1] * jnp.cos(jnp.arange(12.0)))

    gradients_agree(end, jnp.array([0.5, 400.0, 0.0]), [1e-4, 0.1, 1e-4], rtol=1e-4)


@pytest.mark.slow
def test_redundant_constraints_change_nothing():
    args = numbers(1e4)
    system = points(rods=True, redundant=True)
    start, scheme = spinning(LINKED, args), ej.EnergyMomentumDecaying(0.5)
    runs = [
        ej.simulate(x, scheme, start, args, h=4e-3, num_steps=60) for x in (system, LINKED)
    ]
    assert np.max(np.abs(runs[0].audit.leak)) <= 1e4 * EPS * 20
    for found in momenta(runs[0].ys):
        assert np.max(np.abs(found - found[0])) <= 200 * EPS * 20
    # Redundant rows are solved for to the square of their regularisation.
    np.testing.assert_allclose(runs[0].ys.q, runs[1].ys.q, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_forces_and_the_rest_of_the_potential_enter_the_balance():
    """Gravity, which is not damped, a damper, and a point that is moved."""
    index = np.arange(12).reshape(4, 3)
    gravity = ej.Elements(
        lambda x, k, args: 9.81 * jnp.asarray(MASSES)[k] * x[0], index[:, 2:]
    )
    springs = ej.Elements.from_strains(
        stretch, stiffness, np.hstack([index[PAIRS[:, 0]], index[PAIRS[:, 1]]])
    )
    system = ej.System(
        jnp.diag(jnp.repeat(jnp.asarray(MASSES), 3)),
        springs + gravity,
        force=lambda q, v, t, args: -0.3 * v,
        driven=lambda q, t, args: q[:3] - jnp.stack([jnp.sin(3 * t), 0 * t, 0 * t]),
    )
    args = numbers(300.0)
    v = np.zeros(12)
    v[0] = 3.0
    start = ej.initial_state(system, PLACES.ravel(), v, args)
    sol = ej.simulate(
        system, ej.EnergyMomentumDecaying(0.5), start, args, h=0.01, num_steps=60
    )
    size = float(np.max(np.abs(sol.audit.energy)))
    assert np.max(np.abs(sol.audit.leak)) <= 1e3 * EPS * size
    assert np.sum(sol.audit.work) < -0.1
    assert np.max(np.abs(np.asarray(sol.audit.drive_work))) > 0.01
    assert np.sum(sol.audit.dissipated) > 0


@pytest.mark.slow
def test_hinged_rigid_bodies_keep_their_angular_momentum():
    """Free bodies in space that are moved by rotations, with joints and stiff springs."""
    random = np.random.default_rng(1)
    inertia = np.array([0.01, 0.1, 0.1])
    bodies = [
        ej.bodies.RigidBody(f"body {k}", 1.0, inertia, [k + 0.5, 0, 0]) for k in range(2)
    ]
    hinge = ej.joints.Revolute(
        "hinge", "body 0", "body 1", [0.5, 0, 0], [-0.5, 0, 0], axis=[0, 0, 1.0]
    )
    spring = ej.forces.Spring(
        "spring", "body 0", "body 1", 1e6, point_a=[-0.2, 0.3, 0.1],
        point_b=[0.1, -0.3, 0.4],
    )  # fmt: skip
    scene = ej.Scene([*bodies, hinge, spring])
    start = ej.initial_state(
        scene.system, scene.q, random.normal(size=scene.v.shape), scene.args
    )
    sol = ej.simulate(
        scene.system, ej.EnergyMomentumDecaying(0.5), start, scene.args, h=4e-3,
        num_steps=60,
    )  # fmt: skip
    q, v = (np.asarray(x).reshape(-1, 2, 4, 3) for x in (sol.ys.q, sol.ys.v))
    second = 0.5 * inertia.sum() - inertia
    spin = np.einsum("i,tnij->tj", second, np.cross(q[:, :, 1:], v[:, :, 1:]))
    angular = np.cross(q[:, :, 0], v[:, :, 0]).sum(axis=1) + spin
    assert np.max(np.abs(angular)) > 0.3
    assert np.max(np.abs(angular - angular[0])) <= 100 * EPS
    assert np.max(np.abs(sol.audit.leak)) <= 1e3 * EPS
    assert np.sum(sol.audit.dissipated) > 1e-6


def test_what_it_cannot_damp_is_refused():
    scheme = ej.EnergyMomentumDecaying(0.5)
    system, start, args = problem("pendulum")
    with pytest.raises(ValueError, match="damps strains, and this system has none"):
        ej.step(system, scheme, start, args, h=0.01)
    for name, has in (("top", "`kinematics`"), ("double angles", "varying inertia")):
        system, start, args = problem(name)
        with pytest.raises(ValueError, match=has):
            ej.step(system, scheme, start, args, h=0.01)


def test_strains_and_stiffnesses_must_fit():
    make = ej.Elements.from_strains
    with pytest.raises(TypeError, match="`stiffness` must be a function"):
        make(stretch, 3.0, [[0]])  # pyright: ignore
    matrix = make(lambda x, k, args: x, lambda k, args: jnp.ones((3, 2)), [[0, 1]])
    with pytest.raises(ValueError, match="is 2, so `stiffness`"):
        matrix(jnp.ones(2))
    bad = make(lambda x, k, args: x[None], lambda k, args: 1.0, [[0, 1]])
    with pytest.raises(ValueError, match="a number or a vector"):
        bad(jnp.ones(2))
