"""When a search by Newton's method ends, and which corrections it takes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._programs import in_one_function
from enerjax._solvers import find_root, Newton
from enerjax._solvers.linear.norms import largest

from .helpers import EPS


def root_of(fn, guess):
    found = find_root(
        lambda x, _: fn(x), Newton(), jnp.asarray([guess]), None, max_iterations=50
    )
    assert found.found
    return float(found.value[0])


@pytest.mark.parametrize("off", [2e-4, 3e-4, 4e-4])
def test_a_correction_that_does_not_shrink_is_not_taken_for_round_off(off):
    """Strongly curved, with small residuals: a new Jacobian hardly shrinks a correction,
    but the next one does."""

    def fn(x):
        y = x - 1
        return 1e-5 * (y + 1e3 * y**2)

    # The residual is round-off where it is an eps: 2e-11 off the root.
    assert root_of(fn, 1 + off) == pytest.approx(1, rel=0, abs=1e-10)


def test_a_correction_that_is_small_by_coincidence_is_not_the_last():
    """From `-b/2`, the correction of `y + b y^2 + y^3` leads to the root, where the error
    of the old Jacobian is still a hundredth."""
    b = 0.2

    def fn(x):
        y = x - 1
        return y + b * y**2 + y**3

    # Beside it, the first correction leads to the root but for 1e-9.
    assert root_of(fn, 1 - b / 2 + 5e-8) == pytest.approx(1, rel=0, abs=10 * EPS)


def test_a_correction_that_halves_the_residual_is_taken_whole():
    """The first unknown passes through zero, where a correction is large relative to it.
    With halved corrections this takes 19 of them."""
    fn = lambda x, _: jnp.stack([1e-3 * x[0] + 1e-2 * (x[1] - 1) ** 2, x[1] ** 2 - 1])
    guess = jnp.asarray([1.0, 3.0])
    found = find_root(fn, Newton(), guess, None, max_iterations=50, others=(guess,))
    assert found.found
    np.testing.assert_allclose(found.value, [0, 1], rtol=0, atol=10 * EPS)
    assert found.iterations <= 12


def test_steps_that_do_not_resolve_a_chain_take_few_corrections():
    """The fastest oscillations of short rods have periods of less than a step. With halved
    corrections the last steps take 17.6 corrections on average."""
    problem = ej.problems.chain(32)
    system, start, args = problem.system, problem.start, problem.args
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=1e-2, num_steps=40)
    energy = sol.audit.kinetic + sol.audit.potential
    assert np.max(np.abs(energy - energy[0])) <= 1e-13  # round-off of at most 1 J
    assert np.mean(sol.stats.newton_iterations[20:]) <= 14


# The largest entry ------------------------------------------------------------------------

FINITE = np.random.default_rng(0).normal(size=70)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("size", [1, 3, 17, 70])
@pytest.mark.parametrize("entry", [-0.0, -7.0, 1e-310, -np.inf, np.nan, -np.nan])
def test_the_largest_entry_is_infinite_beside_nan(entry, size, dtype):
    x = jnp.asarray(FINITE[:size], dtype).at[size // 2].set(entry)
    expected = np.inf if np.isnan(entry) else np.max(np.abs(x))
    for fn in (largest, jax.jit(largest), jax.jit(in_one_function(largest))):
        found = fn(x)
        assert found.dtype == dtype
        assert found == expected


@pytest.mark.parametrize(
    "fn", [lambda x: x**2, lambda x: jnp.maximum(x, 0), jnp.exp, jnp.abs],
    ids=["square", "maximum", "exp", "abs"],
)  # fmt: skip
def test_a_nan_with_a_sign_is_found_among_numbers_without(fn):
    """The processor's `inf - inf` is a negative NaN, and XLA knows that squares are not
    negative."""
    x = jnp.array([1.0, jnp.inf])
    assert jax.jit(lambda x: largest(fn(x - x)))(x) == jnp.inf


def test_nothing_has_the_largest_entry_zero():
    assert largest(jnp.zeros((0,))) == 0
