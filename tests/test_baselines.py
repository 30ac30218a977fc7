"""Generalized-alpha and RATTLE against independent implementations and known motions."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import enerjax as ej

from .driven_pendulum import ARGS, driven_start, kinetic, moved_rod, potential
from .helpers import problem, slopes
from .numpy_schemes import generalized_alpha, rattle
from .references import double_pendulum_reference


SCHEMES = {
    "rattle": ej.Rattle(),
    "alpha": ej.GeneralizedAlpha(0.9),
    "alpha ggl": ej.GeneralizedAlpha(0.9, "ggl"),
    "rattle 4": ej.Composed(ej.Rattle(), 4),
}


@eqx.filter_jit
def _march(system, scheme, start, args, h, steps, t0):
    """The last step of a run of a traced number of steps, with the memory handed on."""
    first = ej.step(system, scheme, start, args, h=h, t=t0)

    def body(k, out):
        t = t0 + k.astype(float) * h
        return ej.step(system, scheme, out.state, args, h=h, t=t, warm=out.warm)

    return jax.lax.fori_loop(1, steps, body, first)


def march(system, scheme, start, args, *, h, steps, t0=0.0):
    args = jax.tree.map(jnp.asarray, args)
    numbers = (jnp.asarray(h), jnp.asarray(steps), jnp.asarray(t0))
    out = jax.device_get(_march(system, scheme, start, args, *numbers))
    assert out.result == ej.RESULTS.successful
    return out


# Against the published methods ----------------------------------------------------------


def test_rattle_is_the_published_method():
    system, start, args = problem("double")
    out = march(system, SCHEMES["rattle"], start, args, h=0.01, steps=100)
    q, v = rattle(np.asarray(start.q), np.asarray(start.v), 0.01, 100)
    # Round-off of a hundred steps.
    np.testing.assert_allclose(out.state.q, q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(out.state.v, v, rtol=0, atol=1e-11)


def test_generalized_alpha_is_the_published_method():
    system, start, args = problem("double")
    out = march(system, SCHEMES["alpha"], start, args, h=0.01, steps=100)
    q, v = (np.asarray(x) for x in (start.q, start.v))
    first = np.asarray(ej.consistent_start(system, q, v, args).accelerations)
    q, v = generalized_alpha(q, v, first, first, 0.01, 100, 0.9)
    # Round-off of a hundred steps; positions over h^2 in the accelerations.
    np.testing.assert_allclose(out.state.q, q, rtol=0, atol=1e-10)
    np.testing.assert_allclose(out.state.v, v, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("scheme", "tip", "largest"), [("rattle", 8.8e-5, 4.5e-4), ("alpha", None, 9.1e-4)]
)
@pytest.mark.slow_for("rattle-8.8e-05-0.00045")
def test_the_double_pendulum_from_the_horizontal(scheme, tip, largest):
    """Figures of other programs: RATTLE in C, and EXUDYN with rho 0.9."""
    system, start, args = ej.problems.chain(2, length=2.0, mass=2.0)
    out = march(system, SCHEMES[scheme], start, args, h=1e-3, steps=10_000)
    error = np.abs(out.state.q - double_pendulum_reference(10.0, outer=0.0).q)
    assert np.max(error) == pytest.approx(largest, rel=0.05)
    assert tip is None or np.max(error[2:]) == pytest.approx(tip, rel=0.05)


# Orders -----------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.slow_for("alpha ggl")
def test_order_on_the_double_pendulum(scheme):
    system, start, args = problem("double")
    exact, method = double_pendulum_reference(2.0), SCHEMES[scheme]
    # What the start of generalized-alpha leaves in the multipliers is gone after 200 steps.
    counts = (100, 200, 400) if scheme == "rattle 4" else (200, 400, 800)
    runs = [march(system, method, start, args, h=2 / n, steps=n) for n in counts]
    for error in (
        [np.max(np.abs(run.state.q - exact.q)) for run in runs],
        [np.max(np.abs(run.state.v - exact.v)) for run in runs],
    ):
        np.testing.assert_allclose(slopes(error), method.order, rtol=0, atol=0.2)
    if scheme.startswith("alpha"):
        exact = ej.consistent_start(system, exact.q, exact.v, args).multipliers
        error = [np.max(np.abs(run.multipliers - exact)) for run in runs]
        np.testing.assert_allclose(slopes(error), 2, rtol=0, atol=0.1)


def damper(q, v, t, args):
    return -args["c"] * v


DAMPED = ej.System(kinetic, potential, driven=moved_rod, force=damper)
T0, T1 = 0.2, 1.7


@functools.cache
def damped_reference():
    """Of the angle from +y: the damper acts on the velocity in space."""
    m, g, r, w, c = 1.5, 9.81, 0.3, 5.0, 0.4

    def rates(t, y):
        pivot = r * w * np.cos(w * t) * np.cos(y[0])
        fictitious = r * w**2 * np.sin(w * t) * np.cos(y[0])
        return [y[1], -g * np.sin(y[0]) + fictitious - c / m * (y[1] + pivot)]

    run = solve_ivp(rates, (T0, T1), [np.pi / 2, 0.0], "DOP853", rtol=1e-13, atol=1e-14)
    angle = run.y[0, -1]
    return np.array([np.sin(angle) + r * np.sin(w * T1), np.cos(angle)])


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["rattle", "alpha", "alpha ggl"])
def test_order_with_a_damper_and_a_drive(scheme):
    args, start, method = ARGS | dict(c=0.4), driven_start(), SCHEMES[scheme]
    runs = [
        march(DAMPED, method, start, args, h=(T1 - T0) / n, steps=n, t0=T0)
        for n in (100, 200, 400)
    ]
    found = [np.max(np.abs(run.state.q - damped_reference())) for run in runs]
    np.testing.assert_allclose(slopes(found), 2, rtol=0, atol=0.2)
    # The works are those of the equations: what they leave unexplained in one step is a
    # local error.
    np.testing.assert_allclose(
        slopes([abs(run.energies.dissipated) for run in runs]), 3, rtol=0, atol=0.4
    )


# What the schemes promise ---------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["index3", "ggl"])
def test_the_levels_at_which_constraints_are_held(formulation):
    system, start, args = problem("double")
    method = ej.GeneralizedAlpha(0.8, formulation)
    run = ej.simulate(system, method, start, args, h=0.01, num_steps=100)
    # Solver.
    assert np.max(np.abs(run.audit.constraint)) <= 1e-13
    rate = np.max(np.abs(run.audit.constraint_rate))
    assert rate <= 1e-12 if formulation == "ggl" else rate > 1e-4


def test_rattle_keeps_the_angular_momentum():
    """Of two points on rods, about the pivot, where there is no gravity."""
    system, _, args = problem("double")
    args = args | dict(g=0.0)
    start = ej.initial_state(system, [1.0, 0.0, 1.0, 1.0], [0.0, 1.0, -2.0, 1.0], args)
    out = march(system, ej.Rattle(), start, args, h=0.01, steps=200)
    ends = [
        (state.q.reshape(2, 2), state.v.reshape(2, 2))
        for state in (jax.device_get(start), out.state)
    ]
    before, after = (np.sum(x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]) for x, v in ends)
    assert after == pytest.approx(before, abs=1e-12)  # solver
    energies = [0.5 * np.sum(v**2) for _, v in ends]
    assert abs(energies[1] - energies[0]) > 1e-8  # truncation


def test_fast_oscillations_shrink_by_the_spectral_radius():
    system = ej.System(jnp.eye(1), lambda q, args: 0.5 * args["k"] * q @ q)
    start, args = ej.State(jnp.ones(1), jnp.zeros(1)), dict(k=1.0)

    @jax.vmap
    def speeds(rho):
        # h times the frequency is 1e4.
        method = ej.GeneralizedAlpha(rho)
        return ej.simulate(system, method, start, args, h=1e4, num_steps=100).ys.v[:, 0]

    rho = np.array([0.5, 0.8])
    v = np.abs(np.asarray(speeds(jnp.asarray(rho))))
    # A double root: the amplitude is k rho^k in the limit, and 1/k below.
    shrink = (v[:, 40] / v[:, 20] / 2) ** (1 / 20)
    np.testing.assert_allclose(shrink, rho, rtol=2e-2)


def test_hht_shrinks_fast_oscillations_by_its_published_limit():
    """By (1 + alpha)/(1 - alpha): J. Chung and G. M. Hulbert (1993)."""
    system = ej.System(jnp.eye(1), lambda q, args: 0.5 * args["k"] * q @ q)
    start, args = ej.State(jnp.ones(1), jnp.zeros(1)), dict(k=1.0)

    @jax.vmap
    def speeds(alpha):
        method = ej.GeneralizedAlpha.hht(alpha)
        return ej.simulate(system, method, start, args, h=1e4, num_steps=100).ys.v[:, 0]

    alpha = np.array([-0.2, -0.1])
    v = np.abs(np.asarray(speeds(jnp.asarray(alpha))))
    # A double root, as above.
    shrink = (v[:, 40] / v[:, 20] / 2) ** (1 / 20)
    np.testing.assert_allclose(shrink, (1 + alpha) / (1 - alpha), rtol=2e-2)


def test_multipliers_of_rattle_are_those_of_the_middle_of_the_step():
    """With an error of second order; those of its start are off by the first."""
    system, start, args = problem("pendulum")
    errors = []
    for steps in (50, 100):
        # One program: longer steps go on for longer.
        sol = ej.simulate(system, ej.Rattle(), start, args, h=1 / steps, num_steps=100)
        accelerations = jax.vmap(
            lambda q, v: ej.consistent_start(system, q, v, args).multipliers
        )(sol.ys.q, sol.ys.v)
        middle = 0.5 * (accelerations[1:] + accelerations[:-1])
        off = np.abs(sol.multipliers[1:] - middle)
        errors.append(np.max(off[:steps]))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)  # truncation, of order 2


def test_newmark_is_the_trapezoidal_rule():
    """Which conserves the energy of a linear oscillator."""
    system = ej.System(jnp.eye(1), lambda q, args: 0.5 * args["k"] * q @ q)
    start, args = ej.State(jnp.ones(1), jnp.zeros(1)), dict(k=1.0)
    change = lambda method: np.ptp(
        ej.simulate(system, method, start, args, h=0.5, num_steps=100).audit.energy
    )
    assert change(ej.GeneralizedAlpha.newmark()) <= 1e-13  # solver
    assert change(ej.GeneralizedAlpha.hht(0.0)) <= 1e-13
    assert change(ej.GeneralizedAlpha.hht(-0.3)) > 1e-2


@pytest.mark.slow
def test_derivatives_pass_through_the_carried_acceleration():
    system, start, args = problem("pendulum")

    def end(g, rho):
        method, world = ej.GeneralizedAlpha(rho), args | dict(g=g)
        return ej.simulate(system, method, start, world, h=0.05, num_steps=20).ys.q[-1, 0]

    found = jax.jit(jax.grad(end, argnums=(0, 1)))(9.81, 0.7)
    end = jax.jit(end)
    for k, d in enumerate(1e-5 * np.eye(2)):
        expected = (end(9.81 + d[0], 0.7 + d[1]) - end(9.81 - d[0], 0.7 - d[1])) / 2e-5
        assert found[k] == pytest.approx(float(expected), rel=1e-6)


def test_other_schemes_carry_nothing():
    system, start, args = problem("pendulum")
    carried = lambda method: (
        ej.step(system, method, start, args, h=0.01).warm.stages.carried
    )
    assert carried(ej.EnergyPreserving()) is None
    assert len(jax.tree.leaves(carried(ej.GeneralizedAlpha(0.5)))) == 2


# Refusals -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "cause"), [("top", "`kinematics`"), ("double angles", "varying inertia")]
)
@pytest.mark.parametrize("scheme", ["rattle", "alpha"])
def test_systems_that_they_are_not_defined_for(name, cause, scheme):
    system, start, args = problem(name)
    with pytest.raises(ValueError, match=cause):
        ej.simulate(system, SCHEMES[scheme], start, args, h=1e-3, num_steps=1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ej.GeneralizedAlpha(1.2), "rho_inf"),
        (lambda: ej.GeneralizedAlpha.hht(0.1), "alpha"),
        (lambda: ej.GeneralizedAlpha.newmark(0.0), "Rattle"),
        (lambda: ej.Composed(ej.GeneralizedAlpha(0.9), 4), "symmetric"),
    ],
)
def test_they_cannot_be_made_from_bad_numbers(make, message):
    with pytest.raises(ValueError, match=message):
        make()
