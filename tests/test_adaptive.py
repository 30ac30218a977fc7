"""Adaptive steps: their errors, their energy, their derivatives."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._operators import make_model
from enerjax._run.collocation import rates
from enerjax._run.controller import other_end
from enerjax._run.step_sizes import End

from .helpers import problem
from .references import double_pendulum_reference


def adaptive(name, scheme, tolerance, t1, args=None, **options):
    system, start, own = problem(name) if isinstance(name, str) else name
    args = own if args is None else args
    controller = ej.StepController(tolerance, tolerance)
    given: dict[str, Any] = dict(h=0.01, max_steps=512, controller=controller) | options
    return ej.simulate(system, scheme, start, args, t1=t1, **given)


def tried(sol):
    return int(sol.stats.completed_steps) + int(sol.stats.rejected_steps)


# The estimate ---------------------------------------------------------------------------


@eqx.filter_jit
def _step_and_estimate(system, scheme, order, state, args, h):
    end = ej.step(system, scheme, state, args, h=h).state
    model = make_model(system, state, args)
    at_ends = rates(model, state), rates(model, end)
    return end, other_end(model, state, end, h, at_ends, order)


ESTIMATED = {
    "preserving": ej.EnergyPreserving(),
    "consistent": ej.EnergyConsistent(0.0),
    "decaying": ej.EnergyDecaying(0.5),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "preserving" else pytest.mark.slow)
        for name in ESTIMATED
    ],
)
def test_the_estimate_tends_to_the_error_of_a_step(name):
    scheme, begin = ESTIMATED[name], double_pendulum_reference(0.9)
    system, _, args = problem("double")
    state = ej.State(jnp.asarray(begin.q), jnp.asarray(begin.v))
    distances = []
    for h in (0.04, 0.02):
        end, other = _step_and_estimate(
            system, scheme, scheme.order, state, args, jnp.asarray(h)
        )
        exact = double_pendulum_reference(0.9 + h)
        join = lambda x: np.concatenate([x.q, x.v])
        error = join(end) - join(exact)
        estimate = join(end) - join(other)
        distances.append(np.linalg.norm(estimate - error) / np.linalg.norm(error))
    # Truncation: the next order in h.
    assert distances[0] < 0.2
    assert distances[1] < 0.6 * distances[0]


@pytest.mark.parametrize(("size", "is_accepted"), [(0.99, True), (1.01, False)])
def test_a_step_is_accepted_by_the_root_mean_square_of_its_error(size, is_accepted):
    """Points in free flight that end a little off: by hand, for coordinates at rest in
    their velocities, which are half of the entries."""
    rtol, atol, h = 1e-3, 1e-4, jnp.asarray(0.5)
    system = ej.System(jnp.eye(3), lambda q, args: 0.0 * q[0])
    start = ej.State([1.0, 2.0, 0.0], [1.0, -0.5, 0.1])
    plan = ej.StepController(rtol, atol).plan(
        ej.EnergyPreserving(), h, jnp.asarray(0.0), End(t1=jnp.asarray(1.0))
    )
    there = start.q + h * start.v
    part = jnp.array([1.0, -2.0, 0.5]) * size * np.sqrt(6 / 5.25)
    # Of the larger of both ends, to first order in the tolerance.
    bound = atol + rtol * jnp.maximum(jnp.abs(start.q), jnp.abs(there))
    end = ej.State(there + part * bound, start.v)
    model = make_model(system, start, None)
    memory = plan.begin(model, start)
    verdict = plan.judge(memory, model, (start, end), ej.RESULTS.successful, h)
    assert bool(verdict.accepted) == is_accepted


# Structure ------------------------------------------------------------------------------


def damped_double_pendulum():
    def damper(q, v, t, args):
        return -args["c"] * v + jnp.array([0.0, 0.0, jnp.sin(3 * t), 0.0])

    system, start, args = problem("double")
    damped = ej.System(system.kinetic, system.potential, system.constraint, force=damper)
    return damped, start, args | dict(c=0.1)


@functools.cache
def damped_run():
    return adaptive(
        damped_double_pendulum(),
        ej.EnergyConsistent(0.5),
        1e-5,
        2.0,
        saveat=ej.SaveAt(every=1),
    )


def test_the_energy_balance_holds_at_round_off_while_steps_vary():
    sol = damped_run()
    count = int(sol.stats.completed_steps)
    assert sol.result == ej.RESULTS.successful
    assert sol.ts[count] == 2.0
    lengths = np.diff(sol.ts[: count + 1])
    assert lengths.max() > 3 * lengths.min()
    assert np.all(np.isnan(sol.ts[count + 1 :]))
    audit = sol.audit
    change = np.diff(audit.energy)[:count]
    known = (audit.work + audit.drive_work - audit.dissipated)[1 : count + 1]
    # Round-off, against sum m g r.
    assert np.abs(change - known).max() < 1e-12 * 9.81 * 3
    # It is a balance of something.
    assert np.abs(known).sum() > 0.1
    assert float(jnp.nanmax(jnp.abs(audit.constraint))) < 1e-14
    assert float(jnp.nanmax(jnp.abs(audit.constraint_rate))) < 1e-12


@pytest.mark.slow
def test_requested_rows_count_the_energy_of_the_steps_that_have_ended():
    steps = damped_run()
    ts = [0.0, 0.7123, 1.3, 2.0]
    sol = adaptive(
        damped_double_pendulum(),
        ej.EnergyConsistent(0.5),
        1e-5,
        2.0,
        saveat=ej.SaveAt(ts=ts),
    )
    # Round-off; for the work of a row also that of where its steps end: both runs choose
    # them by estimates of 1e-5. In all that makes no difference.
    for name, bound in (("work", 1e-10), ("dissipated", 1e-13)):
        rows, each = getattr(sol.audit, name), getattr(steps.audit, name)
        for row in (1, 2, 3):
            inside = (steps.ts > ts[row - 1]) & (steps.ts <= ts[row])
            assert float(rows[row]) == pytest.approx(float(each[inside].sum()), abs=bound)
        every = each[1 : int(steps.stats.completed_steps) + 1].sum()
        assert float(rows[1:].sum()) == pytest.approx(float(every), abs=1e-13)
    np.testing.assert_array_equal(sol.ys.q[0], steps.ys.q[0])
    last = steps.ys.q[int(steps.stats.completed_steps)]
    np.testing.assert_allclose(sol.ys.q[3], last, rtol=0, atol=1e-13)  # round-off


# Fewer steps ----------------------------------------------------------------------------


@pytest.mark.slow
def test_an_eccentric_planet_takes_a_third_of_the_steps():
    planet, period = ej.problems.kepler(0.9), 2 * np.pi
    system, start, args = planet
    scheme = ej.EnergyConsistent(0.0)
    sol = adaptive(planet, scheme, 1e-6, period)
    error = float(jnp.abs(sol.ys.q[-1] - start.q).max())
    # Truncation: a hundred times the tolerance.
    assert error < 1e-4
    h = period / (3 * tried(sol))
    fixed = ej.simulate(system, scheme, start, args, h=h, t1=period, max_steps=512)
    assert float(jnp.abs(fixed.ys.q[-1] - start.q).max()) > 2 * error


# Failures -------------------------------------------------------------------------------


def test_a_step_that_newton_fails_in_is_repeated_shorter():
    system, start, args = problem("double")
    whole = ej.step(system, ej.EnergyPreserving(), start, args, h=30.0)
    assert whole.result != ej.RESULTS.successful
    run = functools.partial(adaptive, "double", ej.EnergyPreserving())
    sol = run(1e-4, 40.0, h=30.0, saveat=ej.SaveAt(every=1), throw=False, max_steps=256)
    assert tried(sol) > sol.stats.completed_steps
    # Out of steps long before 40 s, but on its way, and rows up to there are kept.
    assert sol.result == ej.RESULTS.out_of_steps
    count = int(sol.stats.completed_steps)
    assert count > 100
    assert np.all(np.isfinite(sol.ys.q[: count + 1]))
    # The same program.
    sol = run(1e-17, 40.0, h=30.0, saveat=ej.SaveAt(every=1), throw=False, max_steps=256)
    assert sol.result == ej.RESULTS.steps_too_short


def test_schemes_with_a_memory_of_the_step_are_refused():
    with pytest.raises(ValueError, match="GeneralizedAlpha.*one step length"):
        adaptive("pendulum", ej.GeneralizedAlpha(0.9), 1e-6, 1.0)


def test_bad_controllers_are_refused():
    with pytest.raises(ValueError, match="must be positive"):
        ej.StepController(1e-6, 0.0)
    system, start, args = problem("pendulum")
    run = functools.partial(ej.simulate, system, ej.EnergyPreserving(), start, args)
    with pytest.raises(TypeError, match="`StepController"):
        run(h=0.1, t1=1.0, controller=1e-6)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="counts equal steps"):
        run(h=0.1, num_steps=4, controller=ej.StepController(1e-6, 1e-6))


# Transformations ------------------------------------------------------------------------


def end_of(g):
    """The end of a swing, and the times of its steps."""
    args = problem("pendulum").args | dict(g=g)
    scheme = ej.EnergyDecaying(0.5)
    sol = adaptive(
        "pendulum", scheme, 1e-4, 0.5, args=args, saveat=ej.SaveAt(every=1), max_steps=48
    )
    return sol.ys.q[sol.stats.completed_steps], (sol.ts, sol.stats)


@functools.cache
def batch_of_ends():
    return jax.vmap(end_of)(jnp.array([9.81, 30.0]))


@pytest.mark.slow
def test_lanes_choose_their_own_steps():
    q, (ts, stats) = batch_of_ends()
    assert stats.completed_steps[0] < stats.completed_steps[1]
    for lane, g in enumerate((9.81, 30.0)):
        alone, (times, own) = end_of(g)
        assert own.completed_steps == stats.completed_steps[lane]
        # Solver: lanes are compiled differently.
        np.testing.assert_allclose(ts[lane], times, rtol=0, atol=1e-10)
        np.testing.assert_allclose(q[lane], alone, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_derivatives_are_those_of_the_steps_as_they_were_chosen():
    """Against differences of a loop over these steps."""
    system, start, args = problem("pendulum")
    reverse, (times, stats) = jax.jit(jax.jacrev(end_of, has_aux=True))(9.81)
    lengths = jnp.diff(times[: int(stats.completed_steps) + 1])

    @jax.jit
    def replayed(g):
        def one(state, h):
            scheme = ej.EnergyDecaying(0.5)
            return ej.step(system, scheme, state, args | dict(g=g), h=h).state, None

        return jax.lax.scan(one, start, lengths)[0].q

    eps = 1e-4
    difference = (replayed(9.81 + eps) - replayed(9.81 - eps)) / (2 * eps)
    # Truncation of the differences.
    np.testing.assert_allclose(reverse, difference, rtol=1e-6)
