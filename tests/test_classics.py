"""Classical problems of numerical integration: closed forms, published values."""

import numpy as np
import pytest

import enerjax as ej


SIXTH = ej.Composed(ej.EnergyConsistent(0.0), 6)


def end(problem, scheme, t, steps):
    system, start, args = problem
    run = ej.simulate(
        system,
        scheme,
        start,
        args,
        h=t / steps,
        num_steps=steps,
        saveat=ej.SaveAt(every=steps),
    )
    # Solver: the energy that was there, or turned over.
    scale = max(abs(float(run.audit.energy[0])), float(np.max(run.audit.kinetic)))
    assert abs(run.audit.energy[-1] - run.audit.energy[0]) <= 1e-11 * scale
    return run.ys.q[-1], run.ys.v[-1]


def kepler_exact(eccentricity, t):
    """By Kepler's equation."""
    anomaly = t
    for _ in range(100):
        change = anomaly - eccentricity * np.sin(anomaly) - t
        anomaly -= change / (1 - eccentricity * np.cos(anomaly))
    root = np.sqrt(1 - eccentricity**2)
    return np.array([np.cos(anomaly) - eccentricity, root * np.sin(anomaly)])


def test_kepler_against_keplers_equation():
    for eccentricity in (0.6, 0.9):
        problem = ej.problems.kepler(eccentricity)
        assert float(problem.system.energy(problem.start, problem.args)) == pytest.approx(
            -0.5, rel=1e-14
        )
    exact, problem = kepler_exact(0.6, 10.0), ej.problems.kepler(0.6)
    error = [
        np.max(np.abs(end(problem, ej.EnergyConsistent(0.0), 10.0, n)[0] - exact))
        for n in (500, 1000)
    ]
    # Truncation, of fourth order.
    assert np.log2(error[0] / error[1]) == pytest.approx(4, abs=0.2)
    assert error[1] <= 1e-4


@pytest.mark.parametrize(
    ("energy", "published"),
    [
        (1 / 12, [-0.006602924213139011, -0.17072158308101174]),
        (0.12471666666666666, [-0.06650529688557064, -0.22709833514134714]),
    ],
)
def test_henon_heiles(energy, published):
    """Against explicit Runge-Kutta runs at a tolerance of 1e-13; t = 10."""
    q, _ = end(ej.problems.henon_heiles(energy), ej.EnergyConsistent(0.0), 10.0, 400)
    np.testing.assert_allclose(q, published, atol=1e-6)  # truncation


def test_fput():
    """Against an explicit Runge-Kutta run at a tolerance of 1e-12; t = 1."""
    q, _ = end(ej.problems.fput(), ej.EnergyConsistent(0.0), 1.0, 1000)
    exact = [0.7477560991407897, 0.54961212455473, 0.003971910807960365]
    np.testing.assert_allclose(q[:3], exact, atol=1e-6)  # truncation
    # The stiff springs: omega times a phase error of (h omega)^4 / 720.
    exact = [0.015648556344648578, 0.0009138440966834615, -6.526986952161027e-05]
    np.testing.assert_allclose(q[3:], exact, atol=1e-6)


@pytest.mark.slow
def test_pleiades():
    """Against the Test Set for IVP Solvers, t = 3."""
    exact = np.array(
        [0.3706139143970502, 3.237284092057233, -3.222559032418324, 0.659709145577531]
        + [0.3425581707156584, 1.562172101400631, -0.7003092922212495]
        + [-3.943437585517392, -3.27138097397255, 5.225081843456543, -2.59061243497747]
        + [1.198213693392275, -0.2429682344935824, 1.09144924042898]
    )
    q, _ = end(ej.problems.pleiades(), SIXTH, 3.0, 4000)
    np.testing.assert_allclose(q.reshape(7, 2).T.ravel(), exact, atol=1e-5)  # truncation
