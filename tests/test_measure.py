"""Comparisons of schemes: errors, orders, refusals, and the model for diffrax."""

import functools
import sys
import types

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import enerjax as ej
from enerjax._tools.measure.reference import extrapolated, Task

from .helpers import EPS, problem
from .references import double_pendulum_reference, HEAVY_TOP, point_on_rod


SCHEMES = {"preserving": ej.EnergyPreserving(), "RATTLE": ej.Rattle()}
STEPS = (80, 40)


@functools.cache
def orders():
    return ej.order_table(problem("pendulum"), SCHEMES, STEPS, duration=1.0)


@functools.cache
def against_data():
    times = np.array([0.25, 0.5, 0.75, 1.0])
    exact = [point_on_rod(t) for t in times]
    data = (times, np.array([x.q for x in exact]), np.array([x.v for x in exact]))
    return ej.work_precision(
        problem("pendulum"), SCHEMES, STEPS, data, duration=1.0, repeats=1
    )


@pytest.mark.slow
def test_orders_of_the_pendulum():
    table = orders()
    assert table.steps == (40, 80)
    np.testing.assert_allclose(table.h, [1 / 40, 1 / 80], rtol=1e-15)
    assert table.expected == (2, 2)
    np.testing.assert_allclose(table.order_q, 2, atol=0.1)
    np.testing.assert_allclose(table.order_v, 2, atol=0.1)
    # Both report the mean over the step, half a step before.
    np.testing.assert_allclose(table.order_multipliers, 1, atol=0.1)


@pytest.mark.slow
def test_the_extrapolated_reference_is_as_good_as_exact_data():
    table, given = orders(), against_data()
    assert max(table.uncertainty["q"], table.uncertainty["v"]) <= 1e-10
    # Both know the motion to 1e-10, against errors of 4e-4.
    np.testing.assert_allclose(table.q, given.q, rtol=1e-6)
    np.testing.assert_allclose(table.v, given.v, rtol=1e-6)
    np.testing.assert_allclose(table.multipliers, given.multipliers, rtol=1e-6)
    assert given.uncertainty == dict(q=0.0, v=0.0, multipliers=0.0)


def test_the_extrapolation_of_two_runs_removes_their_leading_error():
    """Of an oscillator, against the closed form: of order 2, what is left is of order 4."""
    system = ej.System(jnp.eye(1), lambda q, args: 4.5 * q @ q)
    start = ej.State([1.0], [0.0])
    task = Task(system, start, None, 0.0, 1.0, np.array([0.5, 1.0]))
    found = extrapolated(task, 20, ej.EnergyPreserving())
    exact = np.cos(3 * task.times)[:, None]
    off = np.max(np.abs(found.values.q - exact))
    assert 1e-4 < found.uncertainty["q"] < 1e-3
    assert off <= 1e-2 * found.uncertainty["q"]


def test_a_comparison_reports_errors_and_costs():
    given = against_data()
    for name in ("q", "v", "multipliers", "evaluations", "seconds"):
        assert getattr(given, name).shape == (2, 2)
        assert np.all(getattr(given, name) > 0)
    # Solver; the energy of RATTLE is off by truncation, and by a quarter at half the step.
    assert np.max(given.energy[0]) <= 1e-12
    np.testing.assert_allclose(given.energy[1, 0] / given.energy[1, 1], 4, rtol=0.1)
    assert np.max([given.constraint, given.constraint_rate]) <= 1e-12
    text = str(given).splitlines()
    assert len(text) == 2 + 4 + 1
    assert text[0].split()[:4] == ["scheme", "h", "error", "q"]
    assert text[-2].startswith("RATTLE")
    assert "2.0" in str(orders())


def test_the_results_can_be_plotted():
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    for measured in (orders(), against_data()):
        given = plt.subplots(1, 2)[1]
        grid = measured.plot(given)
        assert [*grid] == [*given]
        assert [len(axes.lines) for axes in grid] == [2, 2]
        plt.close("all")


@pytest.mark.slow
def test_a_failed_run_has_a_row_with_the_reason():
    system, start, args = problem("double")
    schemes = {"kappa": ej.KappaDecaying(0.5), "good": ej.EnergyPreserving()}
    end = double_pendulum_reference(2.0)
    comparison = ej.work_precision(
        (system, start, args), schemes, [100], (2.0, end.q), duration=2.0, repeats=1
    )
    assert "failed at t = 1" in comparison.failures[0][0]
    assert comparison.failures[1] == ("",)
    assert np.isnan(comparison.q[0, 0])
    assert comparison.q[1, 0] < 5e-3
    assert np.isnan(comparison.v[1, 0])  # nothing was given to compare with
    assert comparison.failures[0][0] in str(comparison)


