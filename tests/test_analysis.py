"""Equilibria, vibrations about them, and the degrees of freedom of mechanisms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import jn_zeros

import enerjax as ej

from .helpers import problem


def _sagging(num_links, span):
    """A chain of unit weight and length between two points, and a guess of its shape."""
    length = 1 / num_links
    anchors = jnp.array([[0.0, 0.0], [span, 0.0]])

    def rods(q, args):
        points = jnp.concatenate([anchors[:1], q.reshape(-1, 2), anchors[1:]])
        return jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1) - args["l"] ** 2

    system = ej.System(
        lambda v, args: 0.5 * args["m"] * v @ v,
        lambda q, args: -args["m"] * 9.81 * jnp.sum(q[1::2]),
        rods,
    )
    x = np.linspace(0, span, num_links + 1)[1:-1]
    guess = np.stack([x, 1.2 * x * (span - x)], axis=1).ravel()
    args = {"m": jnp.asarray(1 / num_links), "l": jnp.asarray(length)}
    return system, ej.State(guess, np.zeros(guess.size)), args


def _polygon(num_links, span):
    """Closed form: horizontal tension is constant, slopes grow by a weight a joint."""
    length, weight = 1 / num_links, 9.81 / num_links
    steps = np.arange(num_links) - (num_links - 1) / 2
    slopes = lambda tension: -steps * weight / tension
    width = lambda tension: np.sum(length / np.sqrt(1 + slopes(tension) ** 2)) - span
    tension = brentq(width, 1e-3, 1e3, xtol=1e-15)
    x = length / np.sqrt(1 + slopes(tension) ** 2)
    rods = np.stack([x, x * slopes(tension)], axis=1)
    return np.cumsum(rods, axis=0)[:-1].ravel()


@pytest.mark.slow
def test_a_hanging_chain_rests_in_the_catenary_polygon():
    system, guess, args = _sagging(12, 0.6)
    found = ej.equilibrium(system, guess, args)
    np.testing.assert_allclose(found.state.q, _polygon(12, 0.6), atol=1e-12)  # solver
    assert np.all(found.state.v == 0)
    assert system.constraint is not None
    pulls = found.multipliers @ jax.jacfwd(system.constraint)(found.state.q, args)
    weights = np.tile([0.0, 9.81 / 12], 11)
    np.testing.assert_allclose(pulls, weights, rtol=0, atol=1e-12)  # solver
    # Its derivative along a change of the lengths, by differences.
    sag = lambda l: ej.equilibrium(system, guess, args | {"l": l}).state.q[11]
    step, l = 1e-5, args["l"]
    change = (sag(l + step) - sag(l - step)) / (2 * step)
    assert jax.grad(sag)(l) == pytest.approx(float(change), rel=1e-7)  # truncation
    assert jax.jvp(sag, (l,), (1.0,))[1] == pytest.approx(float(change), rel=1e-7)


@pytest.mark.parametrize("stiffness", [0.0, 1.0, 20.0])
@pytest.mark.slow_for("1.0", "20.0")
def test_a_horizontal_arm_comes_to_rest(stiffness):
    """Two links on torsion springs that are relaxed where they are horizontal: without
    springs, or on soft ones, Newton's method does not find the way from there."""
    springs = lambda q, args: 0.5 * args * (q[0] ** 2 + (q[1] - q[0]) ** 2)
    weight = lambda q: 9.81 * (1.5 * jnp.sin(q[0]) + 0.5 * jnp.sin(q[1]))
    system = ej.System(jnp.eye(2), lambda q, args: springs(q, args) + weight(q))
    start = ej.State(jnp.zeros(2), jnp.zeros(2))
    q = ej.equilibrium(system, start, stiffness).state.q
    moment = jax.grad(lambda q: springs(q, stiffness) + weight(q))
    # Solver; and stable, between horizontal and hanging.
    np.testing.assert_allclose(moment(q), 0, atol=1e-12)
    assert np.all(np.linalg.eigvalsh(jax.jacfwd(moment)(q)) > 0)
    assert np.all((q < 0) & (q >= -np.pi / 2 - 1e-12))
    if stiffness == 0:
        np.testing.assert_allclose(q, -np.pi / 2)
    slope = jax.jacfwd(lambda k: ej.equilibrium(system, start, k).state.q)(stiffness)
    by_hand = -jnp.linalg.solve(
        jax.jacfwd(moment)(q), jax.jacfwd(jax.grad(springs), argnums=1)(q, stiffness)
    )
    np.testing.assert_allclose(slope, by_hand, rtol=1e-9)  # round-off


