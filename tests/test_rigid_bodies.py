"""Rigid bodies in space, which the energy schemes move by Cayley rotations."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import enerjax as ej
from enerjax._system import RigidBodies, RigidKinematics

from .helpers import EPS, long, on_host, slopes


# The algebra of a step, with random numbers -----------------------------------------------

_RNG = np.random.default_rng(5)
TABLES = {
    "one": (np.arange(12)[None], 12),
    # A point mass between two bodies.
    "with point": (np.stack([np.arange(12), np.arange(15, 27)]), 27),
    "scattered": (_RNG.permutation(41)[:36].reshape(3, 12), 41),
}
each_table = pytest.mark.parametrize("table", TABLES)


class Step:
    """Two positions that a random step of `size` connects, with velocities at both ends."""

    def __init__(self, table, size=1.0):
        self.bodies: Any = RigidBodies(*TABLES[table])
        self.kinematics: Any = RigidKinematics(self.bodies)
        self.rng = np.random.default_rng(3)
        self.qa = self.random(self.bodies.num_coordinates)
        count = len(self.bodies.q)
        axes = (
            Rotation.random(count, np.random.default_rng(1)).as_matrix().transpose(0, 2, 1)
        )
        self.qa[self.bodies.q[:, 3:]] = axes.reshape(count, 9)
        self.step = size * self.random()
        change = self.kinematics.displacement(self.qa, self.step)
        self.qb = self.qa + np.asarray(change)
        self.va, self.vb = self.random(), self.random()

    def random(self, size=None):
        return self.rng.normal(size=self.bodies.num_velocities if size is None else size)

    def rates(self, q, v):
        return np.asarray(self.kinematics.user_velocity(q, v))

    def axes(self, q):
        """The directors of the bodies as rows, shape `(bodies, 3, 3)`."""
        return q[self.bodies.q].reshape(-1, 4, 3)[:, 1:]

    def body_inertia(self):
        """A random inertia matrix without products of a body with others."""
        size = self.bodies.num_velocities
        matrix = np.diag(self.rng.uniform(0.5, 2.0, size))
        for v in self.bodies.v:
            root = self.rng.normal(size=(3, 3))
            matrix[np.ix_(v[3:], v[3:])] += root @ root.T
        return matrix


def near(found, expected, scale=1.0):
    """Equal but for round-off."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=100 * EPS * scale)


def test_velocities_have_the_order_of_the_coordinates():
    bodies = Step("with point").bodies
    np.testing.assert_array_equal(bodies.v, [range(6), range(9, 15)])
    np.testing.assert_array_equal(bodies.other_q, [12, 13, 14])
    np.testing.assert_array_equal(bodies.other_v, [6, 7, 8])
    bodies = Step("scattered").bodies
    places = np.concatenate([bodies.v.ravel(), bodies.other_v])
    np.testing.assert_array_equal(np.sort(places), np.arange(3 * 6 + 5))
    firsts = np.append(bodies.q[:, 0], bodies.other_q)
    starts = np.append(bodies.v[:, 0], bodies.other_v)
    np.testing.assert_array_equal(np.argsort(firsts), np.argsort(starts))


@each_table
@pytest.mark.parametrize("size", [1e-9, 1.0, 100.0])
def test_a_step_of_any_length_leaves_directors_orthonormal(table, size):
    step = Step(table, size)
    axes = step.axes(step.qb)
    near(axes @ axes.transpose(0, 2, 1), np.broadcast_to(np.eye(3), axes.shape), 0.1)
    near(np.linalg.det(axes), np.ones(len(axes)), 0.1)
    near(step.bodies.constraint(step.qb), np.zeros(6 * len(axes)), 0.1)


@each_table
def test_a_step_translates_and_rotates_as_the_formula_of_cayley(table):
    step = Step(table)
    change = step.qb - step.qa
    for rows, v in zip(step.bodies.q, step.bodies.v, strict=True):
        near(change[rows[:3]], step.step[v[:3]])
        half = step.step[v[3:]] / 2
        turn = Rotation.from_rotvec(
            2 * np.arctan(np.linalg.norm(half)) * half / np.linalg.norm(half)
        )
        first, last = (q[rows[3:]].reshape(3, 3).T for q in (step.qa, step.qb))
        near(last, first @ turn.as_matrix())
    near(change[step.bodies.other_q], step.step[step.bodies.other_v])


@each_table
def test_pulled_gradients_have_the_work_of_the_gradients(table):
    step = Step(table)
    for _ in range(5):
        gradient = step.random(step.qa.size)
        rows = step.kinematics.pull_back(step.qa, step.qb, step.step, gradient)
        near(rows @ step.step, gradient @ (step.qb - step.qa), 10)
        # A force of the user, conjugate to the rates of the coordinates, has the same rows.
        rows = step.kinematics.pull(step.qa, step.qb, gradient, None)
        near(rows @ step.step, gradient @ (step.qb - step.qa), 10)


