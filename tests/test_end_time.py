"""Runs that end at a time, and their rows at any time: dense output."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import EPS, problem, slopes
from .references import HEAVY_TOP, point_on_rod, spring_pendulum_reference


def until(name, scheme, h, t1, **options):
    system, start, args = problem(name)
    return ej.simulate(system, scheme, start, args, h=h, t1=t1, **options)


# Lengths and times without round-off: other programs make the same steps, bit by bit.
STEP, END = 1 / 64, 0.5


@functools.cache
def whole_steps():
    return until("pendulum", ej.EnergyPreserving(), STEP, END, saveat=ej.SaveAt(every=1))


def test_rows_at_the_ends_of_steps_equal_the_steps_bitwise():
    system, start, args = problem("pendulum")
    run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=STEP, num_steps=32)
    timed = whole_steps()
    assert timed.stats.completed_steps == 32
    assert timed.stats.rejected_steps is None
    np.testing.assert_array_equal(
        timed.stats.newton_iterations, run.stats.newton_iterations
    )
    np.testing.assert_array_equal(timed.ys.q, run.ys.q)
    np.testing.assert_array_equal(timed.ys.v, run.ys.v)
    np.testing.assert_array_equal(timed.multipliers, run.multipliers)
    np.testing.assert_array_equal(timed.audit.energy, run.audit.energy)


@pytest.mark.slow
def test_without_times_the_rows_are_both_ends():
    ends = until("pendulum", ej.EnergyPreserving(), STEP, END)
    np.testing.assert_array_equal(ends.ts, [0.0, END])
    np.testing.assert_array_equal(ends.ys.q, whole_steps().ys.q[jnp.array([0, 32])])
    np.testing.assert_array_equal(ends.multipliers[1], whole_steps().multipliers[32])


def test_steps_of_different_lengths_end_at_the_same_time():
    lengths = jnp.array([0.019, 1 / 64, 0.0301])

    @jax.jit
    def run(h):
        options: dict[str, Any] = dict(saveat=ej.SaveAt(every=1), max_steps=32)
        return until("pendulum", ej.EnergyPreserving(), h, END, **options)

    sol = jax.vmap(run)(lengths)
    # Rounded up, but for round-off.
    np.testing.assert_array_equal(sol.stats.completed_steps, [27, 32, 17])
    for lane, count in enumerate((27, 32, 17)):
        ts = sol.ts[lane]
        # Round-off of the times.
        np.testing.assert_allclose(
            ts[: count + 1], np.linspace(0, END, count + 1), atol=EPS
        )
        assert np.all(np.isnan(ts[count + 1 :]))
        assert np.all(np.isnan(sol.ys.q[lane, count + 1 :]))
    # Solver: lanes are compiled differently.
    np.testing.assert_allclose(sol.ys.q[1, :33], whole_steps().ys.q, rtol=0, atol=1e-12)


def test_a_decimal_step_length_takes_no_additional_step():
    # 0.3/0.1 is less than 3, (3 * 0.1)/0.1 is more.
    assert 3 * 0.1 / 0.1 > 3
    for t1, count in ((0.3, 3), (3 * 0.1, 3), (0.7, 7), (0.72, 8)):
        every = ej.SaveAt(every=1)
        run = functools.partial(
            until, "pendulum", ej.EnergyPreserving(), 0.1, t1, saveat=every
        )
        assert jax.eval_shape(run).stats.newton_iterations.size == count


@pytest.mark.slow
def test_a_run_out_of_steps_says_so():
    options: dict[str, Any] = dict(saveat=ej.SaveAt(ts=[0.0, 0.25, END]), max_steps=20)
    sol = until("pendulum", ej.EnergyPreserving(), STEP, END, throw=False, **options)
    assert sol.result == ej.RESULTS.out_of_steps
    assert sol.stats.completed_steps == 20
    np.testing.assert_array_equal(sol.ys.q[1], whole_steps().ys.q[16])
    assert np.all(np.isnan(sol.ys.q[2]))
    with pytest.raises(RuntimeError, match="t = 0.3125.*Raise `max_steps`"):
        until("pendulum", ej.EnergyPreserving(), STEP, END, **options)


BAD = {
    "neither": (dict(), "neither"),
    "both": (dict(num_steps=4, t1=1.0), "both"),
    "a bound on a number": (dict(num_steps=4, max_steps=9), "counts equal steps"),
    "backwards": (dict(t1=-1.0), "after the start"),
    "times outside": (dict(t1=1.0, saveat=ej.SaveAt(ts=[0.0, 2.0])), "ascending times"),
    "times descend": (dict(t1=1.0, saveat=ej.SaveAt(ts=[1.0, 0.0])), "ascending times"),
    "one time": (dict(t1=1.0, saveat=ej.SaveAt(ts=1.0)), "vector of times"),
    "no steps": (dict(t1=1.0, max_steps=0), "positive integer"),
}


@pytest.mark.parametrize("name", BAD)
def test_the_length_of_a_run_is_given_in_one_way(name):
    options, message = BAD[name]
    system, start, args = problem("pendulum")
    with pytest.raises(ValueError, match=message):
        ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.1, **options)


def test_traced_step_lengths_need_a_bound_on_the_steps():
    run = lambda h: until("pendulum", ej.EnergyPreserving(), h, END).ys.q
    with pytest.raises(ValueError, match="`max_steps` is missing"):
        jax.vmap(run)(jnp.array([0.01, 0.02]))


# Dense output ---------------------------------------------------------------------------

# Irrational parts of steps.
TIMES = np.array([0.0777, 0.21312, 0.3333, 0.4567])


def largest_errors(name, scheme, exact, steps, t1, times):
    """Of positions and velocities between the steps, at halving steps, in one program."""
    system, start, args = problem(name)

    @jax.jit
    def rows(h):
        sol = ej.simulate(
            system, scheme, start, args, h=h, t1=t1, max_steps=steps[-1],
            saveat=ej.SaveAt(ts=times),
        )  # fmt: skip
        return sol.ys, sol.audit

    out = []
    for count in steps:
        ys, audit = rows(t1 / count)
        # Round-off: the rows satisfy the constraints like the ends of steps.
        size = 1 + float(jnp.max(jnp.abs(ys.v)))
        assert float(jnp.max(jnp.abs(audit.constraint), initial=0)) < 100 * EPS
        assert float(jnp.max(jnp.abs(audit.constraint_rate), initial=0)) < 1e3 * EPS * size
        off = [np.abs(x - y).max() for x, y in zip((ys.q, ys.v), exact, strict=True)]
        out.append(max(off))
    return out


DENSE = {
    "preserving": (ej.EnergyPreserving(), (20, 40, 80)),
    "consistent": (ej.EnergyConsistent(0.0), (10, 20, 40)),
    "consistent 6": (ej.Composed(ej.EnergyConsistent(0.0), 6), (3, 6, 12)),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "consistent" else pytest.mark.slow)
        for name in DENSE
    ],
)
def test_rows_within_steps_have_the_order_of_the_scheme(name):
    scheme, steps = DENSE[name]
    states = [point_on_rod(t) for t in TIMES]
    exact = np.stack([x.q for x in states]), np.stack([x.v for x in states])
    errors = largest_errors("pendulum", scheme, exact, steps, 0.5, TIMES)
    # Truncation.
    assert slopes(errors)[-1] > scheme.order - 0.3


@pytest.mark.slow
def test_rows_within_steps_without_constraints():
    states = [spring_pendulum_reference(t) for t in TIMES]
    exact = np.stack([x.q for x in states]), np.stack([x.v for x in states])
    for name in DENSE:
        scheme, steps = DENSE[name]
        errors = largest_errors("spring", scheme, exact, steps, 0.5, TIMES)
        assert slopes(errors)[-1] > scheme.order - 0.3


@pytest.mark.slow
def test_rows_of_a_top_in_euler_parameters():
    """Their published values at 0.1 s lie within a step."""
    exact = HEAVY_TOP[0.1]
    q = np.concatenate([exact.position, exact.quaternion])
    v = np.concatenate([exact.velocity, exact.spin])
    for scheme, order in ((ej.EnergyPreserving(), 2), (DENSE_TOP, 4)):
        times, steps = np.array([0.1]), (75, 150, 300)
        errors = largest_errors("top", scheme, (q[None], v[None]), steps, 0.15, times)
        assert slopes(errors)[-1] > order - 0.3


DENSE_TOP = ej.Composed(ej.EnergyPreserving(), 4)
