"""The problems against published values and against each other."""

import jax
import numpy as np
import pytest

import enerjax as ej

from .helpers import failed, long, march, problem, PROBLEMS, slopes, solve, TURNOVER
from .references import CAR_AXIS, FOUR_PARTICLES, FREE_BODY, HEAVY_TOP


@pytest.mark.parametrize("name", PROBLEMS)
def test_starts_are_consistent(name):
    """To round-off: none of them is moved."""
    system, start, args = problem(name)
    again = ej.initial_state(system, start.q, start.v, args)
    np.testing.assert_array_equal(again.q, start.q)
    np.testing.assert_array_equal(again.v, start.v)


@pytest.mark.parametrize("name", ["top", "body", "particles"])
def test_energies_of_the_starts_are_the_published_ones(name):
    system, start, args = problem(name)
    # The tables carry ten digits.
    assert float(system.energy(start, args)) == pytest.approx(
        {"top": 5435.696790865547, "body": 2500.0, "particles": 1.1764705882352942}[name],
        rel=1e-10,
    )


def test_the_weight_of_the_elastic_pendulum_points_downwards():
    """Its spring is relaxed at the start."""
    system, start, args = problem("elastic")
    force = -jax.grad(system.potential)(start.q, args)
    np.testing.assert_allclose(force, [0.0, 0.0, -9.81], rtol=0, atol=1e-13)


def top(h, scheme="preserving"):
    return solve("top", scheme, h=h, steps=1000)


def top_error(h, t, scheme="preserving"):
    row = round(t / h)
    return np.max(np.abs(top(h, scheme).ys.q[row, :3] - HEAVY_TOP[t].position))


def test_heavy_top_follows_the_published_motion():
    solution = top(1e-3)
    assert not failed(solution)
    # Truncation: 2.7e-3 = C h^2, C = 2.7e3: the top turns 24 times in this second.
    assert top_error(1e-3, 1.0) <= 3e-3
    energy = solution.audit.energy
    # Solver.
    assert np.max(np.abs(energy - energy[0])) <= 1e-12 * TURNOVER["top"]
    p = solution.ys.q[:, 3:]
    np.testing.assert_allclose(np.sum(p**2, axis=1), 1, rtol=0, atol=1e-13)
    assert np.max(np.abs(solution.audit.constraint)) <= 1e-12
    assert np.max(np.abs(solution.audit.constraint_rate)) <= 1e-11
    # Truncation: the spin about the axis of symmetry is constant.
    np.testing.assert_allclose(solution.ys.v[:, 4], 150, rtol=1e-3)


def test_heavy_top_converges_with_second_order():
    error = [top_error(h, 0.2) for h in (1e-3, 5e-4, 2.5e-4)]
    np.testing.assert_allclose(slopes(error), 2, rtol=0, atol=0.1)


def test_forces_in_the_joint_of_the_heavy_top():
    """Multipliers of a step are its mean force: the published one to second order."""
    h = 1e-3
    multipliers = top(h).multipliers
    row = round(0.1 / h)
    mean = (multipliers[row, :3] + multipliers[row + 1, :3]) / 2
    force = HEAVY_TOP[0.1].force
    # Truncation, C h^2, and round-off that the step divides by.
    np.testing.assert_allclose(-mean, force, rtol=0, atol=1e-2 * np.max(np.abs(force)))


@pytest.mark.slow
def test_heavy_top_composed_to_fourth_order():
    error = [top_error(h, 0.2, "composed 4") for h in (1e-3, 5e-4)]
    assert error[0] <= 2e-7
    assert slopes(error)[0] == pytest.approx(4, abs=0.2)
    energy = top(1e-3, "composed 4").audit.energy
    assert np.max(np.abs(energy - energy[0])) <= 1e-12 * TURNOVER["top"]


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_heavy_top_with_dissipation(alpha):
    solution = solve("top", "decaying", alpha, h=1e-3, steps=200)
    assert not failed(solution)
    audit = solution.audit
    leak = np.diff(audit.energy) + audit.dissipated[1:]
    assert np.max(np.abs(leak)) <= 1e-12 * TURNOVER["top"]
    # V is linear here.
    assert np.all(audit.dissipated >= 0)
    assert np.max(np.abs(audit.constraint)) <= 1e-12
    assert np.max(np.abs(audit.constraint_rate)) <= 1e-11


def body_error(end):
    row = FREE_BODY[0.5]
    # A quaternion and its negative are one rotation.
    p = end.q * np.sign(end.q @ row.quaternion)
    return np.max(np.abs(p - row.quaternion)), np.max(np.abs(end.v - row.spin))