@each_table
def test_functions_of_inner_products_exert_no_torque_in_space(table):
    """Of the directors of one body, and of two bodies and their distance."""
    step = Step(table)
    bodies, count = step.bodies, 4 * len(step.bodies.q)
    weights = step.rng.normal(size=(count, count))

    def vectors(q):
        """Differences of mass centres, and directors: they all turn together."""
        x = q[bodies.q].reshape(-1, 4, 3).copy()
        x[:, 0] -= x[0, 0]
        return x.reshape(-1, 3)

    # `sum W_ij x_i . x_j / 2` is quadratic: its discrete gradient is the one in the middle.
    weights += weights.T
    by_vector = weights @ (vectors(step.qa) + vectors(step.qb)) / 2
    by_vector = by_vector.reshape(-1, 4, 3)
    by_vector[0, 0] -= by_vector[:, 0].sum(axis=0)
    gradient = np.zeros_like(step.qa)
    gradient[bodies.q] = by_vector.reshape(-1, 12)
    rows = np.asarray(step.kinematics.pull_back(step.qa, step.qb, step.step, gradient))
    torque = np.zeros(3)
    middle = (step.qa + step.qb) / 2
    for body, v in enumerate(bodies.v):
        force, spin = rows[v[:3]], rows[v[3:]]
        torque += np.cross(middle[bodies.q[body, :3]], force)
        torque += spin @ step.axes(step.qa)[body]
    near(torque, np.zeros(3), 100)
    energy = lambda q: 0.5 * np.sum(weights * (vectors(q) @ vectors(q).T))
    near(rows @ step.step, energy(step.qb) - energy(step.qa), 100)


@each_table
def test_the_change_of_rates_is_that_of_a_rotation_and_of_the_velocities(table):
    """`Y_b - Y_a = theta x Ym + Rm^-T ((W_b - W_a) x e_i)`, in products with any `S`."""
    step = Step(table)
    ends = [ej.State(step.qa, step.va), ej.State(step.qb, step.vb)]
    rates = [step.rates(np.asarray(end.q), np.asarray(end.v)) for end in ends]
    mean = (rates[0] + rates[1]) / 2
    for _ in range(5):
        s = step.random(step.qa.size)
        by_rates = [(end.q, part * s) for end, part in zip(ends, (1.5, 0.5), strict=True)]
        at, rows = step.kinematics.mean_rates(*ends, step.rates, lambda x=by_rates: x)
        near(at(step.random(step.qa.size)), mean)
        momentum = step.kinematics.momentum_of_rates(*by_rates, step.step, None)
        found = rows @ step.step + momentum @ (step.vb - step.va)
        near(found, s @ (rates[1] - rates[0]), 10)


@each_table
def test_velocities_and_rates_of_coordinates_are_inverse(table):
    step = Step(table)
    rates = step.rates(step.qb, step.va)
    near(step.kinematics.velocity(step.qb, rates), step.va)
    for rows, v in zip(step.bodies.q, step.bodies.v, strict=True):
        axes = step.qb[rows[3:]].reshape(3, 3)
        spin = step.va[v[3:]] @ axes
        near(rates[rows[3:]].reshape(3, 3), np.cross(spin, axes))
        near(rates[rows[:3]], step.va[v[:3]])
    # Any rates along which directors stay orthonormal are those of a velocity.
    near(step.rates(step.qb, np.asarray(step.kinematics.velocity(step.qb, rates))), rates)


@each_table
def test_the_work_of_the_change_of_momentum_is_that_of_the_kinetic_energy(table):
    step = Step(table)
    inertia, mean = step.body_inertia(), (step.va + step.vb) / 2
    change = inertia @ (step.vb - step.va)
    energy = lambda v: 0.5 * v @ inertia @ v
    for h in (0.01, 3.0):
        rows = step.kinematics.momentum_change(
            step.qa, step.qb, change, inertia @ mean, h * mean, None
        )
        near(rows @ mean, energy(step.vb) - energy(step.va), 100)


@each_table
def test_the_change_of_momentum_is_that_of_the_momenta_in_space(table):
    step = Step(table)
    inertia = step.body_inertia()
    first, last = inertia @ step.va, inertia @ step.vb
    rows = np.asarray(
        step.kinematics.momentum_change(
            step.qa, step.qb, last - first, (first + last) / 2, step.step, None
        )
    )
    expected = last - first
    for body, v in enumerate(step.bodies.v):
        a, b = step.axes(step.qa)[body], step.axes(step.qb)[body]
        expected[v[3:]] = a @ (b.T @ last[v[3:]] - a.T @ first[v[3:]])
    near(rows, expected, 10)


# A free body -----------------------------------------------------------------------------

