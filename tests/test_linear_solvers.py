"""Linear solvers of the user's choice."""

import jax
import lineax as lx
import numpy as np
import pytest

import enerjax as ej

from .helpers import chain_end


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["LU", "QR", "KLU"])
def test_the_linear_solver_of_the_user_is_used(solver):
    """The same motion and derivatives, whoever solves the linear systems."""
    if solver == "KLU":
        pytest.importorskip("klujax")
    given = ej.KLU() if solver == "KLU" else getattr(lx, solver)()
    num_links = 20 if solver == "KLU" else 3
    end = lambda g, solver: chain_end(g, solver, num_links)

    def push(solver):
        return jax.jit(lambda g: jax.jvp(lambda g: end(g, solver), (g,), (1.0,)))(9.81)

    q, derivative = push(given)
    expected, rate = push(None)
    np.testing.assert_allclose(q, expected, atol=1e-11)  # solver
    np.testing.assert_allclose(derivative, rate, atol=1e-10)  # solver
    pulled = jax.jit(jax.grad(lambda g: end(g, given)[-1]))(9.81)
    assert pulled == pytest.approx(float(rate[-1]), rel=1e-9)  # solver


def test_a_wrong_linear_solver_raises_an_error():
    with pytest.raises(TypeError, match="solver of lineax"):
        ej.Newton(linear_solver=np.linalg.solve)  # pyright: ignore