def test_drives_stand_where_they_are_at_the_time():
    """A weight on a rod below a pivot that moves."""
    pivot = lambda t: jnp.stack([jnp.sin(3 * t), 0.2 * t])
    system = ej.System(
        jnp.eye(4),
        lambda q, args: 9.81 * q[3],
        lambda q, args: jnp.stack([jnp.sum((q[2:] - q[:2]) ** 2) - 1]),
        driven=lambda q, t, args: q[:2] - pivot(t),
    )
    guess = ej.State([0.8, 0.0, 1.2, -0.9], [0.0] * 4)
    found = ej.equilibrium(system, guess, t=0.4)
    x, y = pivot(0.4)
    np.testing.assert_allclose(found.state.q, [x, y, x, y - 1], rtol=0, atol=1e-12)
    # Solver: the rod, and the pivot, carry the weight.
    np.testing.assert_allclose(found.multipliers, [9.81 / 2, 0, -9.81], rtol=0, atol=1e-11)


def test_a_stiff_beam_bends_in_proportion_to_small_loads():
    """The round-off of its stiff forces is far above the smallest of these loads times the
    machine epsilon."""
    section = ej.Section.rectangle(0.02, 0.01, E=210e9, nu=0.3, rho=7850.0)
    beam = ej.bodies.Beam("beam", [[0.0, 0.0], [1.0, 0.0]], section, 8)
    clamp = ej.joints.Fixed("clamp", "ground", beam.start)
    load = ej.forces.ConstantForce("load", beam.end, [0.0, 0.0])
    scene = ej.Scene([beam, clamp, load])
    system, start, args = scene.build()
    stiffness = args["beams"]["beam"]

    def deflection(force):
        numbers = args.set("load", force=jnp.stack([0.0 * force, -force]))
        pose = ej.equilibrium(system, start, numbers).state
        return -scene.position(pose, beam.end)[1]

    forces = jnp.array([0.01, 0.1, 1.0, 3.0])
    flexibility = jax.vmap(deflection)(forces) / forces
    # Truncation: large deflections change it by the square of the load.
    np.testing.assert_allclose(flexibility, flexibility[0], rtol=1e-5)
    # Truncation: Bernoulli's and Timoshenko's beam, by eight elements.
    expected = 1 / (3 * stiffness["EI"]) + 1 / stiffness["GA"]
    np.testing.assert_allclose(flexibility[0], expected, rtol=5e-3)


def test_a_missing_equilibrium_raises_an_error():
    system, start, args = problem("particles")
    free = ej.System(system.kinetic, lambda q, args: q[1])
    with pytest.raises(ValueError, match="No equilibrium was found"):
        ej.equilibrium(free, start, args)


@pytest.mark.slow
def test_modes_of_a_hanging_chain():
    """Transverse modes are those of a string of beads, in the limit Bessel's."""
    num_links = 40
    system, _, args = ej.problems.chain(num_links)
    length = 1 / num_links
    hanging = np.stack([np.zeros(num_links), length * np.arange(1, num_links + 1)], axis=1)
    rest = ej.State(hanging.ravel(), np.zeros(2 * num_links))
    found = ej.modes(system, rest, args)
    assert found.eigenvalues.shape == (num_links,)
    # Tension below bead k, of the n-k beads there: m x'' = T_k (x_k-1 - x_k) / l ...
    tension = 9.81 * np.arange(num_links, 0, -1) / length
    matrix = np.diag(tension + np.append(tension[1:], 0)) - np.diag(tension[1:], 1)
    matrix -= np.diag(tension[1:], -1)
    np.testing.assert_allclose(found.eigenvalues, np.linalg.eigvalsh(matrix), rtol=1e-10)
    string = jn_zeros(0, 3) / 2 * np.sqrt(9.81)
    np.testing.assert_allclose(found.frequencies[:3], string, rtol=0.05)  # of order 1/N
    gram = found.shapes @ found.shapes.T / num_links
    np.testing.assert_allclose(gram, np.eye(num_links), atol=1e-10)
    # Frequencies go with the root of gravity.
    first = lambda g: ej.modes(system, rest, args | {"g": g}).frequencies[0]
    assert jax.grad(first)(9.81) == pytest.approx(float(first(9.81)) / 9.81 / 2, rel=1e-9)