SCHEMES = {
    "preserving": ej.EnergyPreserving(),
    "preserving index3": ej.EnergyPreserving("index3"),
    "composed": ej.Composed(ej.EnergyPreserving(), 4),
    "decaying": ej.EnergyDecaying(0.5),
    # Of order 4 here, with the directors as coordinates and constraints between them.
    "consistent": ej.EnergyConsistent(0.0),
}
MOMENTS, SPIN = (0.6, 0.8, 0.3), np.array([1.0, 2.0, 2.0])
# A plate, which has no inertia along its third axis.
PLATE = (0.3, 0.5, 0.8)
START = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
TIME = 5.0


@functools.cache
def free_body(scheme, steps_to_time, moments=MOMENTS):
    body = ej.bodies.RigidBody(
        "body", 2.0, moments, [0.1, 0.2, 0.3], START,
        velocity=[0.5, -1.0, 0.25], angular_velocity=START @ SPIN,
    )  # fmt: skip
    system, start, args = ej.Scene([body]).build()
    h = TIME / steps_to_time
    run = ej.simulate(system, SCHEMES[scheme], start, args, h=h, num_steps=1000)
    return on_host(run)


@functools.cache
def attitude(moments):
    """The rotation at `TIME` by Euler's equations and a quaternion."""
    inertia = np.array(moments)

    def rates(t, y):
        (a, b, c, d), w = y[:4], y[4:]
        turn = np.array([[-b, -c, -d], [a, -d, c], [d, a, -b], [-c, b, a]]) @ w / 2
        return np.append(turn, np.cross(inertia * w, w) / inertia)

    first = np.append(np.roll(Rotation.from_matrix(START).as_quat(), 1), SPIN)
    found = solve_ivp(rates, (0, TIME), first, "DOP853", rtol=1e-13, atol=1e-13)
    return Rotation.from_quat(np.roll(found.y[:4, -1], -1)).as_matrix()


def momenta(run, masses, inertias):
    """Linear and angular momentum about the origin of space, shape `(times, 3)`."""
    q, v = (x.reshape(len(x), -1, 4, 3) for x in (run.ys.q, run.ys.v))
    linear, angular = 0.0, 0.0
    for body, (mass, inertia) in enumerate(zip(masses, inertias, strict=True)):
        x, xdot = q[:, body], v[:, body]
        euler = np.trace(inertia) / 2 * np.eye(3) - inertia
        linear = linear + mass * xdot[:, 0]
        angular = angular + mass * np.cross(x[:, 0], xdot[:, 0])
        for i, j in np.ndindex(3, 3):
            angular = angular + euler[i, j] * np.cross(x[:, 1 + i], xdot[:, 1 + j])
    return linear, angular


def drift(x):
    return np.max(np.abs(x - x[0]))


def largest_leak(run):
    """The energy that a step has changed and its balance does not explain."""
    audit = run.audit
    supplied = audit.work[1:] + audit.drive_work[1:] - audit.dissipated[1:]
    return np.max(np.abs(np.diff(audit.energy) - supplied))


def check_free_body(scheme, order, moments=MOMENTS):
    errors = []
    for steps in (250, 500, 1000):
        run = free_body(scheme, steps, moments)
        # Round-off, a random walk of a thousand steps.
        for momentum in momenta(run, [2.0], [np.diag(moments)]):
            assert drift(momentum) <= 1e-13
        assert largest_leak(run) <= 1e-14
        assert np.max(np.abs(run.audit.constraint)) <= 1e-15
        rotation = run.ys.q[steps, 3:].reshape(3, 3).T
        errors.append(np.max(np.abs(rotation - attitude(moments))))
    assert slopes(errors) == pytest.approx([order] * 2, abs=0.1)
    return errors


@pytest.mark.parametrize(
    ("scheme", "moments", "order", "error"),
    [
        ("preserving", MOMENTS, 2, 3e-4),
        ("preserving", PLATE, 2, 4e-4),
        ("composed", MOMENTS, 4, 1e-9),
        ("composed", PLATE, 4, 2e-9),
    ],
)
def test_a_free_body_turns_as_eulers_equations(scheme, moments, order, error):
    assert check_free_body(scheme, order, moments)[-1] <= error  # truncation
    energy = free_body(scheme, 1000, moments).audit.energy
    assert drift(energy) <= 2e-13  # round-off


@pytest.mark.slow
@pytest.mark.parametrize("moments", [MOMENTS, PLATE])
def test_a_decaying_scheme_takes_energy_from_a_free_body_but_no_momentum(moments):
    """The loss is of third order in the step, and vanishes only for a steady rotation."""
    assert check_free_body("decaying", 2, moments)[-1] <= 4e-4  # truncation
    runs = [free_body("decaying", n, moments) for n in (250, 500, 1000)]
    lost = [
        drift(run.audit.energy[: n + 1])
        for run, n in zip(runs, (250, 500, 1000), strict=True)
    ]
    assert lost[-1] <= 9e-7  # truncation
    assert slopes(lost) == pytest.approx([3, 3], abs=0.2)
    assert np.all(runs[0].audit.dissipated[1:] >= 0)


