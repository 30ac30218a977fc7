"""The function `step`, and its relation to a run."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.flatten_util import ravel_pytree

import enerjax as ej
from enerjax._operators import make_model, scales_like

from .helpers import EPS, long, problem, SCHEMES, solve


# Round-off of a few hundred steps, compiled in another way.
SAME: dict[str, Any] = dict(rtol=0, atol=1e-12)
H, STEPS = 0.01, 100


@pytest.mark.parametrize(
    "scheme", long(["decaying", "consistent", "composed 4"], "decaying", "composed 4")
)
def test_a_loop_over_step_is_a_run(scheme):
    system, start, args = problem("pendulum")
    make = SCHEMES[scheme](0.5)
    first = ej.step(system, make, start, args, h=H)

    def one(carry, _):
        state, warm = carry
        out = ej.step(system, make, state, args, h=H, warm=warm)
        return (out.state, out.warm), (
            out.state,
            out.energies.dissipated,
            out.newton_iterations,
        )

    @jax.jit
    def loop(carry):
        return jax.lax.scan(one, carry, None, length=STEPS - 1)[1]

    states, dissipated, iterations = loop((first.state, first.warm))
    run = solve("pendulum", scheme, 0.5, h=H, steps=STEPS)
    np.testing.assert_allclose(states.q, run.ys.q[2:], **SAME)
    np.testing.assert_allclose(states.v, run.ys.v[2:], **SAME)
    np.testing.assert_allclose(dissipated, run.audit.dissipated[2:], **SAME)
    # Round-off can decide whether a step needs one more correction.
    more = np.abs(iterations - run.stats.newton_iterations[1:])
    assert more.max() <= 1
    assert more.mean() <= 0.05
    np.testing.assert_allclose(first.state.q, run.ys.q[1], **SAME)


def test_the_memory_of_earlier_steps_saves_iterations_and_changes_no_result():
    system, start, args = problem("pendulum")
    scheme = SCHEMES["preserving"](0.0)
    warm, spent = None, [0, 0]
    states = [start, start]
    for _ in range(20):
        outs = [
            ej.step(system, scheme, states[0], args, h=0.02, warm=warm),
            ej.step(system, scheme, states[1], args, h=0.02),
        ]
        warm = outs[0].warm
        states = [out.state for out in outs]
        spent = [n + int(out.newton_iterations) for n, out in zip(spent, outs, strict=True)]
        np.testing.assert_allclose(states[0].q, states[1].q, **SAME)
    assert spent[0] < spent[1]


@pytest.mark.parametrize("save_every", [5, 100])
@pytest.mark.slow_for("5")
def test_saving_less_selects_rows(save_every):
    full = solve("pendulum", "decaying", 0.5, h=H, steps=STEPS)
    thin = solve("pendulum", "decaying", 0.5, h=H, steps=STEPS, save_every=save_every)
    np.testing.assert_allclose(thin.ys.q, full.ys.q[::save_every], **SAME)
    np.testing.assert_allclose(thin.ys.v, full.ys.v[::save_every], **SAME)
    np.testing.assert_allclose(thin.ts, full.ts[::save_every], rtol=1e-14)
    np.testing.assert_allclose(thin.audit.energy, full.audit.energy[::save_every], **SAME)
    # Multipliers are impulses over h: so is their round-off.
    np.testing.assert_allclose(
        thin.multipliers, full.multipliers[::save_every], rtol=0, atol=1e-9
    )
    # What is dissipated between two rows adds up; so do iterations.
    sums = full.audit.dissipated[1:].reshape(-1, save_every).sum(axis=1)
    np.testing.assert_allclose(thin.audit.dissipated[1:], sums, **SAME)
    iterations = np.asarray(full.stats.newton_iterations).reshape(-1, save_every)
    np.testing.assert_array_equal(thin.stats.newton_iterations, iterations.sum(axis=1))


def test_a_run_has_the_shapes_it_promises():
    solution = solve("pendulum", "kappa", 0.5, h=H, steps=STEPS, save_every=5)
    times = STEPS // 5 + 1
    assert solution.ts.shape == (times,)
    assert solution.ys.q.shape == solution.ys.v.shape == (times, 2)
    assert solution.multipliers.shape == (times, 1)
    assert solution.details.shape == (times - 1,)
    assert solution.audit.energy.shape == solution.audit.dissipated.shape == (times,)
    assert solution.audit.constraint.shape == (times, 1)
    assert solution.audit.constraint_rate.shape == (times, 1)
    assert solution.stats.newton_iterations.shape == (times - 1,)
    assert solution.stats.completed_steps == STEPS
    start = problem("pendulum").start
    np.testing.assert_array_equal(solution.ys.q[0], start.q)
    np.testing.assert_array_equal(solution.ys.v[0], start.v)


def test_multipliers_of_a_run_are_the_force_in_the_rod():
    """2 lambda l is the pull of the rod: 3 m g cos(angle) after a start from rest."""
    solution = solve("pendulum", "consistent", 0.0, h=H, steps=STEPS)
    # A step's multiplier is its mean: compare it with the middle of the step.
    middle = (solution.ys.q[1:, 1] + solution.ys.q[:-1, 1]) / 2
    # Truncation, C h^2 with C of the order of g^2.
    np.testing.assert_allclose(
        2 * solution.multipliers[1:, 0], 3 * 9.81 * middle, rtol=0, atol=3e-2
    )
    assert abs(solution.multipliers[0, 0]) <= 1e-13


REVERSIBLE = ["preserving", "consistent", "composed 4"]


def there_and_back(scheme, alpha=0.0):
    system, start, args = problem("double")
    make = SCHEMES[scheme](alpha)
    step = jax.jit(lambda y: ej.step(system, make, y, args, h=0.02).state)
    # Away from rest first: there the way back would be the way there.
    first = step(step(start))
    last = step(step(first))
    back = step(step(ej.State(last.q, -last.v)))
    error = [np.max(np.abs(back.q - first.q)), np.max(np.abs(back.v + first.v))]
    return max(error), np.max(np.abs(last.q - first.q))


@pytest.mark.parametrize("scheme", REVERSIBLE)
@pytest.mark.slow_for("consistent")
def test_symmetric_schemes_go_back_the_way_they_came(scheme):
    """A composition does so by way of its own backward stages."""
    error, way = there_and_back(scheme)
    assert way > 1e-2
    # Solver.
    assert error <= 1e-12


def test_a_dissipative_step_is_not_reversible():
    error, _ = there_and_back("decaying", 1.0)
    assert error > 1e-8


@pytest.mark.parametrize("scheme", ["preserving", "consistent"])
def test_a_step_of_minus_h_undoes_a_step_of_h(scheme):
    """What the backward stages of a composition rest on."""
    system, start, args = problem("double")
    make = SCHEMES[scheme](0.0)
    # Traced, so that the check for a positive step does not see it.
    step = jax.jit(lambda y, h: ej.step(system, make, y, args, h=h).state)
    first = step(start, 0.02)
    again = step(step(first, 0.02), -0.02)
    np.testing.assert_allclose(again.q, first.q, **SAME)
    np.testing.assert_allclose(again.v, first.v, **SAME)


def test_rounding_errors_far_from_the_origin_do_not_add_up():
    """Each of a thousand steps of 1e-4 is rounded, by up to 6e-11, and always alike."""
    free = ej.System(jnp.eye(1), lambda q, args: 0.0 * q[0])
    start = ej.State([1e6], [0.1])
    run = ej.simulate(free, ej.EnergyPreserving(), start, h=1e-3, num_steps=1000)
    # Round-off, of two numbers.
    np.testing.assert_allclose(run.end.q - 1e6, 0.1, rtol=0, atol=2 * EPS * 1e6)


def test_a_composition_is_its_stages_one_after_the_other():
    system, start, args = problem("double")
    composed = SCHEMES["composed 4"](0.0)
    step = jax.jit(lambda y, h: ej.step(system, composed.stage, y, args, h=h))
    state, impulse = start, 0.0
    for length in composed.stages:
        out = step(state, jnp.asarray(length * 0.02))
        state, impulse = out.state, impulse + length * out.multipliers
    whole = ej.step(system, composed, start, args, h=0.02)
    np.testing.assert_allclose(whole.state.q, state.q, **SAME)
    np.testing.assert_allclose(whole.state.v, state.v, **SAME)
    # Round-off of an impulse over h.
    np.testing.assert_allclose(whole.multipliers, impulse, rtol=0, atol=1e-9)


def test_a_backward_stage_is_scaled_like_a_forward_one():
    """Also in steps of about a length: there the two terms of a scale would cancel."""
    system, start, args = problem("double")
    start = ej.State(start.q, jnp.array([0.0, 2.0, 0.0, 2.0]))
    model, scheme = make_model(system, start, args), ej.EnergyPreserving()

    @jax.jit
    def scales(h):
        unknowns = scheme.predict(
            scheme.problem(model, start, h), jnp.zeros(4), jnp.zeros(2)
        )
        return ravel_pytree(scales_like(unknowns, model, start, h))[0]

    for h in (0.02, 0.5):
        np.testing.assert_allclose(scales(-h), scales(h), rtol=1e-14)  # round-off
        assert jnp.all(scales(-h) > 0)


FINDERS = ["Newton", "Chord", "Dogleg", "LevenbergMarquardt"]


@pytest.mark.parametrize("name", long(FINDERS, "Dogleg", "LevenbergMarquardt"))
@pytest.mark.slow_for("Newton")
def test_another_root_finder_can_be_used(name):
    """The step equations are scaled, so a plain tolerance of a library does."""
    system, start, args = problem("pendulum")
    run = ej.simulate(
        system,
        SCHEMES["preserving"](0.0),
        start,
        args,
        h=H,
        num_steps=20,
        root_finder=getattr(optx, name)(rtol=1e-12, atol=1e-12),
    )
    ours = solve("pendulum", "preserving", 0.0, h=H, steps=STEPS)
    # Solver: its tolerance, over twenty steps.
    np.testing.assert_allclose(run.ys.q, ours.ys.q[:21], rtol=0, atol=1e-9)


def test_forces_of_neighbours_that_balance_are_seen_in_every_row():
    """In a long stiff chain they leave the round-off of each."""
    count, k = 400, 1e6
    potential = lambda q, args: 0.5 * k * jnp.sum((jnp.diff(q) - 1.0) ** 2)
    system = ej.System(lambda v, args: 0.5 * v @ v, potential)
    start = ej.State(jnp.arange(1.0, count + 1), jnp.zeros(count))
    model = make_model(system, start, None)
    sizes = model.force_size(model.to_internal(start)) / (k * start.q)
    # Each spring has terms of the size `k q`. Estimates by random changes can be small in a
    # few rows.
    assert 0.02 < np.min(sizes)
    assert np.max(sizes) < 4.0
