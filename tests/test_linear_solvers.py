"""Linear solvers of the user's choice."""

import jax
import lineax as lx
import numpy as np
import pytest

import enerjax as ej


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [*(pytest.param(x, marks=pytest.mark.slow) for x in ("LU", "QR")), "KLU"]
)
def test_the_linear_solver_of_the_user_is_used(solver):
    """The same motion and derivatives, whoever solves the linear systems."""
    if solver == "KLU":
        pytest.importorskip("klujax")
    given = ej.KLU() if solver == "KLU" else getattr(lx, solver)()
    num_links = 20 if solver == "KLU" else 3
    system, start, args = ej.problems.chain(num_links)

    def end(g, root_finder):
        run = ej.simulate(
            system,
            ej.EnergyPreserving(),
            start,
            args | {"g": g},
            h=2e-3,
            num_steps=10,
            root_finder=root_finder,
        )
        return run.ys.q[-1]

    def push(newton):
        return jax.jit(lambda g: jax.jvp(lambda g: end(g, newton), (g,), (1.0,)))(9.81)

    q, derivative = push(ej.Newton(linear_solver=given))
    expected, rate = push(ej.Newton())
    np.testing.assert_allclose(q, expected, atol=1e-11)  # solver
    np.testing.assert_allclose(derivative, rate, atol=1e-10)  # solver
    pulled = jax.jit(jax.grad(lambda g: end(g, ej.Newton(linear_solver=given))[-1]))(9.81)
    assert pulled == pytest.approx(float(rate[-1]), rel=1e-9)  # solver


def test_a_wrong_linear_solver_raises_an_error():
    with pytest.raises(TypeError, match="solver of lineax"):
        ej.Newton(linear_solver=np.linalg.solve)  # pyright: ignore