# Bodies with joints ----------------------------------------------------------------------

MASSES = [1.0, 1.5]
INERTIAS = [
    np.diag([0.05, 0.3, 0.33]),
    np.array([[0.1, 0.01, 0.0], [0.01, 0.2, 0.02], [0.0, 0.02, 0.22]]),
]


@functools.cache
def hinged_flight(scheme):
    """Two bodies with a hinge and a spring, which tumble."""
    parts = [
        ej.bodies.RigidBody(
            "a", MASSES[0], INERTIAS[0], [0.0, 0.0, 0.0],
            velocity=[0.3, 0.2, -0.1], angular_velocity=[0.5, 1.0, -2.0],
        ),
        ej.bodies.RigidBody("b", MASSES[1], INERTIAS[1], [1.0, 0.2, 0.0]),
        ej.joints.Revolute("hinge", "a", "b", [0.5, 0.0, 0.0], axis=[0.0, 0.6, 0.8]),
        ej.forces.Spring("spring", "a", "b", 30.0, 0.6, [0, 0.3, 0], [0.2, 0.3, 0.1]),
    ]  # fmt: skip
    system, start, args = ej.Scene(parts).build()
    return on_host(ej.simulate(system, SCHEMES[scheme], start, args, h=5e-3, num_steps=400))


@pytest.mark.parametrize(
    "scheme", long(["preserving", "preserving index3"], "preserving index3")
)
def test_hinged_bodies_in_flight_keep_energy_and_momenta(scheme):
    run = hinged_flight(scheme)
    # Round-off and solver, in 400 steps, against 10 and 4.
    assert drift(run.audit.energy) <= 2e-13
    for momentum in momenta(run, MASSES, INERTIAS):
        assert drift(momentum) <= 1e-13
    assert np.max(np.abs(run.audit.constraint)) <= 1e-14
    if scheme == "preserving":
        assert np.max(np.abs(run.audit.constraint_rate)) <= 1e-13
    # Five rows of the hinge; the directors need none.
    assert np.max(np.abs(run.multipliers[:, :5])) > 1
    np.testing.assert_array_equal(run.multipliers[:, 5:], np.zeros((401, 12)))


@pytest.mark.slow
def test_the_decaying_scheme_accounts_for_the_energy_of_hinged_bodies():
    run = hinged_flight("decaying")
    assert largest_leak(run) <= 1e-13  # round-off and solver
    assert np.all(run.audit.dissipated[1:] > 0)
    assert np.max(np.abs(run.audit.constraint)) <= 1e-14
    assert np.max(np.abs(run.audit.constraint_rate)) <= 2e-13
    linear, _ = momenta(run, MASSES, INERTIAS)
    assert drift(linear) <= 1e-13


def double_pendulum():
    parts = [
        ej.bodies.RigidBody(
            "a", MASSES[0], INERTIAS[0], [0.5, 0.0, 0.0], angular_velocity=[0.0, 0.0, 2.0]
        ),
        ej.bodies.RigidBody(
            "b", MASSES[1], INERTIAS[1], [1.5, 0.0, 0.0], angular_velocity=[0.5, 0.0, 1.0]
        ),
        ej.joints.Spherical("shoulder", "ground", "a", [0.0, 0.0, 0.0]),
        ej.joints.Spherical("elbow", "a", "b", [0.5, 0.0, 0.0]),
    ]
    return ej.Scene(parts, [0.0, -9.81, 0.0])


@functools.cache
def swing(scheme, steps):
    """The coordinates and their rates after half a second."""
    system, start, args = double_pendulum().build()
    h = 0.5 / steps
    run = on_host(
        ej.simulate(system, SCHEMES[scheme], start, args, h=h, num_steps=100)
    )  # fmt: skip
    return np.concatenate([run.ys.q[steps], run.ys.v[steps]])


def check_against_directors(end, schemes, steps):
    """Compares with runs that know no rotations; `end` are coordinates and rates."""
    fine, coarse = (end("consistent", n) for n in (4 * steps, 2 * steps))
    expected = (16 * fine - coarse) / 15  # its error falls with the fourth power
    assert np.max(np.abs(fine - expected)) <= 1e-7
    for scheme, (order, bound) in schemes.items():
        errors = [np.max(np.abs(end(scheme, n) - expected)) for n in (steps, 2 * steps)]
        assert errors[0] <= bound  # truncation
        assert slopes(errors) == pytest.approx([order], abs=0.2)


@pytest.mark.slow
def test_a_double_pendulum_swings_as_one_whose_directors_are_coordinates():
    check_against_directors(
        swing, {"preserving": (2, 3e-4), "composed": (4, 2e-7)}, 25
    )  # fmt: skip


