"""Chord iterations with inertia and constraints, and Newton's method where they fail."""

import functools
import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import space_mechanisms as space
from jax.flatten_util import ravel_pytree

import enerjax as ej
from enerjax._operators import DelassusMatrix, make_model, SeparableModel
from enerjax._run import experience
from enerjax._run.prediction import (
    differences_after,
    extrapolated,
    for_length,
    initial_memory,
    predicted,
    with_history,
)
from enerjax._solvers import Chord, find_root, Newton, schur, schur_tables
from enerjax._solvers.linear.block_diagonal import in_blocks
from enerjax._solvers.linear.graph_elimination import elimination_order
from enerjax._solvers.linear.krylov import jacobian_solver
from enerjax._system import AbstractDampedForce

from .helpers import EPS, long, SCHEMES
from .third_party_parts import Drag


SIZE = 30

# The first guess --------------------------------------------------------------------------


def test_a_quadratic_motion_is_predicted_exactly():
    quadratic = np.poly1d([-1.0, 2.0, 0.5])
    before = np.arange(3)[::-1]
    values = jnp.asarray(np.stack([quadratic(before), quadratic(before + 0.5)], axis=1))
    expected = [quadratic(3), quadratic(3.5)]
    # Round-off of sums whose terms are at most 100.
    np.testing.assert_allclose(extrapolated(values), expected, rtol=0, atol=1e3 * EPS)


def _memory_after(values):
    """The memory after steps that add these values, oldest first."""
    memory = initial_memory(values[0], None, None, None)
    for value in values[1:]:
        differences = differences_after(value, memory.differences)[:5]
        memory = eqx.tree_at(lambda memory: memory.differences, memory, differences)
    return memory


VALUES = jnp.asarray(np.random.default_rng(0).normal(size=(7, 4)))


@pytest.mark.parametrize(("choice", "count"), [(0, 1), (1, 3), (2, 5)])
def test_a_prediction_is_that_of_the_polynomial_through_the_last_steps(choice, count):
    memory = _memory_after(VALUES)
    memory = eqx.tree_at(lambda memory: memory.choice, memory, jnp.array(choice))
    expected = extrapolated(VALUES[::-1][:count])
    # Round-off of sums whose terms are at most 30.
    np.testing.assert_allclose(predicted(memory), expected, rtol=0, atol=100 * EPS)


def test_the_last_difference_is_the_error_of_the_prediction_from_five_steps():
    differences = differences_after(VALUES[-1], _memory_after(VALUES[:-1]).differences)
    error = VALUES[-1] - extrapolated(VALUES[::-1][1:6])
    np.testing.assert_allclose(differences[5], error, rtol=0, atol=100 * EPS)


def test_a_memory_for_another_length_has_the_history_of_the_steps_before():
    """For steps of equal lengths the prediction is the quadratic one. After a step the
    history is that of the steps, not that of the prediction."""
    old = jax.tree.map(lambda x: x[None], _memory_after(VALUES[:-1]))
    old = eqx.tree_at(lambda memory: memory.choice, old, jnp.array([1]))
    resampled = for_length(old, (1.0,), 0.1 * jnp.ones(3), jnp.array(0.1))
    of_one = jax.tree.map(lambda x: x[0], resampled)
    expected = extrapolated(VALUES[::-1][1:4])
    np.testing.assert_allclose(predicted(of_one), expected, rtol=0, atol=100 * EPS)
    differences = differences_after(VALUES[-1], of_one.differences)[None, :5]
    new = eqx.tree_at(lambda memory: memory.differences, resampled, differences)
    found = with_history(new, old).differences[0]
    expected = _memory_after(VALUES).differences
    np.testing.assert_allclose(found, expected, rtol=0, atol=100 * EPS)


# The matrix of the multipliers ------------------------------------------------------------

