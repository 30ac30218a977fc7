"""Systems of many unknowns: the pattern of the Jacobian, band solvers, and runs."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.sparse import csr_array

import enerjax as ej
from enerjax._programs.sparsity.pattern import jacobian_pattern
from enerjax._solvers.linear.block_diagonal import BlockDiagonal, hessian, inverse_of
from enerjax._solvers.linear.block_elimination import BlockElimination
from enerjax._solvers.linear.jacobian import Dense, RowPattern

from .helpers import EPS, SCHEMES


MATRIX = jnp.asarray(np.random.default_rng(0).normal(size=(5, 6)))
FUNCTIONS = {
    "rods": (lambda x: jnp.sum(jnp.diff(x.reshape(-1, 2), axis=0) ** 2, axis=1), True),
    "springs": (
        jax.grad(lambda x: jnp.sum(jnp.linalg.norm(jnp.diff(x.reshape(-1, 2), axis=0)))),
        False,
    ),
    "discrete": (
        lambda x: ej.discrete_grad(
            lambda y: jnp.sum(jnp.diff(y.reshape(-1, 2), axis=0) ** 4)
        )(x, x + 1.0),
        True,
    ),
    "gather": (lambda x: x[jnp.array([1, 3, 5])] * x[::2][:3], True),
    "scatter": (
        lambda x: jnp.zeros(6).at[jnp.array([0, 2, 2])].add(x[6:9] ** 2) + x[:6],
        True,
    ),
    "add": (lambda x: x.at[jnp.array([0, 2, 2])].add(x[6:9] ** 2), True),
    "set": (lambda x: x.at[2].set(x[0] * x[1]), True),
    "dot": (lambda x: MATRIX @ x[:6], True),
    "dots": (lambda x: (x[:6].reshape(2, 3) @ x[6:].reshape(3, 2)).ravel(), True),
    "batched": (
        lambda x: jnp.einsum("bi,bij->bj", x[:4].reshape(2, 2), x[4:].reshape(2, 2, 2)),
        True,
    ),
    "choice": (lambda x: jnp.where(jnp.arange(x.size) > 4, x, x[::-1]), True),
    "concatenate": (lambda x: jnp.concatenate([x[:2], jnp.zeros(3), x[4:] ** 2]), True),
    "cross": (lambda x: jnp.cross(x[:3], x[3:6]), False),
    "stack": (lambda x: jnp.stack([x[0] * x[1], jnp.sin(x[2]), x[11]]), True),
    "reordered": (lambda x: (x**2).reshape(3, 4).ravel(order="F"), True),
    "roll": (lambda x: jnp.roll(x, 1) * x, True),
    "vmap": (lambda x: jax.vmap(lambda i: x[i] * x[i + 1])(jnp.arange(11)), True),
    "outer": (lambda x: jnp.outer(x, x)[jnp.triu_indices(3)], True),
    "mask": (lambda x: (jnp.eye(12) * x[None, :] * x[:, None]).sum(axis=1), True),
    "norm": (lambda x: x / jnp.linalg.norm(x), True),
    "scan": (lambda x: jax.lax.scan(lambda c, y: (c + y, c), 0.0, x)[1], False),
    "max": (lambda x: jnp.max(x.reshape(3, 4), axis=1), False),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_pattern_covers_the_jacobian(name):
    fn, is_exact = FUNCTIONS[name]
    x = jnp.asarray(np.random.default_rng(1).normal(size=12))
    found = jacobian_pattern(fn, x)
    assert found is not None
    pattern = found.toarray()
    jacobian = np.asarray(jax.jit(jax.jacfwd(fn))(x) != 0).reshape(pattern.shape)
    assert not np.any(jacobian & ~pattern)
    if is_exact:
        np.testing.assert_array_equal(jacobian, pattern)


@pytest.mark.slow
def test_a_pattern_that_is_too_dense_is_none(monkeypatch):
    """A system of such functions runs all the same, densely."""
    monkeypatch.setattr("enerjax._programs.sparsity.pattern._MAX_ENTRIES", 1000)
    size = 40
    mixed = lambda x: jnp.sin(jnp.cumsum(x))
    assert jacobian_pattern(mixed, jnp.ones(size)) is None
    x = jnp.ones(size + 40)
    rows = RowPattern(mixed, x)
    np.testing.assert_allclose(rows.derivative(mixed, x), jax.jacfwd(mixed)(x))
    system = ej.System(
        lambda v, args: 0.5 * jnp.sum(v**2) + 0.1 * jnp.sum(v) ** 2,
        lambda q, args: jnp.sum(jnp.cumsum(q) ** 4),
        lambda q, args: jnp.sum(q[:2] ** 2)[None] - 1,
    )
    q = jnp.concatenate([jnp.array([1.0]), jnp.zeros(2 * size)])
    start = ej.initial_state(system, q, jnp.zeros_like(q))
    run = ej.simulate(system, ej.EnergyPreserving(), start, h=1e-3, num_steps=3)
    assert np.ptp(run.audit.energy) <= 100 * EPS * run.audit.energy[0]  # round-off


def _with_multipliers(graph, rng, own=3, rows=2):
    """The matrix of bodies, and of constraints along the edges of a graph of them.

    The unknowns are shuffled. Blocks of the bodies are not symmetric, and couple
    neighbours; the diagonal block of the multipliers is zero.
    """
    bodies, joints = 1 + max(map(max, graph)), len(graph)
    size = own * bodies + rows * joints
    matrix = np.zeros((size, size))
    place = lambda k: slice(own * k, own * (k + 1))
    for k in range(bodies):
        matrix[place(k), place(k)] = 4 * np.eye(own) + rng.normal(size=(own, own))
    for number, (a, b) in enumerate(graph):
        joint = own * bodies + rows * number + np.arange(rows)
        matrix[place(a), place(b)] = 0.3 * rng.normal(size=(own, own))
        matrix[place(b), place(a)] = 0.3 * rng.normal(size=(own, own))
        for k in (a, b):
            matrix[joint, place(k)] = rng.normal(size=(rows, own))
            matrix[place(k), joint] = rng.normal(size=(own, rows))
    owners = np.concatenate([np.arange(own * bodies), -1 - np.arange(rows * joints)])
    order = rng.permutation(size)
    return matrix[order][:, order], owners[order]


GRAPHS = {
    "chain": [(k, k + 1) for k in range(40)],
    "tree": [((k - 1) // 2, k) for k in range(1, 40)],
    "ring": [(k, (k + 1) % 30) for k in range(30)],
    "ladder": [(k, k + 2) for k in range(30)] + [(k, k + 1) for k in range(0, 30, 6)],
    "apart": [(2 * k, 2 * k + 1) for k in range(20)],
}


@pytest.mark.parametrize("name", GRAPHS)
def test_bodies_with_constraints_are_eliminated_in_blocks(name):
    rng = np.random.default_rng(len(name))
    matrix, owners = _with_multipliers(GRAPHS[name], rng)
    size = owners.size
    elimination = BlockElimination(csr_array(matrix != 0), tuple(owners.tolist()))
    assert elimination.width <= 16
    # One product for each pair of neighbours: far below those of a dense matrix.
    assert elimination.changes.shape[0] * elimination.width**3 < 0.03 * size**3
    entries = elimination.evaluate(lambda x: jnp.asarray(matrix) @ x, jnp.zeros(size))
    factors = elimination.empty(size, float).renewed(entries)
    right = rng.normal(size=size)
    bound = 100 * np.linalg.cond(matrix) * EPS  # round-off
    for found, of in (
        (factors.solve(jnp.asarray(right)), matrix),
        (factors.solve_transposed(jnp.asarray(right)), matrix.T),
    ):
        exact = np.linalg.solve(of, right)
        assert np.max(np.abs(found - exact)) <= bound * np.max(np.abs(exact))


def test_relations_stay_with_the_coordinates_that_they_relate():
    """Without its relation, the inertia of a quaternion at rest is singular."""
    rng = np.random.default_rng(3)
    matrix, owners = _with_multipliers(GRAPHS["chain"], rng, own=2, rows=1)
    size, owners = owners.size, [*owners.tolist(), *range(1000, 1004), None]
    whole = np.zeros((size + 5, size + 5))
    whole[:size, :size] = matrix
    quaternion, relation = np.array([1.0, 0.0, 0.0, 0.0]), size + 4
    own = slice(size, relation)
    whole[own, own] = np.diag([0.0, 1.0, 2.0, 3.0])
    whole[own, relation] = whole[relation, own] = quaternion
    pattern = whole != 0
    pattern[own, own] = pattern[own, relation] = pattern[relation, own] = True
    elimination = BlockElimination(csr_array(pattern), tuple(owners))
    assert np.unique(elimination.back[size:] // elimination.width).size == 1
    entries = elimination.evaluate(lambda x: jnp.asarray(whole) @ x, jnp.zeros(size + 5))
    factors = elimination.empty(size + 5, float).renewed(entries)
    right = rng.normal(size=size + 5)
    exact = np.linalg.solve(whole, right)
    bound = 100 * np.linalg.cond(whole) * EPS  # round-off
    found = factors.solve(jnp.asarray(right))
    assert np.max(np.abs(found - exact)) <= bound * np.max(np.abs(exact))


def test_blocks_are_eliminated_in_lanes_of_their_own():
    """Each lane exchanges rows as its own numbers require."""
    rng = np.random.default_rng(5)
    matrix, owners = _with_multipliers(GRAPHS["chain"], rng)
    elimination = BlockElimination(csr_array(matrix != 0), tuple(owners.tolist()))
    scales = rng.normal(size=(6, owners.size)) + 3
    right = rng.normal(size=(6, owners.size))

    def solution(scale, right):
        apply = lambda x: scale * (jnp.asarray(matrix) @ x)
        entries = elimination.evaluate(apply, jnp.zeros(owners.size))
        return elimination.empty(owners.size, float).renewed(entries).solve(right)

    lanes = jax.jit(jax.vmap(solution))(scales, right)
    bound = 100 * np.linalg.cond(matrix) * EPS  # round-off
    for found, scale, given in zip(lanes, scales, right, strict=True):
        exact = np.linalg.solve(matrix, given / scale)
        assert np.max(np.abs(found - exact)) <= bound * np.max(np.abs(exact))


def test_a_dense_matrix_of_columns_that_are_found_together():
    """Neighbours on a ring share rows; others are found three or four at a time."""
    fn = lambda x: jnp.sin(x) * jnp.roll(x, 1) + jnp.roll(x, -1) ** 2
    x = jnp.linspace(0.1, 2.0, 40)
    pattern = jacobian_pattern(fn, x)
    assert pattern is not None
    found = Dense(None, pattern).evaluate(fn, x)
    np.testing.assert_allclose(found, jax.jacfwd(fn)(x), rtol=0, atol=10 * EPS)


@pytest.mark.slow
def test_the_inertia_of_many_bodies_is_kept_in_blocks():
    rng = np.random.default_rng(0)
    blocks = rng.normal(size=(30, 3, 3))
    blocks = jnp.asarray(blocks @ blocks.swapaxes(1, 2) + np.eye(3))
    energy = lambda v: (
        0.5 * jnp.einsum("ki,kij,kj", v[:90].reshape(-1, 3), blocks, v[:90].reshape(-1, 3))
        + 2.0 * jnp.sum(v[90:] ** 2)
    )
    inertia, x = hessian(energy, jnp.zeros(97)), jnp.asarray(rng.normal(size=97))
    assert isinstance(inertia, BlockDiagonal)
    full = jax.hessian(energy)(jnp.zeros(97))
    np.testing.assert_allclose(inertia @ x, full @ x, rtol=1e-13)
    np.testing.assert_allclose(x @ inertia, full @ x, rtol=1e-13)
    np.testing.assert_allclose(inertia.diagonal(), np.diagonal(full), rtol=1e-13)
    np.testing.assert_allclose(inverse_of(inertia) @ (full @ x), x, rtol=1e-10)


def test_padded_blocks_couple_no_others():
    """Also where the blocks are not known: smaller ones read no row of another block."""
    energy = lambda v, m: (
        m * (jnp.sum(jnp.sum(v[:90].reshape(-1, 3), axis=1) ** 2) + jnp.sum(v[90:] ** 2))
    )
    found = []

    @jax.make_jaxpr
    def product(m):
        inertia = hessian(lambda v: energy(v, m), jnp.zeros(97))
        found.append(jacobian_pattern(lambda x: inertia @ x, jnp.zeros(97)))
        return inertia @ jnp.zeros(97)

    product(2.0)
    (pattern,) = found
    assert pattern is not None
    assert pattern.nnz == 30 * 9 + 7


def test_zeros_within_the_blocks_of_bodies_are_known():
    """A body has one block, in which its translations are coupled with nothing else."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 3, 3))
    polar = jnp.asarray(root @ root.swapaxes(1, 2))

    def energy(v):
        moved, turned = v.reshape(4, 2, 3).swapaxes(0, 1)
        spin = jnp.einsum("ki,kij,kj", turned, polar, turned)
        return jnp.sum(moved**2) + 0.5 * spin

    bodies = np.repeat(np.arange(4), 6)
    inertia, full = hessian(energy, jnp.zeros(24), bodies), jax.hessian(energy)
    assert isinstance(inertia, BlockDiagonal)
    assert inertia.blocks.shape == (4, 6, 6)
    coupled = np.eye(6, dtype=bool)
    coupled[3:, 3:] = True
    np.testing.assert_array_equal(inertia.places.coupled, coupled)
    x = jnp.asarray(rng.normal(size=24))
    expected = full(jnp.zeros(24)) @ x
    np.testing.assert_allclose(inertia @ x, expected, rtol=0, atol=100 * EPS)
    np.testing.assert_allclose(inverse_of(inertia) @ expected, x, rtol=0, atol=1e5 * EPS)