def test_free_rigid_body_converges_to_the_published_motion():
    ends = [march("body", "preserving", h=0.5 / n, steps=n) for n in (250, 500, 1000)]
    turn, spin = np.array([body_error(end) for end in ends]).T
    np.testing.assert_allclose(slopes(turn), 2, rtol=0, atol=0.1)
    np.testing.assert_allclose(slopes(spin), 2, rtol=0, atol=0.1)
    for end in ends:
        # Solver.
        assert end.q @ end.q == pytest.approx(1, abs=1e-13)
        assert np.array([3.0, 4.0, 1.5]) @ end.v**2 == pytest.approx(2500, rel=1e-12)


def rotation(p):
    """Rotation matrix of a unit quaternion, from the formula of Rodrigues."""
    skew = np.array([[0, -p[3], p[2]], [p[3], 0, -p[1]], [-p[2], p[1], 0]])
    return np.eye(3) + 2 * p[0] * skew + 2 * skew @ skew


def test_free_rigid_body_keeps_its_momentum_to_second_order():
    error = []
    for n in (250, 500, 1000):
        end = march("body", "preserving", h=0.5 / n, steps=n)
        momentum = rotation(end.q) @ (np.array([6.0, 8.0, 3.0]) * end.v)
        error.append(np.max(np.abs(momentum - [60, 160, 60])))
    np.testing.assert_allclose(slopes(error), 2, rtol=0, atol=0.1)


@pytest.mark.parametrize(
    ("scheme", "order", "bound"),
    [
        ("preserving", 2, 1e-4),
        pytest.param("consistent", 4, 1e-7, marks=pytest.mark.slow),
    ],
)
def test_four_particles_converge_to_the_published_motion(scheme, order, bound):
    q, v = FOUR_PARTICLES[1.0]
    ends = [march("particles", scheme, h=1 / n, steps=n) for n in (200, 400, 800)]
    error = np.array([(np.max(np.abs(y.q - q)), np.max(np.abs(y.v - v))) for y in ends]).T
    for e in error:
        assert slopes(e)[-1] == pytest.approx(order, abs=0.2)
    # Truncation: C h^p at h = 0.005.
    assert error[0][0] <= bound


CAR_AXIS_RUNS = {
    "preserving": (ej.EnergyPreserving(), 600, 4.2e-3, 0.6),
    "preserving, composed": (ej.Composed(ej.EnergyPreserving(), 4), 1200, 3e-7, 2e-5),
    "consistent": (ej.EnergyConsistent(0.0), 600, 7e-6, 5e-4),
    "consistent, composed": (ej.Composed(ej.EnergyConsistent(0.0), 6), 300, 4e-9, 3e-7),
}


@pytest.mark.parametrize("case", long(CAR_AXIS_RUNS, *list(CAR_AXIS_RUNS)[1:]))
def test_the_car_axis_meets_the_published_values(case):
    """Driven; truncation, bounded by what was measured at these steps."""
    scheme, steps, position, velocity = CAR_AXIS_RUNS[case]
    system, start, args = ej.problems.car_axis()
    run = ej.simulate(system, scheme, start, args, h=3.0 / steps, num_steps=steps)
    assert np.max(np.abs(run.ys.q[-1, :4] - CAR_AXIS.q)) <= position
    assert np.max(np.abs(run.ys.v[-1, :4] - CAR_AXIS.v)) <= velocity
    # Solver, of an energy of 1.5e-3.
    leak = np.diff(run.audit.energy) - run.audit.drive_work[1:]
    assert np.max(np.abs(leak)) <= 1e-15
    assert np.max(np.abs(run.audit.constraint)) <= 1e-14
    assert np.max(np.abs(run.audit.constraint_rate)) <= 1e-13


def test_a_chain_of_links_falls_without_losing_energy():
    solution = solve("chain", "preserving", h=0.005, steps=200)
    assert not failed(solution)
    audit = solution.audit
    # Solver; the chain turns over m g l / 2.
    assert np.max(np.abs(audit.energy - audit.energy[0])) <= 1e-12 * 9.81
    assert np.max(np.abs(audit.constraint)) <= 1e-12
    # Its free end has fallen past the pivot's level, and the links keep their lengths.
    assert solution.ys.q[-1, 7] > 0.1
    points = solution.ys.q.reshape(-1, 4, 2)
    links = np.diff(points, axis=1, prepend=np.zeros((201, 1, 2)))
    lengths = np.linalg.norm(links, axis=2)
    np.testing.assert_allclose(lengths, 0.25, rtol=0, atol=1e-12)


def test_problems_with_other_numbers_share_a_program(caplog):
    ej.problems.pendulum()
    with jax.log_compiles():
        ej.problems.pendulum(m=2.0, l=1.5, g=1.6)
    assert not [r for r in caplog.records if "Compiling" in r.getMessage()]
