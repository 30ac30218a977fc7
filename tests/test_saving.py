"""Which states a run saves: every few steps, at requested times, or a function of them."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import EPS, problem


H, STEPS = 1 / 64, 32


def run(saveat, **given):
    system, start, args = problem("pendulum")
    options: dict[str, Any] = given or dict(num_steps=STEPS)
    return ej.simulate(
        system, ej.EnergyDecaying(0.5), start, args, h=H, saveat=saveat, **options
    )


@functools.cache
def every_step():
    return run(ej.SaveAt())


TIMES = [H, 0.3, STEPS * H]


@functools.cache
def timed():
    return run(ej.SaveAt(ts=TIMES), t1=STEPS * H)


def test_the_end_is_a_row_where_the_steps_do_not_fill_the_last_one():
    thin, full = run(ej.SaveAt(every=10)), every_step()
    rows = np.array([0, 10, 20, 30, 32])
    np.testing.assert_array_equal(thin.ts, full.ts[rows])
    # Round-off: another program.
    np.testing.assert_allclose(thin.ys.q, full.ys.q[rows], rtol=0, atol=100 * EPS)
    sums = np.add.reduceat(np.asarray(full.audit.dissipated)[1:], rows[:-1])
    np.testing.assert_allclose(thin.audit.dissipated[1:], sums, rtol=0, atol=100 * EPS)
    costs = np.add.reduceat(np.asarray(full.stats.newton_iterations), rows[:-1])
    np.testing.assert_array_equal(thin.stats.newton_iterations, costs)
    estimates = np.add.reduceat(np.asarray(full.stats.local_error), rows[:-1])
    np.testing.assert_allclose(thin.stats.local_error, estimates, rtol=1e-6)


def test_rows_of_a_prime_number_of_steps():
    """The steps of a row are cut into segments of equal length, which 31 has not."""
    thin, full = (run(ej.SaveAt(every=k), num_steps=62) for k in (31, 1))
    # Round-off: another program.
    np.testing.assert_allclose(thin.ys.q, full.ys.q[::31], rtol=0, atol=100 * EPS)


@pytest.mark.slow
def test_a_function_of_the_state_is_saved_in_its_place():
    height = lambda t, state, args: {"y": args["l"] * state.q[1], "t": t, "row": 1}
    told, full = run(ej.SaveAt(every=8, fn=height)), every_step()
    np.testing.assert_allclose(told.ys["y"], full.ys.q[::8, 1], rtol=0, atol=100 * EPS)
    np.testing.assert_array_equal(told.ys["t"], told.ts)
    np.testing.assert_allclose(told.audit.energy, full.audit.energy[::8], rtol=1e-13)
    np.testing.assert_allclose(told.end.q, full.ys.q[-1], rtol=0, atol=100 * EPS)
    # Between the steps it is a function of the interpolated state.
    within = run(ej.SaveAt(ts=TIMES, fn=height), t1=STEPS * H)
    np.testing.assert_allclose(within.ys["y"], timed().ys.q[:, 1], rtol=0, atol=100 * EPS)


@pytest.mark.slow
def test_every_accepted_step_of_a_controller_is_counted():
    options = dict(t1=1.0, controller=ej.StepController(1e-5, 1e-5), max_steps=128)
    each, thin = (run(ej.SaveAt(every=k), **options) for k in (1, 5))
    count = int(each.stats.completed_steps)
    assert count % 5 != 0
    rows = [*range(0, count, 5), count]
    used = len(rows)
    np.testing.assert_allclose(thin.ts[:used], each.ts[np.array(rows)], rtol=1e-14)
    assert thin.ts.shape == (27,)
    assert np.all(np.isnan(thin.ts[used:]))
    assert np.all(np.isnan(thin.ys.q[used:]))
    np.testing.assert_allclose(thin.ys.q[:used], each.ys.q[np.array(rows)], atol=1e-13)
    sums = np.add.reduceat(np.asarray(each.audit.dissipated)[1 : count + 1], rows[:-1])
    np.testing.assert_allclose(thin.audit.dissipated[1:used], sums, atol=1e-14)
    assert np.sum(thin.stats.newton_iterations) == np.sum(each.stats.newton_iterations)


def test_a_number_of_steps_has_rows_at_times_too():
    counted = run(ej.SaveAt(ts=TIMES), num_steps=STEPS)
    np.testing.assert_allclose(counted.ys.q, timed().ys.q, rtol=0, atol=100 * EPS)
    full = every_step()
    np.testing.assert_allclose(counted.ys.q[0], full.ys.q[1], atol=100 * EPS)
    # The energies of a row are those of the steps that have ended since the row before.
    sums = np.add.reduceat(np.asarray(full.audit.dissipated)[1:], [0, 1, 19])
    np.testing.assert_allclose(counted.audit.dissipated, sums, rtol=0, atol=100 * EPS)


@pytest.mark.slow
def test_derivatives_pass_through_a_function_of_the_state():
    system, start, args = problem("pendulum")

    def height(g):
        saveat = ej.SaveAt(t1=True, fn=lambda t, state, args: state.q[1])
        numbers = args | dict(g=g)
        scheme = ej.EnergyDecaying(0.5)
        sol = ej.simulate(
            system, scheme, start, numbers, h=H, num_steps=STEPS, saveat=saveat
        )
        return sol.ys[-1]

    forward = jax.jvp(height, (9.81,), (1.0,))[1]
    both = jnp.stack([height(9.81 + x) for x in (1e-5, -1e-5)])
    # Truncation and round-off of the difference.
    assert forward == pytest.approx(float(both[0] - both[1]) / 2e-5, rel=1e-7)
    assert jax.grad(height)(9.81) == pytest.approx(float(forward), rel=1e-12)


BAD = {
    "two choices": (dict(every=2, t1=True), ValueError, "`every` and `t1`"),
    "no steps": (dict(every=0), ValueError, "`every`"),
    "a time as a flag": (dict(t1=1.0), TypeError, "SaveAt\\(ts="),
    "no function": (dict(fn=3), TypeError, "`fn`"),
}


@pytest.mark.parametrize("name", BAD)
def test_contradictory_choices_are_refused(name):
    options, kind, message = BAD[name]
    with pytest.raises(kind, match=message):
        ej.SaveAt(**options)


def test_anything_but_a_save_at_is_refused():
    with pytest.raises(TypeError, match="`saveat` must be a `SaveAt`"):
        run([0.0, 1.0])
