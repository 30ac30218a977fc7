"""Mechanisms made of parts against the literature and against minimal coordinates."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import enerjax as ej

from .helpers import on_host


SCHEMES = {
    "preserving": ej.EnergyPreserving(),
    "composed 4": ej.Composed(ej.EnergyPreserving(), 4),
}


@functools.cache
def made(name, *numbers):
    return getattr(ej.problems, name)(*numbers)


def run(problem, scheme, h, steps):
    system, start, args = problem
    every = max(steps // 100, 1)
    return on_host(
        ej.simulate(
            system,
            SCHEMES[scheme],
            start,
            args,
            h=h,
            num_steps=steps,
            saveat=ej.SaveAt(every=every),
        )
    )


def leak(solution):
    """The change of the energy over the largest kinetic one: solver and round-off."""
    energy = solution.audit.energy
    return np.max(np.abs(energy - energy[0])) / np.max(solution.audit.kinetic)


# IFToMM multibody benchmark A01, from elliptic functions: t, x, y.
PENDULUM = [
    (1.0, 0.9862917511318753, -0.16501085312554117),
    (2.0, -0.7935661953433217, -0.6084839304437916),
    (4.0, 0.5775636282486314, -0.8163456714678389),
    (6.0, 0.9994975399393528, -0.03169649278992706),
    (8.0, 0.9198579831077385, -0.39225156585151255),
    (10.0, -0.2750874625761169, -0.961419205099125),
]


@pytest.mark.parametrize(
    ("scheme", "bound"), [("preserving", 4.7e-3), ("composed 4", 1e-6)]
)
def test_the_pendulum_of_the_benchmark(scheme, bound):
    solution = run(made("point_pendulum"), scheme, 0.01, 1000)
    for t, x, y in PENDULUM:
        error = np.abs(solution.ys.q[round(10 * t)] - [x, y])
        assert np.max(error) <= bound  # truncation
    assert leak(solution) <= 1e-12


# IFToMM multibody benchmark A02 on its branch of parallelograms, by a method of order 8 and
# Taylor series: number of cells, t, position and velocity of the first upright's top.
PARALLEL = {
    2: {
        1.0: (
            -0.19502030194951211, -0.9807992056621585, -6.676678036880978,
            1.3275783251609965,
        ),
        10.0: (
            0.32845811153622184, 0.9445185381801984, 1.4230514701967134,
            -0.49486884547572746,
        ),
    },
    40: {
        1.0: (
            -0.11535688063220455, -0.9933241113004392, -6.66998752394164,
            0.7746000986629722,
        ),
        10.0: (
            0.18051222668329853, 0.9835727405829411, 1.1484412774626611,
            -0.2107700667740449,
        ),
    },
}  # fmt: skip


@pytest.mark.parametrize(
    ("cells", "scheme", "h", "t", "bound"),
    [
        pytest.param(2, "preserving", 0.01, 1.0, 5e-3, marks=pytest.mark.slow),
        pytest.param(2, "composed 4", 0.01, 10.0, 1e-6, marks=pytest.mark.slow),
        pytest.param(40, "preserving", 0.01, 1.0, 5e-3, marks=pytest.mark.slow),
        # At h = 0.01 a step across a singular pose fails at t = 3.2.
        pytest.param(40, "preserving", 0.005, 10.0, 5e-3, marks=pytest.mark.slow),
    ],
)
def test_parallel_bars_pass_their_singular_poses(cells, scheme, h, t, bound):
    """All bars lie level when the uprights have turned by a quarter: before t = 1."""
    solution = run(made("parallel_bars", cells), scheme, h, round(t / h))
    # The top is twice as far from the foot, the origin, as the mass centre.
    top = 2 * np.concatenate([solution.ys.q[-1, :2], solution.ys.v[-1, :2]])
    np.testing.assert_allclose(top, PARALLEL[cells][t], rtol=0, atol=bound)  # truncation
    assert leak(solution) <= 1e-12


# Andrews' mechanism at t = 0.03: beta, Theta, gamma, Phi, delta, Omega, epsilon. The first
# from a quadrature of thirty digits, the others from closing the loops; the values of the
# Test Set for IVP Solvers agree to 1e-9.
ANDREWS = (
    15.810771195153768, -15.756371058411915, 0.040822240119646316, -0.5347301163420787,
    0.524409965879954, 0.5347301163420788, 1.048080741041938,
)  # fmt: skip


@pytest.mark.slow
def test_the_squeezer_reaches_the_published_angles():
    solution = run(made("squeezer"), "composed 4", 1e-4, 300)
    k1, k2, k3, k4, k5, k6, k7 = solution.ys.q[-1, 2::3]
    angles = [k1, k2 - k1, k3, k4 - k5, k5, k6 - k7, k7]
    # Truncation: 1.7e-6 = C h^4 in the crank, that has turned two and a half times. (It is
    # 2.7e-5 with h = 2e-4 and 1.07e-7 with 5e-5.) The turning of a planar body by twice an
    # arctangent has a larger C than the turning by its rate.
    np.testing.assert_allclose(angles, ANDREWS, rtol=0, atol=2e-6)
    assert leak(solution) <= 1e-12


def slider_crank_reference(t, r=0.15, l=0.35, speed=40.0, g=9.81):
    """Angle of the crank and its rate, in that one coordinate; all masses 1."""

    def places(angle):
        """Mass centres, and the angles that the inertias go with."""
        tip = r * jnp.array([jnp.cos(angle), jnp.sin(angle)])
        pin = jnp.array([tip[0] + jnp.sqrt(l**2 - tip[1] ** 2), 0.0])
        tilt = jnp.arcsin(-tip[1] / l)
        turns = jnp.sqrt(jnp.array([r**2, l**2]) / 12) * jnp.stack([angle, tilt])
        return jnp.concatenate([tip / 2, (tip + pin) / 2, pin, turns])

    rates = jax.jacfwd(places)
    inertia = lambda angle: jnp.sum(rates(angle) ** 2)
    weight = lambda angle: g * (places(angle)[1] + places(angle)[3])

    @jax.jit
    def acceleration(angle, rate):
        force = 0.5 * jax.grad(inertia)(angle) * rate**2 + jax.grad(weight)(angle)
        return -force / inertia(angle)

    right = lambda _, y: [y[1], float(acceleration(y[0], y[1]))]
    start = [np.pi / 2, speed]
    return solve_ivp(right, (0, t), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def test_the_slider_crank_moves_as_in_its_one_coordinate():
    solution = run(made("slider_crank"), "preserving", 1e-3, 500)
    crank = solution.ys.q[:, 2]
    r, l = 0.15, 0.35
    stroke = r * np.cos(crank) + np.sqrt(l**2 - (r * np.sin(crank)) ** 2)
    np.testing.assert_allclose(solution.ys.q[:, 6], stroke, rtol=0, atol=1e-12)  # solver
    angle, rate = slider_crank_reference(0.5)
    # Truncation: 8e-3 = C h^2, where the crank has turned three times.
    assert crank[-1] == pytest.approx(angle, abs=0.01)
    assert solution.ys.v[-1, 2] == pytest.approx(rate, rel=0.005)
    assert leak(solution) <= 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "steps"),
    [("four_bar", 500), pytest.param("spatial_four_bar", 500, marks=pytest.mark.slow)],
)
def test_closed_loops_keep_their_energy_and_stay_closed(name, steps):
    solution = run(made(name), "preserving", 2e-3, steps)
    assert leak(solution) <= 1e-11  # solver
    assert np.max(np.abs(solution.audit.constraint)) <= 1e-12
    assert np.max(np.abs(solution.ys.q[-1] - solution.ys.q[0])) > 0.1