# A hung body in scenes and in systems of the user ----------------------------------------

HUNG = [0.05, 0.3, 0.33]


def hung():
    parts = [
        ej.bodies.RigidBody("body", 1.0, HUNG, [0.5, 0.0, 0.0]),
        ej.joints.Spherical("pivot", "ground", "body", [0.0, 0.0, 0.0]),
    ]
    return ej.Scene(parts, [0.0, 0.0, -9.81])


@functools.cache
def hung_system():
    # Kept: it must hold no numbers of a function that is being traced.
    with jax.ensure_compile_time_eval():
        return hung().build()


def turning(spin):
    """The hung body with an angular velocity in space."""
    _, start, _ = hung_system()
    rates = jnp.cross(spin[None], start.q.reshape(4, 3))
    return ej.State(start.q, rates.ravel())


SPEED = jnp.array([0.3, 1.0, 1.5])


@functools.cache
def hung_run(scheme, h):
    """Two hundred steps."""
    system, _, args = hung_system()
    begin = turning(SPEED)
    return on_host(
        ej.simulate(system, SCHEMES[scheme], begin, args, h=h, num_steps=200)
    )  # fmt: skip


@pytest.mark.slow
def test_a_hung_body_swings_as_one_whose_directors_are_coordinates():
    def end(scheme, steps):
        run = hung_run(scheme, 1 / steps)
        return np.concatenate([run.ys.q[steps], run.ys.v[steps]])

    check_against_directors(end, {"preserving": (2, 1.2e-2)}, 50)


# The third moment is the sum of the others, as of a plate and of a thin rod.
FLAT = {"plate": (0.05, 0.3, 0.35), "rod": (3e-4, 0.3, 0.3003)}


def flat_system(name):
    """The hung body with other moments, in the program of `hung_system`."""
    system, _, args = hung_system()
    return system, args.set("body", inertia=jnp.diag(jnp.array(FLAT[name])))


def swing_about_the_pivot(moments, time):
    """The first axis by Euler's equations about the pivot; the body starts in the axes of
    space."""
    centre = np.array([0.5, 0, 0])
    inertia = np.diag(moments) + centre @ centre * np.eye(3) - np.outer(centre, centre)

    def rates(_, y):
        axes, w = y[:9].reshape(3, 3), y[9:]  # rotation matrix, angular velocity
        torque = np.cross(centre, axes.T @ [0, 0, -9.81]) - np.cross(w, inertia @ w)
        turn = np.cross(axes, w)  # R w^, row by row
        return np.append(turn, np.linalg.solve(inertia, torque))

    first = np.append(np.eye(3), np.asarray(SPEED))
    found = solve_ivp(rates, (0, time), first, "DOP853", rtol=1e-12, atol=1e-13)
    return found.y[:9, -1].reshape(3, 3)[:, 0], rates(0, first)[9:]


@pytest.mark.parametrize("name", FLAT)
@pytest.mark.slow_for("plate")
def test_a_flat_hung_body_swings_as_eulers_equations(name):
    system, args = flat_system(name)
    begin, time, errors = turning(SPEED), 0.5, []
    expected, _ = swing_about_the_pivot(FLAT[name], time)
    for h in (0.005, 0.0025):
        run = on_host(
            ej.simulate(system, ej.EnergyPreserving(), begin, args, h=h, num_steps=200)
        )
        assert drift(run.audit.energy) <= 1e-13  # round-off and solver
        errors.append(np.max(np.abs(run.ys.q[round(time / h), 3:6] - expected)))
    assert errors[0] <= 1e-3  # truncation
    assert slopes(errors) == pytest.approx([2], abs=0.2)


