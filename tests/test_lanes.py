"""Batches of runs: values, failures, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import long


LANES = 18  # which is no multiple of the width of a vector

# Runs -----------------------------------------------------------------------------------

STEPS = 24


def double_pendulum(m, h, **options):
    system, start, args = ej.problems.chain(2, length=2.0, mass=2.0)
    args = args | dict(m=args["m"] * jnp.stack([m, 1.0]))
    return ej.simulate(
        system, options.pop("scheme"), start, args, h=h, throw=False, **options
    )


def car_axis(m, h, **options):
    system, start, args = ej.problems.car_axis()
    args = args | dict(k=args["k"] * m)
    return ej.simulate(
        system, options.pop("scheme"), start, args, h=h, throw=False, **options
    )


def angles(m, h, **options):
    system, start, args = ej.problems.double_pendulum_angles()
    args = args | dict(m1=args["m1"] * m)
    return ej.simulate(
        system, options.pop("scheme"), start, args, h=h, throw=False, **options
    )


def parameters():
    return jnp.linspace(0.5, 2.0, LANES), 1e-3 * jnp.linspace(0.5, 1.5, LANES)


CASES = {
    "pendulum": (double_pendulum, ej.EnergyPreserving()),
    "consistent": (double_pendulum, ej.EnergyConsistent(0.5)),
    "decaying": (double_pendulum, ej.EnergyDecaying(0.5)),
    "composed": (double_pendulum, ej.Composed(ej.EnergyPreserving(), 4)),
    "rattle": (double_pendulum, ej.Rattle()),
    "axis": (car_axis, ej.EnergyPreserving()),
    "angles": (angles, ej.EnergyPreserving()),
    "angles decaying": (angles, ej.EnergyDecaying(0.5)),
    "angles consistent": (angles, ej.EnergyConsistent(0.5)),
}


@pytest.mark.parametrize("name", long(CASES, *list(CASES)[1:]))
def test_lanes_equal_single_runs(name):
    """They differ by the round-off of the search; the energies by that of their terms."""
    simulated, scheme = CASES[name]
    run = lambda m, h: simulated(m, h, scheme=scheme, num_steps=STEPS)
    lanes, h = parameters()
    found = jax.jit(jax.vmap(run))(lanes, h)
    alone = jax.jit(run)
    for lane in (0, 7, LANES - 1):
        expected = alone(lanes[lane], h[lane])
        close = lambda a, b, lane=lane: np.testing.assert_allclose(a[lane], b, atol=1e-12)
        jax.tree.map(close, (found.ts, found.ys.q), (expected.ts, expected.ys.q))
        close(found.audit.energy, expected.audit.energy)
        # Velocities and forces amplify the error of a position by 1/h and more.
        np.testing.assert_allclose(found.ys.v[lane], expected.ys.v, atol=1e-10)
    assert np.all(found.result._value == found.result._value[0])
    assert np.all(found.stats.newton_iterations > 0)


def test_lanes_that_fail_or_end_early():
    """A lane that needs Newton's method, one that fails with it, others that end before."""
    lanes, h = parameters()
    h = h.at[3].set(0.35).at[5].set(0.2)
    lanes = lanes.at[8].set(jnp.nan)
    ends = (STEPS * h).at[11].set(5 * h[11]).at[12].set(0.5 * h[12])

    def run(m, h, end):
        return double_pendulum(
            m, h, scheme=ej.EnergyPreserving(), t1=end, max_steps=STEPS + 1
        )

    found = jax.jit(jax.vmap(run))(lanes, h, ends)
    alone = jax.jit(run)
    for lane in (0, 3, 5, 8, 11, 12):
        expected = alone(lanes[lane], h[lane], ends[lane])
        of_lane = jax.tree.map(lambda x, lane=lane: x[lane], found)
        assert bool(of_lane.result == expected.result)
        assert of_lane.stats.completed_steps == expected.stats.completed_steps
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
        jax.tree.map(close, (of_lane.ts, of_lane.ys), (expected.ts, expected.ys))


@pytest.mark.slow
def test_derivatives_and_batches_of_batches():
    """Derivatives of batches are those of lanes one after the other."""
    lanes, h = parameters()

    def end(m, h):
        run = double_pendulum(m, h, scheme=ej.EnergyPreserving(), num_steps=STEPS)
        return run.ys.q[-1]

    total = lambda fn: lambda m: jnp.sum(jnp.sin(fn(m, h)))
    alone = jax.jit(jax.grad(lambda m, h: jnp.sum(jnp.sin(end(m, h)))))
    expected = np.array([alone(*pair) for pair in zip(lanes, h, strict=True)])
    of_batch = jax.jit(jax.grad(total(jax.vmap(end))))(lanes)
    batch_of = jax.jit(jax.vmap(jax.grad(lambda m, h: jnp.sum(jnp.sin(end(m, h))))))
    # Round-off and the stop of the search.
    np.testing.assert_allclose(of_batch, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(batch_of(lanes, h), expected, rtol=0, atol=1e-11)
    shared = jax.vmap(jax.vmap(end, in_axes=(None, 0)), in_axes=(0, None))
    both = jax.jit(shared)(lanes[:2], h)
    single = jax.jit(end)
    for k in (0, 1):
        np.testing.assert_allclose(both[k, 4], single(lanes[k], h[4]), rtol=0, atol=1e-12)
