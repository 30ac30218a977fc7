"""When a search by Newton's method ends, on equations whose root is known."""

import jax.numpy as jnp
import pytest

from enerjax._solvers import find_root, Newton

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
