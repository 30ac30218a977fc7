"""Rigid bodies in space, which the energy schemes move by Cayley rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from enerjax._system import RigidBodies, RigidKinematics

from .helpers import EPS


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
        self.bodies = RigidBodies(*TABLES[table])
        self.kinematics = RigidKinematics(self.bodies)
        self.rng = np.random.default_rng(3)
        self.qa = self.random(self.bodies.num_coordinates)
        count = len(self.bodies.q)
        axes = Rotation.random(count, rng=1).as_matrix().transpose(0, 2, 1)
        self.qa[self.bodies.q[:, 3:]] = axes.reshape(count, 9)
        self.step = size * self.random()
        change = self.kinematics.displacement(self.qa, self.step)
        self.qb = self.qa + np.asarray(change)
        self.va, self.vb = self.random(), self.random()

    def random(self, size=None):
        return self.rng.normal(size=self.bodies.num_velocities if size is None else size)

    def rates(self, q, v):
        return np.asarray(self.kinematics.lift(q, v, None, None))

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
    near(step.bodies.internal(step.qb), np.zeros(6 * len(axes)), 0.1)


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
        rows = step.kinematics.pull_back(step.qa, step.qb, gradient)
        near(rows @ step.step, gradient @ (step.qb - step.qa), 10)
    # A force with the velocities of the bodies as conjugates, in the same manner.
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
    rows = np.asarray(step.kinematics.pull_back(step.qa, step.qb, gradient))
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
    rates = [step.rates(q, v) for q, v in [(step.qa, step.va), (step.qb, step.vb)]]
    mean = (rates[0] + rates[1]) / 2
    for _ in range(5):
        s = step.random(step.qa.size)
        rows = step.kinematics.spin_rows(step.qa, mean, s)
        momentum = step.kinematics.momentum_of_rates(step.qa, step.step, s)
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
