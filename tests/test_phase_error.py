"""The phase error: a run's own estimate of its accuracy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import enerjax as ej


W, STEPS = 3.0, 200


@pytest.mark.parametrize(
    "scheme",
    [ej.EnergyPreserving(), ej.EnergyConsistent(0.0), ej.EnergyConsistent(0.5)],
    ids=["preserving", "consistent", "consistent decaying"],
)
@pytest.mark.slow_for("preserving", "consistent decaying")
def test_the_estimate_follows_the_error_of_an_oscillator(scheme):
    system = ej.System(lambda v, args: 0.5 * v @ v, lambda q, args: 0.5 * W**2 * q @ q)
    for h in (0.01, 0.05, 0.2):
        run = ej.simulate(
            system, scheme, ej.State([1.0], [0.0]), h=h, num_steps=STEPS, throw=False
        )
        exact = np.cos(W * np.asarray(run.ts))
        error = np.max(np.abs(run.ys.q[:, 0] - exact)[-60:])
        # Truncation, of the estimate: the errors span eight orders, and the first steps,
        # which have no past, are taken for worse than they are.
        assert 0.3 * error < run.phase_error < 20 * error
    unresolved = ej.simulate(
        system, scheme, ej.State([1.0], [0.0]), h=10.0, num_steps=STEPS, throw=False
    )
    assert unresolved.phase_error > 1
    assert "phase of the motion, by local errors: to about" in str(unresolved)


def test_forces_limit_the_order_of_the_estimate():
    """A forced oscillator: the estimate is no less than the error at any step."""
    system = ej.System(
        jnp.eye(1),
        lambda q, args: 0.5 * q @ q,
        force=lambda q, v, t, args: -0.1 * v + jnp.cos(3.0 * t),
    )
    start = ej.State(jnp.ones(1), jnp.zeros(1))
    wanted = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], -y[0] - 0.1 * y[1] + np.cos(3 * t)],
        (0, 10),
        [1.0, 0.0],
        rtol=1e-11,
        atol=1e-12,
    ).y[0, -1]
    for steps in (200, 800):
        scheme = ej.EnergyConsistent(0.0)
        sol = ej.simulate(system, scheme, start, h=10 / steps, num_steps=steps)
        error = abs(float(sol.ys.q[-1, 0]) - wanted)
        assert error < sol.phase_error < 1e3 * error


@pytest.mark.slow
def test_an_unresolved_motion_has_a_large_phase_error():
    """A light mass that is whipped around, faster than the steps can follow: the balance
    holds, and the heavy mass is 0.98 of a length off."""
    system, start, args = ej.problems.double_pendulum(m1=1e-4, m2=1.0)
    run = ej.simulate(
        system, ej.EnergyPreserving(), start, args, h=1e-3, num_steps=500, throw=False
    )
    assert run.result == ej.RESULTS.successful
    assert run.phase_error > 0.1
    _, _, heavy = ej.problems.double_pendulum()
    calm = ej.simulate(system, ej.EnergyPreserving(), start, heavy, h=1e-3, num_steps=500)
    assert calm.phase_error < 1e-3


def test_a_system_at_rest_has_no_phase_error():
    system, start, args = ej.problems.pendulum()
    hanging = ej.initial_state(system, [0.0, 1.0], [0.0, 0.0], args)
    run = ej.simulate(system, ej.EnergyPreserving(), hanging, args, h=0.05, num_steps=50)
    # Round-off: the bob moves by 1e-17, as fast as round-off makes it.
    assert run.phase_error < 1e-6
