"""A scheme outside of the package that is written with public names is like all others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import code_of, EPS, HERE, imported, problem
from .midpoint_scheme import Midpoint


STEPS, DURATION = (16, 32), 0.5


def tip(g, h):
    system, start, args = problem("pendulum")
    world = args | {"g": g}
    run = ej.simulate(system, Midpoint(), start, world, h=h, num_steps=20)
    return run.ys.q[-1, 0]


def test_it_imports_public_names_alone():
    assert imported("midpoint_scheme.py") == {"enerjax", "enerjax.schemes", "jax"}


def test_the_tutorial_shows_this_file():
    assert (HERE / "midpoint_scheme.py").read_text() in code_of("write-your-own-scheme.md")


@pytest.fixture(scope="module")
def orders():
    """Against the library's scheme of order 4, whose order other tests establish."""
    return ej.order_table(
        ej.problems.pendulum(),
        {"midpoint": Midpoint(), "composed": ej.Composed(Midpoint(), 4)},
        STEPS,
        ej.EnergyConsistent(0.0),
        duration=DURATION,
    )


@pytest.mark.slow
def test_its_order_is_two_with_constraints(orders):
    for slopes in (orders.order_q[0], orders.order_v[0]):
        assert np.all(np.abs(slopes - 2) < 0.1)  # truncation


@pytest.mark.slow
def test_it_can_be_composed(orders):
    assert orders.order_q[1, 0] > 3.7  # truncation


def test_a_quadratic_energy_is_conserved_and_constraints_hold():
    mass, spring = jnp.array([1.0, 2.0]), jnp.array([[3.0, -1.0], [-1.0, 2.0]])
    system = ej.System(
        lambda v, args: 0.5 * mass @ v**2, lambda q, args: 0.5 * q @ spring @ q
    )
    start = ej.initial_state(system, [0.4, -0.2], [0.1, 0.3])
    audit = ej.simulate(system, Midpoint(), start, h=0.2, num_steps=50).audit
    assert np.ptp(audit.energy) <= 100 * EPS * audit.energy[0]  # round-off
    system, start, args = problem("pendulum")
    audit = ej.simulate(system, Midpoint(), start, args, h=0.01, num_steps=50).audit
    assert np.max(np.abs(audit.constraint)) <= 100 * EPS  # round-off
    assert np.max(np.abs(audit.constraint_rate)) <= 1e3 * EPS  # round-off, over h
    # Not an energy-consistent scheme: what it loses or gains is told as `dissipated`.
    assert 1e-9 < np.max(np.abs(audit.dissipated)) < 1e-3
    assert np.max(np.abs(audit.leak)) <= 1e3 * EPS * np.max(audit.kinetic)


def test_a_hamiltonian_gives_the_motion_of_constant_inertia():
    energy = lambda q, p, args: 0.5 * p @ p / args["m"] + args["m"] * args["g"] * q[1]
    rod = lambda q, args: jnp.array([q @ q - 1.0])
    system = ej.System.from_hamiltonian(energy, rod)
    same = ej.System(
        lambda v, args: 0.5 * args["m"] * v @ v,
        lambda q, args: args["m"] * args["g"] * q[1],
        rod,
    )
    args = dict(m=2.0, g=9.81)
    ends = []
    for each in (system, same):
        start = ej.initial_state(each, [1.0, 0.0], [0.0, 0.0], args)
        run = ej.simulate(each, Midpoint(), start, args, h=0.01, num_steps=40)
        ends.append(run.ys.q[-1])
    np.testing.assert_allclose(*ends, rtol=1e-11)  # round-off, grown over the steps


def test_it_is_differentiated_and_mapped():
    reverse = jax.jit(jax.grad(tip))(9.81, 0.01)
    eps = 1e-5
    differences = (tip(9.81 + eps, 0.01) - tip(9.81 - eps, 0.01)) / (2 * eps)
    # Truncation and round-off of the differences.
    assert reverse == pytest.approx(float(differences), rel=1e-7)
    gs, hs = jnp.array([5.0, 9.81]), jnp.array([0.01, 0.02])
    lanes = jax.vmap(jax.vmap(tip, (0, None)), (None, 0))(gs, hs)
    alone = [[tip(g, h) for g in gs] for h in hs]
    np.testing.assert_allclose(lanes, alone, rtol=1e-12)