def test_a_refused_system_has_a_row_with_the_reason():
    system, start, args = problem("top")
    data = (0.1, np.concatenate([HEAVY_TOP[0.1].position, HEAVY_TOP[0.1].quaternion]))
    table = ej.order_table(
        (system, start, args), {"RATTLE": ej.Rattle()}, [10], data, duration=0.1
    )
    assert "refused: `Rattle` needs" in table.failures[0][0]
    assert np.isnan(table.q).all()


@pytest.mark.parametrize(
    ("schemes", "steps", "reference", "message"),
    [
        (SCHEMES, [10], (0.123, [1.0, 0.0]), "ends at t = 0.123"),
        (SCHEMES, [10], (1.0, [1.0, 0.0, 0.0]), "has shape"),
        (SCHEMES, [10], (1.0,), "must be a scheme, or data"),
        (SCHEMES, [], None, "`steps` is empty"),
        ([ej.Rattle()], [10], None, "dictionary"),
    ],
)
def test_bad_input(schemes, steps, reference, message):
    with pytest.raises((ValueError, TypeError), match=message):
        ej.order_table(problem("pendulum"), schemes, steps, reference, duration=1.0)


# The model for diffrax ------------------------------------------------------------------


def _solved(diffrax, problem, duration):
    term, y0 = ej.to_diffrax(*problem)
    tight = diffrax.PIDController(rtol=1e-10, atol=1e-10)
    solution = diffrax.diffeqsolve(
        term, diffrax.Dopri8(), 0.0, duration, None, y0, stepsize_controller=tight
    )
    return term, jax.tree.map(lambda x: x[-1], solution.ys)


@pytest.mark.slow
def test_diffrax_on_the_double_pendulum():
    diffrax = pytest.importorskip("diffrax")
    system, start, args = problem("double")
    term, y = _solved(diffrax, (system, start, args), 2.0)
    exact = double_pendulum_reference(2.0)
    # Its tolerance, and the growth of errors in two seconds.
    np.testing.assert_allclose(y[0], exact.q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(y[1], exact.v, rtol=0, atol=1e-8)
    expected = ej.consistent_start(system, exact.q, exact.v, args).multipliers
    found = term.vector_field.multipliers(2.0, y)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_diffrax_on_a_body_that_rotates():
    diffrax = pytest.importorskip("diffrax")
    term, y = _solved(diffrax, problem("top"), 0.1)
    state, exact = term.vector_field.state(0.1, y), HEAVY_TOP[0.1]
    np.testing.assert_allclose(state.q[:3], exact.position, rtol=0, atol=1e-8)
    np.testing.assert_allclose(state.v[3:], exact.spin, rtol=0, atol=1e-6)


def test_accelerations_away_from_a_start_with_zeros(monkeypatch):
    """A chain that starts horizontally moves vertically too."""
    term = lambda field: types.SimpleNamespace(vector_field=field)
    monkeypatch.setitem(sys.modules, "diffrax", types.SimpleNamespace(ODETerm=term))
    system, start, args = ej.problems.chain(8)
    assert isinstance(system, ej.System)
    constraint, potential = system.constraint, system.potential
    assert constraint is not None
    found, _ = ej.to_diffrax(system, start, args)
    angles, spins = np.random.default_rng(0).normal(size=(2, 8))
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    lengths = np.asarray(args["l"])[:, None]
    q = jnp.asarray(np.cumsum(lengths * direction, axis=0).ravel())
    normal = np.stack([-np.sin(angles), np.cos(angles)], axis=1) * spins[:, None]
    v = jnp.asarray(np.cumsum(lengths * normal, axis=0).ravel())
    _, acceleration = found.vector_field(0.0, (q, v))
    # The same by dense algebra.
    rods = lambda q: constraint(q, args)
    gradients = np.asarray(jax.jacfwd(rods)(q))
    bending = jax.jvp(lambda q: jax.jvp(rods, (q,), (v,))[1], (q,), (v,))[1]
    force = -np.asarray(jax.grad(lambda q: potential(q, args))(q))
    weight = np.diag(1 / np.repeat(args["m"], 2))
    matrix = gradients @ weight @ gradients.T
    right = gradients @ weight @ force + np.asarray(bending)
    expected = weight @ (force - gradients.T @ np.linalg.solve(matrix, right))
    # Round-off, by the condition of the matrix.
    atol = 100 * EPS * np.linalg.cond(matrix) * np.max(np.abs(expected))
    np.testing.assert_allclose(acceleration, expected, rtol=0, atol=atol)


def test_without_diffrax_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "diffrax", None)
    with pytest.raises(ImportError, match=r"enerjax\[diffrax\]"):
        ej.to_diffrax(*problem("pendulum"))
