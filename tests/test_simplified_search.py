"""Newton's method uses a simplified Jacobian for large systems, with the same solutions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.sparse import csr_array

import enerjax as ej
from enerjax._operators import SeparableModel
from enerjax._programs.sparsity.pattern import jacobian_pattern
from enerjax._solvers import find_root, Newton
from enerjax._solvers.linear.banded import Band

from .helpers import EPS, SCHEMES


NUM_LINKS, SIZE = 20, 100


def test_a_band_is_cut_into_the_blocks_that_it_is_made_of():
    """Blocks as wide as the band would be of seven unknowns."""
    neighbours = np.abs(np.subtract.outer(np.arange(30), np.arange(30))) <= 1
    rng = np.random.default_rng(0)
    order = rng.permutation(120)
    pattern = np.kron(neighbours, np.ones((4, 4)))[order][:, order]
    band = Band(csr_array(pattern != 0))
    assert band.width == 4
    matrix = pattern * rng.normal(size=pattern.shape)
    entries = band.evaluate(lambda x: jnp.asarray(matrix) @ x, jnp.zeros(120))
    right = rng.normal(size=120)
    x = band.empty(120, float).renewed(entries).solve(jnp.asarray(right))
    size = np.abs(np.linalg.inv(matrix)).max()
    np.testing.assert_allclose(matrix @ x, right, atol=1e4 * size * EPS)  # round-off


@pytest.mark.parametrize(
    ("scheme", "blocks"), [("preserving", (8, 4)), ("decaying", (16, 8))]
)
def test_the_simplified_jacobian_of_a_chain_has_its_pattern(scheme, blocks):
    """Links meet only their neighbours in it, and where nothing has moved it is exact."""
    system, start, args = ej.problems.chain(NUM_LINKS)
    assert isinstance(system, ej.System)
    model, scheme = SeparableModel(system, start, args), SCHEMES[scheme](0.5)
    problem = scheme.problem(model, start, jnp.asarray(1e-3))
    z = scheme.predict(problem, *model.accelerations(start))
    flat, unravel = ravel_pytree(z)
    flat = flat + 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=flat.size))

    def exact(x):
        return ravel_pytree(scheme.residual(unravel(x), problem))[0]

    def simplified(x):
        rows = scheme.residual(unravel(x), problem.with_weak_couplings_held())
        return ravel_pytree(rows)[0]

    np.testing.assert_allclose(simplified(flat), exact(flat), rtol=1e-12, atol=1e-15)
    for fn, width in zip((exact, simplified), blocks, strict=True):
        pattern = jacobian_pattern(fn, flat)
        assert pattern is not None
        assert Band(pattern).width == width
    # What it leaves out is weak, but there: it vanishes with the multipliers eta.
    off = [jnp.max(jnp.abs(jax.jacfwd(exact)(x) - jax.jacfwd(simplified)(x)))
           for x in (flat, ravel_pytree(z)[0])]  # fmt: skip
    assert off[0] > 1e-6 > 1e-12 > off[1]


def _equations(strength):
    """A band, and a coupling far along it that the simplified equations leave out."""

    def equations(x, far, args):
        near = 2 * x + 0.3 * jnp.sin(jnp.roll(x, 1).at[0].set(0)) - args
        return near + strength * jnp.arctan(jnp.roll(far, 9).at[:9].set(0))

    return _simplified_and_exact(equations)


def _simplified_and_exact(equations):
    """`equations(x, far, args)` with and without the derivatives by way of `far`."""
    return (
        lambda x, args: equations(x, jax.lax.stop_gradient(x), args),
        lambda x, args: equations(x, x, args),
    )


@pytest.mark.parametrize("strength", [1e-3, 0.3, 30.0])
def test_a_root_and_its_derivatives_do_not_depend_on_the_simplification(strength):
    """Neither if the neglected coupling is weak, nor if the search fails without it."""
    simplified, exact = _equations(strength)
    args = jnp.cos(jnp.arange(float(SIZE)))

    def root(args):
        guess = jnp.zeros(SIZE)
        return find_root(
            exact, Newton(), guess, args, max_iterations=50, jacobian_of=simplified
        )

    found, change = jax.jit(lambda a: jax.jvp(lambda a: root(a).value, (a,), (a,)))(args)
    assert jax.jit(root)(args).found
    assert jnp.max(jnp.abs(exact(found, args))) <= 100 * (1 + strength) * EPS  # round-off
    jacobian = jax.jacfwd(exact)(found, args)
    np.testing.assert_allclose(change, np.linalg.solve(jacobian, args), rtol=1e-9)


def test_only_the_search_uses_the_simplified_jacobian():
    """One correction with the simplified Jacobian leaves an error."""
    simplified, exact = _equations(0.3)
    args = jnp.cos(jnp.arange(float(SIZE)))
    count = lambda **kind: jax.jit(
        lambda args: (
            find_root(
                exact, Newton(), jnp.zeros(SIZE), args, max_iterations=50, **kind
            ).iterations
        )
    )(args)
    assert count(jacobian_of=simplified) > count()


def test_lanes_that_need_the_exact_jacobian_do_not_affect_others():
    args = jnp.cos(jnp.arange(float(SIZE)))

    def root(strength):
        simplified, exact = (
            lambda x, inputs, k=k: _equations(inputs[0])[k](x, inputs[1]) for k in (0, 1)
        )
        return find_root(
            exact, Newton(), jnp.zeros(SIZE), (strength, args), max_iterations=50,
            jacobian_of=simplified,
        )  # fmt: skip

    strengths = jnp.array([1e-3, 30.0])
    lanes = jax.jit(jax.vmap(root))(strengths)
    assert jnp.all(lanes.found)
    for k, strength in enumerate(strengths):
        alone = jax.jit(root)(strength)
        np.testing.assert_allclose(lanes.value[k], alone.value, rtol=1e-12)  # solver
        assert lanes.iterations[k] == alone.iterations


@pytest.mark.parametrize("off", [1e-3, 1e-7])
def test_slow_corrections_are_not_taken_for_round_off(off):
    """Each leaves about half of the one before, from where they are small on."""

    def equations(x, far, args):
        near = 2 * x + 0.3 * jnp.sin(jnp.roll(x, 1).at[0].set(0)) - args
        far = jnp.roll(far, 9).at[:9].set(0) + jnp.roll(far, -9).at[-9:].set(0)
        return near + 0.5 * jnp.sin(far)

    simplified, exact = _simplified_and_exact(equations)

    def root(guess, args):
        return find_root(
            exact, Newton(), guess, args, max_iterations=50, jacobian_of=simplified
        )

    args = jnp.cos(jnp.arange(float(SIZE)))
    noise = np.random.default_rng(0).normal(size=SIZE)
    at = jax.jit(root)(jnp.zeros(SIZE), args).value
    found = jax.jit(root)(at + off * noise, args)
    assert found.found
    rest = exact(found.value, args)
    assert jnp.max(jnp.abs(rest)) <= 100 * EPS  # round-off
