"""The terms of a sum, by which plain potentials tell the elements that they sum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._operators.elements import element_energies
from enerjax._programs import summands_of

from .helpers import EPS


K = jnp.array([1.0, 2.0, 3.0])
Q = jnp.array([0.3, -0.4, 0.9, 1.3, 0.2, -0.6])


def _of_distance(q):
    return jnp.sum((q[:3] - q[3:]) ** 4)


# Functions, how many terms each has, and the largest number of coordinates in one of them.
SUMS = {
    "sum": (lambda q: 0.5 * jnp.sum(K * jnp.diff(q[:4]) ** 2), 3, 2),
    "dot product": (lambda q: K @ jnp.cos(q[:3]), 3, 1),
    "mean": (lambda q: jnp.mean(jnp.diff(q) ** 4), 5, 2),
    "quadratic form": (lambda q: q[:3] @ jnp.diag(K) @ q[:3] / 2, 3, 3),
    "several": (lambda q: jnp.sum(q**2) - q[0] * q[5] + 3.0, 7, 2),
    "a function within": (lambda q: jax.jit(_of_distance)(q) * 4.0 - jnp.sin(q[1]), 4, 2),
    "sums of sums": (lambda q: jnp.sum(jnp.sum(q.reshape(2, 3) ** 3, axis=0)), 3, 2),
    "negative": (lambda q: -(-jnp.sum(q[:2] ** 2) / 2.0), 2, 1),
    "no sum": (lambda q: jnp.sqrt(jnp.sum(q**2)), 1, 6),
    "a product of sums": (lambda q: jnp.sum(q[:3]) * jnp.sum(q[3:]), 1, 6),
    "nothing": (lambda q: jnp.sum(K), 0, 0),
}


@pytest.mark.parametrize("name", SUMS)
def test_all_terms_of_a_sum_are_found(name):
    fn, count, width = SUMS[name]
    terms = summands_of(fn)
    assert terms(Q).shape == (count,)
    # Up to a constant.
    change = jnp.sum(terms(Q + 0.1) - terms(Q))
    assert float(change) == pytest.approx(float(fn(Q + 0.1) - fn(Q)), abs=100 * EPS)
    touched = np.sum(np.asarray(jax.jacfwd(terms)(Q)) != 0, axis=1)
    assert touched.max(initial=0) <= width


N = 40


def _quartic_chain(q, args):
    """The chain of Fermi, Pasta, Ulam and Tsingou between two walls, on soft ground."""
    stretch = jnp.diff(q, prepend=0.0, append=0.0)
    springs = jnp.sum(stretch**2) / 2 + args["b"] / 4 * jnp.sum(stretch**4)
    return springs + 0.01 * jnp.sum(jnp.cos(q))


def test_newtons_method_eliminates_blocks_where_a_plain_potential_is_a_sum():
    """One correction of the energy for the whole sum would make the Jacobian dense."""
    system = ej.System(lambda v, args: 0.5 * v @ v, _quartic_chain)
    args, start = {"b": 0.3}, ej.State(jnp.sin(jnp.arange(1.0, N + 1) / 3), jnp.zeros(N))
    for scheme in (ej.EnergyConsistent(0.0), ej.EnergyConsistent(0.5)):
        found = ej.explain(system, scheme, start, args)
        assert "nodes of up to 4 unknowns" in str(found.jacobian)
        # Terms of one coordinate beside those of two couple no others.
        products = int(str(found.jacobian).partition("found by ")[2].split()[0])
        assert products <= 8

    def end(h):
        run = ej.simulate(
            system, ej.EnergyConsistent(0.0), start, args, h=h, num_steps=round(2 / h)
        )
        leak = np.asarray(run.audit.energy) - run.audit.energy[0]
        assert np.max(np.abs(leak)) <= 1e3 * EPS * run.audit.energy[0]  # round-off
        return run.ys.q[-1]

    exact = end(0.0125)
    coarse, fine = (float(jnp.max(jnp.abs(end(h) - exact))) for h in (0.2, 0.1))
    assert coarse / fine == pytest.approx(16, rel=0.2)


def test_summands_that_couple_all_coordinates_are_not_used():
    """They would cost more than the dense Jacobian, and so would those of few unknowns."""

    def potential(q, args):
        far = (q[:, None] - q[None, :]) ** 2
        return jnp.sum(1 / (1.0 + far)) + 0.5 * jnp.sum(q**2)

    system = ej.System(lambda v, args: 0.5 * v @ v, potential)
    assert element_energies(system, jnp.linspace(-1.0, 1.0, N), None) is None
    plain = ej.System(lambda v, args: 0.5 * v @ v, _quartic_chain)
    assert element_energies(plain, jnp.zeros(N), {"b": 0.3}) is not None
    assert element_energies(plain, jnp.zeros(8), {"b": 0.3}) is None