@pytest.mark.parametrize("name", FLAT)
def test_a_start_of_a_flat_body_is_projected_and_accelerates(name):
    system, args = flat_system(name)
    _, spin_rate = swing_about_the_pivot(FLAT[name], 0.1)
    moving = turning(SPEED)
    # Moved off the pivot, with axes that are not orthonormal, and the rates to match.
    off = jnp.zeros(12).at[jnp.array([0, 2, 4, 9])].set(1e-3)
    near_by = ej.consistent_start(system, moving.q + off, moving.v + off, args)
    assert np.max(np.abs(near_by.constraint_after)) <= 1e-15
    assert np.max(np.abs(near_by.rate_after)) <= 1e-15
    assert np.max(np.abs(near_by.state.q - moving.q)) <= 1e-2
    found = ej.consistent_start(system, moving.q, moving.v, args)
    np.testing.assert_array_equal(found.state.q, moving.q)
    w, axis = np.asarray(SPEED), np.array([1.0, 0, 0])
    expected = np.cross(spin_rate, axis) + np.cross(w, np.cross(w, axis))
    # Round-off; that of the inertia about its axis is divided by that of the rod.
    np.testing.assert_allclose(found.accelerations[3:6], expected, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_modes_of_a_hanging_plate_are_those_of_two_pendulums():
    moments = np.array([0.2, 0.5, 0.7])
    body = ej.bodies.RigidBody("plate", 2.0, moments, [0.0, 0.0, -0.5])
    pivot = ej.joints.Spherical("pivot", "ground", "plate", [0, 0, 0], [0, 0, 0.5])
    found = ej.modes(*ej.Scene([body, pivot], [0.0, 0.0, -9.81]).build()).frequencies
    expected = np.sqrt(2.0 * 9.81 * 0.5 / (moments[:2] + 2.0 * 0.5**2))
    np.testing.assert_allclose(found[1:], np.sort(expected), rtol=1e-12)  # round-off
    # Round-off of a square: nothing turns the plate back about the vertical.
    assert abs(found[0]) <= 1e-6


def test_schemes_without_rotations_refuse_flat_bodies():
    system, args = flat_system("plate")
    for scheme in (ej.EnergyConsistent(0.0), ej.Composed(ej.Rattle(), 4)):
        name = type(scheme.stage).__name__
        with pytest.raises(ValueError, match=f"`{name}` takes the axes .* is flat"):
            ej.simulate(system, scheme, turning(SPEED), args, h=0.01, num_steps=1)


def test_one_flat_body_of_many_is_found_whatever_its_axes_are():
    """Its least second moment is round-off, and not zero."""
    to_axes = Rotation.from_rotvec([0.2, 0.5, 0.9]).as_matrix()
    inertias = [np.diag(MOMENTS), to_axes @ np.diag(PLATE) @ to_axes.T, np.diag(MOMENTS)]
    bodies = [
        ej.bodies.RigidBody(f"body{k}", 2.0, (x + x.T) / 2, [k, 0.0, 0.0])
        for k, x in enumerate(inertias)
    ]
    system, start, args = ej.Scene(bodies).build()
    with pytest.raises(ValueError, match="`Rattle` takes the axes .* is flat"):
        ej.simulate(system, ej.Rattle(), start, args, h=0.01, num_steps=1)


# Places in scattered order: the vectors of the body, last director first, are interleaved.
PLACES = np.array([9, 4, 2, 6, 0, 11, 1, 8, 10, 3, 7, 5])


def own_kinetic(v, args):
    rates = v[PLACES].reshape(4, 3)
    moments = jnp.array(HUNG)
    euler = jnp.sum(moments) / 2 - moments
    spin = jnp.sum(euler[:, None] * rates[1:] ** 2)
    return 0.5 * (args["mass"] * rates[0] @ rates[0] + spin)


def own_potential(q, args):
    return args["mass"] * 9.81 * q[PLACES[2]]


def own_pivot(q, args):
    x = q[PLACES].reshape(4, 3)
    return x[0] - 0.5 * x[1]


def own(kinetic=own_kinetic, constraint=own_pivot, table=PLACES[None]):
    return ej.System(kinetic, own_potential, constraint, rigid_bodies=table)


OWN_START = np.zeros(12)
OWN_START[PLACES] = [0.5, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1]
OWN_ARGS = dict(mass=1.0)


def begin(system):
    return ej.initial_state(system, OWN_START, np.zeros(12), OWN_ARGS)


@pytest.mark.slow
def test_a_system_of_the_user_moves_as_the_scene():
    first, system = turning(SPEED), own()
    places = np.argsort(PLACES)
    start = ej.State(first.q[places], first.v[places])
    run = on_host(
        ej.simulate(
            system, ej.EnergyPreserving(), start, OWN_ARGS, h=0.01, num_steps=200
        )
    )  # fmt: skip
    scene = hung_run("preserving", 0.01)
    # Round-off of two hundred steps.
    near(run.ys.q[:, PLACES], scene.ys.q, 10)
    near(run.ys.v[:, PLACES], scene.ys.v, 100)
    assert drift(run.audit.energy) <= 1e-13
    assert run.multipliers.shape == (201, 9)
    np.testing.assert_array_equal(run.multipliers[:, 3:], np.zeros((201, 6)))


# Derivatives, batches and steps that vary -------------------------------------------------


@jax.jit
def last_height(mass, speed, h=0.01):
    """A mixture of the end of a run and its multipliers."""
    system, _, args = hung_system()
    start = turning(jnp.array([0.3, 1.0, 0.5]) * speed + jnp.array([0.0, 0.0, 2.0]))
    numbers = args.set("body", mass=mass)
    run = ej.simulate(system, ej.EnergyPreserving(), start, numbers, h=h, num_steps=40)
    return run.ys.q[-1, 2] + 0.1 * run.ys.v[-1, 4] + 0.01 * run.multipliers[-1, 0]


@functools.cache
def reverse_derivatives():
    return np.array(jax.jit(jax.grad(last_height, (0, 1)))(1.0, 1.0))


def test_derivatives_are_those_of_central_differences():
    e = 1e-4
    differences = [
        (last_height(1 + e, 1.0) - last_height(1 - e, 1.0)) / (2 * e),
        (last_height(1.0, 1 + e) - last_height(1.0, 1 - e)) / (2 * e),
    ]
    # Truncation of the differences.
    np.testing.assert_allclose(reverse_derivatives(), differences, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_derivatives_in_forward_and_reverse_mode_agree():
    forward = np.array(jax.jit(jax.jacfwd(last_height, (0, 1)))(1.0, 1.0))
    np.testing.assert_allclose(forward, reverse_derivatives(), rtol=1e-10)  # solver


@pytest.mark.slow
def test_batches_of_masses_and_steps_are_runs_one_by_one():
    masses, steps = jnp.array([0.5, 1.0, 2.0]), jnp.array([0.005, 0.01, 0.02])
    batch = jax.jit(jax.vmap(lambda m, h: last_height(m, 1.0, h)))(masses, steps)
    alone = [last_height(m, 1.0, h) for m, h in zip(masses, steps, strict=True)]
    near(batch, alone, 100)  # solver


@pytest.mark.slow
@pytest.mark.parametrize(
    "controller",
    [
        ej.StepController(1e-6, 1e-6),
        pytest.param(ej.EqualSteps(), marks=pytest.mark.slow),
    ],
    ids=["varied", "equal"],
)
def test_states_at_given_times_are_those_of_a_fine_run(controller):
    times = np.array([0.1, 0.33, 0.5, 1.0])
    is_varied = isinstance(controller, ej.StepController)
    system, _, args = hung_system()
    run = on_host(
        ej.simulate(
            system, ej.EnergyPreserving(), turning(SPEED), args, h=0.02, t1=1.0,
            controller=controller, saveat=ej.SaveAt(ts=times),
        )
    )  # fmt: skip
    rows = np.rint(times / 0.01).astype(int)
    fine, coarse = (hung_run("preserving", h).ys for h in (0.005, 0.01))
    q, v = (
        (4 * x[::2][rows] - y[rows]) / 3
        for x, y in [(fine.q, coarse.q), (fine.v, coarse.v)]
    )
    np.testing.assert_allclose(run.ts, times, rtol=1e-15)
    # Truncation, measured: 6e-5 and 4e-4, or 1.2e-3 and 1e-2.
    bounds = (1e-4, 6e-4) if is_varied else (2e-3, 1.5e-2)
    np.testing.assert_allclose(run.ys.q, q, rtol=0, atol=bounds[0])
    np.testing.assert_allclose(run.ys.v, v, rtol=0, atol=bounds[1])
    # Between steps too the directors are orthonormal, but the energy is interpolated.
    axes = run.ys.q[:, 3:].reshape(-1, 3, 3)
    near(axes @ axes.transpose(0, 2, 1), np.broadcast_to(np.eye(3), axes.shape), 0.1)
    assert drift(run.audit.energy) <= (2e-8 if is_varied else 1e-5)


# Dampers and drives -----------------------------------------------------------------------


def balanced(scene, scheme="preserving", steps=200):
    system, start, args = scene.build()
    run = on_host(
        ej.simulate(system, SCHEMES[scheme], start, args, h=0.01, num_steps=steps)
    )
    energy = np.max(np.abs(run.audit.energy))
    assert largest_leak(run) <= 1e-13 * max(energy, 1)  # solver
    assert np.min(run.audit.damped[1:]) >= 0
    assert np.max(run.audit.damped) > 1e-3
    assert np.max(np.abs(run.audit.drive_work)) > 1e-3
    assert np.max(np.abs(run.audit.constraint)) <= 1e-14
    assert np.max(np.abs(run.audit.constraint_rate)) <= 1e-12
    return run


@pytest.mark.slow
def test_a_damped_body_on_a_moving_pivot_balances_its_energy():
    place = lambda t, args: jnp.stack([0.2 * jnp.sin(3 * t), 0.0 * t, 0.1 * t**2])
    parts = [
        ej.bodies.RigidBody("body", 1.0, HUNG, [0.5, 0.0, 0.0]),
        ej.drives.Position("pivot", "body", place, [-0.5, 0.0, 0.0]),
        ej.forces.Damper("damper", "ground", "body", 0.4, [0, 1.0, 2.0], [0.5, 0, 0]),
    ]
    balanced(ej.Scene(parts, [0.0, 0.0, -9.81]))


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["preserving", "decaying"])
def test_driven_and_braked_hinges_balance_the_energy(scheme):
    axis, other = [0.0, 0.6, 0.8], [0.0, 1.0, 0.0]
    swing = lambda t, args: 2 * jnp.sin(3 * t)
    parts = [
        ej.bodies.RigidBody("a", 1.0, HUNG, [0.5, 0.0, 0.0]),
        ej.bodies.RigidBody("b", 1.5, [0.1, 0.2, 0.22], [1.5, 0.0, 0.0]),
        ej.joints.Revolute("shaft", "ground", "a", [0.0, 0.0, 0.0], axis=axis),
        ej.joints.Revolute("elbow", "a", "b", [0.5, 0.0, 0.0], axis=other),
        ej.forces.TorsionDamper("brake", "a", "b", 0.3, other),
        ej.drives.Angle("motor", "ground", "a", swing, axis),
    ]
    run = balanced(ej.Scene(parts, [0.0, -9.81, 0.0]), scheme)
    first = run.ys.q[:, 3:12].reshape(-1, 3, 3)
    angle = 2 * np.sin(3 * run.ts)
    expected = Rotation.from_rotvec(angle[:, None] * np.array(axis)).as_matrix()
    # Solver: the first body only follows.
    np.testing.assert_allclose(first.transpose(0, 2, 1), expected, rtol=0, atol=1e-12)


# Wrong declarations -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (np.arange(12), r"of shape \(bodies, 12\); got shape \(12,\)"),
        (np.arange(24).reshape(4, 6), r"got shape \(4, 6\)"),
        (np.arange(12.0)[None], "integers of shape.* of float64"),
        (np.append(np.arange(11), 3)[None], "twice to one"),
        (np.stack([np.arange(12), np.arange(11, 23)]), "two bodies"),
        (np.arange(12)[None] - 1, "indices start from 0"),
    ],
)
def test_wrong_tables_are_errors(table, message):
    with pytest.raises(ValueError, match=message):
        own(table=table)


