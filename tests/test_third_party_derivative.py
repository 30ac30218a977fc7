"""A discrete derivative outside of the package that is written with public names is like
those of the library."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .coordinate_increments import CoordinateIncrements
from .helpers import code_of, HERE, imported


def test_it_imports_public_names_alone():
    modules = {"enerjax", "jax", "jax.numpy", "numpy"}
    assert imported("coordinate_increments.py") == modules


def test_the_tutorial_shows_this_file():
    assert (HERE / "coordinate_increments.py").read_text() in code_of("write-your-own.md")


def test_it_is_the_difference_quotient_of_each_coordinate():
    """In closed form, of a product: the mean of both orders."""
    fn, a, b = lambda x: x[0] * x[1] ** 2, jnp.array([1.0, 2.0]), jnp.array([3.0, 5.0])
    found = CoordinateIncrements().gradient(fn, a, b)
    expected = [(2.0**2 + 5.0**2) / 2, (1.0 + 3.0) / 2 * (2.0 + 5.0)]
    np.testing.assert_allclose(found, expected, rtol=1e-14)  # round-off


def height(g, num_steps=50):
    system, start, args = ej.problems.pendulum()
    scheme = ej.EnergyPreserving(derivative=CoordinateIncrements())
    world = args | {"g": g}
    return ej.simulate(system, scheme, start, world, h=0.01, num_steps=num_steps)


@pytest.mark.slow
def test_it_keeps_the_energy_and_converges_to_the_motion():
    sol, system = height(9.81), ej.problems.pendulum()
    scale = np.max(sol.audit.kinetic)
    assert np.ptp(sol.audit.energy) <= 1e-12 * scale  # solver
    assert np.max(np.abs(sol.audit.constraint)) <= 1e-13  # solver
    exact = ej.simulate(
        system.system, ej.EnergyConsistent(0.0), system.start, system.args, h=0.01,
        num_steps=50,
    )  # fmt: skip
    off = np.max(np.abs(sol.ys.q - exact.ys.q))
    assert 1e-7 < off < 1e-3  # truncation, of order 2


@pytest.mark.slow
def test_it_is_differentiated():
    slope = jax.grad(lambda g: height(g, 20).ys.q[-1, 1])(9.81)
    eps = 1e-5
    ends = [float(height(g, 20).ys.q[-1, 1]) for g in (9.81 - eps, 9.81 + eps)]
    # Truncation and round-off of the difference.
    assert slope == pytest.approx((ends[1] - ends[0]) / (2 * eps), rel=1e-7)