NUM_LINKS = 20


@functools.cache
def _chain(scheme):
    system, start, args = ej.problems.chain(NUM_LINKS)
    return ej.simulate(system, SCHEMES[scheme](0.5), start, args, h=2e-3, num_steps=20)


@pytest.mark.parametrize(
    "scheme", ["preserving", pytest.param("decaying", marks=pytest.mark.slow)]
)
def test_a_chain_moves_as_with_a_dense_solver(scheme):
    system, start, args = ej.problems.chain(NUM_LINKS)
    dense = ej.simulate(
        system, SCHEMES[scheme](0.5), start, args,
        h=2e-3, num_steps=20, root_finder=optx.Newton(1e-9, 1e-9),
    )  # fmt: skip
    run = _chain(scheme)
    assert jnp.max(jnp.abs(run.ys.q - dense.ys.q)) <= 1e-10  # solver
    assert jnp.max(jnp.abs(run.ys.v - dense.ys.v)) <= 1e-8
    leak = jnp.diff(run.audit.energy) + run.audit.dissipated[1:]
    assert jnp.max(jnp.abs(leak)) <= 50 * EPS
    assert jnp.max(jnp.abs(run.audit.constraint)) <= 50 * EPS


@pytest.mark.slow
def test_derivatives_of_a_chain():
    system, start, args = ej.problems.chain(NUM_LINKS)

    def tip(m):
        run = ej.simulate(
            system, ej.EnergyPreserving(), start, args | {"m": m}, h=2e-3, num_steps=20
        )
        return run.ys.q[-1, -1]

    direction = jnp.cos(jnp.arange(float(NUM_LINKS))) / NUM_LINKS
    value = jax.jit(jax.grad(tip))(args["m"]) @ direction
    push = jax.jit(lambda m: jax.jvp(tip, (m,), (direction,)))
    step = 1e-4
    ends = (push(args["m"] + sign * step * direction)[0] for sign in (1, -1))
    change = next(ends) - next(ends)
    assert value == pytest.approx(float(push(args["m"])[1]), rel=1e-10)  # round-off
    assert value == pytest.approx(float(change / (2 * step)), rel=1e-6)  # truncation