def test_rigid_bodies_with_kinematics_are_an_error():
    with pytest.raises(ValueError, match="Leave one of them out"):
        ej.System(
            own_kinetic,
            own_potential,
            kinematics=lambda q, args: jnp.eye(12),
            rigid_bodies=PLACES[None],
        )


def test_indices_beyond_the_coordinates_are_an_error():
    with pytest.raises(ValueError, match=r"the index 12, but `q` has 12 .* 0 to 11"):
        begin(own(table=PLACES[None] + 1))


def test_constraints_count_with_those_between_the_axes():
    message = "13 constraints of 12 coordinates .*, 6 of them between the axes of rigid"
    with pytest.raises(ValueError, match=message):
        begin(own(constraint=lambda q, args: q[:7]))
    begin(own())


def off_centre(v, args):
    """A point away from the mass centre in place of it."""
    rates = v[PLACES].reshape(4, 3)
    return own_kinetic(v, args) + 0.1 * rates[0] @ rates[1]


def not_round(v, args):
    """With an inertia along one direction of space."""
    return own_kinetic(v, args) + 0.1 * v[PLACES[3]] ** 2


@pytest.mark.parametrize("kinetic", [off_centre, not_round])
def test_kinetic_energies_that_no_rigid_body_has_are_errors(kinetic):
    message = r"not that of rigid bodies.* Is `x` another point .* Take the mass centre"
    with pytest.raises(ValueError, match=message):
        begin(own(kinetic))


