"""What the schemes do to the energy, and the levels at which they hold constraints."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import enerjax as ej

from .helpers import EPS, failed, solve, TURNOVER


# h and number of steps: 10 s of cases a, b and c, and 1 s of case d.
RUNS = {
    "angle": (0.02, 500),
    "pendulum": (0.02, 500),
    "double": (0.01, 1000),
    "stiff": (0.001, 1000),
}

# Solver: Newton leaves a few eps of the turnover in each step.
SOLVER_ENERGY = 1e-12
SOLVER_POSITION = 1e-12
SOLVER_VELOCITY = 1e-11
# Figures are given to three digits; they are at least an order above the solver's share.
FIGURE = 0.01


def run(name, scheme, alpha=0.0):
    h, steps = RUNS[name]
    return solve(name, scheme, alpha, h=h, steps=steps)


def change(solution):
    return solution.audit.energy[-1] - solution.audit.energy[0]


# Case a has no constraint, hence no formulation.
SCHEMES_OF = {
    "angle": ("preserving", "decaying", "consistent"),
    "pendulum": (
        "preserving",
        "preserving index3",
        "decaying",
        "decaying index3",
        "consistent",
        "kappa",
        "composed 4",
    ),
    "double": (
        "preserving",
        "preserving index3",
        "decaying",
        "consistent",
        "composed 4",
    ),
    "stiff": ("preserving", "decaying", "consistent"),
}
# Kappa needs a kinetic energy that changes in every step: case b alone.
PRESERVING = [(name, scheme) for name, all_ in SCHEMES_OF.items() for scheme in all_]
ALPHAS = (0.0, 0.5, 1.0)
EVERY_RUN = [
    (name, scheme, alpha)
    for name, scheme in PRESERVING
    for alpha in ((0.0,) if "preserving" in scheme or "composed" in scheme else ALPHAS)
]
# What the pendulum shows too.
LONG = [("double", "preserving index3"), ("double", "composed 4")]


def long(cases):
    """The cases, some of them marked `slow`."""
    mark = [pytest.mark.slow]
    return [pytest.param(*x, marks=mark if x[:2] in LONG else []) for x in cases]


@pytest.mark.parametrize(("name", "scheme"), long(PRESERVING))
@pytest.mark.slow_for(
    "stiff-decaying",
    "double-consistent",
    "pendulum-kappa",
    "angle-preserving",
    "double-preserving",
)
def test_at_alpha_zero_the_energy_is_constant(name, scheme):
    solution = run(name, scheme)
    assert not failed(solution)
    error = np.abs(solution.audit.energy - solution.audit.energy[0])
    assert np.max(error) <= SOLVER_ENERGY * TURNOVER[name]


@pytest.mark.parametrize(("name", "scheme", "alpha"), long(EVERY_RUN))
def test_every_step_changes_the_energy_by_what_it_reports_as_dissipated(
    name, scheme, alpha
):
    audit = run(name, scheme, alpha).audit
    leak = np.diff(audit.energy) + audit.dissipated[1:]
    assert np.max(np.abs(leak)) <= SOLVER_ENERGY * TURNOVER[name]
    assert audit.dissipated[0] == 0


@pytest.mark.parametrize(("name", "scheme", "alpha"), long(EVERY_RUN))
def test_constraints_hold_at_the_promised_levels(name, scheme, alpha):
    audit = run(name, scheme, alpha).audit
    assert np.max(np.abs(audit.constraint), initial=0) <= SOLVER_POSITION
    rate = np.max(np.abs(audit.constraint_rate), initial=0)
    if "index3" not in scheme:
        assert rate <= SOLVER_VELOCITY
    else:
        # Held at position level alone: the drift of the velocities is there to be seen.
        assert rate > 1e-3


@pytest.mark.parametrize(("name", "scheme", "alpha"), long(EVERY_RUN))
def test_kinetic_and_potential_energy_are_those_of_the_states(name, scheme, alpha):
    solution = run(name, scheme, alpha)
    q, v = solution.ys.q, solution.ys.v
    if name == "angle":
        kinetic, potential = 0.5 * v[:, 0] ** 2, 9.81 * (1 - np.cos(q[:, 0]))
    else:
        m = np.repeat([0.005 if name == "stiff" else 1.0, 1.0][: q.shape[1] // 2], 2)
        kinetic, potential = 0.5 * v**2 @ m, -9.81 * q[:, 1::2] @ m[::2]
    round_off = 50 * EPS * TURNOVER[name]
    np.testing.assert_allclose(solution.audit.kinetic, kinetic, rtol=0, atol=round_off)
    np.testing.assert_allclose(solution.audit.potential, potential, rtol=0, atol=round_off)


@pytest.mark.parametrize(("alpha", "loss"), [(0.1, -9.15), (0.5, -7.19), (1.0, -5.67)])
def test_index3_loses_far_too_much_energy_on_the_constrained_pendulum(alpha, loss):
    assert change(run("pendulum", "decaying index3", alpha)) == pytest.approx(
        loss, rel=FIGURE
    )


@pytest.mark.parametrize(("alpha", "loss"), [(0.5, -3.79e-4), (1.0, -7.57e-4)])
def test_the_pendulum_in_its_angle_loses_little(alpha, loss):
    assert change(run("angle", "decaying", alpha)) == pytest.approx(loss, rel=FIGURE)


@pytest.mark.parametrize(("alpha", "loss"), [(0.5, -2.75e-3), (1.0, -5.50e-3)])
def test_kappa_cures_the_loss_on_the_constrained_pendulum(alpha, loss):
    assert change(run("pendulum", "kappa", alpha)) == pytest.approx(loss, rel=FIGURE)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_kappa_stays_near_one_on_the_constrained_pendulum(alpha):
    kappa = run("pendulum", "kappa", alpha).details
    assert kappa.shape == (500,)
    # Truncation: kappa - 1 is of the order of the square of the step.
    assert np.max(np.abs(kappa - 1)) <= 5e-5
    assert np.max(np.abs(kappa - 1)) > 0


@pytest.mark.parametrize("scheme", ["decaying", "consistent"])
@pytest.mark.parametrize("name", ["pendulum", "double", "stiff"])
@pytest.mark.parametrize("alpha", [0.5, 1.0])
def test_energy_never_rises_where_the_potential_is_linear(name, scheme, alpha):
    solution = run(name, scheme, alpha)
    assert not failed(solution)
    round_off = 20 * EPS * TURNOVER[name]
    assert np.max(np.diff(solution.audit.energy)) <= round_off
    assert np.all(solution.audit.dissipated >= 0)


@pytest.mark.parametrize("scheme", ["decaying", "consistent"])
@pytest.mark.parametrize("name", ["angle", "pendulum", "double", "stiff"])
def test_more_alpha_dissipates_more(name, scheme):
    losses = [change(run(name, scheme, alpha)) for alpha in ALPHAS]
    assert losses[2] < 1.5 * losses[1] < 0
    # Solver, against a loss of at least 1e-4.
    assert abs(losses[0]) <= SOLVER_ENERGY * TURNOVER[name]


@pytest.mark.parametrize("scheme", ["preserving", "decaying", "consistent"])
@pytest.mark.parametrize("name", ["pendulum", "double"])
@pytest.mark.parametrize("alpha", ALPHAS)
def test_a_step_needs_few_corrections(name, scheme, alpha):
    iterations = run(name, scheme, alpha).stats.newton_iterations
    assert iterations.min() >= 1
    # Corrections of the chord method, with one factorisation.
    assert iterations.max() <= 16
    assert iterations.mean() <= 8


@functools.cache
def stiff(alpha=1.0):
    # 10 s, to share the program of the runs above; 2 s are asked for.
    return solve("stiff", "consistent", alpha, h=0.01, steps=1000)


def test_energy_consistent_passes_the_stiff_pendulum_with_a_long_step():
    solution = stiff()
    assert solution.stats.completed_steps >= 200
    assert np.all(np.isfinite(solution.ys.q[:201]))
    round_off = 20 * EPS * TURNOVER["stiff"]
    assert np.max(np.diff(solution.audit.energy[:201])) <= round_off
    assert np.max(np.abs(solution.audit.constraint[:201])) <= 1e-11
    # Solver: the velocity of the light mass is a hundred times that of free fall.
    assert np.max(np.abs(solution.audit.constraint_rate[:201])) <= SOLVER_VELOCITY


def test_index3_without_dissipation_locks():
    """The motion stalls while energy and position constraint look perfect."""
    solution = run("pendulum", "decaying index3", 0.0)
    free = run("pendulum", "decaying", 0.0)
    last = slice(250, None)
    assert np.max(np.abs(free.ys.q[last, 0])) > 0.9
    # From the first swing on the point hangs still, long before the end of the run.
    assert np.max(np.abs(solution.ys.q[last, 0])) < 1e-3
    assert np.all(solution.ys.q[last, 1] > 0.999)
    # Its velocity is all along the rod, and holds the energy that the motion has lost.
    v = solution.ys.v[last]
    assert np.max(np.abs(v[:, 0])) < 1e-2
    np.testing.assert_allclose(v[:, 1] ** 2 / 2, 9.81, rtol=1e-3)
    assert np.max(np.abs(solution.audit.constraint_rate)) > 5
    assert abs(change(solution)) <= SOLVER_ENERGY * TURNOVER["pendulum"]


CORRECTED = [
    ej.EnergyConsistent(0.0),
    ej.EnergyConsistent(0.7),
    ej.EnergyDecaying(0.5, derivative=ej.MeanValue()),
    ej.EnergyPreserving(derivative=ej.Gonzalez()),
]


@pytest.mark.parametrize("coordinates", ["apart", "mixed"])
@pytest.mark.parametrize("scheme", CORRECTED, ids=str)
def test_a_heavy_body_does_not_drive_a_light_one(scheme, coordinates):
    """A pendulum beside an anharmonic oscillator with which it has nothing in common."""
    # The coordinates may be those of the two, or their sum and their difference.
    parts = np.eye(2) if coordinates == "apart" else np.array([[0.5, 0.5], [0.5, -0.5]])
    wells = lambda q: 0.25 * q**4 + 1 - jnp.cos(2 * q)
    bodies = lambda x: jnp.asarray(parts) @ x
    weighted = lambda x, m: x @ (jnp.array([1.0, m]) * x)
    system = ej.System(
        lambda v, m: 0.5 * weighted(bodies(v), m),
        lambda q, m: wells(bodies(q)[0]) + m * (1 - jnp.cos(bodies(q)[1])),
    )
    to_user = np.linalg.inv(parts)
    start = ej.State(to_user @ np.array([1.0, 2.0]), to_user @ np.array([1.0, 0.0]))
    run = lambda m: ej.simulate(system, scheme, start, m, h=0.05, num_steps=200)
    angle = lambda m: float(bodies(run(m).ys.q[-1])[1])
    rates = lambda t, y: [y[1], -np.sin(y[0])]
    exact = solve_ivp(rates, (0, 10), [2.0, 0.0], "DOP853", rtol=1e-12, atol=1e-12).y[0, -1]
    equal, light = (abs(angle(m) - exact) for m in (1.0, 1e-7))
    # Truncation. With a correction in the metric of the coordinates it is 1e5 times that of
    # equal masses.
    assert light < 2 * equal


@pytest.mark.parametrize("kind", ["quaternion", "rod", "directors"])
def test_a_heavy_oscillator_does_not_turn_a_light_body(kind):
    """A free body that spins evenly about a principal axis."""
    wells = lambda x: 0.25 * x**4 + 1 - jnp.cos(2 * x)
    if kind == "quaternion":
        light = jnp.array([1e-6, 1e-6, 2e-6])
        spins = lambda q: 2 * jnp.array([
            [-q[1], q[0], q[3], -q[2]],
            [-q[2], -q[3], q[0], q[1]],
            [-q[3], q[2], -q[1], q[0]],
        ])  # fmt: skip
        system = ej.System(
            lambda v, _: 0.5 * (v[:3] @ (light * v[:3]) + v[3] ** 2),
            lambda q, _: wells(q[4]),
            kinematics=lambda q, _: (
                jnp.zeros((4, 5)).at[:3, :4].set(spins(q)).at[3, 4].set(1)
            ),
            coordinate_constraint=lambda q, _: (q[:4] @ q[:4] - 1)[None],
        )
        start = ej.State([1.0, 0, 0, 0, 1.0], [0, 0, 2.0, 1.0])
        spin = lambda ys: ys.v[:, 2]
    else:
        moments = jnp.array([1e-6, 1e-6, 1.0])  # second moments of a thin rod

        def kinetic(v, _):
            axes = jnp.sum(moments[:, None] * v[3:12].reshape(3, 3) ** 2)
            return 0.5 * (v[:3] @ v[:3] + axes + v[12] ** 2)

        body = [list(range(12))]
        system = ej.System(kinetic, lambda q, _: wells(q[12]), rigid_bodies=body)
        axes = np.eye(3)
        rates = np.cross([0.0, 0.0, 2.0], axes)
        poses = [np.zeros(3), axes.ravel(), [1.0]], [np.zeros(3), rates.ravel(), [1.0]]
        q, v = map(np.concatenate, poses)
        start = ej.State(q, v)
        spin = lambda ys: 0.5 * (
            jnp.cross(ys.q[:, 3:6], ys.v[:, 3:6]) + jnp.cross(ys.q[:, 6:9], ys.v[:, 6:9])
        )[:, 2]  # fmt: skip
    scheme = ej.EnergyPreserving(derivative=ej.Gonzalez())
    if kind == "directors":
        scheme = ej.EnergyConsistent(0.0)
    sol = ej.simulate(system, scheme, start, h=0.05, num_steps=100)
    # Truncation. In the metric of the coordinates the spin is between -30 and 30.
    np.testing.assert_allclose(spin(sol.ys), 2.0, rtol=2e-3)
