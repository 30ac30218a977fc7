"""Forces without a potential: order, exact work, and dampers that only remove energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import enerjax as ej

from .helpers import EPS, follow, long, slopes


SCHEMES = {
    "preserving": ej.EnergyPreserving(),
    "consistent": ej.EnergyConsistent(0.5),
    "decaying": ej.EnergyDecaying(0.5),
    "kappa": ej.KappaDecaying(0.5),
}


def exact(rates, start, t0, t1):
    return solve_ivp(rates, (t0, t1), start, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


def unit_kinetic(v, args):
    return 0.5 * v @ v


def errors(system, scheme, start, args, truth, *, t0, t1, numbers):
    """At the end of runs of some numbers of steps, and their worst energy leak."""
    runs = [
        follow(system, scheme, start, args, h=(t1 - t0) / n, steps=n, t0=t0)
        for n in numbers
    ]
    found = [np.max(np.abs(state.q - truth)) for state, _, _ in runs]
    return np.array(found), max(float(leak) for _, leak, _ in runs)


# Oscillators ---------------------------------------------------------------------------


def spring(q, args):
    return 0.5 * args["k"] * q @ q


def damper(q, v, t, args):
    return -args["c"] * v


DAMPED = ej.System(unit_kinetic, spring, force=damper)


@pytest.mark.parametrize(
    ("scheme", "order"), [("preserving", 2), ("consistent", 2), ("decaying", 3)]
)
def test_a_damped_oscillator_follows_its_closed_form(scheme, order):
    """Where nothing is constrained linear dampers keep the order of `EnergyDecaying`."""
    t, c, w = 2.0, 0.3, np.sqrt(4 - 0.15**2)
    truth = np.exp(-0.15 * t) * (np.cos(w * t) + 0.15 / w * np.sin(w * t))
    start, args = ej.State([1.0], [0.0]), dict(k=4.0, c=c)
    found, leak = errors(
        DAMPED, SCHEMES[scheme], start, args, truth, t0=0.0, t1=t, numbers=[40, 80, 160]
    )
    np.testing.assert_allclose(slopes(found), order, atol=0.15)
    assert found[-1] <= 2e-4
    # Solver, against an energy of 2.
    assert leak <= 1e-14


OMEGA = np.logspace(-3, 4, 15)


@pytest.mark.parametrize(
    "scheme",
    [
        ej.EnergyPreserving(),
        ej.EnergyConsistent(0.0),
        ej.EnergyConsistent(1.0),
        ej.EnergyDecaying(0.0),
        ej.EnergyDecaying(0.5),
        ej.EnergyDecaying(1.0),
    ],
)
def test_a_damper_never_creates_energy_in_steps_of_any_length(scheme):
    """`h = 1` and frequencies from 1e-3 to 1e4; critical dampers and weak ones."""
    start = ej.State([1.0], [1.0])

    def run(omega, share):
        args = dict(k=omega**2, c=2 * share * omega)
        _, leak, most = follow(DAMPED, scheme, start, args, h=1.0, steps=30)
        return leak / (1 + omega**2), most / (1 + omega**2)

    omega, share = (jnp.asarray(x.ravel()) for x in np.meshgrid(OMEGA, [0.01, 1.0, 50.0]))
    leak, most = jax.vmap(run)(omega, share)
    # Solver, and round-off of the work, against the energy of the start.
    assert np.max(leak) <= 1e-11
    assert np.max(most) <= 1e-15


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_the_work_of_a_damper_in_a_decaying_step_is_a_sum_of_squares(alpha):
    h, q0, v0 = 0.7, 1.0, 0.3
    args = dict(k=4.0, c=0.8)
    out = ej.step(DAMPED, ej.EnergyDecaying(alpha), ej.State([q0], [v0]), args, h=h)
    mean = (out.state.q[0] - q0) / h
    jumped = 2 * mean - out.state.v[0]
    # Eq. (47e): the velocities fix the jump of the position.
    lag = -(out.state.v[0] - alpha * jumped - (1 - alpha) * v0) / 6
    squares = mean**2 + 3 * lag**2
    np.testing.assert_allclose(
        np.asarray(out.energies.work), -args["c"] * h * squares, rtol=1e-13
    )


def _pushed_and_braked(q, v, t, args):
    dry = jnp.tanh(1e3 * v) if args["smooth"] is True else v / jnp.abs(v)
    return args["push"] - args["c"] * v - args["dry"] * dry


# Whether the force is smooth is nothing that a scheme knows of: one of them for both.
BRAKED = [
    pytest.param(
        scheme,
        smooth,
        id=f"{type(scheme).__name__}-{smooth}",
        marks=pytest.mark.slow if smooth and number > 0 else [],
    )
    for number, scheme in enumerate(
        [
            ej.EnergyPreserving(),
            ej.EnergyDecaying(0.5),
            ej.EnergyConsistent(0.5),
            ej.Rattle(),
        ]
    )
    for smooth in (True, False)
]


@pytest.mark.parametrize(("scheme", "smooth"), BRAKED)
@pytest.mark.slow_for("EnergyPreserving-False", "EnergyConsistent-False")
def test_the_energy_that_dampers_remove_is_reported_separately(scheme, smooth):
    system = ej.System(DAMPED.kinetic, DAMPED.potential, force=_pushed_and_braked)
    args = dict(k=4.0, c=0.8, dry=0.1, push=0.7, smooth=smooth)
    start = ej.State([1.0], [0.3])
    run = ej.simulate(system, scheme, start, args, h=0.05, num_steps=4)
    audit = run.audit
    # A constant force works along the way, whatever the velocity is; round-off.
    np.testing.assert_allclose(
        audit.work + audit.damped,
        0.7 * np.diff(run.ys.q[:, 0], prepend=run.ys.q[0, 0]),
        atol=1e-15,
    )
    assert np.all(audit.damped[1:] > 0)


def push(q, v, t, args):
    return jnp.sin(args["w"] * t) - 0.2 * v * jnp.abs(v)


FORCED = ej.System(unit_kinetic, lambda q, args: 0.25 * jnp.sum(q**4), force=push)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_force_that_depends_on_time_and_velocity(scheme):
    rates = lambda t, y: [y[1], -(y[0] ** 3) - 0.2 * y[1] * abs(y[1]) + np.sin(3 * t)]
    truth = exact(rates, [1.0, 0.0], 0.7, 2.7)[:1]
    start, args = ej.State([1.0], [0.0]), dict(w=3.0)
    found, leak = errors(
        FORCED, SCHEMES[scheme], start, args, truth, t0=0.7, t1=2.7, numbers=[40, 80]
    )
    np.testing.assert_allclose(slopes(found), 2, atol=0.1)
    assert found[-1] <= 7e-4
    assert leak <= 1e-14


# Constraints and rotations -------------------------------------------------------------


def hanging(q, args):
    return -args["m"] * args["g"] * q[1]


def rod(q, args):
    return jnp.array([q @ q - args["l"] ** 2])


PENDULUM = ej.System(lambda v, args: 0.5 * args["m"] * v @ v, hanging, rod, force=damper)
PENDULUM_ARGS = dict(m=1.5, g=9.81, l=1.0, c=0.4)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.slow_for("kappa", "consistent")
def test_a_damped_pendulum_on_its_rod(scheme):
    rates = lambda _, y: [y[1], -9.81 * np.sin(y[0]) - 0.4 / 1.5 * y[1]]
    angle = exact(rates, [np.pi / 2, 0.0], 0.0, 2.0)[0]
    start, truth = ej.State([1.0, 0.0], [0.0, 0.0]), [np.sin(angle), np.cos(angle)]
    run = lambda n: follow(
        PENDULUM, SCHEMES[scheme], start, PENDULUM_ARGS, h=2.0 / n, steps=n
    )
    (coarse, *_), (fine, leak, most) = run(100), run(200)
    found = [np.max(np.abs(state.q - np.array(truth))) for state in (coarse, fine)]
    np.testing.assert_allclose(slopes(found), 2, atol=0.25)
    assert found[-1] <= 1e-3
    # Solver, against a turnover of 15; kappa divides by a small change of energy.
    assert leak <= 5e-13
    # The rod changes nothing: its multipliers do not show in the velocity of the damper.
    assert most <= 0


def body_rates(q, args):
    e0, e1, e2, e3 = q
    return 2 * jnp.array([[-e1, e0, e3, -e2], [-e2, -e3, e0, e1], [-e3, e2, -e1, e0]])


def torque(q, v, t, args):
    return args["motor"] * jnp.sin(2 * t) - args["c"] * v


BODY = ej.System(
    lambda v, args: 0.5 * v @ (args["J"] * v),
    lambda q, args: 0.0 * q[0],
    kinematics=body_rates,
    coordinate_constraint=lambda q, args: jnp.array([q @ q - 1]),
    force=torque,
)
BODY_ARGS = dict(
    J=jnp.array([6.0, 8.0, 3.0]),
    c=jnp.array([1.0, 2.0, 0.5]),
    motor=jnp.array([20.0, 5.0, -3.0]),
)


def body_reference(t0, t1):
    inertia, c, motor = (np.asarray(BODY_ARGS[name]) for name in ("J", "c", "motor"))

    def rates(t, y):
        (e0, e1, e2, e3), spin = y[:4], y[4:]
        lift = np.array([[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]])
        moment = motor * np.sin(2 * t) - c * spin - np.cross(spin, inertia * spin)
        return [*(0.5 * lift @ spin), *(moment / inertia)]

    return exact(rates, [1.0, 0, 0, 0, 1.0, 2.0, 2.0], t0, t1)[:4]


@pytest.mark.parametrize("scheme", long(["preserving", "decaying", "kappa"], "kappa"))
@pytest.mark.slow_for("decaying")
def test_a_torque_acts_in_body_axes(scheme):
    start = ej.State([1.0, 0, 0, 0], [1.0, 2.0, 2.0])
    truth = body_reference(0.3, 1.3)
    found, leak = errors(
        BODY, SCHEMES[scheme], start, BODY_ARGS, truth, t0=0.3, t1=1.3, numbers=[50, 100]
    )
    np.testing.assert_allclose(slopes(found), 2, atol=0.1)
    assert found[-1] <= 5e-4
    # Round-off, against an energy of 25: a random walk of a hundred steps.
    assert leak <= 4 * np.sqrt(100) * EPS * 25
    still = BODY_ARGS | dict(motor=jnp.zeros(3))
    _, _, most = follow(BODY, SCHEMES[scheme], start, still, h=0.5, steps=20)
    assert most < 0