@pytest.mark.parametrize(
    ("moments", "is_right"),
    [
        ((1, 1, 2), True),
        ((1, 1, 3), False),
        ((0, 1, 1), False),
        ((1e-12, 1, 1), False),
    ],
)
def test_moments_that_no_rigid_body_has_are_errors(moments, is_right):
    """Those of a plate are right; a negative second moment and an axis without are not."""

    def kinetic(v, args):
        rates, inertia = v[PLACES].reshape(4, 3), jnp.array(moments, float)
        euler = jnp.sum(inertia) / 2 - inertia
        return 0.5 * (rates[0] @ rates[0] + jnp.sum(euler[:, None] * rates[1:] ** 2))

    if is_right:
        begin(own(kinetic))
        return
    with pytest.raises(ValueError, match="not positive definite"):
        begin(own(kinetic))


def test_inertia_matrices_that_no_rigid_body_has_are_errors():
    inertia = np.eye(12)
    begin(own(inertia))
    inertia[PLACES[0], PLACES[3]] = inertia[PLACES[3], PLACES[0]] = 0.1
    with pytest.raises(ValueError, match="The inertia matrix is not that of rigid bodies"):
        begin(own(inertia))


def test_kinetic_energies_that_couple_bodies_are_errors():
    def kinetic(v, args):
        rates = v.reshape(2, 4, 3)
        return 0.5 * v @ v + args * rates[0, 1] @ rates[1, 1]

    table = np.arange(24).reshape(2, 12)
    potential = lambda q, args: q[0] + q[12]
    system = ej.System(kinetic, potential, rigid_bodies=table)
    q = np.tile([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1.0], 2)
    ej.initial_state(system, q, np.zeros(24), 0.0)
    with pytest.raises(ValueError, match="does a term couple bodies"):
        ej.initial_state(system, q, np.zeros(24), 0.01)
