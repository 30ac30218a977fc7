"""Nonholonomic constraints: knife edges, rolling, and the stability of steady motions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej


# The Chaplygin sleigh: a body with an edge at a distance behind its mass centre ---------

MASS, INERTIA, ARM = 1.3, 0.4, 0.7
ARGS = dict(arm=ARM)
# The start: the velocity of the edge, and the angular velocity.
U0, W0, ANGLE = -0.4, 1.1, 0.3


def no_sideslip(q, args):
    sine, cosine = jnp.sin(q[2]), jnp.cos(q[2])
    return jnp.stack([-sine, cosine, -args["arm"]])[None]


SLEIGH = ej.System(
    np.diag([MASS, MASS, INERTIA]), lambda q, args: 0.0 * q[0], nonholonomic=no_sideslip
)


def sleigh_at(u, w, arm=ARM):
    sine, cosine = np.sin(ANGLE), np.cos(ANGLE)
    v = [u * cosine - arm * w * sine, u * sine + arm * w * cosine, w]
    return ej.State(jnp.array([0.0, 0.0, ANGLE]), jnp.stack([jnp.asarray(x) for x in v]))


def edge_velocities(ys):
    """`u` and `w` along a run."""
    angle, v = ys.q[..., 2], ys.v
    return jnp.cos(angle) * v[..., 0] + jnp.sin(angle) * v[..., 1], v[..., 2]


def exact_velocities(t):
    """The closed form: `u = U tanh(kt + c)`, `w` likewise with the hyperbolic secant."""
    energy = 0.5 * MASS * U0**2 + 0.5 * (INERTIA + MASS * ARM**2) * W0**2
    top = np.sqrt(2 * energy / MASS)
    k = MASS * ARM * top / (INERTIA + MASS * ARM**2)
    phase = k * t + np.arctanh(U0 / top)
    spin = np.sqrt(2 * energy / (INERTIA + MASS * ARM**2))
    return top * np.tanh(phase), spin / np.cosh(phase)


def sleigh_run(scheme, h, num_steps, system: Any = SLEIGH, start=None, args=ARGS):
    start = sleigh_at(U0, W0) if start is None else start
    return ej.simulate(system, scheme, start, args, h=h, num_steps=num_steps)


def error_of(sol):
    pairs = zip(edge_velocities(sol.ys), exact_velocities(np.asarray(sol.ts)), strict=True)
    return max(np.abs(np.asarray(a) - b).max() for a, b in pairs)


PRESERVING = ej.EnergyPreserving()


@pytest.fixture(scope="module")
def sleigh():
    return sleigh_run(PRESERVING, 0.05, 60)


@pytest.mark.parametrize(
    ("scheme", "order", "bound"),
    [
        (PRESERVING, 2, 1e-3),
        pytest.param(ej.Composed(PRESERVING, 4), 4, 1e-7, marks=pytest.mark.slow),
        (ej.EnergyDecaying(0.0), 2, 1e-3),
        pytest.param(ej.Rattle(), 2, 1e-3, marks=pytest.mark.slow),
    ],
    ids=["preserving", "composed", "decaying", "rattle"],
)
@pytest.mark.slow_for("decaying")
def test_the_sleigh_converges_to_its_closed_form(scheme, order, bound):
    errors = [error_of(sleigh_run(scheme, 3 / n, n)) for n in (30, 60)]
    # Truncation.
    assert errors[0] < bound
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.05)


def test_the_sleigh_keeps_energy_and_both_forms_of_its_constraint(sleigh):
    audit, q = sleigh.audit, np.asarray(sleigh.ys.q)
    # Round-off, of an energy of 0.7.
    assert np.abs(audit.energy - audit.energy[0]).max() < 2e-15
    assert np.abs(audit.constraint_rate).max() < 2e-15
    assert (audit.constraint_rate.shape, audit.constraint.shape) == ((61, 1), (61, 0))
    middle, step = 0.5 * (q[1:] + q[:-1]), np.diff(q, axis=0)
    slips = [no_sideslip(x, ARGS)[0] @ dx for x, dx in zip(middle, step, strict=True)]
    assert np.abs(slips).max() < 1e-15
    assert sleigh.multipliers.shape == (61, 1)


def test_the_multiplier_is_the_force_on_the_edge(sleigh):
    # Across the edge, Newton's law for the mass centre says force = m (u w + a wdot).
    u, w = exact_velocities(0.05 * (np.arange(60) + 0.5))
    slope = -MASS * ARM / (INERTIA + MASS * ARM**2) * u * w
    force = MASS * (u * w + ARM * slope)
    # Truncation: multipliers are those of the middle of a step.
    np.testing.assert_allclose(-sleigh.multipliers[1:, 0], force, atol=2e-3)


@pytest.mark.slow
def test_volume_is_not_preserved():
    def end(x):
        return jnp.stack(edge_velocities(jax.tree.map(lambda y: y[-1], run(x).ys)))

    def run(x):
        start = sleigh_at(x[0], x[1])
        return sleigh_run(ej.Composed(PRESERVING, 4), 0.05, 40, start=start)

    volume = np.linalg.det(jax.jacfwd(end)(jnp.array([U0, W0])))
    # The divergence of the flow of (u, w) is -m a u / (I + m a^2), and u = U tanh.
    times = np.linspace(0, 2, 2001)
    rate = -MASS * ARM / (INERTIA + MASS * ARM**2) * exact_velocities(times)[0]
    # Truncation.
    assert volume == pytest.approx(np.exp(np.trapezoid(rate, times)), rel=1e-6)
    assert abs(volume - 1) > 0.1


def test_energy_decays_by_the_amount_that_the_scheme_reports():
    sol = sleigh_run(ej.EnergyDecaying(1.0), 0.1, 30)
    assert np.abs(sol.audit.leak).max() < 2e-15
    assert np.all(np.asarray(sol.audit.dissipated)[1:] > 0)
    assert np.abs(sol.audit.constraint_rate).max() < 2e-15


@pytest.mark.slow
def test_a_knife_edge_of_a_scene_is_the_sleigh(tmp_path):
    """With the same turn of a body in a step, which is not that of an angle of a system."""
    body = ej.System(
        SLEIGH.kinetic, SLEIGH.potential, nonholonomic=no_sideslip, rigid_bodies=[[0, 1, 2]]
    )
    sleigh = sleigh_run(PRESERVING, 0.05, 60, body)
    start = sleigh_at(U0, W0)
    body = ej.bodies.PlanarBody(
        "sleigh", MASS, INERTIA, start.q[:2], ANGLE,
        velocity=start.v[:2], angular_velocity=W0,
    )  # fmt: skip
    scene = ej.Scene(
        [body, ej.joints.KnifeEdge("edge", "ground", "sleigh", point_b=[-ARM, 0])]
    )
    system, start, args = scene.build()
    sol = sleigh_run(PRESERVING, 0.05, 60, system, start, args)
    # Round-off.
    np.testing.assert_allclose(sol.ys.q, sleigh.ys.q, atol=1e-13)
    np.testing.assert_allclose(
        scene.multipliers(sol, "edge"), sleigh.multipliers, atol=1e-12
    )
    force = scene.reaction(sol, "edge").force[1:]
    np.testing.assert_allclose(
        np.linalg.norm(force, axis=1), np.abs(sleigh.multipliers[1:, 0]), atol=1e-12
    )
    assert "nonholonomic[0:1]" in str(scene)
    assert scene.mobility().degrees_of_freedom == 2
    sol.to_csv(tmp_path / "run.csv")
    header = (tmp_path / "run.csv").read_text().splitlines()[0].split(",")
    found = [name for name in header if name.endswith("edge.slip")]
    assert found == ["multiplier.edge.slip", "constraint_rate.edge.slip"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lagrangian", "hamiltonian"])
def test_systems_with_momenta(kind, sleigh):
    inertia, start = jnp.array([MASS, MASS, INERTIA]), sleigh_at(U0, W0)
    if kind == "lagrangian":
        system = ej.System.from_lagrangian(
            lambda q, v, args: 0.5 * jnp.sum(inertia * v**2),
            lambda q, args: 0.0 * q[0],
            nonholonomic=no_sideslip,
        )
        sol = sleigh_run(PRESERVING, 0.05, 60, system)
    else:
        system = ej.System.from_hamiltonian(
            lambda q, p, args: 0.5 * jnp.sum(p**2 / inertia), nonholonomic=no_sideslip
        )
        start = ej.State(start.q, inertia * start.v)
        sol = sleigh_run(PRESERVING, 0.05, 60, system, start)
    # Round-off: with constant inertia these are the same equations.
    np.testing.assert_allclose(sol.ys.q, sleigh.ys.q, atol=1e-12)
    assert np.abs(sol.audit.leak).max() < 5e-15


def test_reverse_derivatives_and_batches(sleigh):
    def end(arm):
        start, args = sleigh_at(U0, W0, arm), dict(arm=arm)
        return sleigh_run(PRESERVING, 0.05, 60, start=start, args=args).ys.v[-1, 0]

    arms = jnp.array([ARM - 1e-4, ARM, ARM + 1e-4])
    values, slopes = map(np.asarray, jax.vmap(jax.value_and_grad(end))(arms))
    # Truncation of the difference. (Forward derivatives: the volume above.)
    assert slopes[1] == pytest.approx((values[2] - values[0]) / 2e-4, rel=1e-6)
    # Round-off.
    assert values[1] == pytest.approx(float(sleigh.ys.v[-1, 0]), abs=1e-13)


@pytest.mark.slow
def test_an_elastic_impact_respects_the_knife_edge():
    wall = ej.Impact(lambda q, args: 1.0 - q[0], 1.0)
    start = sleigh_at(1.5, 0.2)
    sol: Any = ej.simulate(
        SLEIGH, PRESERVING, start, ARGS, h=0.05, num_steps=40, events=wall, max_events=5
    )
    assert sol.events.count >= 1
    before, after = sol.events.before, sol.events.after
    # Round-off.
    assert after.v[0, 0] == pytest.approx(float(-before.v[0, 0]), rel=1e-12)
    assert abs((no_sideslip(after.q[0], ARGS) @ after.v[0])[0]) < 1e-14
    assert np.abs(sol.audit.energy - sol.audit.energy[0]).max() < 1e-14
    assert np.abs(sol.audit.constraint_rate).max() < 1e-14


# Starts and refusals ----------------------------------------------------------------------


def test_starts_are_projected_and_checked():
    found = ej.consistent_start(SLEIGH, [0.0, 0.0, ANGLE], [1.0, 0.0, W0], ARGS)
    rate = lambda v: (no_sideslip(found.state.q, ARGS) @ v)[0]
    assert found.rate_before[0] == pytest.approx(rate(jnp.array([1.0, 0.0, W0])))
    assert abs(found.rate_after[0]) < 1e-15
    # The nearest in the metric of the inertia: the change is along M^-1 A^T.
    change = np.array([1.0, 0.0, W0]) - np.asarray(found.state.v)
    change = change * np.array([MASS, MASS, INERTIA])
    row = np.asarray(no_sideslip(found.state.q, ARGS)[0])
    assert np.linalg.norm(np.cross(change, row)) < 1e-15
    # The accelerations are those of the closed form.
    u, w = edge_velocities(found.state)
    slope = -MASS * ARM / (INERTIA + MASS * ARM**2) * u * w
    assert found.accelerations[2] == pytest.approx(float(slope), rel=1e-13)
    bad = ej.State(found.state.q, jnp.array([1.0, 0.0, W0]))
    sol = ej.simulate(SLEIGH, PRESERVING, bad, ARGS, h=0.1, num_steps=2, throw=False)
    assert sol.result == ej.RESULTS.inconsistent_start


@pytest.mark.parametrize(
    ("matrix", "match"),
    [
        (lambda q, args: q, "`nonholonomic`.*3 columns"),
        (lambda q, args: jnp.zeros((1, 2)), "3 columns"),
        (lambda q, args: jnp.zeros((1, 3)), "is zero at the start"),
        (lambda q, args: jnp.full((1, 3), jnp.nan), "not finite at the start"),
        (lambda q, args: jnp.ones((2, 3)), "rank 1, of 2 rows"),
        (lambda q, args: jnp.ones((4, 3)), "4 constraints of 3 coordinates"),
    ],
)
def test_wrong_matrices_are_refused(matrix, match):
    system = ej.System(np.eye(3), lambda q, args: 0.0 * q[0], nonholonomic=matrix)
    with pytest.raises(ValueError, match=match):
        ej.initial_state(system, jnp.zeros(3), jnp.zeros(3))


def test_what_cannot_be_used_is_refused():
    start = sleigh_at(U0, W0)
    for scheme in (
        ej.EnergyConsistent(0.0),
        ej.KappaDecaying(0.0),
        ej.GeneralizedAlpha(0.8),
    ):
        with pytest.raises(ValueError, match="cannot be used with `nonholonomic`"):
            ej.simulate(SLEIGH, scheme, start, ARGS, h=0.1, num_steps=1)
    with pytest.raises(ValueError, match="`eigenvalues` finds"):
        ej.modes(SLEIGH, start, ARGS)
    with pytest.raises(ValueError, match="family of equilibria"):
        ej.equilibrium(SLEIGH, start, ARGS)
    matrix: Any = np.ones((1, 3))
    with pytest.raises(TypeError, match="`nonholonomic` must be a function"):
        ej.System(np.eye(3), lambda q, args: 0.0 * q[0], nonholonomic=matrix)


# A disc that rolls in a circle ----------------------------------------------------------

# R. I. Leine and others (2005): the lean, the radius of the circle of the contact, and the
# heading rate of a steady motion; the last is recomputed.
DISC_MASS, RADIUS, LEAN, CIRCLE = 0.3048, 0.05, np.deg2rad(5.0), 0.5
TURN = 1.07364981632612


def disc_scene(body: Any = ej.bodies.RigidBody):
    spin = -TURN * CIRCLE / RADIUS
    sine, cosine = np.sin(LEAN), np.cos(LEAN)
    axle, down = np.array([cosine, 0, sine]), np.array([sine, 0, -cosine])
    distance = CIRCLE - RADIUS * sine
    moments = DISC_MASS * RADIUS**2 * np.array([0.25, 0.25, 0.5])
    disc = body(
        "disc", DISC_MASS, moments, [distance, 0, RADIUS * cosine],
        np.stack([down, np.cross(axle, down), axle], axis=1),
        velocity=[0, TURN * distance, 0],
        angular_velocity=TURN * np.array([0, 0, 1]) + spin * axle,
    )  # fmt: skip
    contact = ej.joints.RollingDisc("contact", "ground", "disc", RADIUS, axis_b=[0, 0, 1])
    return ej.Scene([disc, contact], gravity=[0, 0, -9.81])


@pytest.fixture(scope="module")
def disc():
    scene = disc_scene()
    return scene, *scene.build()


def disc_symmetries(q, args):
    """A rotation of space about the vertical, and one of the disc about its axle."""
    x = q.reshape(4, 3)
    turned = jnp.cross(jnp.array([[0.0, 0.0, 1.0]]), x)
    spun = jnp.concatenate([jnp.zeros((1, 3)), jnp.cross(x[3:], x[1:])])
    return jnp.stack([turned.ravel(), spun.ravel()])


@pytest.mark.slow
def test_the_nutation_of_a_rolling_disc(disc):
    _, system, start, args = disc
    found = np.asarray(ej.eigenvalues(system, start, args, symmetry=disc_symmetries))
    # Two are those of the centre of the circle, which rests, in axes that turn.
    wanted = sorted([*nutation(), 1j * TURN, -1j * TURN], key=lambda x: x.imag)
    # Round-off of a double eigenvalue zero.
    found = np.array(sorted(found, key=lambda x: x.imag))
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert abs(found[-1] - wanted[-1]) < 1e-11


def nutation():
    """The eigenvalues of the lean `b` and of the angular velocities of the disc, from
    Euler's equations: `r` along the horizontal diameter, `c` along the steepest one, `n`
    along the axle."""

    def rates(x):
        b, r, c, n = x
        pull = -9.81 / RADIUS * np.sin(b) - 1.5 * c * n + 0.25 * c**2 * np.tan(b)
        return np.array([-r, pull / 1.25, 2 * n * r - c * r * np.tan(b), c * r / 1.5])

    x = np.array([LEAN, 0, TURN * np.cos(LEAN), TURN * (np.sin(LEAN) - CIRCLE / RADIUS)])
    assert np.abs(rates(x)).max() < 1e-12
    columns = [np.imag(rates(x + 1e-30j * e)) / 1e-30 for e in np.eye(4)]
    return np.linalg.eigvals(np.stack(columns, axis=1))


@pytest.mark.slow
def test_eigenvalues_of_the_disc_in_euler_parameters():
    scene = disc_scene(ej.bodies.QuaternionBody)
    system, start, args = scene.build()

    def symmetries(q, args):
        up = ej.scenes.rotation(q[3:])[2]  # the vertical in the axes of the disc
        turned = jnp.concatenate([jnp.stack([-q[1], q[0], 0.0 * q[0]]), up])
        return jnp.stack([turned, jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])])

    found = np.asarray(ej.eigenvalues(system, start, args, symmetry=symmetries))
    assert max(x.imag for x in found) == pytest.approx(max(x.imag for x in nutation()))


@pytest.mark.slow
def test_states_without_eigenvalues_are_refused(disc):
    _, system, start, args = disc
    with pytest.raises(ValueError, match="along no symmetry"):
        ej.eigenvalues(system, start, args)
    faster = ej.State(start.q, 1.1 * start.v)
    with pytest.raises(ValueError, match="out of balance"):
        ej.eigenvalues(system, faster, args, symmetry=disc_symmetries)

    def with_roll(q, args):  # a rotation about a horizontal axis, which gravity forbids
        x = q.reshape(4, 3)
        rolled = jnp.cross(jnp.array([[1.0, 0.0, 0.0]]), x)
        return jnp.concatenate([disc_symmetries(q, args), rolled.ravel()[None]])

    with pytest.raises(ValueError, match="is no symmetry"):
        ej.eigenvalues(system, start, args, symmetry=with_roll)


def test_a_damped_oscillator_has_its_eigenvalues():
    system = ej.System(
        np.eye(1),
        lambda q, args: 2.0 * q[0] ** 2,
        force=lambda q, v, t, args: -0.6 * v,
    )
    found = ej.eigenvalues(system, ej.State(jnp.zeros(1), jnp.zeros(1)))
    wanted = -0.3 + 1j * np.sqrt(4 - 0.09) * np.array([1, -1])
    np.testing.assert_allclose(sorted(found, key=lambda x: -x.imag), wanted, rtol=1e-14)


@pytest.mark.slow
def test_a_disc_rolls_steadily_in_a_circle(disc):
    scene, system, start, args = disc
    # Round-off: the poses of the scene satisfy the constraints.
    np.testing.assert_allclose(start.v, scene.v, atol=1e-15)
    found = ej.consistent_start(system, start.q, start.v, args)
    pull = TURN**2 * (CIRCLE - RADIUS * np.sin(LEAN))
    # Round-off of the published rate, which has fifteen digits.
    np.testing.assert_allclose(found.accelerations[:3], [-pull, 0, 0], atol=1e-13)
    force = scene.reaction(found, "contact").force
    np.testing.assert_allclose(force, [-DISC_MASS * pull, 0, DISC_MASS * 9.81], atol=1e-13)


@pytest.mark.slow
def test_a_turn_of_the_rolling_disc(disc):
    _, system, start, args = disc
    height, period = RADIUS * np.cos(LEAN), 2 * np.pi / TURN
    assert (height, period) == pytest.approx((0.04980973490458728, 5.852173782956319))
    errors = []
    for n in (500, 1000):
        scheme = ej.Composed(PRESERVING, 4)
        sol = ej.simulate(system, scheme, start, args, h=period / n, num_steps=n)
        # Round-off.
        assert np.abs(sol.audit.leak).max() < 1e-15
        assert np.abs(sol.audit.constraint_rate).max() < 3e-14
        errors.append(np.abs(np.asarray(sol.ys.q[:, 2]) - height).max())
    # Truncation.
    assert errors[1] < 1e-9
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.1)


@pytest.mark.slow
def test_kinds_of_bodies_and_schemes_agree_on_the_rolling_disc():
    ends = []
    for body, scheme in (
        (ej.bodies.RigidBody, ej.Composed(PRESERVING, 4)),
        (ej.bodies.QuaternionBody, ej.Composed(PRESERVING, 4)),
        (ej.bodies.RigidBody, ej.EnergyDecaying(1.0)),
    ):
        scene = disc_scene(body)
        system, start, args = scene.build()
        # A push, so that the disc nutates.
        push = np.zeros(start.v.size)
        push[:3] = [0.05, 0.02, 0.0]
        start = ej.initial_state(system, start.q, start.v + push, args)
        sol = ej.simulate(system, scheme, start, args, h=2e-3, num_steps=50)
        # Round-off.
        assert np.abs(sol.audit.leak).max() < 1e-15
        assert np.abs(sol.audit.constraint_rate).max() < 1e-13
        ends.append(np.asarray(sol.ys.q[-1, :3]))
    # Truncation.
    assert np.abs(ends[1] - ends[0]).max() < 1e-8
    assert np.abs(ends[2] - ends[0]).max() < 1e-4


# Other contacts -------------------------------------------------------------------------


@pytest.mark.slow
def test_a_wheel_rolls_down_an_incline():
    slope, radius, inertia = 0.4, 0.3, 0.02
    normal = np.array([-np.sin(slope), np.cos(slope)])
    wheel = ej.bodies.PlanarBody("wheel", 2.0, inertia, radius * normal)
    contact = ej.joints.RollingDisc("rolls", "ground", "wheel", radius, normal=normal)
    scene = ej.Scene([wheel, contact], gravity=[0.0, -9.81])
    system, start, args = scene.build()
    fall = 9.81 * np.sin(slope) / (1 + inertia / (2.0 * radius**2))
    down = -np.array([np.cos(slope), np.sin(slope)])
    errors = []
    for steps in (20, 40):
        sol = ej.simulate(
            system, PRESERVING, start, args, h=1 / steps, num_steps=40, throw=False
        )
        path = np.asarray(sol.ys.q[: steps + 1, :2]) - radius * normal
        rolled = 0.5 * fall * np.asarray(sol.ts[: steps + 1])[:, None] ** 2
        friction = np.asarray(scene.reaction(sol, "rolls").force[1 : steps + 1]) @ down
        exact = 2.0 * (fall - 9.81 * np.sin(slope))
        errors.append([np.abs(path - rolled * down).max(), np.abs(friction - exact).max()])
        assert np.abs(sol.audit.leak).max() < 1e-13  # round-off of 40 J
    # Truncation: a wheel turns by `2 atan(h w/2)` in a step.
    assert max(errors[1]) < 1e-2
    np.testing.assert_allclose(np.log2(np.divide(*errors)), 2, atol=0.1)


@pytest.mark.slow
def test_a_ball_on_a_turntable_circles_at_two_sevenths_of_its_rate():
    """E. J. Routh: whatever the start is. The plane belongs to a body that moves."""
    rate, radius, speed = 3.0, 0.1, np.array([0.2, -0.1, 0.0])
    place = np.array([0.3, 0.1, radius])
    table = ej.bodies.RigidBody(
        "table", 1.0, [1.0, 1.0, 1.5], [0, 0, 0], angular_velocity=[0, 0, rate]
    )
    # The velocity of the table below the ball, and a rotation that rolls.
    below = np.cross([0, 0, rate], place)
    spin = np.cross([0, 0, 1.0], speed - below) / radius
    ball = ej.bodies.RigidBody(
        "ball", 0.5, 0.4 * 0.5 * radius**2 * np.ones(3), place,
        velocity=speed, angular_velocity=spin,
    )  # fmt: skip
    scene = ej.Scene(
        [
            table,
            ball,
            ej.joints.Revolute("bearing", "ground", "table", [0, 0, 0], axis=[0, 0, 1]),
            ej.drives.Angle(
                "turns", "ground", "table", lambda t, args: rate * t, axis=[0, 0, 1]
            ),
            ej.joints.RollingSphere("rolls", "table", "ball", radius),
        ],
        gravity=[0, 0, -9.81],
    )
    system, start, args = scene.build()
    scheme = ej.Composed(PRESERVING, 4)
    sol = ej.simulate(system, scheme, start, args, h=0.01, num_steps=100)
    phase = 2 / 7 * rate * np.asarray(sol.ts)
    turned = np.stack([np.cos(phase), np.sin(phase)], axis=1) * speed[0]
    turned += np.stack([-np.sin(phase), np.cos(phase)], axis=1) * speed[1]
    velocity = scene.velocity(sol.ys, "ball")[:, :2]
    # Truncation.
    np.testing.assert_allclose(velocity, turned, atol=1e-5)
    assert np.abs(sol.audit.leak).max() < 1e-13
    assert np.abs(sol.audit.constraint_rate).max() < 1e-13


@pytest.mark.slow
def test_a_skate_in_space_is_the_sleigh(sleigh):
    moments, start = [INERTIA, INERTIA, INERTIA], sleigh_at(U0, W0)
    sine, cosine = np.sin(ANGLE), np.cos(ANGLE)
    body = ej.bodies.RigidBody(
        "skate", MASS, moments, [0, 0, 0],
        np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]),
        velocity=[*start.v[:2], 0], angular_velocity=[0, 0, W0],
    )  # fmt: skip
    ice = ej.joints.Planar("ice", "ground", "skate", axis=[0, 0, 1])
    edge = ej.joints.KnifeEdge(
        "edge", "ground", "skate", axis_b=[0, 1, 0], point_b=[-ARM, 0, 0]
    )
    system, start, args = ej.Scene([body, ice, edge]).build()
    scheme = ej.Composed(PRESERVING, 4)
    sol = ej.simulate(system, scheme, start, args, h=0.05, num_steps=60)
    u, w = exact_velocities(np.asarray(sol.ts))
    x = np.asarray(sol.ys.q).reshape(-1, 4, 3)
    v = np.asarray(sol.ys.v).reshape(-1, 4, 3)
    # Truncation.
    np.testing.assert_allclose(np.sum(v[:, 0] * x[:, 1], axis=1), u, atol=1e-6)
    np.testing.assert_allclose(np.sum(v[:, 1] * x[:, 2], axis=1), w, atol=1e-6)
    assert np.abs(sol.audit.leak).max() < 1e-14


@pytest.mark.slow
def test_impossible_contacts_are_refused():
    flat = ej.bodies.RigidBody("disc", 1.0, [1.0, 1.0, 1.5], [0, 0, 0.0])
    below = ej.bodies.RigidBody("disc", 1.0, [1.0, 1.0, 1.5], [0, 0, -0.5])
    high = ej.bodies.RigidBody("disc", 1.0, [1.0, 1.0, 1.5], [0, 0, 0.7])
    slips = ej.bodies.RigidBody(
        "disc", 1.0, [1.0, 1.0, 1.5], [0, 0, 0.5],
        velocity=[1, 0, 0], angular_velocity=[0, 0, 0],
    )  # fmt: skip
    disc = lambda **options: ej.joints.RollingDisc("c", "ground", "disc", 0.5, **options)
    for body, contact, match in (
        (flat, disc(axis_b=[0, 0, 1]), "'c' lies flat"),
        (below, disc(axis_b=[0, 1, 0]), "below its plane"),
        (high, disc(axis_b=[0, 1, 0]), "'c' is off by"),
        (flat, disc(), "needs `axis_b`, the axle"),
        (flat, disc(axis_b=[0, 0, 0]), "must not be zero"),
        (flat, ej.joints.KnifeEdge("c", "ground", "disc"), "direction across the edge"),
    ):
        with pytest.raises(ValueError, match=match):
            ej.Scene([body, contact])
    with pytest.raises(ValueError, match="velocities of the bodies do not fit 'c'"):
        ej.Scene([slips, disc(axis_b=[0, 1, 0])]).start()


# A bicycle ------------------------------------------------------------------------------

# J. P. Meijaard, J. M. Papadopoulos, A. Ruina and A. L. Schwab, Proc. R. Soc. A 463 (2007)
# 1955-1982: the benchmark, and its eigenvalues with more digits.
WEAVE = {
    0.0: [5.530943717654, 3.131643247907, -3.131643247907, -5.530943717654],
    3.0: [
        1.706756056640 + 2.315824473843j, 1.706756056640 - 2.315824473843j,
        -2.633661372537, -10.351014672459,
    ],
    5.0: [
        -0.322866429004, -0.775341882196 + 4.464867713788j,
        -0.775341882196 - 4.464867713788j, -14.078389692798,
    ],
}  # fmt: skip


def bicycle(speed):
    """The benchmark, with the third axis upwards."""
    base, trail, tilt, rear, front = 1.02, 0.08, np.pi / 10, 0.3, 0.35
    rigid = lambda name, mass, moments, place, spin=0.0: ej.bodies.RigidBody(
        name, mass, moments, place, velocity=[speed, 0, 0], angular_velocity=[0, spin, 0]
    )
    frame = [[9.2, 0, -2.4], [0, 11, 0], [-2.4, 0, 2.8]]
    fork = [[0.05892, 0, 0.00756], [0, 0.06, 0], [0.00756, 0, 0.00708]]
    head, ahead = [base + trail - 0.3, 0, -0.9], [-np.sin(tilt), 0, np.cos(tilt)]
    hub = dict(point_b=[0, 0, 0], axis=[0, 1, 0])
    disc, hinge = ej.joints.RollingDisc, ej.joints.Revolute
    parts = [
        rigid("rear", 2, [0.0603, 0.12, 0.0603], [0, 0, rear], speed / rear),
        rigid("frame", 85, frame, [0.3, 0, 0.9]),
        rigid("fork", 4, fork, [0.9, 0, 0.7]),
        rigid("front", 3, [0.1405, 0.28, 0.1405], [base, 0, front], speed / front),
        hinge("rear hub", "frame", "rear", **hub),
        hinge("head", "frame", "fork", point_a=head, axis=ahead),
        hinge("front hub", "fork", "front", **hub),
        disc("rear contact", "ground", "rear", rear, axis_b=[0, 1, 0]),
        disc("front contact", "ground", "front", front, axis_b=[0, 1, 0]),
    ]
    return ej.Scene(parts, gravity=[0, 0, -9.81])


def bicycle_symmetries(q, args):
    """Translations along the ground, a rotation about the vertical, and those of wheels."""
    x = q.reshape(4, 4, 3)
    along = [jnp.zeros_like(x).at[:, 0, k].set(1) for k in (0, 1)]
    turned = jnp.cross(jnp.array([[[0.0, 0.0, 1.0]]]), x)
    spun = [
        jnp.zeros_like(x).at[k, 1:].set(jnp.cross(x[k, 2][None], x[k, 1:])) for k in (0, 3)
    ]
    return jnp.stack([row.ravel() for row in (*along, turned, *spun)])


@pytest.mark.slow
def test_eigenvalues_of_the_benchmark_bicycle():
    for speed, wanted in WEAVE.items():
        system, start, args = bicycle(speed).build()
        found = ej.eigenvalues(system, start, args, symmetry=bicycle_symmetries)
        found = np.asarray(found)
        # A change of the speed is neutral.
        assert np.abs(found).min() < 1e-10
        rest = np.delete(found, np.argmin(np.abs(found)))
        rest = np.array(sorted(rest, key=lambda x: (-round(x.real, 9), -x.imag)))
        # The digits that are given.
        np.testing.assert_allclose(rest, wanted, rtol=0, atol=1e-11)
