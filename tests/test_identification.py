"""Fits: estimates, their uncertainty, and what the data cannot tell."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize
import scipy.stats

import enerjax as ej

from .references import double_pendulum_reference, FREE_BODY


TIMES = np.linspace(0.0, 2.0, 40)


def decay(parameters, t):
    return parameters["a"] * jnp.exp(-parameters["rate"] * t) + parameters["offset"]


def decay_residuals(parameters, data):
    return decay(parameters, jnp.asarray(TIMES)) - data


TRUE = {"a": 2.0, "offset": -0.5, "rate": 1.5}
GUESS = {"a": 1.0, "offset": 0.0, "rate": 0.5}
POSITIVE = {"a": True, "offset": False, "rate": True}


def noisy(count, sigma=0.05):
    exact = np.asarray(decay(TRUE, TIMES))
    return exact + sigma * np.random.default_rng(1).normal(size=(count, TIMES.size))


# Statistics, on formulas -----------------------------------------------------------------


def test_estimate_and_covariance_of_an_independent_program():
    (data,) = noisy(1)
    fit = ej.fit(decay_residuals, GUESS, data, positive=POSITIVE)
    model = lambda t, a, offset, rate: a * np.exp(-rate * t) + offset
    best, spread = scipy.optimize.curve_fit(model, TIMES, data, [1.0, 0.0, 0.5])
    found = [float(fit.parameters[name]) for name in ("a", "offset", "rate")]
    assert fit.names == ("a", "offset", "rate")
    # Solver: both stop where a step is 1e-8 of the parameters; theirs is by differences.
    np.testing.assert_allclose(found, best, rtol=1e-5)
    np.testing.assert_allclose(fit.covariance, spread, rtol=1e-4)
    errors = [float(fit.standard_errors[name]) for name in fit.names]
    np.testing.assert_allclose(errors, np.sqrt(np.diagonal(spread)), rtol=1e-4)
    assert fit.degrees_of_freedom == 37
    assert 0.03 < fit.noise < 0.07
    # Of a plain parameter the interval is symmetric, of a positive one its logarithm.
    half = scipy.stats.t.ppf(0.975, 37)
    middle, error = found[1], errors[1]
    np.testing.assert_allclose(fit.lower["offset"], middle - half * error, rtol=1e-12)
    np.testing.assert_allclose(fit.upper["offset"], middle + half * error, rtol=1e-12)
    product = fit.lower["rate"] * fit.upper["rate"]
    np.testing.assert_allclose(product, found[2] ** 2, rtol=1e-12)
    ratio = np.log(fit.upper["rate"] / found[2])
    np.testing.assert_allclose(ratio, half * errors[2] / found[2], rtol=1e-12)
    table = str(fit).splitlines()
    assert [row.split()[0] for row in table[1:4]] == ["a", "offset", "rate"]


def test_intervals_hold_what_they_promise():
    """Of 400 intervals of 95 % about 380 +- 4.4 hold the truth; five deviations."""
    fit = lambda data: ej.fit(decay_residuals, GUESS, data, positive=POSITIVE, throw=False)
    fits = eqx.filter_jit(jax.vmap(fit))(noisy(400))
    assert jnp.all(fits.result == optx.RESULTS.successful)
    for name, value in TRUE.items():
        held = np.sum((fits.lower[name] < value) & (value < fits.upper[name]))
        assert 358 <= held <= 400, (name, held)


def test_minimisers_find_the_same():
    (data,) = noisy(1)
    best = ej.fit(decay_residuals, GUESS, data, positive=POSITIVE)
    solver = optx.BFGS(rtol=1e-9, atol=1e-9)
    other = ej.fit(decay_residuals, GUESS, data, positive=POSITIVE, solver=solver)
    for name in TRUE:
        np.testing.assert_allclose(other.parameters[name], best.parameters[name], rtol=1e-5)
    assert best.simulations == 4 * (best.iterations + 1)
    assert other.simulations == 2 * other.iterations + 4


def test_what_the_data_does_not_tell_is_told():
    redundant = lambda p, data: p["a"] * p["b"] * jnp.exp(-p["rate"] * TIMES) - data
    data = 2 * np.exp(-TIMES) + 0.01 * np.random.default_rng(0).normal(size=TIMES.size)
    guess = {"a": 1.0, "b": 1.0, "rate": 0.5, "unused": 1.0}
    with pytest.raises(ValueError, match="do not determine a, b, unused:"):
        ej.fit(redundant, guess, data)
    fit = ej.fit(redundant, guess, data, throw=False)
    errors = fit.standard_errors
    assert np.isinf([errors["a"], errors["b"], errors["unused"]]).all()
    assert 0 < errors["rate"] < 0.05
    assert np.isinf(fit.upper["unused"])


def test_starts_from_many_guesses():
    """The frequency of a sine: a cost with many minima."""
    wave = lambda p, data: jnp.sin(p["w"] * TIMES) - data
    data = np.sin(9.0 * TIMES)
    fits = ej.sweep(
        lambda w: ej.fit(wave, {"w": w}, data, throw=False), {"w": np.arange(1.0, 16.0)}
    )
    assert fits.at(w=3.0).values.cost > 1
    best = fits.smallest("cost").values
    np.testing.assert_allclose(best.parameters["w"], 9.0, rtol=1e-8)


@pytest.mark.parametrize(
    ("guess", "options", "message"),
    [
        (GUESS | {"a": -1.0}, {"positive": POSITIVE}, "guess of `a` is -1; it must be pos"),
        (GUESS | {"offset": np.nan}, {}, "`offset` is nan; it must be finite"),
        ({}, {}, "holds no parameters"),
        (GUESS, {"positive": {"b": True}}, "does not fit to the parameters a, offset"),
        (GUESS, {"solver": optx.Newton(1e-8, 1e-8)}, "`solver` must be one of optimistix"),
        (GUESS | {"rate": -1e9}, {}, "not finite where the fit began"),
        (GUESS | {"offset": np.zeros(40)}, {}, "40 numbers for 42 parameters"),
        (GUESS, {"max_steps": 0}, "positive integer"),
        (GUESS | {"a": 1j}, {}, "must hold real numbers"),
    ],
)
def test_bad_input(guess, options, message):
    (data,) = noisy(1)
    with pytest.raises((ValueError, TypeError), match=message):
        ej.fit(decay_residuals, guess, data, **options)


def test_a_solver_that_fails_says_so():
    (data,) = noisy(1)
    with pytest.raises(eqx.EquinoxRuntimeError, match="failed after 2 iterations. The max"):
        ej.fit(decay_residuals, GUESS, data, max_steps=2)


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
        save_every=5,
        throw=False,
    )


def damped(t, k, c):
    """Its position and velocity, in closed form."""
    w = np.sqrt(k - c**2 / 4)
    fade, swing = np.exp(-c / 2 * t), np.cos(w * t) + c / (2 * w) * np.sin(w * t)
    return fade * swing, -fade * k / w * np.sin(w * t)


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
        save_every=every,
        throw=False,
    )


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
            save_every=100,
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

    residuals = ej.multiple_shooting(window)
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
    residuals = ej.multiple_shooting(window, continuity=1e3)
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
