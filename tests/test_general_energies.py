"""Systems from a Lagrangian and from a Hamiltonian."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import enerjax as ej

from .helpers import march, on_host, slopes
from .references import double_pendulum_reference


# Constant inertia declared as if it varied: the same discrete equations with momenta as
# unknowns, so the same motion to round-off. Index 3 locks, which amplifies round-off.
SAME = [
    ("double", ej.EnergyPreserving()),
    pytest.param("pendulum", ej.EnergyDecaying(0.5), marks=pytest.mark.slow),
    ("pendulum", ej.EnergyConsistent(0.5)),
    pytest.param("pendulum", ej.KappaDecaying(0.5), marks=pytest.mark.slow),
    pytest.param("pendulum", ej.EnergyPreserving("index3"), marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "scheme"), SAME)
@pytest.mark.slow_for("pendulum-scheme2")
def test_constant_inertia_gives_the_motion_of_a_system(name, scheme):
    problems = {"double": ej.problems.double_pendulum, "pendulum": ej.problems.pendulum}
    system, start, args = problems[name]()
    general = ej.System.from_lagrangian(
        lambda q, qdot, args: system.kinetic(qdot, args),
        system.potential,
        system.constraint,
    )
    runs = [
        ej.simulate(s, scheme, start, args, h=0.01, num_steps=20) for s in (system, general)
    ]
    one, other = map(on_host, runs)
    np.testing.assert_allclose(other.ys.q, one.ys.q, atol=1e-13)  # round-off
    np.testing.assert_allclose(other.ys.v, one.ys.v, atol=1e-11)
    np.testing.assert_allclose(other.multipliers, one.multipliers, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other.audit.dissipated, one.audit.dissipated, atol=1e-12)
    np.testing.assert_allclose(other.audit.kinetic, one.audit.kinetic, atol=1e-12)


ORDERS = [
    ("preserving", 2),
    *[pytest.param(f"composed {order}", order, marks=pytest.mark.slow) for order in (4, 6)],
    ("consistent", 4),
]


@pytest.mark.parametrize(("scheme", "order"), ORDERS)
@pytest.mark.slow_for("consistent-4")
def test_angles_move_as_points_on_rods(scheme, order):
    reference = double_pendulum_reference(1.0)
    steps = (40, 80) if order == 6 else (100, 200)
    errors = []
    for n in steps:
        q = march("double angles", scheme, h=1.0 / n, steps=n).q
        inner = np.array([np.sin(q[0]), np.cos(q[0])])
        outer = inner + np.array([np.sin(q[1]), np.cos(q[1])])
        errors.append(np.max(np.abs(np.concatenate([inner, outer]) - reference.q)))
    assert slopes(errors)[0] == pytest.approx(order, abs=0.2)
    assert errors[-1] <= {2: 2e-4, 4: 5e-8, 6: 1e-9}[order]  # truncation


def differences(fn, x, step=1e-5):
    rows = step * jnp.eye(x.size)
    return [(fn(x + row) - fn(x - row)) / (2 * step) for row in rows]


@pytest.mark.slow
def test_gradients_of_a_bead_on_a_parabola():
    """Its inertia varies; by the curvature, and by the alpha of the scheme."""
    system = ej.System.from_lagrangian(
        lambda q, qdot, k: 0.5 * (1 + (k * q[0]) ** 2) * qdot[0] ** 2,
        lambda q, k: 9.81 * k * q[0] ** 2 / 2,
    )

    @jax.jit
    @jax.value_and_grad
    def end(x):
        start, scheme = ej.State([1.0], [0.0]), ej.EnergyConsistent(x[1])
        run = ej.simulate(system, scheme, start, x[0], h=0.05, num_steps=25)
        return run.ys.q[-1, 0] + run.ys.v[-1, 0]

    x = jnp.array([0.9, 0.3])
    reverse, difference = end(x)[1], differences(lambda x: end(x)[0], x)
    np.testing.assert_allclose(reverse, difference, rtol=1e-7, atol=1e-8)  # differences
    assert np.min(np.abs(reverse)) > 1e-6


@pytest.mark.slow
def test_gradients_through_a_varying_inertia():
    """Of the last point of a run from angles, by a mass and a length."""
    system, start, args = ej.problems.double_pendulum_angles()

    def tip(x):
        world, scheme = dict(args, m1=x[0], l2=x[1]), ej.EnergyConsistent(0.3)
        angles = ej.simulate(system, scheme, start, world, h=0.02, num_steps=25).ys
        return angles.q[-1, 1] + angles.v[-1, 0]

    x, run = jnp.array([1.2, 0.9]), jax.jit(tip)
    forward, reverse = jax.jacfwd(run)(x), jax.grad(run)(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)  # round-off
    difference = differences(run, x)
    np.testing.assert_allclose(reverse, difference, rtol=1e-7, atol=1e-8)  # differences


@pytest.mark.slow
def test_lanes_of_a_sweep_are_their_single_runs():
    system, start, args = ej.problems.double_pendulum_angles()

    def last(alpha, h):
        scheme = ej.EnergyConsistent(alpha)
        return ej.simulate(system, scheme, start, args, h=h, num_steps=30).ys.q[-1]

    alphas, steps = jnp.array([0.0, 0.5, 1.0]), jnp.array([0.01, 0.02, 0.03])
    lanes = jax.vmap(last)(alphas, steps)
    alone = jnp.stack([last(alpha, h) for alpha, h in zip(alphas, steps, strict=True)])
    np.testing.assert_allclose(lanes, alone, rtol=1e-11)


@pytest.mark.slow
def test_derivatives_of_a_hamiltonian_by_numbers_of_python():
    system = ej.System.from_lagrangian(
        lambda q, v, args: 0.5 * args["m"] * (2 + jnp.cos(q[0] - q[1])) * v @ v,
        lambda q, args: args["m"] * 9.81 * jnp.sum(q),
    )

    def energy(z, m):
        return system.hamiltonian_at(z[:2], z[2:], {"m": m, "name": "a"})

    def exact(z, m):
        inertia = m * (2 + jnp.cos(z[0] - z[1]))
        return 0.5 * z[2:] @ z[2:] / inertia + m * 9.81 * (z[0] + z[1])

    z = jnp.array([0.3, -0.8, 1.1, 0.4])
    for of in (jax.grad, jax.hessian):
        found, expected = (of(fn, (0, 1))(z, 1.5) for fn in (energy, exact))
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)
        jax.tree.map(close, found, expected)  # round-off


def test_a_linear_term_that_vanishes_at_the_start_is_refused():
    system = ej.System.from_lagrangian(
        lambda q, v, args: 0.5 * v @ v + jnp.sin(q[0]) * q[1] * v[1],
        lambda q, args: 0.5 * q @ q,
    )
    start = ej.State([0.0, 0.5], [0.1, 0.2])
    with pytest.raises(ValueError, match="not quadratic in the velocities"):
        ej.simulate(system, ej.EnergyPreserving(), start, h=0.01, num_steps=3)


def _charged(q, p, args):
    """A particle in a uniform magnetic field across the plane."""
    momentum = p - 0.5 * args["b"] * jnp.array([-q[1], q[0]])
    return 0.5 * momentum @ momentum


@pytest.mark.parametrize(
    ("scheme", "order"), [(ej.EnergyPreserving(), 2), (ej.EnergyConsistent(0.0), 4)]
)
def test_a_charged_particle_circles(scheme, order):
    system, args = ej.System.from_hamiltonian(_charged), {"b": 2.0}
    # Velocity (0, 1) at (0.5, 0): the circle of radius v/b about the origin, backwards.
    start = ej.initial_state(system, [-0.5, 0.0], [0.0, 1.0 - 0.5], args)
    errors = []
    for n in (50, 100):  # in two seconds: one program, which runs the coarse steps on
        run = ej.simulate(system, scheme, start, args, h=2.0 / n, num_steps=100)
        exact = -0.5 * np.array([np.cos(4.0), -np.sin(4.0)])
        errors.append(np.max(np.abs(np.asarray(run.ys.q[n]) - exact)))
        energy = run.audit.energy
        assert jnp.max(jnp.abs(energy - energy[0])) <= 1e-14  # round-off
    assert slopes(errors)[0] == pytest.approx(order, abs=0.1)


def test_a_relativistic_oscillator_keeps_its_energy():
    hamiltonian = lambda q, p, args: jnp.sum(jnp.sqrt(1 + p**2)) + 0.5 * q @ q
    system = ej.System.from_hamiltonian(hamiltonian)
    start = ej.initial_state(system, [3.0], [0.0])
    run = ej.simulate(system, ej.EnergyPreserving(), start, h=0.05, num_steps=200)
    energy = np.asarray(run.audit.energy)
    assert np.max(np.abs(energy - energy[0])) <= 1e-12 * energy[0]  # solver
    rates = lambda t, y: [y[1] / np.sqrt(1 + y[1] ** 2), -y[0]]
    exact = solve_ivp(rates, (0, 10), [3.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(run.ys.q[-1, 0], exact.y[0, -1], atol=2e-3)  # truncation


@pytest.mark.slow
def test_a_start_is_made_consistent_in_positions_and_momenta():
    system, start, args = ej.problems.heavy_top_canonical()
    found = ej.consistent_start(system, 1.1 * start.q, start.v + 3 * start.q, args)
    np.testing.assert_allclose(found.constraint_after, 0, atol=1e-15)
    np.testing.assert_allclose(found.rate_after, 0, atol=1e-14)
    np.testing.assert_allclose(found.state.v, start.v, atol=1e-12)
    assert float(jnp.max(jnp.abs(found.rate_before))) > 1


def test_a_relativistic_start_is_made_consistent():
    """Velocities are no linear functions of the momenta."""
    rod = lambda q, args: jnp.stack([q @ q - 1])
    system = ej.System.from_hamiltonian(lambda q, p, args: jnp.sqrt(1 + p @ p), rod)
    start = ej.initial_state(system, [0.6, 0.8], [0.7, 0.2])
    assert float(start.q @ start.v) == pytest.approx(0, abs=1e-14)  # round-off
    assert float(start.v @ start.v) > 0.01
    # From here Newton's method diverges.
    with pytest.raises(ValueError, match="too far from the constraints"):
        ej.initial_state(system, [0.6, 0.8], [2.0, 1.5])


BAD = [
    (
        ej.System.from_lagrangian(lambda q, w, args: w @ w + w[0], lambda q, args: q @ q),
        "not quadratic",
    ),
    (ej.System.from_hamiltonian(lambda q, p, args: q @ q - p @ p), "not positive definite"),
    (ej.System.from_hamiltonian(lambda q, p, args: q * p), "must return a scalar"),
    (
        ej.System.from_lagrangian(lambda q, w, args: w[:1] @ w[:1], lambda q, args: q @ q),
        "not positive definite",
    ),
]


@pytest.mark.parametrize(("system", "message"), BAD)
def test_bad_energies_raise_an_error(system, message):
    with pytest.raises(ValueError, match=message):
        ej.initial_state(system, [1.0, 2.0], [0.5, 0.1])


def test_functions_of_the_wrong_number_of_arguments():
    system = ej.System.from_lagrangian(
        lambda v, args: v @ v,  # pyright: ignore
        lambda q, args: q @ q,
    )
    with pytest.raises(TypeError, match=r"must take 3 arguments, .*\(q, qdot, args\)"):
        ej.initial_state(system, [1.0], [0.5])


def test_as_many_momenta_as_coordinates():
    system = ej.System.from_hamiltonian(lambda q, p, args: q @ q + p @ p)
    with pytest.raises(ValueError, match="as many of each"):
        ej.initial_state(system, [1.0, 2.0], [0.5])
    with pytest.raises(TypeError, match="`hamiltonian` must be a function of"):
        ej.System.from_hamiltonian(jnp.eye(2))  # pyright: ignore
