"""Orders of accuracy, against references in other coordinates and by other methods."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._operators import make_model

from .helpers import march, SCHEMES, slopes
from .references import (
    double_pendulum_reference,
    pendulum_reference,
    point_on_rod,
    spring_pendulum_reference,
)


T = 2.0
REFERENCES = {
    "pendulum": point_on_rod,
    "double": double_pendulum_reference,
    "spring": spring_pendulum_reference,
}
# Round-off of 1e3 steps, and of the references.
PLATEAU = 2e-12
# Errors above this are not yet in the range where the leading term rules.
TOO_LARGE = 5e-2


def errors(name, scheme, alpha, steps):
    reference = REFERENCES[name](T)
    ends = [march(name, scheme, alpha, h=T / n, steps=n) for n in steps]
    return (
        np.array([np.max(np.abs(end.q - reference.q)) for end in ends]),
        np.array([np.max(np.abs(end.v - reference.v)) for end in ends]),
    )


FINE = (100, 200, 400, 800)
COARSE = (12, 24, 48, 96)
# name, scheme, alpha, order, allowed deviation, numbers of steps
CASES = [
    ("pendulum", "preserving", 0.0, 2, 0.1, FINE),
    ("pendulum", "preserving index3", 0.0, 2, 0.1, FINE),
    ("double", "preserving", 0.0, 2, 0.1, FINE),
    ("spring", "preserving", 0.0, 2, 0.1, FINE),
    ("pendulum", "decaying", 0.0, 2, 0.1, FINE),
    ("pendulum", "decaying", 0.5, 2, 0.1, FINE),
    ("pendulum", "decaying", 1.0, 2, 0.1, FINE),
    pytest.param("double", "decaying", 0.0, 2, 0.1, FINE, marks=pytest.mark.slow),
    ("spring", "decaying", 0.5, 2, 0.1, FINE),
    ("spring", "decaying gauss", 0.0, 3, 0.1, FINE),
    ("spring", "decaying gauss", 0.5, 3, 0.1, FINE),
    ("spring", "decaying gauss", 1.0, 3, 0.1, FINE),
    ("pendulum", "kappa", 0.0, 2, 0.1, FINE),
    ("pendulum", "kappa", 0.5, 2, 0.1, FINE),
    ("pendulum", "kappa", 1.0, 2, 0.1, FINE),
    *[(name, "consistent", 0.0, 4, 0.15, (50, 100, 200, 400)) for name in REFERENCES],
    *[("spring", "consistent", alpha, 3, 0.15, FINE) for alpha in (0.5, 1.0)],
    *[
        pytest.param("double", "consistent", alpha, 3, 0.15, FINE, marks=pytest.mark.slow)
        for alpha in (0.5, 1.0)
    ],
    # On the pendulum the leading error in the positions is small: finer steps.
    *[("pendulum", "consistent", alpha, 3, 0.15, (400, 800, 1600)) for alpha in (0.5, 1.0)],
    ("pendulum", "composed 4", 0.0, 4, 0.2, (24, 48, 96, 192)),
    ("double", "composed 4", 0.0, 4, 0.2, (50, 100, 200, 400)),
    ("pendulum", "composed 6", 0.0, 6, 0.2, COARSE),
    pytest.param(
        "double", "composed 6", 0.0, 6, 0.2, (50, 100, 200), marks=pytest.mark.slow
    ),
    ("pendulum", "composed 8", 0.0, 8, 0.25, (16, 24, 32, 48)),
    ("pendulum", "consistent 6", 0.0, 6, 0.2, (8, 16, 32)),
]


@pytest.mark.parametrize(("name", "scheme", "alpha", "order", "deviation", "steps"), CASES)
@pytest.mark.slow_for(
    "double-preserving-0.0-2-0.1-steps2",
    "pendulum-kappa-0.0-2-0.1-steps12",
    "pendulum-kappa-0.5-2-0.1-steps13",
    "pendulum-kappa-1.0-2-0.1-steps14",
    "spring-consistent-0.5-3-0.15-steps18",
    "spring-consistent-0.0-4-0.15-steps17",
    "spring-consistent-1.0-3-0.15-steps19",
    "pendulum-preserving-0.0-2-0.1-steps0",
    "pendulum-composed 4-0.0-4-0.2-steps24",
    "pendulum-consistent-0.5-3-0.15-steps22",
    "double-composed 4-0.0-4-0.2-steps25",
)
def test_errors_shrink_with_the_order_of_the_scheme(
    name, scheme, alpha, order, deviation, steps
):
    for error in errors(name, scheme, alpha, steps):
        usable = (error > PLATEAU) & (error < TOO_LARGE)
        assert usable.sum() >= 3, f"too few errors between round-off and chaos: {error}"
        n = np.array(steps)[usable]
        e = error[usable]
        slope = np.log(e[:-1] / e[1:]) / np.log(n[1:] / n[:-1])
        np.testing.assert_allclose(slope[-2:], order, rtol=0, atol=deviation)


def test_nine_stages_raise_the_fourth_order_to_eight():
    for error in errors("pendulum", "consistent 8", 0.0, (12, 24)):
        # One halving: the next one ends in round-off.
        assert error[1] > PLATEAU
        np.testing.assert_allclose(slopes(error), 8, rtol=0, atol=0.3)


@pytest.mark.parametrize("alpha", [0.5, 1.0])
def test_index3_converges_more_slowly(alpha):
    """It loses an order in the velocities: about 1.6 in q and 1 in v."""
    q, v = (slopes(e)[-1] for e in errors("pendulum", "decaying index3", alpha, FINE))
    assert 1.5 < q < 1.9
    assert v == pytest.approx(1, abs=0.1)


def test_one_coordinate_gets_the_third_order_from_any_derivative():
    reference = np.array(pendulum_reference(T))
    error = []
    for n in FINE:
        end = march("angle", "decaying", 0.5, h=T / n, steps=n)
        error.append(np.max(np.abs(np.concatenate([end.q, end.v]) - reference)))
    np.testing.assert_allclose(slopes(error)[-2:], 3, rtol=0, atol=0.1)


# The locking scheme is left out: decaying index 3. Bounds are C h^p at h = 0.01.
SAME_MOTION = [
    ("preserving", 0.0, 6e-3),
    ("preserving index3", 0.0, 6e-3),
    ("decaying", 0.0, 6e-3),
    ("decaying", 1.0, 6e-3),
    ("kappa", 0.0, 1.2e-2),
    ("consistent", 0.0, 1e-7),
    ("consistent", 1.0, 5e-5),
    ("composed 4", 0.0, 1e-5),
]


@pytest.mark.parametrize(("scheme", "alpha", "bound"), SAME_MOTION)
def test_the_constrained_pendulum_swings_as_the_one_in_its_angle(scheme, alpha, bound):
    for steps in (50, 100, 150, 200):
        point = march("pendulum", scheme, alpha, h=0.01, steps=steps).q
        angle = march("angle", scheme, alpha, h=0.01, steps=steps).q[0]
        # Truncation, of both; and of the scheme in the angle against the reference.
        assert abs(np.arctan2(point[0], point[1]) - angle) <= bound
        assert abs(angle - pendulum_reference(0.01 * steps)[0]) <= bound


@pytest.mark.parametrize(
    ("scheme", "alpha", "steps", "bound"),
    [
        ("preserving", 0.0, 200, 1e-3),
        ("consistent", 0.0, 200, 5e-6),
        ("composed 4", 0.0, 200, 5e-7),
        pytest.param("composed 6", 0.0, 200, 1e-9, marks=pytest.mark.slow),
    ],
)
def test_error_on_the_double_pendulum(scheme, alpha, steps, bound):
    # Truncation: C h^p at h = 0.01, 2 s.
    q, _ = errors("double", scheme, alpha, (steps,))
    assert q[0] <= bound


def test_schemes_state_their_order():
    expected = {
        "preserving": 2,
        "decaying": 2,
        "kappa": 2,
        "consistent": 4,
        "composed 4": 4,
        "composed 6": 6,
        "composed 8": 8,
        "consistent 6": 6,
        "consistent 8": 8,
    }
    assert {name: SCHEMES[name](0.0).order for name in expected} == expected
    assert ej.EnergyConsistent(0.5).order == 3


def test_the_dissipative_stiffness_is_that_of_half_a_step_of_free_flight():
    """Of stiffening springs, 3 k q^2; in between no eigenvalue is negative."""
    k, h = jnp.array([2.0, 5.0]), jnp.asarray(0.3)
    system = ej.System(jnp.eye(2), lambda q, args: 0.25 * k @ q**4)
    start = ej.State([1.0, -0.4], [0.7, 2.0])
    step = ej.EnergyConsistent(0.5).problem(make_model(system, start, None), start, h)
    middle = np.array([1.0 + 0.15 * 0.7, -0.4 + 0.15 * 2.0])
    expected = np.diag(3 * np.asarray(k) * middle**2)
    assert step.dissipative is not None
    found = np.asarray(step.dissipative.matrix)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_zero_as_a_python_number_leaves_the_dissipation_out():
    """The same motion as with an array, which can be differentiated; a number cannot."""
    system, start, args = ej.problems.double_pendulum()
    run = lambda scheme: ej.simulate(system, scheme, start, args, h=0.01, num_steps=20)
    number, array = run(ej.EnergyConsistent(0)), run(ej.EnergyConsistent(jnp.array(0.0)))
    # Solver and round-off of twenty steps.
    np.testing.assert_allclose(number.ys.q, array.ys.q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(number.multipliers, array.multipliers, rtol=0, atol=1e-10)
    assert np.all(np.asarray(number.audit.dissipated) == 0)

    height = lambda scheme: run(scheme).ys.q[-1, 1]
    assert eqx.filter_grad(height)(ej.EnergyConsistent(0.0)).alpha is None
    slope = jax.grad(lambda alpha: height(ej.EnergyConsistent(alpha)))(0.0)
    assert abs(slope) > 1e-9


def test_transformations_keep_the_order():
    """Whether alpha is 0 is decided where a scheme is made."""
    seen = []

    def look(scheme):
        seen.append((scheme.order, ej.Composed(scheme, 6).order))
        return scheme.alpha

    jax.jit(look)(ej.EnergyConsistent(0.0))
    jax.grad(look)(ej.EnergyConsistent(0.0))
    jax.jit(lambda x: look(ej.EnergyConsistent(0.0)) + x)(1.0)
    jax.jit(lambda x: look(ej.EnergyConsistent.from_spectral_radius(1.0)) + x)(1.0)
    assert seen == [(4, 6)] * 4
    jax.vmap(lambda alpha: seen.append(ej.EnergyConsistent(alpha).order))(jnp.zeros(2))
    assert seen[-1] == 3


@pytest.mark.parametrize(
    ("scheme", "count"),
    [("composed 4", 5), ("composed 6", 9), ("composed 8", 17), ("consistent 6", 5)],
)
def test_stages_are_a_palindrome_that_adds_up_to_the_step(scheme, count):
    composed = SCHEMES[scheme](0.0)
    stages = np.array(composed.stages)
    assert stages.size == count
    np.testing.assert_array_equal(stages, stages[::-1])
    # Round-off, and the condition that removes the leading error.
    power = composed.stage.order + 1
    assert np.sum(stages) == pytest.approx(1, abs=1e-14)
    assert np.sum(stages**power) == pytest.approx(0, abs=1e-14)
