"""A linear solver outside of the package that is written with public names is like all
others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import enerjax as ej

from .block_tridiagonal import along_chain
from .helpers import chain_end, code_of, HERE, imported, long


NUM_LINKS = 20


class SciPy(ej.AbstractSparseSolver):
    """SuperLU, called outside of JAX for each right-hand side; keeps nothing."""

    def factorise(self, pattern, entries):
        return entries

    def solve(self, pattern, factors, right):
        def by_scipy(entries, right):
            csr = np.asarray(entries), pattern.columns, pattern.row_starts
            matrix = scipy.sparse.csr_array(csr, shape=(pattern.size,) * 2)
            return scipy.sparse.linalg.splu(matrix.tocsc()).solve(np.asarray(right))

        like = jax.ShapeDtypeStruct(right.shape, right.dtype)
        return jax.pure_callback(by_scipy, like, factors, right, vmap_method="sequential")


# The velocity level couples links that are two apart: two links make a block.
SOLVERS = {"blocks": along_chain(NUM_LINKS, 2), "scipy": SciPy()}


@jax.jit
def pushed(g, linear_solver):
    return jax.jvp(lambda g: chain_end(g, linear_solver, NUM_LINKS), (g,), (1.0,))


def test_it_imports_public_names_alone():
    assert imported("block_tridiagonal.py") == {
        "enerjax", "equinox", "jax", "jax.numpy", "numpy"
    }  # fmt: skip


def test_the_tutorial_shows_this_file():
    assert (HERE / "block_tridiagonal.py").read_text() in code_of("write-your-own.md")


GS = jnp.array([5.0, 9.81])


@pytest.fixture(scope="module")
def expected():
    return [pushed(g, None) for g in GS]


@pytest.mark.slow
@pytest.mark.parametrize("name", long(SOLVERS, "scipy"))
def test_the_motion_and_its_derivatives_are_those_of_the_default(name, expected):
    """Forward in the lanes of a batch, in reverse alone."""
    solver = SOLVERS[name]
    lanes = jax.jit(jax.vmap(lambda g: pushed(g, solver)))(GS)
    for k, (q, rate) in enumerate(expected):
        np.testing.assert_allclose(lanes[0][k], q, atol=1e-11)  # solver
        np.testing.assert_allclose(lanes[1][k], rate, atol=1e-10)  # solver
    pulled = jax.jit(jax.grad(lambda g: chain_end(g, solver, NUM_LINKS)[-1]))(GS[1])
    assert pulled == pytest.approx(float(expected[1][1][-1]), rel=1e-9)  # solver


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
def test_lanes_of_a_batch_are_solved_apart(name):
    lanes = jax.jit(jax.vmap(lambda g: chain_end(g, SOLVERS[name], NUM_LINKS)))(GS)
    alone = [pushed(g, SOLVERS[name])[0] for g in GS]
    np.testing.assert_allclose(lanes, alone, atol=1e-12)  # solver


@pytest.mark.slow
def test_few_unknowns_go_to_the_given_solver_too():
    """Which the default solves densely: the solver is given, and is used."""
    sizes = []

    class Counting(ej.AbstractSparseSolver):
        def factorise(self, pattern, entries):
            sizes.append(pattern.size)
            dense = jnp.zeros((pattern.size, pattern.size), entries.dtype)
            return dense.at[pattern.rows, pattern.columns].set(entries)

        def solve(self, pattern, factors, right):
            return jnp.linalg.solve(factors, right)

    q = chain_end(9.81, Counting(), num_links=2)
    np.testing.assert_allclose(q, chain_end(9.81, None, num_links=2), atol=1e-12)  # solver
    assert set(sizes) == {8}


def test_a_singular_matrix_is_a_failure_of_the_run():
    class Broken(SciPy):
        def solve(self, pattern, factors, right):
            return jnp.full_like(right, jnp.nan)

    with pytest.raises(RuntimeError, match="became singular"):
        chain_end(9.81, Broken(), num_links=2)


def test_the_pattern_is_that_of_a_matrix_in_csr():
    """Against SciPy, which keeps a matrix in the same format."""
    random = np.random.default_rng(0)
    matrix = scipy.sparse.csr_array(random.random((7, 7)) * (random.random((7, 7)) < 0.3))
    rows = np.repeat(np.arange(7), np.diff(matrix.indptr))
    pattern = ej.SparsePattern(7, rows, matrix.indices)
    np.testing.assert_array_equal(pattern.row_starts, matrix.indptr)
    turned, order = pattern.transposed
    expected = scipy.sparse.csr_array(matrix.toarray().T)
    np.testing.assert_array_equal(turned.columns, expected.indices)
    np.testing.assert_array_equal(turned.row_starts, expected.indptr)
    np.testing.assert_array_equal(matrix.data[order], expected.data)


def test_wrong_shapes_and_types_are_told():
    class Short(SciPy):
        def solve(self, pattern, factors, right):
            return right[1:]

    class NoArray(SciPy):
        def solve(self, pattern, factors, right):
            return None

    class NoTree(ej.AbstractSparseSolver):
        def factorise(self, pattern, entries):
            return "LU"

        def solve(self, pattern, factors, right):
            return right

    with pytest.raises(ValueError, match=r"`Short.solve` must .*\[8\].*got .*\[7\]"):
        chain_end(9.81, Short(), num_links=2)
    with pytest.raises(ValueError, match="`NoArray.solve` must .* got NoneType"):
        chain_end(9.81, NoArray(), num_links=2)
    with pytest.raises(TypeError, match="`NoTree.factorise` must .* a str"):
        chain_end(9.81, NoTree(), num_links=2)
    with pytest.raises(TypeError, match="AbstractSparseSolver"):
        ej.Newton(linear_solver=np.linalg.solve)  # pyright: ignore
