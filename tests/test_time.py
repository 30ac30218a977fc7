"""Time-dependent systems can be differentiated and batched; others have no time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Literal

import enerjax as ej

from .driven_pendulum import (
    ARGS,
    DRIVEN_PENDULUM,
    driven_start,
    kinetic,
    moved_rod,
    potential,
    SCHEMES,
)


def reach(numbers, scheme):
    args = ARGS | dict(w=numbers[0], r=numbers[1])
    begin = driven_start(numbers[2], args)
    system = ej.System(
        kinetic, potential, driven=moved_rod, force=lambda q, v, t, args: -0.3 * v * t
    )
    run = ej.simulate(system, scheme, begin, args, h=0.02, num_steps=20, t0=numbers[2])
    return run.ys.q[-1] @ jnp.array([1.0, 0.3]) + run.audit.drive_work.sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheme",
    [
        ej.EnergyPreserving(),
        ej.EnergyDecaying(0.5),
        ej.EnergyConsistent(0.5),
    ],
    ids=lambda scheme: type(scheme).__name__,
)
def test_derivatives_by_frequency_amplitude_and_start(scheme):
    at, eps = jnp.array([5.0, 0.3, 0.2]), 1e-5
    run = jax.value_and_grad(lambda numbers: reach(numbers, scheme))
    shifts = eps * jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3), -jnp.eye(3)])
    values, slopes = jax.jit(jax.vmap(run))(at[None, :] + shifts)
    # Truncation, eps^2, and round-off, 1e-14 / eps.
    differences = (values[1:4] - values[4:]) / (2 * eps)
    np.testing.assert_allclose(slopes[0], differences, rtol=1e-6, atol=1e-7)
    # Amplitude and frequency act: against a comparison of zeros.
    assert np.min(np.abs(differences)) > 1e-2


def depends(jaxpr, source):
    """Whether the outputs of a program come from one of its inputs."""
    reached = {source}
    comes = lambda atoms: any(x in reached for x in atoms if not isinstance(x, Literal))
    for eqn in jaxpr.eqns:
        if comes(eqn.invars):
            reached.update(eqn.outvars)
    return comes(jaxpr.outvars)


@pytest.mark.parametrize("scheme", ["preserving", "consistent damped"])
@pytest.mark.slow_for("consistent damped")
def test_without_force_and_drive_there_is_no_time(scheme):
    system = ej.System(kinetic, potential, lambda q, args: jnp.array([q @ q - 1.0]))
    start = ej.State([1.0, 0.0], [0.0, 0.0])
    assert start.t is None

    def program(system):
        step = lambda t: ej.step(system, SCHEMES[scheme][0], start, ARGS, h=0.01, t=t)
        return jax.make_jaxpr(step)(0.5).jaxpr, jax.eval_shape(step, 0.5)

    jaxpr, out = program(system)
    assert not depends(jaxpr, jaxpr.invars[0])
    assert out.energies.work is None
    assert out.energies.drive_work is None
    # With a drive there is: the test above can fail.
    jaxpr, _ = program(DRIVEN_PENDULUM)
    assert depends(jaxpr, jaxpr.invars[0])


def test_states_of_users_have_no_time():
    out = ej.step(
        DRIVEN_PENDULUM, SCHEMES["preserving"][0], driven_start(), ARGS, h=0.01, t=0.2
    )
    assert out.state.t is None
    assert driven_start().t is None