@pytest.mark.slow
def test_lanes_of_chains_are_independent():
    system, start, args = ej.problems.chain(NUM_LINKS)
    run = eqx.filter_jit(
        lambda g: ej.simulate(
            system, ej.EnergyPreserving(), start, args | {"g": g}, h=2e-3, num_steps=20
        ).ys.q[-1]
    )
    both = jax.vmap(run)(jnp.array([9.81, 3.0]))
    alone = _chain("preserving").ys.q[-1]
    assert jnp.max(jnp.abs(both[0] - alone)) <= 1e-11  # solver


@pytest.mark.slow
def test_repeated_constraints_of_a_large_system_are_reported():
    system, start, args = ej.problems.chain(300)
    assert isinstance(system, ej.System)
    assert system.constraint is not None
    once = system.constraint
    twice = ej.System(
        system.kinetic,
        system.potential,
        lambda q, args: jnp.concatenate([once(q, args)] * 2),
    )
    with pytest.raises(ValueError, match="do not determine their multipliers"):
        ej.initial_state(twice, start.q, start.v, args)


@pytest.mark.slow
@pytest.mark.parametrize("num_links", [64, 512])
def test_a_chain_that_cracks_like_a_whip_keeps_energy_and_constraints(num_links):
    """At the whip of the longer chain some steps have to be divided."""
    system, start, args = ej.problems.chain(num_links)
    run = ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        args,
        h=1e-3,
        num_steps=2000,
        saveat=ej.SaveAt(every=10),
    )
    turnover = float(jnp.sum(args["m"] * args["g"] * jnp.cumsum(args["l"])))
    length = 1 / num_links
    assert np.ptp(run.audit.energy) <= 1e-11 * turnover  # solver
    assert np.max(np.abs(run.audit.constraint)) <= 1e-9 * length**2
    assert np.max(np.abs(run.audit.constraint_rate)) <= 1e-9 * length**2
