"""The units of length, time and mass are the user's: in others the motion is the same.

Units are powers of two, so that nothing but round-off could differ.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import failed


# Systems are made once, so that other units do not compile other programs.
ROD = ej.System(
    lambda v, args: 0.5 * args["m"] * v @ v,
    lambda q, args: args["m"] * args["g"] * q[1],
    driven=lambda q, t, args: jnp.stack(
        [jnp.sqrt(q @ q) - args["l"] - args["a"] * jnp.sin(args["w"] * t)]
    ),
)


def rod_of_varying_length(metre, second, kilogram):
    """A point in the plane, at rest, on a rod that is driven."""
    args = dict(
        m=2.0 * kilogram,
        g=9.81 * metre / second**2,
        l=1.0 * metre,
        a=0.3 * metre,
        w=3.0 / second,
    )
    start = ej.initial_state(ROD, [1.0 * metre, 0.0], [0.0, 0.0], args)
    return ROD, start, args


def _bead_energy(q, p, args):
    heavier = jnp.stack([1 + (q[1] / args["l"]) ** 2, 1.0])
    return 0.5 * jnp.sum(p**2 / (args["m"] * heavier)) + 0.25 * args["k"] * (q @ q) ** 2


BEAD = ej.System.from_hamiltonian(_bead_energy)


def bead_of_varying_inertia(metre, second, kilogram):
    """On a hard spring; the inertia of one coordinate depends on the other."""
    args = dict(
        m=jnp.array([2.0, 0.5]) * kilogram,
        l=1.0 * metre,
        k=30.0 * kilogram / (metre * second) ** 2,
    )
    momentum = jnp.array([1.0, 0.4]) * kilogram * metre / second
    return BEAD, ej.State(jnp.array([0.3, 0.8]) * metre, momentum), args


@pytest.mark.parametrize("make", [rod_of_varying_length, bead_of_varying_inertia])
@pytest.mark.slow_for("rod_of_varying_length")
def test_the_motion_does_not_depend_on_units(make):
    """Not by the correction of a discrete gradient either, which adds squares of all."""
    scheme = ej.EnergyPreserving(derivative=ej.Gonzalez())

    def run(metre, second, kilogram):
        system, start, args = make(metre, second, kilogram)
        h = 0.1 * second
        sol = ej.simulate(system, scheme, start, args, h=h, num_steps=20, throw=False)
        assert not failed(sol)
        return np.asarray(sol.ys.q) / metre

    # Solver: the unknowns are scaled to order one in any unit.
    np.testing.assert_allclose(run(16.0, 1024.0, 1 / 256), run(1.0, 1.0, 1.0), atol=1e-12)
