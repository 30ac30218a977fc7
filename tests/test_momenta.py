"""Symmetries that the chain rule keeps: momenta of free systems and of tops."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import long, on_host, problem
from .references import HEAVY_TOP


def _points(run, args):
    """Linear and angular momentum of points of mass `m`, shape (times, 3)."""
    x, v = (y.reshape(len(y), -1, 3) for y in (run.ys.q, run.ys.v))
    mass = np.broadcast_to(np.asarray(args["m"]), x.shape[1])[None, :, None]
    return np.sum(mass * v, axis=1), np.sum(mass * np.cross(x, v), axis=1)


def _directors(run, args):
    """Vertical momentum, and spin about the axis of figure, of the top."""
    x, v = (y.reshape(-1, 3, 3) for y in (run.ys.q, run.ys.v))
    momentum = np.einsum("k,tki->ti", [0.234375, 15.0, 0.234375], np.cross(x, v))
    return momentum[:, 2], np.sum(momentum * x[:, 1], axis=1)


def _in_space(q):
    a, b, c, d = q
    return 0.5 * np.array([[-b, a, -d, c], [-c, d, a, -b], [-d, -c, b, a]])


def _in_body(q):
    a, b, c, d = q
    return 0.5 * np.array([[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]])


def _canonical(run, args):
    pairs = list(zip(run.ys.q, run.ys.v, strict=True))
    vertical = np.array([(_in_space(q) @ p)[2] for q, p in pairs])
    return vertical, np.array([(_in_body(q) @ p)[1] for q, p in pairs])


def _parameters(run, args):
    """Of the top in Euler parameters: rotation and translation."""
    spin = run.ys.v[:, 3:] * np.asarray(args["J"])
    body = (
        2
        * np.stack(
            [
                [row @ _rotated(q[3:]) for row in spin[k : k + 1]]
                for k, q in enumerate(run.ys.q)
            ]
        )[:, 0]
    )
    x, v = run.ys.q[:, :3], run.ys.v[:, :3]
    return (0.5 * body + 15.0 * np.cross(x, v))[:, 2], spin[:, 1]


def _rotated(p):
    """The transpose of the rotation matrix of a unit quaternion."""
    return (4 * _in_space(p) @ _in_body(p).T).T


def _drift(x):
    return np.max(np.abs(x - x[0])) / max(np.max(np.abs(x[0])), 1.0)


FREE = {"particles": 0.01, "ring": 0.02, "elastic": 0.01}


def _check_points(name, steps, bound):
    system, start, args = problem(name)
    run = on_host(
        ej.simulate(
            system, ej.EnergyPreserving(), start, args,
            h=FREE[name], num_steps=steps, saveat=ej.SaveAt(every=steps // 100),
        )
    )  # fmt: skip
    linear, angular = _points(run, args)
    assert _drift(run.audit.energy) <= bound
    if name == "elastic":  # gravity leaves the momentum about its axis
        assert _drift(angular[:, 2]) <= bound
    else:
        assert _drift(linear) <= bound
        assert _drift(angular) <= bound


@pytest.mark.parametrize("name", FREE)
@pytest.mark.slow_for("ring")
def test_points_keep_their_momenta(name):
    _check_points(name, 1000, 1e-12)  # round-off of a thousand steps


@pytest.mark.slow
@pytest.mark.parametrize("name", FREE)
def test_points_conserve_their_momenta_in_long_runs(name):
    # Round-off, a random walk. The particles end 250 lengths away from where they began,
    # and their moment of momentum is rounded that much more.
    _check_points(name, 100_000, 4e-11 if name == "particles" else 1e-11)


TOPS = {
    "top": (_parameters, lambda q: q[:3], 7e-4),
    "top directors": (_directors, lambda q: q[3:6], 7e-5),
    "top canonical": (
        _canonical,
        lambda q: 4 * (_in_space(q) @ _in_body(q).T)[:, 1],
        3.1e-3,
    ),
}


EPS = np.finfo(float).eps
# Without an error of Newton's method, whose sign is the same in all steps of a top.
TIGHT = ej.Newton(rtol=1e-6, atol=1e-3)


@functools.cache
def _top(name, h, steps=200, save_every=1, newton=ej.Newton()):
    system, start, args = problem(name)
    run = on_host(
        ej.simulate(
            system, ej.EnergyPreserving(), start, args,
            h=h, num_steps=steps, saveat=ej.SaveAt(every=save_every), root_finder=newton,
        )
    )  # fmt: skip
    vertical, spin = TOPS[name][0](run, args)
    return run, vertical, spin


@pytest.mark.parametrize("name", long(TOPS, "top", "top canonical"))
@pytest.mark.slow_for("top directors")
def test_tops_conserve_energy_and_the_visible_momenta(name):
    run, vertical, spin = _top(name, 1e-3)
    # The same program, for twice as long.
    _, *coarse = _top(name, 2e-3)
    coarse_vertical, coarse_spin = (x[:101] for x in coarse)
    position = TOPS[name][1](run.ys.q[-1])
    error = np.max(np.abs(position - HEAVY_TOP[0.2].position))
    assert error <= TOPS[name][2]  # truncation
    assert _drift(run.audit.energy) <= 200 * EPS  # solver: one unit of round-off a step
    # The spin about the axis of figure, and with Euler parameters the vertical momentum,
    # are kept to second order: a mean of rotations is no rotation.
    assert _drift(spin) <= 0.3 * _drift(coarse_spin)
    if name == "top":
        assert _drift(vertical) <= 0.3 * _drift(coarse_vertical)
        assert _drift(vertical) <= 2e-3
    else:
        assert _drift(vertical) <= 2e-14


@pytest.mark.slow
@pytest.mark.parametrize("name", TOPS)
def test_tops_conserve_energy_and_momenta_in_long_runs(name):
    steps = 100_000
    run, vertical, _ = _top(name, 1e-3, steps, 1000)
    assert _drift(run.audit.energy) <= steps * EPS  # solver: one unit of round-off a step
    exact, exact_vertical, _ = _top(name, 1e-3, steps, 1000, TIGHT)
    assert _drift(exact.audit.energy) <= 2e-12  # round-off
    if name != "top":
        assert _drift(vertical) <= 1e-11
        assert _drift(exact_vertical) <= 1e-12  # round-off


@pytest.mark.slow
def test_angles_keep_the_energy_in_long_runs():
    system, start, args = problem("double angles")
    for scheme in (ej.EnergyPreserving(), ej.Composed(ej.EnergyPreserving(), 4)):
        run = ej.simulate(
            system,
            scheme,
            start,
            args,
            h=0.01,
            num_steps=100_000,
            saveat=ej.SaveAt(every=1000),
        )
        energy = np.asarray(run.audit.energy)
        assert np.max(np.abs(energy - energy[0])) <= 1e-12 * 9.81 * 3


@pytest.mark.slow
def test_the_canonical_top_with_energy_consistent():
    system, start, args = problem("top canonical")
    errors = []
    for h, bound in ((2e-3, 1e-4), (1e-3, 6e-6)):
        run = ej.simulate(
            system, ej.EnergyConsistent(0.0), start, args, h=h, num_steps=round(0.2 / h)
        )
        position = TOPS["top canonical"][1](np.asarray(run.ys.q[-1]))
        errors.append(np.max(np.abs(position - HEAVY_TOP[0.2].position)))
        assert errors[-1] <= bound  # truncation
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.1)


@pytest.mark.slow
def test_the_preserving_scheme_keeps_angular_momentum_with_the_chain_rule():
    system, start, args = ej.problems.four_particles()

    def drift(derivative):
        scheme = ej.EnergyPreserving(derivative=derivative)
        run = ej.simulate(system, scheme, start, args, h=0.01, num_steps=300)
        x, v = (y.reshape(-1, 4, 3) for y in (run.ys.q, run.ys.v))
        momentum = jnp.sum(args["m"][None, :, None] * jnp.cross(x, v), axis=1)
        energy = run.audit.energy
        size = lambda x: jnp.max(jnp.abs(x))
        return size(momentum - momentum[:1]), size(energy - energy[0])

    momentum, energy = drift(ej.ChainRule())
    assert momentum <= 1e-12  # round-off of 300 steps, against |L| = 2.8
    assert energy <= 1e-12  # likewise, against 1.2
    assert drift(ej.Gonzalez())[0] > 1e-7  # its error is a truncation
