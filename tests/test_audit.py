"""The energy identities where the potential is not linear."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import EPS, failed, long, on_host, problem, SCHEMES, solve, TURNOVER


# Solver: Newton leaves a few eps of the energy in each step.
SOLVER = 1e-12

ALPHAS = (0.0, 0.5, 1.0)
SCHEMES_OF = {
    "spring": (
        "preserving",
        "preserving gauss",
        "decaying",
        "decaying gauss",
        "consistent",
    ),
    "particles": ("preserving", "consistent"),
    "body": ("preserving", "decaying"),
}
CASES = [
    (name, scheme, alpha)
    for name, schemes in SCHEMES_OF.items()
    for scheme in schemes
    for alpha in (ALPHAS if scheme.split()[0] in ("decaying", "consistent") else (0.0,))
]
STEP = {"spring": 0.02, "particles": 0.01, "body": 0.002}


# The same is seen of the spring.
LONG = [("particles", "consistent", 0.0)]


@pytest.mark.parametrize(
    ("name", "scheme", "alpha"),
    [pytest.param(*x, marks=pytest.mark.slow if x in LONG else []) for x in CASES],
)
@pytest.mark.slow_for(
    "particles-consistent-0.5", "body-preserving-0.0", "particles-preserving-0.0"
)
def test_the_energy_identity_holds(name, scheme, alpha):
    solution = solve(name, scheme, alpha, h=STEP[name], steps=200)
    assert not failed(solution)
    audit = solution.audit
    leak = np.diff(audit.energy) + audit.dissipated[1:]
    assert np.max(np.abs(leak)) <= SOLVER * TURNOVER[name]
    if alpha == 0:
        assert np.all(audit.dissipated == 0)
    else:
        # The identity is about something: the steps do dissipate.
        assert np.sum(audit.dissipated) > 1e-9 * TURNOVER[name]


@pytest.mark.parametrize("name", ["spring", "particles"])
def test_energy_consistent_never_gains_energy_in_many_dimensions(name):
    audit = solve(name, "consistent", 1.0, h=STEP[name], steps=200).audit
    assert np.all(audit.dissipated >= 0)
    # Round-off of the energy alone.
    assert np.max(np.diff(audit.energy)) <= 20 * EPS * TURNOVER[name]


@pytest.mark.parametrize("scheme", long(["preserving", "consistent"], "consistent"))
def test_momenta_of_the_free_particles_are_kept_to_second_order(scheme):
    """The correction of a discrete gradient points along the increment: no symmetry of
    the potential survives it, but what it breaks is small."""
    m = np.asarray(problem("particles").args["m"])[None, :, None]
    ys = solve("particles", scheme, 0.0, h=0.01, steps=200).ys
    x, v = ys.q.reshape(-1, 4, 3), ys.v.reshape(-1, 4, 3)
    linear, angular = np.sum(m * v, axis=1), np.sum(m * np.cross(x, v), axis=1)
    # Truncation: C h^2 with C of order one.
    np.testing.assert_allclose(linear, np.array([[0, 0, 2]] * 201), rtol=0, atol=1e-4)
    np.testing.assert_allclose(angular, np.array([[2, -2, 0]] * 201), rtol=0, atol=1e-4)


def _well(q, args):
    return args["depth"] * (q[0] ** 2 - 1) ** 2


def _swing(q, args):
    return args["g"] * (1 - jnp.cos(q[0]))


# Started where V is concave: at the top of a circle, and between two wells.
CONCAVE = {
    "angle from 3.0 rad": (_swing, dict(g=9.81), 3.0, 0.0, 0.02),
    "double well": (_well, dict(depth=5.0), 0.0, 1.0, 0.05),
}


@functools.cache
def concave(name, scheme, alpha):
    potential, args, q, v, h = CONCAVE[name]
    system = ej.System(jnp.eye(1), potential)
    start = ej.initial_state(system, [q], [v], args)
    solution = ej.simulate(
        system, SCHEMES[scheme](alpha), start, args, h=h, num_steps=2000, throw=False
    )
    return on_host(solution)


@pytest.mark.parametrize("name", CONCAVE)
@pytest.mark.parametrize("alpha", [0.5, 1.0])
def test_energy_consistent_never_gains_energy_where_the_potential_is_concave(name, alpha):
    solution = concave(name, "consistent", alpha)
    assert not failed(solution)
    audit = solution.audit
    scale = np.max(audit.kinetic) + np.max(audit.potential)
    assert np.all(audit.dissipated >= 0)
    assert np.max(np.diff(audit.energy)) <= 20 * EPS * scale
    leak = np.diff(audit.energy) + audit.dissipated[1:]
    assert np.max(np.abs(leak)) <= 20 * EPS * scale


def test_energy_decaying_gains_energy_there_and_reports_it():
    """V_jump has either sign; the identity holds all the same."""
    solution = concave("angle from 3.0 rad", "decaying", 1.0)
    assert not failed(solution)
    audit = solution.audit
    scale = np.max(audit.kinetic) + np.max(audit.potential)
    leak = np.diff(audit.energy) + audit.dissipated[1:]
    assert np.max(np.abs(leak)) <= 20 * EPS * scale
    assert np.min(audit.dissipated) < -1e3 * EPS * scale


def test_potential_jumps_dissipate_where_the_potential_is_convex():
    """A stiff spring near its rest length: V is convex over every jump, V_jump >= 0."""

    def potential(q, args):
        return 0.5 * args["k"] * q @ q

    args = dict(k=100.0)
    system = ej.System(jnp.eye(2), potential)
    start = ej.initial_state(system, [1.0, 0.0], [0.0, 2.0], args)
    solution = ej.simulate(
        system, ej.EnergyDecaying(1.0), start, args, h=0.05, num_steps=100
    )
    assert np.all(solution.audit.dissipated >= 0)
    assert solution.audit.energy[-1] < 0.9 * solution.audit.energy[0]


@pytest.mark.parametrize("scheme", ["decaying", "consistent"])
@pytest.mark.parametrize("rho_inf", [0.0, 0.3, 1.0])
def test_a_fast_oscillation_shrinks_by_the_spectral_radius(scheme, rho_inf):
    stiffness = 1e10
    make = {"decaying": ej.EnergyDecaying, "consistent": ej.EnergyConsistent}[scheme]
    system = ej.System(jnp.eye(1), lambda q, k: 0.5 * k * q @ q)
    start = ej.State([1.0], [0.0])
    out = ej.step(system, make.from_spectral_radius(rho_inf), start, stiffness, h=1.0)
    energies = [system.energy(y, stiffness) for y in (start, out.state)]
    amplitude = float(jnp.sqrt(energies[1] / energies[0]))
    # Truncation in 1 / (h w), with h w = 1e5.
    assert amplitude == pytest.approx(rho_inf, abs=1e-4)


def _turning(q, args):
    """Both points turn about the z axis, and move along it."""
    up = jnp.array([0.0, 0.0, 1.0])
    turn = jnp.concatenate([jnp.cross(up, q[:3]), jnp.cross(up, q[3:])])
    return jnp.stack([turn, jnp.concatenate([up, up])])


def test_the_audit_reports_the_momenta_of_symmetries():
    def potential(q, args):
        x = q[:3] - q[3:]
        return 0.5 * args["k"] * (x @ x - 1.0) ** 2

    args = dict(k=10.0)
    system = ej.System(jnp.eye(6), potential, symmetry=_turning)
    start = ej.initial_state(system, [0, 0, 0, 1, 0.1, 0], [0, 0.1, 1, 0, 1, 0], args)
    for scheme, bound in ((ej.EnergyPreserving(), 1e-14), (ej.EnergyDecaying(1.0), 1e-2)):
        audit = ej.simulate(system, scheme, start, args, h=0.02, num_steps=100).audit
        # By hand: x times v, summed.
        q, v = np.asarray(start.q), np.asarray(start.v)
        angular = sum(np.cross(q[k : k + 3], v[k : k + 3])[2] for k in (0, 3))
        np.testing.assert_allclose(audit.momentum[0], [angular, v[2] + v[5]], atol=1e-15)
        drift = np.abs(np.asarray(audit.momentum) - np.asarray(audit.momentum[0]))
        # Round-off; truncation of the decaying scheme in the angular momentum.
        assert np.max(drift) <= 10 * bound
        assert np.max(drift[:, 1]) <= 1e-13


def test_printing_an_audit_shows_a_summary():
    system, start, args = problem("spring")
    scheme = ej.EnergyDecaying(0.5)
    audit = ej.simulate(system, scheme, start, args, h=STEP["spring"], num_steps=200).audit
    text = str(audit)
    assert "201 rows" in text
    assert "removed by the scheme" in text
    assert "unaccounted for" in text
    cut = str(jax.tree.map(lambda x: x.at[100:].set(jnp.nan), audit))
    assert "100 of them reached" in cut
    assert "nan" not in cut
