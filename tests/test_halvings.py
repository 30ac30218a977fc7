"""Failed steps are divided into 2, 4, 8 steps, with the properties of a whole step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import failed, problem, TURNOVER


# The double pendulum turns a link over in some of these steps, and in others not.
STEPS = np.array([0.1, 0.5, 0.4])


def run(h, max_halvings=3, num_steps=20):
    system, start, args = problem("double")
    return ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        args,
        h=h,
        num_steps=num_steps,
        max_halvings=max_halvings,
        throw=False,
    )


@functools.cache
def batch():
    return jax.jit(jax.vmap(run))(jnp.asarray(STEPS))


def test_a_step_that_turns_a_link_over_reports_a_failure():
    solution = run(0.5, max_halvings=0)
    assert solution.result == ej.RESULTS.step_too_large
    assert np.all(np.asarray(solution.stats.halvings) == 0)
    # A solution of the step equations all the same: the root was found.
    done = int(solution.stats.completed_steps)
    assert solution.stats.residual[done] <= 1e-8
    np.testing.assert_array_equal(solution.end.q, solution.ys.q[done])


@pytest.mark.slow
def test_a_divided_step_keeps_energy_and_constraints():
    solution = batch()
    assert np.all(np.asarray(solution.result == ej.RESULTS.successful))
    assert np.max(solution.stats.halvings[1]) > 0
    audit = solution.audit
    # Solver.
    assert np.max(np.abs(audit.leak)) <= 1e-12 * TURNOVER["double"]
    assert np.max(np.abs(audit.constraint)) <= 1e-12
    assert np.max(np.abs(audit.constraint_rate)) <= 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("lane", range(3))
def test_lanes_are_halved_on_their_own(lane):
    alone, together = run(STEPS[lane]), jax.tree.map(lambda x: x[lane], batch())
    np.testing.assert_array_equal(alone.stats.halvings, together.stats.halvings)
    # Solver: a batched program rounds differently.
    np.testing.assert_allclose(alone.ys.q, together.ys.q, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_step_that_is_halved_once_equals_two_steps():
    solution = run(0.5)
    halved = int(np.argmax(solution.stats.halvings))
    assert solution.stats.halvings[halved] == 1
    start = ej.State(solution.ys.q[halved], solution.ys.v[halved])
    system, _, args = problem("double")
    multipliers = []
    for _ in range(2):
        out = ej.step(system, ej.EnergyPreserving(), start, args, h=0.25)
        start = out.state
        multipliers.append(out.multipliers)
    # Solver: Newton begins elsewhere.
    np.testing.assert_allclose(solution.ys.q[halved + 1], start.q, rtol=0, atol=1e-11)
    # The mean force.
    mean = (multipliers[0] + multipliers[1]) / 2
    np.testing.assert_allclose(solution.multipliers[halved + 1], mean, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_derivatives_pass_through_divided_steps():
    last = lambda h: run(h).ys.q[-1, 0]
    slope, step = float(jax.grad(last)(0.5)), 1e-6
    difference = float(last(0.5 + step) - last(0.5 - step)) / (2 * step)
    # Truncation and round-off of the central difference.
    assert slope == pytest.approx(difference, rel=1e-6)


@pytest.mark.slow
def test_a_divided_step_with_damper_and_drive_keeps_its_balance():
    """Time passes through the parts, and work adds up over them."""

    def on_moving_pivot(q, t, args):
        return jnp.array([q[0] - args["a"] * jnp.sin(args["w"] * t)])

    system = ej.System(
        jnp.eye(4),
        lambda q, args: args["g"] * (q[1] + q[3]),
        lambda q, args: jnp.array([q[1], (q[2:] - q[:2]) @ (q[2:] - q[:2]) - 1.0]),
        force=lambda q, v, t, args: -args["c"] * v,
        driven=on_moving_pivot,
    )
    args = dict(a=0.3, w=5.0, g=9.81, c=0.1)
    start = ej.initial_state(system, [0.0, 0.0, 1.0, 0.0], [0.0] * 4, args)
    scheme = ej.EnergyPreserving()
    coarse = ej.simulate(
        system, scheme, start, args, h=0.8, num_steps=5, max_halvings=4, throw=False
    )
    assert not failed(coarse)
    assert np.max(coarse.stats.halvings) > 0
    # Solver.
    assert np.max(np.abs(coarse.audit.leak)) <= 1e-11
    assert np.max(np.abs(coarse.audit.constraint)) <= 1e-12


def test_bad_halvings_are_refused():
    for bad in (-1, 2.0, True, 21):
        with pytest.raises(ValueError, match="max_halvings"):
            run(0.1, max_halvings=bad)  # pyright: ignore[reportArgumentType]


def test_newton_is_damped_where_a_force_saturates():
    """Undamped, no first step of these is made: each correction is larger than the last."""
    softening = lambda q, args: args["k"] * jnp.sqrt(1 + q @ q)
    system = ej.System(lambda v, args: 0.5 * v @ v, softening)

    def run(q, k):
        start = ej.State(q[None], jnp.array([0.7]))
        return ej.simulate(
            system,
            ej.EnergyPreserving(),
            start,
            {"k": k},
            h=1.0,
            num_steps=20,
            throw=False,
            max_halvings=0,
        )

    stiffness = jnp.array([100.0, 1e4])
    runs = jax.vmap(lambda k: jax.vmap(run, (0, None))(jnp.array([0.9, 1.5, 6.0]), k))(
        stiffness
    )
    good = np.asarray(runs.result == ej.RESULTS.successful)
    assert np.mean(good) >= 0.5
    # Round-off, in energies that are as large as the stiffness.
    leak = np.max(np.abs(runs.audit.leak), axis=-1) / stiffness[:, None]
    assert np.max(leak[good]) <= 1e-13