def test_modes_of_a_ring_of_springs():
    """Masses on a line ring of linear springs: 2 sqrt(k/m) sin(pi j / n)."""
    n, k, m = 9, 7.0, 0.3
    system = ej.System(
        m * np.eye(n), lambda q, args: 0.5 * k * jnp.sum((jnp.roll(q, 1) - q) ** 2)
    )
    found = ej.modes(system, ej.State(np.zeros(n), np.zeros(n)))
    j = np.array([0, 1, 1, 2, 2, 3, 3, 4, 4])
    exact = 4 * k / m * np.sin(np.pi * j / n) ** 2
    np.testing.assert_allclose(found.eigenvalues, exact, atol=1e-12 * k / m * n)


def test_an_inverted_pendulum_is_unstable():
    system, _, args = problem("pendulum")
    growth = []
    for y in (1.0, -1.0):
        found = ej.equilibrium(system, ej.State([0.01, y], [0.0, 0.0]), args)
        growth.append(float(ej.modes(system, found.state, args).frequencies[0]))
    np.testing.assert_allclose(growth, [np.sqrt(9.81), -np.sqrt(9.81)], rtol=1e-12)


def test_a_pose_out_of_balance_has_no_modes():
    system, start, args = problem("pendulum")  # horizontal: its weight is not carried
    with pytest.raises(ValueError, match="out of balance: -9.81 along coordinate 1"):
        ej.modes(system, start, args)


def _parallelogram(offset=0.0):
    """Four bars and a fifth that repeats the others where it is parallel."""

    def bars(q, args):
        left, right = q[:2], q[2:]
        middle = 0.5 * (left + right)
        return jnp.array(
            [
                left @ left - 1,
                (right - jnp.array([2.0, 0.0])) @ (right - jnp.array([2.0, 0.0])) - 1,
                (right - left) @ (right - left) - 4,
                (middle - jnp.array([1.0, 0.0])) @ (middle - jnp.array([1.0, 0.0]))
                - (1 + offset),
            ]
        )

    system = ej.System(np.eye(4), lambda q, args: 9.81 * (q[1] + q[3]), bars)
    up = np.array([np.cos(1.0), np.sin(1.0)])
    return system, ej.State(np.concatenate([up, up + [2, 0]]), np.zeros(4))


def test_mobility_of_an_over_constrained_loop():
    system, pose = _parallelogram()
    found = ej.mobility(system, pose, names=["left", "right", "coupler", "middle"])
    assert (found.degrees_of_freedom, found.rank, found.num_constraints) == (1, 3, 4)
    assert len(found.redundant) == 1
    assert found.inconsistent == ()
    velocity = found.velocities[:, 0]
    exact = np.tile([-np.sin(1.0), np.cos(1.0)], 2) / np.sqrt(2)
    np.testing.assert_allclose(np.abs(velocity @ exact), 1, rtol=1e-12)
    system, pose = _parallelogram(offset=0.1)
    found = ej.mobility(system, pose)
    assert 3 in found.inconsistent
    with pytest.raises(ValueError, match="2 names for 4 constraints"):
        ej.mobility(system, pose, names=["a", "b"])


def test_round_off_is_not_inconsistent():
    """Of rows whose every term almost vanishes, and that repeat each other."""
    twice = lambda q, args: jnp.array([q[0], 2 * q[0] - 4e-16])
    system = ej.System(np.eye(2), lambda q, args: 0.0 * q[0], twice, redundant=True)
    found = ej.mobility(system, ej.State([5e-18, 1.0], np.zeros(2)))
    assert (found.redundant, found.inconsistent) == ((1,), ())


def test_mobility_in_a_singular_pose():
    """Flat, the parallelogram can also fold into a crossed one."""
    system, pose = _parallelogram()
    flat = ej.State([1.0, 0.0, 3.0, 0.0], np.zeros(4))
    assert ej.mobility(system, flat).degrees_of_freedom == 2
    assert ej.mobility(system, pose).degrees_of_freedom == 1
    assert ej.mobility(*problem("top")).degrees_of_freedom == 3
