"""Fits of models that move: dampers, rods, bodies, and long chaotic runs in windows."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import enerjax as ej

from .references import double_pendulum_reference, FREE_BODY


# Models that move ------------------------------------------------------------------------


def oscillation(parameters, h=0.01, steps=200):
    """A mass on a spring and a damper, pulled out by one."""
    system = ej.System(
        lambda v, args: 0.5 * v @ v,
        lambda q, args: 0.5 * args["k"] * q @ q,
        force=lambda q, v, t, args: -args["c"] * v,
    )
    start = ej.State(jnp.ones(1), jnp.zeros(1))
    return ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        parameters,
        h=h,
        num_steps=steps,
        saveat=ej.SaveAt(every=5),
        throw=False,
    )


def damped(t, k, c):
    """Its position and velocity, in closed form."""
    w = np.sqrt(k - c**2 / 4)
    fade, swing = np.exp(-c / 2 * t), np.cos(w * t) + c / (2 * w) * np.sin(w * t)
    return fade * swing, -fade * k / w * np.sin(w * t)


@pytest.mark.slow
def test_a_damper_from_positions_and_energies():
    t = 0.05 * np.arange(41)
    x, v = damped(t, 10.0, 0.4)
    rng = np.random.default_rng(2)
    sigma = 1e-2
    data = {"x": x + sigma * rng.normal(size=41)}
    data["energy"] = 5.0 * x**2 + 0.5 * v**2 + sigma * rng.normal(size=41)

    def residuals(parameters, data):
        run = oscillation(parameters)
        return {
            "x": (run.ys.q[:, 0] - data["x"]) / sigma,
            "energy": (run.audit.energy - data["energy"]) / sigma,
        }

    fit = ej.fit(residuals, {"k": 8.0, "c": 1.0}, data, positive=True)
    # The noise is known here: the residuals have a deviation of one.
    assert 0.75 < fit.noise < 1.25
    for name, value, most in (("k", 10.0, 0.1), ("c", 0.4, 0.02)):
        assert fit.standard_errors[name] < most
        assert abs(fit.parameters[name] - value) < 3 * fit.standard_errors[name]
    # The uncertainty of an independent solver, on the closed form.
    both = lambda _, k, c: np.concatenate(
        [damped(t, k, c)[0], k / 2 * damped(t, k, c)[0] ** 2 + damped(t, k, c)[1] ** 2 / 2]
    )
    measured = np.concatenate([data["x"], data["energy"]])
    best, spread = scipy.optimize.curve_fit(both, t, measured, [9.0, 0.5])
    found = [float(fit.parameters[name]) for name in ("k", "c")]
    # Truncation, of order two: about (h w)^2 / 12.
    np.testing.assert_allclose(found, best, rtol=5e-4)
    order = [fit.names.index(name) for name in ("k", "c")]
    np.testing.assert_allclose(fit.covariance[np.ix_(order, order)], spread, rtol=1e-2)


def rods(parameters, state, h, steps, every):
    system, _, args = ej.problems.double_pendulum()
    return ej.simulate(
        system,
        ej.EnergyPreserving(),
        state,
        args | parameters,
        h=h,
        num_steps=steps,
        saveat=ej.SaveAt(every=every),
        throw=False,
    )


@pytest.mark.slow
def test_masses_lengths_and_gravity_through_the_rods_of_a_double_pendulum():
    times = 0.1 * np.arange(1, 11)
    exact = np.array([double_pendulum_reference(t, m2=2.0).q for t in times])
    sigma = 5e-3
    data = exact + sigma * np.random.default_rng(3).normal(size=exact.shape)

    def residuals(p, data):
        reach, none = p["l1"], jnp.zeros_like(p["l1"])
        q = jnp.stack([reach, none, reach, p["l2"]])
        run = rods(p, ej.State(q, jnp.zeros(4)), 0.01, 100, 10)
        return (run.ys.q[1:] - data) / sigma

    guess = {"m2": 1.0, "l1": 0.8, "l2": 1.2, "g": 8.0}
    fit = ej.fit(residuals, guess, data, positive=True)
    assert 0.7 < fit.noise < 1.3
    assert fit.iterations < 30
    for name, value in {"m2": 2.0, "l1": 1.0, "l2": 1.0, "g": 9.81}.items():
        assert fit.standard_errors[name] < 0.05 * value
        # Truncation is a twentieth of the noise here.
        assert abs(fit.parameters[name] - value) < 3 * fit.standard_errors[name]


@pytest.mark.slow
def test_inertias_of_a_body_in_quaternions():
    """Two of three: without a force a body shows their quotients."""
    system, start, _ = ej.problems.free_rigid_body()
    known = FREE_BODY[0.5]

    def residuals(parameters, known):
        inertia = jnp.append(parameters["J"], 3.0)
        scheme = ej.Composed(ej.EnergyPreserving(), 4)
        run = ej.simulate(
            system,
            scheme,
            start,
            dict(J=inertia),
            h=5e-3,
            num_steps=100,
            saveat=ej.SaveAt(every=100),
            throw=False,
        )
        return run.ys.q[-1] - known[0], (run.ys.v[-1] - known[1]) / 20

    fit = ej.fit(
        residuals,
        {"J": np.array([6.2, 7.8])},
        (known.quaternion, known.spin),
        positive=True,
    )
    # Truncation.
    np.testing.assert_allclose(fit.parameters["J"], [6.0, 8.0], rtol=1e-3)
    assert fit.noise < 1e-3


# Windows ---------------------------------------------------------------------------------


def swing(parameters, start, t):
    """An oscillator in closed form, from its position and velocity."""
    w, (x, v) = parameters["w"], start
    c, s = jnp.cos(w * t), jnp.sin(w * t)
    return x * c + v / w * s, v * c - w * x * s


@pytest.mark.slow
def test_windows_find_what_one_run_finds():
    times = np.linspace(0.0, 8.0, 65)
    data = 0.7 * np.sin(2.0 * times + 0.3)
    data = data + 0.02 * np.random.default_rng(4).normal(size=65)
    whole = lambda p, data: swing(p, p["start"], times)[0] - data
    one = ej.fit(whole, {"w": 1.98, "start": [0.0, 1.0]}, data)

    def window(parameters, start, data):
        inside = jnp.asarray(times[:16])
        return swing(parameters, start, inside)[0] - data, jnp.stack(
            swing(parameters, start, 2.0)
        )

    residuals = ej.MultipleShooting(window, 1e3)
    pieces = data[:64].reshape(4, 16)
    starts = np.stack([pieces[:, 0], (pieces[:, 1] - pieces[:, 0]) * 8], axis=1)
    # From so far off a single run ends elsewhere; this one has the first program.
    guess = {"parameters": {"w": 3.0}, "starts": starts}
    many = ej.fit(residuals, guess, pieces)
    lost = ej.fit(whole, {"w": 3.0, "start": list(starts[0])}, data, throw=False)
    assert lost.cost > 50 * one.cost
    # The last sample belongs to no window; gaps are a thousandth of the noise.
    error = one.standard_errors["w"]
    assert abs(many.parameters["parameters"]["w"] - one.parameters["w"]) < 0.5 * error
    np.testing.assert_allclose(many.standard_errors["parameters"]["w"], error, rtol=0.1)
    assert many.degrees_of_freedom == 64 - 3
    gaps = residuals(many.parameters, pieces)["gaps"]
    assert np.max(np.abs(gaps)) / 1e3 < 1e-4


@functools.cache
def chaotic():
    """Twelve seconds of a double pendulum: windows of half a second, five rows in each."""
    times = np.arange(120) / 10
    states = [double_pendulum_reference(t) for t in times[1:]]
    q = np.array([[1.0, 0.0, 1.0, 1.0], *(x.q for x in states)])
    return q + 0.01 * np.random.default_rng(5).normal(size=q.shape)


def angles(q):
    inner, outer = q[..., :2], q[..., 2:] - q[..., :2]
    return np.stack([np.arctan2(x[..., 1], x[..., 0]) for x in (inner, outer)], axis=-1)


@pytest.mark.slow
def test_a_long_chaotic_run_through_constraints():
    data, sigma = chaotic(), 0.01
    turns = np.unwrap(angles(data), axis=0)
    rates = np.gradient(turns, 0.1, axis=0)
    starts = np.concatenate([turns, rates], axis=1)[::5]

    def state(x):
        (a, b), (da, db) = x[:2], x[2:]
        inner, outer = (jnp.stack([jnp.cos(y), jnp.sin(y)]) for y in (a, b))
        q = jnp.concatenate([inner, inner + outer])
        along = [dy * jnp.stack([-y[1], y[0]]) for y, dy in ((inner, da), (outer, db))]
        return ej.State(q, jnp.concatenate([along[0], along[0] + along[1]]))

    def window(parameters, start, data):
        run = rods(parameters, state(start), 0.005, 100, 20)
        inner, outer = run.ys.q[-1, :2], run.ys.q[-1, 2:] - run.ys.q[-1, :2]
        speeds = run.ys.v[-1, :2], run.ys.v[-1, 2:] - run.ys.v[-1, :2]
        turn = [
            x[0] * v[1] - x[1] * v[0] for x, v in zip((inner, outer), speeds, strict=True)
        ]
        ends = [jnp.arctan2(x[1], x[0]) for x in (inner, outer)]
        # The angle nearest to where the next window may begin: they are continuous.
        ends = [
            y + 2 * jnp.pi * jnp.round((x - y) / (2 * jnp.pi))
            for x, y in zip(data["next"], ends, strict=True)
        ]
        return (run.ys.q[:5] - data["q"]) / sigma, jnp.stack([*ends, *turn])

    following = np.append(turns[5::5], turns[-1:], axis=0)
    pieces = {"q": data.reshape(24, 5, 4), "next": following}
    residuals = ej.MultipleShooting(window, 1e3)
    guess = {"parameters": {"m2": 0.8, "g": 9.0}, "starts": starts}
    fit = ej.fit(residuals, guess, pieces)
    found, errors = fit.parameters["parameters"], fit.standard_errors["parameters"]
    assert 0.8 < fit.noise < 1.2
    for name, value in (("m2", 1.0), ("g", 9.81)):
        assert errors[name] < 0.01 * value
        assert abs(found[name] - value) < 3 * errors[name]
    # One run over the whole time has lost the data after a few seconds.
    start = jnp.asarray(starts[0])
    single = lambda p, data: (rods(p, state(start), 0.005, 2380, 20).ys.q - data) / sigma
    lost = ej.fit(single, {"m2": 0.8, "g": 9.0}, data, throw=False)
    assert abs(lost.parameters["g"] - 9.81) > 0.1
