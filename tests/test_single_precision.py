"""Properties that hold to round-off hold to that of float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import long


EPS = float(np.finfo(np.float32).eps)
# Of a run as long as the sum of its round-off still is small against the energy.
STEPS, H = 400, 0.005
RUNS = {
    "preserving": (ej.problems.double_pendulum, ej.EnergyPreserving()),
    "decaying": (ej.problems.double_pendulum, ej.EnergyDecaying(0.5)),
    "consistent": (ej.problems.double_pendulum, ej.EnergyConsistent(0.5)),
    "composed": (ej.problems.double_pendulum, ej.Composed(ej.EnergyPreserving(), 4)),
    "top": (ej.problems.heavy_top_directors, ej.EnergyPreserving()),
    "chain": (lambda: ej.problems.chain(40), ej.EnergyPreserving()),
}


def run(name, dtype):
    make, scheme = RUNS[name]
    system, start, args = make()
    start, args = jax.tree.map(lambda x: jnp.asarray(x, dtype), (start, args))
    # Of a chain that long the steps must be short for the waves in it.
    h = H / 5 if name == "chain" else H
    return ej.simulate(system, scheme, start, args, h=h, num_steps=STEPS)


@pytest.mark.parametrize(
    "name", long(RUNS, "preserving", "decaying", "composed", "top", "chain")
)
@pytest.mark.slow_for("consistent")
def test_energy_and_constraints_hold_to_the_round_off_of_the_dtype(name):
    single, double = run(name, jnp.float32), run(name, jnp.float64)
    assert single.ys.q.dtype == single.audit.energy.dtype == jnp.float32
    audit = jax.tree.map(np.asarray, single.audit)
    size = np.max(audit.kinetic) + np.ptp(audit.potential)
    # A step: the energies are sums and differences of some terms of this size.
    assert np.max(np.abs(audit.leak)) <= 20 * EPS * size
    # A run: at the worst all of one sign.
    assert np.abs(np.sum(audit.leak)) <= STEPS * EPS * size
    speed = np.max(np.abs(single.ys.v))
    length = np.max(np.abs(single.ys.q))
    assert np.max(np.abs(audit.constraint)) <= 10 * EPS * length**2
    assert np.max(np.abs(audit.constraint_rate)) <= 50 * EPS * speed * length
    # The same motion: round-off, as far as it has grown in that time.
    np.testing.assert_allclose(single.ys.q, double.ys.q, atol=3e-4 * length)
    # And no more work: the tolerances of Newton know the dtype.
    iterations = [np.mean(x.stats.newton_iterations) for x in (single, double)]
    assert iterations[0] <= iterations[1] + 0.5


@pytest.mark.slow
def test_derivatives_in_single_precision():
    system, start, args = ej.problems.pendulum()

    def tip(g, dtype):
        begin = jax.tree.map(lambda x: jnp.asarray(x, dtype), start)
        scheme = ej.EnergyPreserving()
        run = ej.simulate(system, scheme, begin, args | {"g": g}, h=0.02, num_steps=50)
        return run.ys.q[-1, 0]

    slope = jax.jit(jax.grad(tip), static_argnums=1)
    single, double = slope(jnp.float32(9.81), jnp.float32), slope(9.81, jnp.float64)
    assert single.dtype == jnp.float32
    # Round-off of positions of size one; the derivative itself happens to be small.
    np.testing.assert_allclose(single, double, rtol=0, atol=5 * EPS)
