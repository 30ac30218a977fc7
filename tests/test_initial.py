"""Consistent starts: the smallest correction, accelerations and multipliers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import EPS, problem
from .references import HEAVY_TOP


def unequal():
    system, _, args = problem("double")
    return system, args | dict(m1=1.0, m2=5.0)


# Off the rods by a fortieth, and off their velocity level.
GUESS = dict(q=[0.97, 0.1, 1.9, 0.4], v=[0.3, 0.5, -0.2, 1.0])


def outside_of_the_rows(rows, x):
    """The part of `x` that is no combination of the rows, relative to `x`."""
    x, rows = np.asarray(x), np.asarray(rows)
    multipliers = np.linalg.lstsq(rows.T, x, rcond=None)[0]
    return np.max(np.abs(x - rows.T @ multipliers)) / np.max(np.abs(x))


def test_positions_move_by_the_smallest_change_in_the_inertia():
    system, args = unequal()
    start = ej.initial_state(system, GUESS["q"], GUESS["v"], args)
    # Solver.
    np.testing.assert_allclose(system.constraint(start.q, args), 0, atol=20 * EPS)
    change = start.q - jnp.array(GUESS["q"])
    assert np.max(np.abs(change)) > 1e-3
    # Stationary: M dq is a combination of the gradients of the constraints at the end.
    gradients = jax.jacrev(system.constraint)(start.q, args)
    momentum = jnp.array([1.0, 1.0, 5.0, 5.0]) * change
    assert outside_of_the_rows(gradients, momentum) <= 1e-12
    # In another metric it would be another point.
    assert outside_of_the_rows(gradients, change) > 1e-3


def test_the_smallest_change_in_an_inertia_that_couples_the_coordinates():
    inertia = jnp.array([[2.0, 0.9], [0.9, 1.0]])
    system = ej.System(
        inertia, lambda q, args: 0.0 * q[0], problem("pendulum").system.constraint
    )
    guess, slow = jnp.array([0.9, 0.5]), jnp.array([0.3, 0.7])
    start = ej.initial_state(system, guess, slow, dict(l=1.0))
    assert (
        outside_of_the_rows(start.q[None], inertia @ (start.q - guess)) <= 1e-12
    )  # solver
    assert outside_of_the_rows(start.q[None], inertia @ (start.v - slow)) <= 1e-12
    assert outside_of_the_rows(start.q[None], start.q - guess) > 1e-2


def test_velocities_move_by_the_smallest_change_in_the_inertia():
    system, args = unequal()
    start = ej.initial_state(system, GUESS["q"], GUESS["v"], args)
    gradients = jax.jacrev(system.constraint)(start.q, args)
    # Round-off.
    np.testing.assert_allclose(gradients @ start.v, 0, atol=100 * EPS)
    momentum = jnp.array([1.0, 1.0, 5.0, 5.0]) * (start.v - jnp.array(GUESS["v"]))
    assert outside_of_the_rows(gradients, momentum) <= 1e-12


def test_a_consistent_start_stays_as_it_is():
    system, start, args = problem("double")
    again = ej.initial_state(system, start.q, start.v, args)
    np.testing.assert_allclose(again.q, start.q, rtol=0, atol=2 * EPS)
    np.testing.assert_allclose(again.v, start.v, rtol=0, atol=2 * EPS)


def test_without_constraints_nothing_moves():
    system, _, args = problem("spring")
    start = ej.consistent_start(system, [0.3, 0.4], [1.0, 2.0], args)
    np.testing.assert_array_equal(start.state.q, [0.3, 0.4])
    np.testing.assert_array_equal(start.state.v, [1.0, 2.0])
    assert start.multipliers.shape == start.constraint_after.shape == (0,)
    # Closed form: half of the rest length pulls outwards with k / 2.
    expected = 0.5 * 100 * np.array([0.6, 0.8]) + [0, 9.81]
    np.testing.assert_allclose(start.accelerations, expected, rtol=1e-14)


def test_the_residuals_before_and_after_are_reported():
    system, args = unequal()
    start = ej.consistent_start(system, GUESS["q"], GUESS["v"], args)
    before = system.constraint(jnp.array(GUESS["q"]), args)
    np.testing.assert_allclose(start.constraint_before, before, rtol=1e-14)
    rows = jax.jacrev(system.constraint)(start.state.q, args)
    np.testing.assert_allclose(start.rate_before, rows @ jnp.array(GUESS["v"]), rtol=1e-13)
    np.testing.assert_allclose(start.constraint_after, 0, atol=20 * EPS)
    np.testing.assert_allclose(start.rate_after, 0, atol=100 * EPS)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -1.2])
@pytest.mark.parametrize("rate", [0.0, 3.0])
def test_accelerations_and_multipliers_of_the_pendulum(angle, rate):
    system, _, _ = problem("pendulum")
    m, l, g = 1.3, 0.8, 9.81
    args = dict(m=m, l=l, g=g)
    along = np.array([np.sin(angle), np.cos(angle)])
    across = np.array([np.cos(angle), -np.sin(angle)])
    start = ej.consistent_start(system, l * along, l * rate * across, args)
    # Closed form: the rod pulls with 2 lambda l towards the pivot.
    pull = m * g * np.cos(angle) + m * l * rate**2
    acceleration = -g * np.sin(angle) * across - l * rate**2 * along
    np.testing.assert_allclose(start.multipliers, [pull / (2 * l)], rtol=0, atol=1e-13)
    np.testing.assert_allclose(start.accelerations, acceleration, rtol=0, atol=1e-13)


@pytest.mark.parametrize("t", [0.0, 0.1, 1.0])
def test_the_joint_force_of_the_heavy_top_is_the_published_one(t):
    system, _, args = problem("top")
    row = HEAVY_TOP[t]
    v = np.concatenate([row.velocity, row.spin])
    q = np.concatenate([row.position, row.quaternion])
    start = ej.consistent_start(system, q, v, args)
    # The multipliers are minus the force. The tables carry ten digits.
    np.testing.assert_allclose(start.multipliers[:3], -row.force, rtol=0, atol=1e-6)
    centre = row.force / 15 - [0, 0, 9.81]
    np.testing.assert_allclose(start.accelerations[:3], centre, rtol=0, atol=1e-7)
    np.testing.assert_allclose(start.state.q, q, rtol=0, atol=1e-9)


def test_a_quaternion_is_made_a_unit_and_the_body_follows_it():
    system, start, args = problem("top")
    q = start.q.at[3:].multiply(1.05).at[0].add(0.02)
    repaired = ej.consistent_start(system, q, start.v, args)
    state = repaired.state
    np.testing.assert_allclose(state.q[3:] @ state.q[3:], 1, rtol=0, atol=10 * EPS)
    np.testing.assert_allclose(repaired.constraint_after, 0, atol=100 * EPS)
    np.testing.assert_allclose(repaired.rate_after, 0, atol=1e3 * EPS)


def test_derivatives_run_along_the_constraints():
    """Moving a start off the rod moves the projected one along it, or not at all."""
    system, _, args = problem("pendulum")
    jacobian = jax.jit(
        jax.jacfwd(lambda q: ej.initial_state(system, q, jnp.zeros(2), args).q)
    )(jnp.array([0.6, 0.8]))
    # Closed form at unit length: the projection on the tangent of a circle.
    tangent = np.array([0.8, -0.6])
    np.testing.assert_allclose(jacobian, np.outer(tangent, tangent), rtol=0, atol=1e-14)


def test_derivatives_with_respect_to_args_follow_the_rod():
    system, _, args = problem("pendulum")

    def point(l):
        guess = jnp.array([0.6, 0.8])
        return ej.initial_state(system, guess, [0.0, 0.0], args | dict(l=l)).q

    slope = jax.jacrev(point)(1.05)
    np.testing.assert_allclose(slope, [0.6, 0.8], rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("q", "residual"), [([0.5, 0.0], "-0.75"), ([0.0, 0.1], "-0.99"), ([0.3, 0.4], "-0.75")]
)
def test_a_start_too_far_away_raises_and_names_the_residual(q, residual):
    """Near the pivot the direction of the rod is not determined."""
    system, _, args = problem("pendulum")
    with pytest.raises(ValueError, match="too far") as caught:
        ej.initial_state(system, q, [0.0, 0.0], args)
    assert residual in str(caught.value)


def test_a_start_too_far_away_raises_under_jit_too():
    system, _, args = problem("pendulum")
    project = eqx.filter_jit(lambda q: ej.initial_state(system, q, [0.0, 0.0], args))
    assert np.all(np.isfinite(project(jnp.array([1.1, 0.0])).q))
    with pytest.raises(eqx.EquinoxRuntimeError, match="too far"):
        jax.block_until_ready(project(jnp.array([0.1, 0.0])).q)


def test_constraints_that_repeat_each_other_raise_and_name_their_rank():
    single, start, args = problem("pendulum")
    twice = lambda q, args: jnp.concatenate([single.constraint(q, args)] * 2)
    system = ej.System(single.kinetic, single.potential, twice)
    with pytest.raises(ValueError, match="rank 1, of 2"):
        ej.initial_state(system, start.q, start.v, args)


def test_integers_and_lists_are_accepted_as_vectors():
    system, start, args = problem("pendulum")
    same = ej.initial_state(system, [1, 0], (0, 0), args)
    np.testing.assert_array_equal(same.q, start.q)
    assert same.v.dtype == start.v.dtype


@pytest.mark.slow
def test_a_light_slow_body_is_projected_as_accurately_as_a_heavy_fast_one():
    """The pendulum keeps its rod, and moves as if it were alone.

    Its scaled rates are 1e-11 of those of the heavy body, whose residual is round-off from
    the first correction on. The chord method makes a second one, and searches with smaller
    bounds leave the error of the pendulum at round-off too.
    """

    def kinetic(v, args):
        return 0.5e-6 * v[:2] @ v[:2] + 0.5e6 * v[2] ** 2

    rod = lambda q, args: jnp.array([q[:2] @ q[:2] - 1.0])
    system = ej.System(kinetic, lambda q, args: -9.81e-6 * q[1], rod)
    start = ej.initial_state(system, [1.0, 0.0, 0.0], [0.0, 0.0, 1e4])
    alone = ej.System(1e-6 * jnp.eye(2), lambda q, args: -9.81e-6 * q[1], rod)
    rest = ej.initial_state(alone, [1.0, 0.0], [0.0, 0.0])
    single = ej.simulate(alone, ej.EnergyPreserving(), rest, h=0.01, num_steps=50)
    exact = ej.Newton(rtol=1e-6, atol=1e-6)
    for newton, constraint, position in (
        (ej.Newton(), 1e-12, 1e-8),  # solver
        (exact, 1e-13, 1e-11),  # solver
    ):
        run = ej.simulate(
            system, ej.EnergyPreserving(), start, h=0.01, num_steps=50, root_finder=newton
        )
        assert float(jnp.max(jnp.abs(run.audit.constraint))) <= constraint
        np.testing.assert_allclose(run.ys.q[-1, :2], single.ys.q[-1], rtol=position)


def test_far_from_the_origin_a_wrong_length_is_still_seen():
    far = jnp.array([1e6, 0.0])
    rod = lambda q, args: jnp.array([(q - far) @ (q - far) - args])
    system = ej.System(jnp.eye(2), lambda q, args: -9.81 * q[1], rod)
    start = ej.State(far + jnp.array([1.0, 0.0]), [0.0, 0.0])
    run = lambda square: ej.simulate(
        system, ej.EnergyPreserving(), start, square, h=0.01, num_steps=50, throw=False
    )
    assert run(1.0).result == ej.RESULTS.successful
    assert run(1.0 + 1e-3).result == ej.RESULTS.inconsistent_start


@pytest.mark.slow
def test_known_entries_stay_and_the_rest_follows():
    system, _, args = problem("double")

    def start(x, u):
        q, v = jnp.array([x, 0.7, 1.5, 0.9]), jnp.array([u, 0.1, 0.3, 0.2])
        return ej.initial_state(system, q, v, args, known_q=[0, 3], known_v=[0, 2])

    state = start(0.6, 1.0)
    np.testing.assert_allclose(state.q[:2], [0.6, 0.8], rtol=1e-13)  # solver
    assert state.q[3] == pytest.approx(0.9, abs=1e-14)
    np.testing.assert_allclose(state.q[2], 0.6 + np.sqrt(1 - 0.1**2), rtol=1e-13)
    np.testing.assert_allclose(state.v[:3], [1.0, -0.75, 0.3], rtol=1e-13)
    by_x = jax.jit(jax.jacfwd(lambda x: start(x, 1.0).q[1]))(0.6)
    assert by_x == pytest.approx(-0.75, rel=1e-12)  # solver


def test_too_many_known_entries_raise_an_error():
    system, _, args = problem("pendulum")
    with pytest.raises(ValueError, match="too many entries are known"):
        ej.initial_state(system, [0.9, 0.1], [0.0, 0.0], args, known_q=[0, 1])
    with pytest.raises(ValueError, match="too many entries are known"):
        ej.initial_state(system, [0.6, 0.8], [1.0, 0.0], args, known_v=[0, 1])
    with pytest.raises(ValueError, match="indices from 0 to 1"):
        ej.initial_state(system, [0.6, 0.8], [1.0, 0.0], args, known_v=[2])


def test_a_lane_without_a_start_does_not_affect_the_others():
    system, _, args = problem("pendulum")
    guesses = jnp.array([[1.0, 0.1], [9.0, 0.0], [0.3, 0.9]])
    make = lambda q: ej.initial_state(system, q, jnp.zeros(2), args, throw=False)
    starts = jax.vmap(make)(guesses)
    assert np.isnan(starts.q).all(axis=1).tolist() == [False, True, False]
    expected = guesses[0] / jnp.linalg.norm(guesses[0])
    np.testing.assert_allclose(starts.q[0], expected, atol=4 * EPS)


@pytest.mark.parametrize(("angle", "tolerance"), [(1e-2, 4 * EPS), (1e-3, 1e-11)])
@pytest.mark.slow_for("0.001-1e-11")
def test_known_velocities_are_kept_in_a_nearly_singular_pose(angle, tolerance):
    """A pendulum near the horizontal, of which the small velocity along the rod is known.

    Tolerance: round-off; closer to the singular pose, what four corrections leave.
    """
    rod = lambda q, args: jnp.array([q @ q - 1])
    system = ej.System(lambda v, args: 0.5 * v @ v, lambda q, args: 0.0 * q[0], rod)
    q = [np.cos(angle), np.sin(angle)]
    start = ej.initial_state(system, q, [0.1 * angle, 0.0], known_v=(0,))
    tangential = -0.1 * angle / np.tan(angle)
    np.testing.assert_allclose(start.v, [0.1 * angle, tangential], rtol=tolerance)