# Pairs of three-dimensional bodies that are joined by two rows each; -1 is the ground.
GRAPHS = {
    "one": [(-1, 0)],
    "chain": [(k - 1, k) for k in range(12)],
    "tree": [((k - 1) // 2, k) for k in range(1, 12)] + [(-1, 0)],
    "loops": [(k - 1, k) for k in range(9)] + [(8, -1), (2, 6)],
    "apart": [(2 * k, 2 * k + 1) for k in range(5)],
    "star": [(0, k) for k in range(1, 8)],
    "net": [(i + 4 * j, i + 4 * j + 1) for i in range(3) for j in range(4)]
    + [(i + 4 * j, i + 4 * j + 4) for i in range(4) for j in range(3)],
}


@pytest.mark.parametrize(
    ("coupled", "mixed"), [(False, False), (False, True), (True, True)]
)
@pytest.mark.parametrize("graph", GRAPHS)
def test_the_matrix_of_the_multipliers_is_that_of_dense_algebra(graph, coupled, mixed):
    """Of joints with two rows each, or with one, two or three in any order."""
    joints = np.array(GRAPHS[graph])
    count = joints.max() + 1
    rng = np.random.default_rng(0)
    if mixed:
        joints = rng.permutation(np.repeat(joints, 1 + np.arange(len(joints)) % 3, axis=0))
    per_joint = 1 if mixed else 2
    shape = len(joints), per_joint, 3
    a, b = (jnp.asarray(rng.normal(size=shape)) for _ in range(2))

    def rows(u):
        bodies = jnp.concatenate([u.reshape(count, 3), jnp.zeros((1, 3))])
        ends = [bodies[joints[:, k]][:, None] for k in (0, 1)]
        return jnp.sum(a * ends[0] + b * ends[1], axis=2).ravel()

    root = rng.normal(size=(3, 3))
    weight = np.kron(np.eye(count), root @ root.T + np.eye(3))
    if coupled:
        weight = weight + 0.1
    at = jnp.asarray(rng.normal(size=3 * count))
    symmetric = in_blocks(jnp.asarray(weight))
    tables = schur_tables(rows, at, symmetric)
    assert tables is not None
    u, x = rng.normal(size=3 * count), rng.normal(size=(2, per_joint * len(joints)))

    @jax.jit
    def found(at, u, x):
        of_rows = schur(tables, tables.products(rows, at), symmetric)
        products = of_rows.product(u), of_rows.transposed(x[0]), of_rows.solve(x)
        return *products, jax.jacfwd(rows)(at)

    product, transposed, solved, jacobian = found(at, *map(jnp.asarray, (u, x)))
    matrix = jacobian @ weight @ jacobian.T
    np.testing.assert_allclose(product, jacobian @ u, atol=100 * EPS)
    np.testing.assert_allclose(transposed, jacobian.T @ x[0], atol=100 * EPS)
    # Round-off, by the condition of the matrix.
    atol = 10 * EPS * np.linalg.cond(matrix) * np.linalg.norm(np.linalg.inv(matrix), 2)
    np.testing.assert_allclose(solved, np.linalg.solve(matrix, x.T).T, rtol=0, atol=atol)


@pytest.mark.parametrize("copies", [1, 3])
def test_the_matrix_of_redundant_rows_is_that_of_the_pseudo_inverse(copies):
    """Rows of which some follow from others, and the norm that weighs each."""
    rng = np.random.default_rng(1)
    independent = jnp.asarray(rng.normal(size=(4, 9)))
    combined = jnp.asarray(rng.normal(size=(copies, 4))) @ independent
    rows = lambda u: jnp.concatenate([independent, combined]) @ u
    at, weight = jnp.zeros(9), jnp.asarray(np.diag(rng.uniform(1, 2, 9)))
    jacobian = np.asarray(jax.jacfwd(rows)(at))
    matrix = jacobian @ np.asarray(weight) @ jacobian.T
    measure = rng.uniform(1, 2, len(matrix))
    eps = 1e-6
    added = jnp.asarray(eps * measure**2)
    tables = schur_tables(rows, at, weight)
    assert tables is not None
    x = rng.normal(size=len(matrix))

    @jax.jit
    def found(at, x):
        of_rows = schur(tables, tables.products(rows, at), weight, added)
        delassus = DelassusMatrix(weight, of_rows, None, added)
        return delassus.solve(x[None])[0], delassus.effective(x)

    solved, effective = map(np.asarray, found(at, jnp.asarray(x)))
    # Truncation: of first order in what is added. Round-off is divided by its square.
    size = np.max(np.linalg.svd(np.linalg.pinv(matrix, rcond=1e-10))[1])
    null = np.linalg.svd(jacobian.T / measure)[2][4:]
    in_range = x - measure * (null.T @ (null @ (x / measure)))
    np.testing.assert_allclose(matrix @ solved, in_range, atol=100 * eps * size)
    scale = np.linalg.norm(x)
    assert np.max(np.abs(null @ (measure * solved))) <= 1e3 * EPS / eps**2 * scale
    # Truncation, of second order, and round-off divided by what is added.
    atol = 1e3 * ((eps * size) ** 2 + EPS / eps) * scale
    np.testing.assert_allclose(jacobian.T @ effective, jacobian.T @ x, atol=atol)
    np.testing.assert_allclose(null @ (measure * effective), 0, atol=atol)


# The corrections of the schemes -----------------------------------------------------------

CHORDS = {
    "preserving": ej.EnergyPreserving(),
    "preserving index3": ej.EnergyPreserving("index3"),
    "decaying 0": ej.EnergyDecaying(0.0),
    "decaying": ej.EnergyDecaying(0.4),
    "decaying index3": ej.EnergyDecaying(0.4, "index3"),
    "consistent 0": ej.EnergyConsistent(0.0),
    "consistent": ej.EnergyConsistent(0.6),
    "momentum": ej.EnergyMomentumDecaying(0.6),
}


STEP = 0.1


def _left_by_one_correction(scheme, system, start, rng, args=None):
    """The sizes of a residual before and after one correction of the chord method."""
    model = make_model(system, start, args, chord_terms=scheme.chord_terms)
    start = model.to_internal(start)
    problem = scheme.problem(model, start, jnp.asarray(STEP))
    num_constraints = model.scales.constraint.size
    z = scheme.predict(problem, jnp.zeros(start.v.size), jnp.zeros(num_constraints))
    flat, unravel = ravel_pytree(z)
    flat = flat + jnp.asarray(rng.normal(size=flat.size))

    @jax.jit
    def corrected(flat):
        residual = scheme.residual(unravel(flat), problem)
        matrix = scheme.delassus_matrix(unravel(flat), problem)
        correction = scheme.chord(residual, problem, matrix)
        left = scheme.residual(
            jax.tree.map(jnp.subtract, unravel(flat), correction), problem
        )
        return ravel_pytree(residual)[0], ravel_pytree(left)[0]

    return (jnp.max(jnp.abs(x)) for x in corrected(flat))


@pytest.mark.parametrize("name", CHORDS)
@pytest.mark.parametrize("size", [4, pytest.param(80, marks=pytest.mark.slow)])
@pytest.mark.slow_for(
    "4-consistent", "4-momentum", "4-decaying 0", "4-preserving index3", "4-consistent 0"
)
def test_without_stiffness_one_correction_solves_the_step(name, size):
    """With a weight for a potential and constant gradients of the constraints."""
    rng = np.random.default_rng(0)
    count = size // 4
    rows = jnp.asarray(rng.normal(size=(count, 4)))
    mass = jnp.asarray(rng.uniform(0.5, 2, size=size))
    potential: Any = lambda q, args: 9.81 * jnp.sum(q)
    if name == "momentum":
        ends = np.stack([np.arange(size - 1), np.arange(1, size)], axis=1)
        slack = ej.Elements.from_strains(
            lambda x, k, args: x[0] - x[1], lambda k, args: 0.0, ends
        )
        potential = slack + ej.Elements(lambda x, k, args: 9.81 * x[0], ends[:, :1])
    system = ej.System(
        jnp.diag(mass),
        potential,
        lambda q, args: jnp.sum(rows * q.reshape(count, 4), axis=1),
    )
    start = ej.initial_state(system, rng.normal(size=size), rng.normal(size=size))
    before, left = _left_by_one_correction(CHORDS[name], system, start, rng)
    assert before > 0.1
    assert left <= 1e4 * EPS  # round-off


def _matrices(k, args):
    """Stiffness matrices of elements: positive definite, of rank one, and zero."""
    root = jnp.stack([jnp.eye(2) + 0.5, jnp.ones((2, 2)), jnp.zeros((2, 2))])[k % 3]
    return args * root @ root.T


STIFF = {
    # Strains of elements with a matrix, springs, and squares in a plain function.
    "matrices": ej.Elements.from_strains(
        lambda x, k, args: jnp.stack([x[1] - x[0], x[0] + 2 * x[1]]),
        _matrices,
        [[0, 1], [4, 5], [6, 7], [3, 8], [1, 2]],
    ),
    "springs": ej.Elements.from_strains(
        lambda x, k, args: x[1] - x[0], lambda k, args: args, [[0, 1], [4, 5], [3, 8]]
    ),
    "plain": lambda q, args: (
        0.5 * args * (q[1] - q[0] - 1) ** 2 + args * jnp.sum((q[4:6] - q[7:9]) ** 2)
    ),
}


def _with_strains(potential, redundant, rng):
    rows = jnp.asarray(rng.normal(size=(3, 4)))
    system = ej.System(
        jnp.diag(jnp.asarray(rng.uniform(0.5, 2, size=12))),
        STIFF[potential],
        lambda q, args: jnp.sum(rows * q.reshape(3, 4), axis=1),
        redundant=redundant,
    )
    return system, ej.State(*jnp.asarray(rng.normal(size=(2, 12))))


@pytest.mark.parametrize("formulation", ["ggl", "index3"])
@pytest.mark.parametrize("redundant", [False, True])
@pytest.mark.parametrize("potential", STIFF)
@pytest.mark.slow_for(
    "plain-True-ggl", "springs-False-index3", "springs-True-index3", "plain-True-index3"
)
def test_linear_strains_take_one_correction_too(potential, redundant, formulation):
    """However stiff they are: here 30 to 1000 radians a step."""
    rng = np.random.default_rng(0)
    system, start = _with_strains(potential, redundant, rng)
    scheme = ej.EnergyPreserving(formulation)
    for stiffness in (1e5, 1e8):
        before, left = _left_by_one_correction(scheme, system, start, rng, stiffness)
        # Round-off, by the condition of the stiffness beside the inertia; truncation of
        # what makes redundant rows regular.
        condition = STEP**2 * stiffness
        assert left <= (1e-5 if redundant else 100 * EPS * condition) * before


@pytest.mark.parametrize("alpha", [0.0, pytest.param(0.5, marks=pytest.mark.slow), 1.0])
@pytest.mark.parametrize("formulation", ["ggl", "index3"])
@pytest.mark.slow_for("index3-0.0", "ggl-1.0")
def test_linear_strains_take_few_corrections_in_decaying_steps(alpha, formulation):
    """Their equations have complex frequencies, those of the chord method real ones."""
    rng = np.random.default_rng(0)
    system, start = _with_strains("plain", False, rng)
    scheme = ej.EnergyDecaying(alpha, formulation)
    for stiffness in (1.0, 1e2, 1e3, 1e4, 1e8):
        sizes = _sizes_of_corrections(scheme, system, start, rng, stiffness)
        # By the third power of a third each; the first one is taken by the reactions. Below
        # that round-off, by the condition of the stiffness beside the inertia.
        floor = 1e3 * EPS * (1 + STEP**2 * stiffness) * sizes[0]
        for before, after in zip(sizes[1:-1], sizes[2:], strict=True):
            assert after <= max(before / 20, floor)


class _Dampers(AbstractDampedForce):
    """Dampers of sums of coordinates, with the resistance `args`."""

    rows: jax.Array

    def __call__(self, q, v, t, args=None):
        return -args * (self.rows @ v) @ self.rows

    def measures(self, q, args=None):
        return (self.rows @ q,)

    def resistances(self, q, v, t, args=None, *, delay):
        return (args * jnp.ones(len(self.rows)),)


def _with_dampers(with_springs, rng):
    rows, joints = jnp.asarray(rng.normal(size=(2, 3, 12)))
    system = ej.System(
        jnp.diag(jnp.asarray(rng.uniform(0.5, 2, size=12))),
        STIFF["springs"] if with_springs else lambda q, args: jnp.sum(q),
        lambda q, args: joints @ q,
        force=_Dampers(rows),
    )
    q, v = jnp.asarray(rng.normal(size=(2, 12)))
    return system, ej.State(q, v, jnp.zeros(()))


DAMPED = [(x, y) for x in ("preserving", "consistent 0") for y in (False, True)]


@pytest.mark.parametrize(("name", "with_springs"), DAMPED[:3])
@pytest.mark.slow_for("preserving-False")
def test_linear_dampers_take_one_correction_too(name, with_springs):
    """However strong they are, also beside springs."""
    rng = np.random.default_rng(0)
    system, start = _with_dampers(with_springs, rng)
    for resistance in (1e2, 1e6):
        found = _left_by_one_correction(CHORDS[name], system, start, rng, resistance)
        before, left = found
        # Round-off, by the condition of resistance and stiffness beside the inertia.
        assert left <= 100 * EPS * STEP * resistance * before


@pytest.mark.parametrize("alpha", [0.0, pytest.param(1.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("with_springs", [False, True])
@pytest.mark.slow_for("False-0.0")
def test_linear_dampers_take_few_corrections_in_decaying_steps(alpha, with_springs):
    rng = np.random.default_rng(0)
    system, start = _with_dampers(with_springs, rng)
    for resistance in (1.0, 30.0, 1e3, 1e6):
        sizes = _sizes_of_corrections(
            ej.EnergyDecaying(alpha), system, start, rng, resistance
        )
        # By the third power of a third each, as with strains.
        floor = 1e3 * EPS * (1 + STEP * resistance) * sizes[0]
        for before, after in zip(sizes[1:-1], sizes[2:], strict=True):
            assert after <= max(before / 20, floor)


def _sizes_of_corrections(scheme, system, start, rng, args):
    """The sizes of the residuals before a few corrections of the chord method."""
    model = make_model(system, start, args, chord_terms=scheme.chord_terms)
    start = model.to_internal(start)
    problem = scheme.problem(model, start, jnp.asarray(STEP))
    none = jnp.zeros(model.scales.constraint.size)
    z = scheme.predict(problem, jnp.zeros(start.v.size), none)
    flat, unravel = ravel_pytree(z)

    @jax.jit
    def corrected(flat):
        residual = scheme.residual(unravel(flat), problem)
        matrix = scheme.delassus_matrix(unravel(flat), problem)
        correction = scheme.chord(residual, problem, matrix)
        size = jnp.max(jnp.abs(ravel_pytree(residual)[0]))
        return flat - ravel_pytree(correction)[0], size

    flat = flat + jnp.asarray(rng.normal(size=flat.size))
    sizes = []
    for _ in range(6):
        flat, size = corrected(flat)
        sizes.append(float(size))
    return sizes


WITH_MOMENTA = [x for x in CHORDS if x not in ("consistent", "momentum")]
AND_JOINTS = [
    pytest.param(x, True, marks=[] if x == "preserving" else pytest.mark.slow)
    for x in WITH_MOMENTA
]


@pytest.mark.parametrize(
    ("name", "joined"), [*((x, False) for x in WITH_MOMENTA), *AND_JOINTS]
)
@pytest.mark.slow_for(
    "preserving-True", "consistent 0-False", "decaying-False", "preserving index3-False"
)
def test_with_momenta_one_correction_solves_the_step_too(name, joined):
    """With a constant inertia, declared as if it varied."""
    rng = np.random.default_rng(0)
    root, row = rng.normal(size=(2, 4, 4))
    inertia = jnp.asarray(root @ root.T + np.eye(4))
    system = ej.System.from_lagrangian(
        lambda q, qdot, args: 0.5 * qdot @ inertia @ qdot,
        lambda q, args: 9.81 * jnp.sum(q),
        (lambda q, args: jnp.asarray(row[:2]) @ q) if joined else None,
    )
    start = ej.initial_state(system, rng.normal(size=4), rng.normal(size=4))
    before, left = _left_by_one_correction(CHORDS[name], system, start, rng)
    assert before > 0.1
    assert left <= 1e4 * EPS  # round-off


REDUNDANT = [x for x in CHORDS if "consistent" not in x and x != "momentum"]


@pytest.mark.parametrize(
    "name",
    long(REDUNDANT, *(x for x in REDUNDANT if x not in ("preserving", "decaying 0"))),
)
@pytest.mark.slow_for("preserving")
def test_redundant_coordinates_take_one_correction_too(name):
    """With a constant map to the velocities, and constant relations of the coordinates."""
    rng = np.random.default_rng(1)
    rows, relations = (jnp.asarray(rng.normal(size=(k, 8))) for k in (3, 2))
    rates = jnp.asarray(rng.normal(size=(6, 8)))
    system = ej.System(
        jnp.diag(jnp.asarray(rng.uniform(0.5, 2, size=6))),
        lambda q, args: 9.81 * jnp.sum(q),
        lambda q, args: rows @ q,
        kinematics=lambda q, args: rates,
        coordinate_constraint=lambda q, args: relations @ q,
    )
    start = ej.initial_state(system, rng.normal(size=8), rng.normal(size=6))
    before, left = _left_by_one_correction(CHORDS[name], system, start, rng)
    assert before > 0.1
    assert left <= 1e5 * EPS  # round-off, by the condition of the random matrices


# The search -------------------------------------------------------------------------------

ARGS, MANY = (jnp.cos(jnp.arange(float(size))) for size in (SIZE, 3 * SIZE))


def _equations(x, inputs):
    strength, args = inputs
    return 2 * x + strength * jnp.arctan(jnp.roll(x, 9)) - args


CHORD = Chord(lambda x, inputs: None, lambda value, inputs, _: 0.5 * value)


@functools.partial(jax.jit, static_argnums=3)
def _root(strength, args, guess, chord=CHORD):
    inputs = strength, args
    return find_root(_equations, Newton(), guess, inputs, max_iterations=50, chord=chord)


@pytest.mark.parametrize(("strength", "by_chord"), [(1e-3, True), (0.1, True), (30, False)])
def test_a_root_does_not_depend_on_the_chord(strength, by_chord):
    """Neither where the chord iteration is quick, nor where Newton's method must follow."""
    guess = jnp.zeros(SIZE)
    root = _root(strength, ARGS, guess)
    assert root.found
    assert root.by_chord == by_chord
    rest = _equations(root.value, (strength, ARGS))
    assert jnp.max(jnp.abs(rest)) <= 100 * (1 + strength) * EPS  # round-off


@pytest.mark.parametrize("args", [ARGS, MANY], ids=["few", "many"])
@pytest.mark.parametrize("strength", [1e-3, 0.1, 30])
def test_the_derivatives_of_a_root_are_exact(strength, args):
    """By products with the Jacobian where the chord is close to it, else by its entries."""
    value = lambda a: _root(strength, a, jnp.zeros_like(args)).value
    found, change = jax.jvp(value, (args,), (args,))
    jacobian = jax.jacfwd(_equations)(found, (strength, args))
    # Round-off, by the condition of the Jacobian.
    close = functools.partial(np.testing.assert_allclose, rtol=1e-10, atol=1e-12)
    close(change, np.linalg.solve(jacobian, args))
    _, pull = jax.vjp(value, args)
    for scale in (1.0, 1e-250, 1e250):
        (pulled,) = pull(scale * args)
        close(pulled / scale, np.linalg.solve(jacobian.T, args))


def test_a_chord_that_misleads_gives_no_wrong_derivative():
    """It ignores half of the unknowns, so its corrections do not reach the solution."""
    half = jnp.arange(SIZE) < SIZE // 2
    solver = jacobian_solver(lambda x: 2 * x, ARGS, lambda x: jnp.where(half, x, 0))
    assert jnp.all(jnp.isnan(solver(ARGS)))
    np.testing.assert_array_equal(solver(jnp.zeros(SIZE)), 0)


@pytest.mark.parametrize("size", [2, 6, 20])
def test_a_breakdown_of_the_products_gives_no_wrong_derivative(size):
    """With a skew-symmetric matrix the first direction is of no use."""
    rng = np.random.default_rng(size)
    matrix = rng.normal(size=(size, size))
    matrix = jnp.asarray(matrix - matrix.T)
    right = jnp.asarray(rng.normal(size=size))
    solver = jacobian_solver(lambda x: matrix @ x, right, lambda x: x)
    assert jnp.all(jnp.isnan(solver(right)))


def test_products_solve_where_the_chord_is_far_off():
    """Random matrices, and the identity as approximate inverse."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        matrix = jnp.asarray(np.eye(SIZE) + 0.3 * rng.normal(size=(SIZE, SIZE)))
        right = jnp.asarray(rng.normal(size=SIZE))
        solver = jacobian_solver(lambda x, m=matrix: m @ x, right, lambda x: x)
        found, expected = solver(right), np.linalg.solve(matrix, right)
        rest = jnp.linalg.norm(matrix @ found - right)
        assert rest <= 1e-13 * jnp.linalg.norm(right)  # round-off
        error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
        assert error <= 1e-12 * np.linalg.cond(matrix)


def test_lanes_that_need_newton_do_not_affect_others():
    strengths = jnp.array([1e-3, 30.0])
    lanes = jax.vmap(lambda s: _root(s, ARGS, jnp.zeros(SIZE)))(strengths)
    assert lanes.by_chord.tolist() == [True, False]
    for k, strength in enumerate(strengths):
        alone = _root(strength, ARGS, jnp.zeros(SIZE))
        np.testing.assert_allclose(lanes.value[k], alone.value, rtol=1e-12)  # solver
        assert lanes.iterations[k] == alone.iterations


@pytest.mark.parametrize("off", [1e-3, 1e-7])
def test_slow_corrections_are_not_taken_for_round_off(off):
    """Each leaves a good third of the one before."""
    noise = jnp.asarray(np.random.default_rng(0).normal(size=SIZE))
    at = _root(0.8, ARGS, jnp.zeros(SIZE)).value
    found = _root(0.8, ARGS, at + off * noise)
    assert found.found
    rest = _equations(found.value, (0.8, ARGS))
    assert jnp.max(jnp.abs(rest)) <= 100 * EPS  # round-off


@pytest.mark.slow
@pytest.mark.parametrize("name", ["preserving", "decaying", "consistent"])
def test_the_motion_is_that_of_newton_alone(name):
    """A given linear solver is used by Newton's method, without a chord iteration."""
    system, start, args = ej.problems.chain(5)
    run = lambda finder: ej.simulate(
        system, SCHEMES[name](0.5), start, args, h=4e-3, num_steps=50, root_finder=finder
    )
    runs = run(Newton()), run(Newton(linear_solver=lx.LU()))
    # Solver: round-off of fifty steps.
    np.testing.assert_allclose(runs[0].ys.q, runs[1].ys.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(runs[0].ys.v, runs[1].ys.v, rtol=0, atol=1e-11)


def test_newton_follows_where_springs_are_too_stiff_for_the_chord():
    """Two points on rods, held by nonlinear springs of a hundred radians a step."""
    soft = lambda x: x * jnp.tanh(x)
    system = ej.System(
        jnp.eye(4),
        lambda q, args: 0.5 * args * (soft(q[1]) + soft(q[3] - q[1])),
        lambda q, args: jnp.array([q[:2] @ q[:2] - 1, jnp.sum((q[2:] - q[:2]) ** 2) - 1]),
    )
    stiffness = (100 / 0.01) ** 2
    start = ej.initial_state(
        system, [1.0, 0.0, 2.0, 0.0], [0.0, 1.0, 0.0, 0.5], args=stiffness
    )
    sol = ej.simulate(system, ej.EnergyPreserving(), start, stiffness, h=0.01, num_steps=60)
    energy = sol.audit.energy
    assert jnp.ptp(energy) <= 60 * 100 * EPS * energy[0]  # round-off


# Programs without the exact Jacobian ------------------------------------------------------


@pytest.fixture
def searched_by(monkeypatch):
    """The root finders of the programs that runs have used, by name."""
    # Without what other tests have shown of the same systems.
    experience.remembered.cache_clear()
    module, names = sys.modules["enerjax._run.simulate"], []
    run = module._run

    def recorded(task):
        names.append(type(task.root_finder).__name__)
        return run(task)

    monkeypatch.setattr(module, "_run", recorded)
    return names


def test_a_run_that_needs_newton_is_made_again_with_it_once(searched_by):
    """A falling chain of 8 points: the chord method is too slow for h = 0.02."""
    system, start, args = ej.problems.chain(8)

    def run(h):
        searched_by.clear()
        sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=60)
        return sol, list(searched_by)

    assert run(0.002)[1] == ["ChordAlone"]
    sol, names = run(0.02)
    assert names == ["ChordAlone", "Newton"]
    assert run(0.002)[1] == ["Newton"]  # remembered
    energy = sol.audit.energy
    assert jnp.ptp(energy) <= 60 * 100 * EPS * jnp.max(sol.audit.kinetic)  # round-off
    # Under `jit` the program has both methods from the beginning. Solver: round-off.
    both = jax.jit(
        lambda h: ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=60)
    )(0.02)
    np.testing.assert_allclose(sol.ys.q, both.ys.q, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_residuals_of_two_levels_may_shrink_in_turn(searched_by):
    """In a slider-crank a correction can leave most of a residual, the next one little."""
    system, start, args = ej.problems.slider_crank()
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=1e-3, num_steps=200)
    assert searched_by == ["ChordAlone"]
    # Solver: round-off of 200 steps.
    assert jnp.max(jnp.abs(sol.audit.leak)) <= 1e3 * EPS * jnp.max(sol.audit.kinetic)


@pytest.mark.slow
def test_what_is_round_off_grows_with_the_system(searched_by):
    """The residual of 512 points in their first steps stays above 1e-13."""
    system, start, args = ej.problems.chain(512)
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=1e-4, num_steps=3)
    assert searched_by == ["ChordAlone"]
    # Round-off of the energies of 512 points.
    assert jnp.max(jnp.abs(sol.audit.leak)) <= 512 * EPS * jnp.ptp(sol.audit.potential)


@pytest.mark.parametrize("damped", long([False, True], True))
@pytest.mark.slow
def test_stiff_forces_are_noticed_before_the_first_program(searched_by, damped):
    """A row of points on nonlinear springs, or in dampers, of ten radians a step."""
    size, h, strength = 12, 0.01, 1e3
    stiffness = 0.0 if damped else strength**2
    force = lambda q, v, t, args: -args["c"] * v
    system = ej.System(
        jnp.eye(2 * size),
        lambda q, args: 9.81 * jnp.sum(q[::2]) - args["k"] * jnp.sum(jnp.cos(q[1::2])),
        lambda q, args: q[::2] - 0.1 * q[1::2] ** 2,
        force=force if damped else None,
    )
    args = dict(k=stiffness, c=strength)
    start = ej.initial_state(system, jnp.zeros(2 * size), jnp.ones(2 * size), args)
    ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=3)
    assert searched_by == ["Newton"]


def test_springs_do_not_need_newton_however_stiff_they_are(searched_by):
    """A spatial chain with springs of a thousand radians a step in its hinges."""
    mechanism = space.with_springs(space.chain(3), 1e8)
    system, start, args = mechanism.scene().build()
    run = lambda finder: ej.simulate(
        system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=20, root_finder=finder
    )
    sol = run(Newton())
    assert searched_by == ["ChordAlone"]
    by_newton = run(Newton(linear_solver=lx.LU()))
    # Solver: round-off of the forces of the springs over 20 steps.
    np.testing.assert_allclose(sol.ys.q, by_newton.ys.q, rtol=0, atol=1e-11)
    assert jnp.max(jnp.abs(sol.audit.leak)) <= 1e3 * EPS
    assert "3 of the rows are those of strains" in str(
        ej.explain(system, ej.EnergyPreserving(), start, args)
    )


@pytest.mark.parametrize("scheme", [ej.EnergyPreserving(), ej.EnergyDecaying(0.5)])
def test_dampers_and_servos_do_not_need_newton_however_strong_they_are(searched_by, scheme):
    """A spatial chain with dampers and servos that no step resolves in its hinges."""

    def torque(view, t, args, k):
        return args["gain"] * (0.1 * t - view.angle(f"servo {k}") - view.rate(f"servo {k}"))

    parts = []
    for k, (before, axis) in enumerate(zip(("ground", "0", "1"), np.eye(3), strict=True)):
        ends = before, str(k)
        at = [0.3 * k, 0.0, 0.1 * k]
        body = ej.bodies.RigidBody(str(k), 1.0, [0.01, 0.02, 0.03], at)
        hinge = ej.joints.Revolute(f"hinge {k}", *ends, point_b=[-0.15, 0, 0], axis=axis)
        spring = ej.forces.TorsionSpring(f"spring {k}", *ends, 50.0, axis=axis)
        damper = ej.forces.TorsionDamper(f"damper {k}", *ends, 1e4, axis=axis)
        servo = ej.forces.TorsionActuator(
            f"servo {k}", *ends, functools.partial(torque, k=k), axis=axis
        )
        parts += [body, hinge, spring, servo if k == 1 else damper]
    scene = ej.Scene(parts, gravity=[0, 1, -9.81], args=dict(gain=1e4))
    system, start, args = scene.build()
    run = lambda finder: ej.simulate(
        system, scheme, start, args, h=0.01, num_steps=20, root_finder=finder
    )
    sol = run(Newton())
    assert searched_by == ["ChordAlone"]
    by_newton = run(Newton(linear_solver=lx.LU()))
    # Solver: round-off of the forces of the dampers over 20 steps.
    np.testing.assert_allclose(sol.ys.q, by_newton.ys.q, rtol=0, atol=1e-10)
    assert jnp.max(jnp.abs(sol.audit.leak)) <= 1e4 * EPS
    assert "6 of the rows are those of strains and dampers" in str(
        ej.explain(system, scheme, start, args)
    )


@pytest.mark.parametrize("name", ["preserving", "decaying"])
@pytest.mark.slow_for("decaying")
def test_a_law_without_a_slope_at_rest_is_left_out(searched_by, name):
    """`-c |v| v`: its slope at rest is the derivative of the root of zero."""
    body = ej.bodies.RigidBody("rod", 1.0, [0.01, 0.02, 0.03], [0.5, 0.0, 0.0])
    hinge = ej.joints.Revolute("hinge", "ground", "rod", [0, 0, 0], axis=[0, 1, 0])
    drag = Drag("drag", "ground", "rod", 0.1)
    system, start, args = ej.Scene([body, hinge, drag], gravity=[0, 0, -9.81]).build()
    sol = ej.simulate(system, CHORDS[name], start, args, h=0.01, num_steps=20)
    assert searched_by == ["ChordAlone"]
    assert jnp.max(jnp.abs(sol.audit.leak)) <= 1e3 * EPS


@pytest.mark.parametrize("seed", range(4))
def test_each_round_eliminates_what_causes_the_least_fill(seed):
    draw, count = np.random.default_rng(seed), 40
    coupled = np.tril(draw.random((count, count)) < 0.06, -1)
    coupled = coupled | coupled.T
    adjacent = [set(np.flatnonzero(row).tolist()) for row in coupled]
    order = elimination_order([np.array([k]) for k in range(count)], adjacent)
    assert order is not None

    def fill(k):
        near = np.flatnonzero(coupled[k])
        pairs = np.tril_indices(near.size, -1)
        return np.count_nonzero(~coupled[np.ix_(near, near)][pairs])

    left = set(range(count))
    for of in order.rounds:
        least = max(1, min(map(fill, left)))
        assert max(map(fill, of.nodes)) <= least
        for k, neighbours in zip(of.nodes, of.neighbours, strict=True):
            assert neighbours == np.flatnonzero(coupled[k]).tolist()
        for k in of.nodes:
            near = np.flatnonzero(coupled[k])
            coupled[np.ix_(near, near)] = ~np.eye(near.size, dtype=bool)
            coupled[k], coupled[:, k] = False, False
        left -= set(of.nodes)
    assert sorted(left) == order.left


def test_the_stiffness_of_a_net_is_left_to_newton():
    """Its elimination would take many rounds."""
    size = 8
    net = np.arange(size**2).reshape(size, size)
    ends = np.concatenate([
        np.stack([net[:, :-1].ravel(), net[:, 1:].ravel()], axis=1),
        np.stack([net[:-1].ravel(), net[1:].ravel()], axis=1),
    ])  # fmt: skip
    springs = lambda q, args: jnp.sum((q[ends[:, 0]] - q[ends[:, 1]]) ** 2)
    held = lambda q, args: q[:2]
    system = ej.System(jnp.eye(2 * size**2), springs, held)
    start = ej.State(jnp.zeros(2 * size**2), jnp.zeros(2 * size**2))
    model = make_model(system, start, None, chord_terms=(("strains",),))
    assert isinstance(model, SeparableModel)
    assert model.has_delassus_matrix
    assert model.elastic_tables is None


@pytest.mark.parametrize(
    ("transform", "finder"), [(jax.vmap, "Newton"), (jax.grad, "ChordAlone")]
)
def test_a_traced_number_in_a_closure_is_noticed(searched_by, transform, finder):
    def run(length):
        system = ej.System(
            jnp.eye(2),
            lambda q, args: 9.81 * q[1],
            lambda q, args: jnp.array([q @ q - length**2]),
        )
        start = ej.State(jnp.array([length, 0.0]), jnp.zeros(2))
        sol = ej.simulate(system, ej.EnergyPreserving(), start, h=0.01, num_steps=5)
        return sol.ys.q[-1, 1]

    found = transform(run)(jnp.array([1.0, 2.0]) if transform is jax.vmap else 1.0)
    assert jnp.all(jnp.isfinite(found))
    assert set(searched_by) == {finder}


@pytest.mark.parametrize(
    ("h", "finders"), [pytest.param(2e-3, 1, marks=pytest.mark.slow), (0.02, 2)]
)
@pytest.mark.slow
def test_derivatives_alone_do_not_need_newton_either(searched_by, h, finders):
    """Outside of `jit` it is known whether the run of a derivative has failed."""
    system, start, args = ej.problems.chain(8)

    def end(h):
        sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=60)
        return sol.ys.q[-1, -1]

    slope = jax.grad(end)(h)
    assert searched_by == ["ChordAlone", "Newton"][:finders]
    together = jax.jit(lambda h: jax.jvp(end, (h,), (1.0,))[1])(h)
    # Solver: round-off, grown over 60 steps.
    np.testing.assert_allclose(slope, together, rtol=1e-9)


def test_a_failure_that_newton_cannot_mend_is_made_once(searched_by):
    system, start, args = ej.problems.chain(8)
    off = ej.State(start.q * 1.1, start.v)
    sol = ej.simulate(
        system, ej.EnergyPreserving(), off, args, h=1e-3, num_steps=3, throw=False
    )
    assert sol.result == ej.RESULTS.inconsistent_start
    assert len(searched_by) == 1


@pytest.mark.slow
def test_a_run_that_fails_in_both_ways_is_forgotten(searched_by):
    system, start, args = ej.problems.chain(5)

    def run(h):
        searched_by.clear()
        ej.simulate(
            system, ej.EnergyPreserving(), start, args, h=h, num_steps=8, throw=False
        )
        return list(searched_by)

    assert run(5.0) == ["ChordAlone", "Newton"]
    assert run(1e-3) == ["ChordAlone"]


# Systems without constraints --------------------------------------------------------------


def _free_masses(count, stiffness):
    """Masses in a row, on springs whose tension is linear in the length or not."""

    def potential(q, args):
        change = jnp.diff(q)
        squares = 0.5 * stiffness * jnp.sum(change**2)
        return squares + jnp.sum(jnp.cosh(change)) + 0.1 * jnp.sum(q**4)

    masses = jnp.diag(1.0 + jnp.arange(float(count)) % 3.0)
    q = 0.3 * jnp.cos(jnp.arange(1.0, count + 1))
    return ej.System(masses, potential), ej.State(q, q[::-1])


FREE = [
    ej.EnergyPreserving(),
    ej.EnergyConsistent(0.0),
    ej.EnergyDecaying(0.5),
    ej.Composed(ej.EnergyPreserving(), 4),
]


@pytest.mark.parametrize("stiffness", [1.0, 1e4])
@pytest.mark.parametrize("scheme", FREE, ids=str)
def test_free_masses_move_as_with_newtons_method(scheme, stiffness):
    system, start = _free_masses(12, stiffness)
    run = functools.partial(ej.simulate, system, scheme, start, h=0.01, num_steps=50)
    assert ej.explain(system, scheme, start).method.startswith("chord method")
    found = run()
    exact = run(root_finder=ej.Newton(linear_solver=lx.LU()))
    # Round-off, which the stiff springs amplify.
    np.testing.assert_allclose(found.ys.q, exact.ys.q, atol=1e-10)
    scale = jnp.max(jnp.abs(found.audit.energy))
    assert jnp.max(jnp.abs(found.audit.leak)) < 1e-13 * scale


def test_few_coordinates_without_constraints_have_newtons_method_alone():
    for count, has_chord in ((8, False), (9, True)):
        system, start = _free_masses(count, 1.0)
        method = ej.explain(system, ej.EnergyPreserving(), start).method
        assert method.startswith("chord method") == has_chord


def test_impulses_of_strains_are_eliminated_in_blocks():
    """Of a truss with more bars than coordinates, which has no rows of strains."""
    places = np.array([[x, y] for x in range(6) for y in range(2)], float)
    ends = np.array([
        (i, j)
        for i in range(12)
        for j in range(i)
        if np.linalg.norm(places[i] - places[j]) < 1.5
    ])  # fmt: skip
    columns = np.concatenate([2 * ends[:, :1] + [0, 1], 2 * ends[:, 1:] + [0, 1]], axis=1)
    rest = jnp.asarray(np.linalg.norm(places[ends[:, 0]] - places[ends[:, 1]], axis=1))
    length = lambda x: jnp.sqrt(jnp.sum((x[:2] - x[2:]) ** 2))
    bars = ej.Elements.from_strains(
        lambda x, k, _: length(x) - rest[k], lambda k, _: 1e5, columns
    )
    system = ej.System(jnp.eye(24), bars)
    start = ej.State(places.ravel(), 0.1 * np.sin(np.arange(24)))
    scheme = ej.EnergyMomentumDecaying(0.5)
    assert "blocks" in ej.explain(system, scheme, start, h=0.01).jacobian
    run = functools.partial(ej.simulate, system, scheme, start, h=0.01, num_steps=20)
    found, exact = run(), run(root_finder=ej.Newton(linear_solver=lx.LU()))
    # Solver.
    np.testing.assert_allclose(found.ys.q, exact.ys.q, atol=1e-10)
