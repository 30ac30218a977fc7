"""Large systems as sums over elements, which are declared or found."""

import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._solvers.linear.block_diagonal import BlockDiagonal

from .helpers import EPS


def _net(size, declared=False):
    """Points on a square net of springs, corners held by rods: loops, and no chain.

    The potential is a plain function, or declared as a sum over elements.
    """
    index = np.arange(size * size).reshape(size, size)
    pairs = np.concatenate(
        [
            np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()]),
            np.stack([index[:-1].ravel(), index[1:].ravel()]),
        ],
        axis=1,
    )
    corners = np.array([0, size - 1])
    rest = np.stack(np.meshgrid(*[np.arange(float(size))] * 2, indexing="ij"), axis=-1)
    rest = np.concatenate([rest, np.zeros((size, size, 1))], axis=2).reshape(-1, 3)
    anchors = rest[corners] + np.array([0.0, 0.0, 1.0])

    def potential(q, args):
        x = q.reshape(-1, 3)
        lengths = jnp.linalg.norm(x[pairs[0]] - x[pairs[1]], axis=1)
        return 9.81 * jnp.sum(x[:, 2]) + 0.5 * args["k"] * jnp.sum((lengths - 1) ** 2)

    def constraint(q, args):
        return jnp.sum((q.reshape(-1, 3)[corners] - anchors) ** 2, axis=1) - 1

    def spring(x, k, args):
        length = jnp.linalg.norm(x[:3] - x[3:])
        return 0.5 * args["k"] * (length - 1) ** 2

    coordinates = np.arange(rest.size).reshape(-1, 3)
    springs = ej.Elements(spring, np.hstack([coordinates[pairs[0]], coordinates[pairs[1]]]))
    weights = ej.Elements(lambda x, k, args: 9.81 * x[0], coordinates[:, 2:])
    energy = springs + weights if declared else potential
    system = ej.System(jnp.eye(rest.size), energy, constraint)
    args = {"k": 500.0}
    return system, ej.initial_state(system, rest.ravel(), np.zeros(rest.size), args), args


@pytest.mark.slow
def test_a_net_with_loops():
    system, start, args = _net(6)
    assert isinstance(system.kinetic, BlockDiagonal)
    # One program: the runs of longer steps go on for longer.
    runs = [
        ej.simulate(
            system,
            ej.EnergyPreserving(),
            start,
            args,
            h=h,
            num_steps=100,
            saveat=ej.SaveAt(every=25),
        )
        for h in (4e-3, 2e-3, 1e-3)
    ]
    for run in runs:
        scale = np.max(run.audit.kinetic)
        assert np.ptp(run.audit.energy) <= 1e3 * EPS * scale
    ends = [run.ys.q[row] for run, row in zip(runs, (1, 2, 4), strict=True)]
    coarse, fine = ends[0] - ends[1], ends[1] - ends[2]
    ratio = np.max(np.abs(coarse)) / np.max(np.abs(fine))
    assert ratio == pytest.approx(4, rel=0.1)  # second order


def test_a_sum_over_elements_is_the_plain_function():
    plain, start, args = _net(6)
    declared, _, _ = _net(6, declared=True)
    q = start.q + 0.1 * jnp.sin(jnp.arange(start.q.size))
    energies = [s.potential_energy(ej.State(q, start.v), args) for s in (plain, declared)]
    assert energies[0] == pytest.approx(float(energies[1]), rel=1e-14)  # round-off
    rods = ej.Elements(lambda x, k, args: x**2 * args[k], [[0, 3], [1, 2]])
    lengths = jnp.array([1.0, 2.0])
    np.testing.assert_allclose(rods(jnp.arange(4.0), lengths), [0, 9, 2, 8])
    with pytest.raises(ValueError, match="contains the index 3, but there are 3"):
        rods(jnp.arange(3.0))
    with pytest.raises(ValueError, match="indices of the coordinates"):
        ej.Elements(lambda x, k, args: x, [[0.5]])
    with pytest.raises(ValueError, match="start from 0"):
        ej.Elements(lambda x, k, args: x, [[-1]])
    with pytest.raises(TypeError, match="must be a function"):
        ej.Elements(3, [[0]])  # pyright: ignore


@pytest.mark.slow
def test_energy_consistent_on_many_elements():
    """The jump is an unknown there, and the stiffness a sum over the rods."""
    num_links = 36
    system, start, args = ej.problems.chain(num_links)
    scheme = ej.EnergyConsistent(0.5)
    run = ej.simulate(system, scheme, start, args, h=5e-3, num_steps=40)
    scale = np.max(run.audit.kinetic)
    leak = np.diff(run.audit.energy) + run.audit.dissipated[1:]
    assert np.max(np.abs(leak)) <= 100 * EPS * scale  # round-off
    assert np.all(run.audit.dissipated[1:] >= 0)
    assert np.sum(run.audit.dissipated) > 1e-7 * scale
    length = 1 / num_links
    assert np.max(np.abs(run.audit.constraint)) <= 1e-12 * length**2  # solver
    assert np.max(np.abs(run.audit.constraint_rate)) <= 1e-11 * length**2  # solver


@pytest.mark.slow
def test_energy_consistent_on_many_elements_is_of_order_four():
    system, start, args = _net(6, declared=True)
    plain, _, _ = _net(6)

    def end(system, alpha, h):
        scheme, steps = ej.EnergyConsistent(alpha), round(0.1 / h)
        return ej.simulate(
            system, scheme, start, args, h=h, num_steps=steps, saveat=ej.SaveAt(every=steps)
        ).ys.q[-1]

    far = lambda a, b: float(np.max(np.abs(a - b)))
    exact = end(plain, 0.0, 5e-4)
    for alpha, ratio in ((0.0, 16), (1.0, 8)):
        coarse, fine = (far(end(system, alpha, h), exact) for h in (4e-3, 2e-3))
        assert coarse / fine == pytest.approx(ratio, rel=0.15)
        # The whole stiffness decomposed: another P, errors of the same size.
        assert far(end(plain, alpha, 4e-3), exact) == pytest.approx(coarse, rel=0.2)
