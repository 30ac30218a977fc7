"""Fits: estimates, their uncertainty, and undetermined parameters."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize
import scipy.stats

import enerjax as ej


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


def test_confidence_intervals_contain_the_truth_as_often_as_they_claim():
    """Of 400 intervals of 95 % about 380 +- 4.4 hold the truth; five deviations."""
    fit = lambda data: ej.fit(decay_residuals, GUESS, data, positive=POSITIVE, throw=False)
    fits = eqx.filter_jit(jax.vmap(fit))(noisy(400))
    assert jnp.all(fits.result == optx.RESULTS.successful)
    for name, value in TRUE.items():
        held = np.sum((fits.lower[name] < value) & (value < fits.upper[name]))
        assert 358 <= held <= 400, (name, held)


def test_minimisers_find_the_same_estimate():
    (data,) = noisy(1)
    best = ej.fit(decay_residuals, GUESS, data, positive=POSITIVE)
    solver = optx.BFGS(rtol=1e-9, atol=1e-9)
    other = ej.fit(decay_residuals, GUESS, data, positive=POSITIVE, solver=solver)
    for name in TRUE:
        np.testing.assert_allclose(other.parameters[name], best.parameters[name], rtol=1e-5)
    assert best.simulations == 4 * (best.iterations + 1)
    assert other.simulations == 2 * other.iterations + 4


def test_undetermined_parameters_are_named():
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
        (
            GUESS,
            {"solver": optx.Newton(1e-8, 1e-8)},
            "`solver` must be a least-squares solver",
        ),
        (GUESS | {"rate": -1e9}, {}, "not finite at the guess"),
        (GUESS | {"offset": np.zeros(40)}, {}, "40 numbers for 42 parameters"),
        (GUESS, {"max_steps": 0}, "positive integer"),
        (GUESS | {"a": 1j}, {}, "must hold real numbers"),
    ],
)
def test_bad_input(guess, options, message):
    (data,) = noisy(1)
    with pytest.raises((ValueError, TypeError), match=message):
        ej.fit(decay_residuals, guess, data, **options)


def test_a_failed_solver_raises_an_error():
    (data,) = noisy(1)
    with pytest.raises(eqx.EquinoxRuntimeError, match="failed after 2 iterations. The max"):
        ej.fit(decay_residuals, GUESS, data, max_steps=2)
