"""Discrete derivatives of users, which are checked at the start of a run."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej


class Midpoint(ej.AbstractDerivative):
    """The gradient in the middle: consistent, and directional for quadratic functions."""

    slope: ClassVar[float] = 1.0

    def gradient(self, fn, a, b, *, weights=1.0, size=0.0):
        del weights, size
        return self.slope * jax.grad(fn)(0.5 * (a + b))


class AdmittedMidpoint(Midpoint):
    is_directional = False


class Doubled(AdmittedMidpoint):
    slope = 2.0


def run(derivative, system=None, **options):
    problem = ej.problems.pendulum_angle()
    scheme = ej.EnergyPreserving(derivative=derivative)
    system = problem.system if system is None else system
    return ej.simulate(
        system, scheme, problem.start, problem.args, h=0.05, num_steps=100, **options
    )


def test_a_derivative_that_is_not_directional_is_refused():
    with pytest.raises(ValueError, match=r"`potential` .*`Midpoint` violates `D . .b - a."):
        run(Midpoint())


def test_a_declared_one_is_used_and_the_audit_shows_the_loss():
    audit = run(AdmittedMidpoint()).audit
    leak = np.abs(audit.energy - audit.energy[0])
    # Truncation: the midpoint rule keeps the energy to second order.
    assert 1e-5 < np.max(leak) < 1e-1


def test_one_that_is_exact_for_the_energies_of_the_system_is_used():
    oscillator = ej.System(lambda v, args: 0.5 * v @ v, lambda q, args: 2.0 * q @ q)
    start = ej.State([1.0], [0.0])
    scheme = ej.EnergyPreserving(derivative=Midpoint())
    audit = ej.simulate(oscillator, scheme, start, h=0.05, num_steps=50).audit
    # Solver.
    np.testing.assert_allclose(audit.energy, 2.0, rtol=1e-13)


def test_one_that_is_not_consistent_is_refused():
    with pytest.raises(ValueError, match="`Doubled` is not its gradient at the start"):
        run(Doubled())


def test_a_constraint_is_named_where_only_its_derivative_is_wrong():
    class WrongOnCurves(ej.ChainRule):
        def gradient(self, fn, a, b, *, weights=1.0, size=0.0):
            exact = super().gradient(fn, a, b, weights=weights, size=size)
            return exact + jnp.where(jnp.abs(fn(0 * a) + 1) < 1e-9, 0.1, 0.0)

    system, start, args = ej.problems.pendulum()
    scheme = ej.EnergyPreserving(derivative=WrongOnCurves())
    with pytest.raises(ValueError, match="`constraint` .* is not its gradient"):
        ej.simulate(system, scheme, start, args, h=0.01, num_steps=1)


@pytest.mark.parametrize("x", [0.0, 1.0])
def test_a_kink_at_the_start_is_no_contradiction(x):
    system = ej.System(
        lambda v, args: 0.5 * v @ v,
        lambda q, args: jnp.sum(jnp.maximum(q, 0.0) + jnp.abs(q)),
    )
    scheme, start = ej.EnergyPreserving(), ej.State([x], [1.0])
    solution = ej.simulate(system, scheme, start, h=0.01, num_steps=5)
    np.testing.assert_allclose(solution.audit.energy, 2 * x + 0.5, rtol=1e-13)


def test_a_stiff_spring_at_rest_is_no_contradiction():
    system = ej.System(
        lambda v, args: 0.5 * v @ v,
        lambda q, args: 0.5e9 * (jnp.sqrt(q @ q) - 1.0) ** 2 + q[0],
    )
    start = ej.State([0.6, 0.8], [0.0, 0.0])
    ej.simulate(system, ej.EnergyPreserving(), start, h=1e-5, num_steps=2)
