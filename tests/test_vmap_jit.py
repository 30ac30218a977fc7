"""Batches equal loops, and new numbers do not recompile."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import long, problem, SCHEMES


# Solver: lanes are compiled differently, and Newton stops a few eps apart.
SAME: dict[str, Any] = dict(rtol=0, atol=1e-10)
STEPS = 50
SYSTEM = problem("pendulum").system


def run(numbers, scheme="decaying"):
    alpha, h, g, q, v = numbers
    args = problem("pendulum").args | dict(g=g)
    start = ej.State(q, v)
    return ej.simulate(
        SYSTEM, SCHEMES[scheme](alpha), start, args, h=h, num_steps=STEPS, throw=False
    )


def lanes():
    angles = np.array([0.0, 0.3, 1.0])
    q = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    v = np.array([[0.0], [0.1], [0.2]]) * q[:, ::-1] * [[-1, 1]]
    numbers = ([0.0, 0.4, 1.0], [0.005, 0.01, 0.015], [9.81, 5.0, 1.6], q, v)
    return tuple(jnp.asarray(x) for x in numbers)


def compare(batch, number, solution):
    lane = jax.tree.map(lambda x: x[number], eqx.filter(batch, eqx.is_array))
    np.testing.assert_allclose(lane.ys.q, solution.ys.q, **SAME)
    np.testing.assert_allclose(lane.ys.v, solution.ys.v, **SAME)
    np.testing.assert_allclose(lane.ts, solution.ts, **SAME)
    np.testing.assert_allclose(lane.audit.dissipated, solution.audit.dissipated, **SAME)
    # Multipliers are momenta per step: the tolerance over h.
    np.testing.assert_allclose(lane.multipliers, solution.multipliers, rtol=0, atol=1e-8)
    assert lane.stats.completed_steps == solution.stats.completed_steps == STEPS


AXES = {"alpha": (0,), "h": (1,), "args": (2,), "start": (3, 4), "all": (0, 1, 2, 3, 4)}


@pytest.mark.slow
@pytest.mark.parametrize("swept", AXES)
def test_vmap_equals_a_loop(swept):
    numbers = lanes()
    in_axes = tuple(0 if i in AXES[swept] else None for i in range(5))
    pick = lambda x, axis, k: x if axis is None else x[k]
    first = tuple(
        x if axis == 0 else x[0] for x, axis in zip(numbers, in_axes, strict=True)
    )
    batch = eqx.filter_jit(eqx.filter_vmap(run, in_axes=(in_axes,)))(first)
    for k in range(3):
        one = tuple(pick(x, a, k) for x, a in zip(first, in_axes, strict=True))
        compare(batch, k, run(one))


@pytest.mark.parametrize("scheme", long(["consistent", "composed 4"], "composed 4"))
def test_vmap_over_everything_equals_a_loop(scheme):
    numbers = lanes()
    batch = eqx.filter_jit(eqx.filter_vmap(lambda x: run(x, scheme)))(numbers)
    for k in range(3):
        compare(batch, k, run(tuple(x[k] for x in numbers), scheme))


def test_vmap_over_systems_equals_a_loop():
    """An inertia matrix is a leaf of the system, so systems can be stacked."""
    (system, start, args) = problem("spring")

    def with_mass(m):
        heavier = ej.System(m * jnp.eye(2), system.potential)
        return ej.simulate(
            heavier, ej.EnergyPreserving(), start, args, h=0.01, num_steps=20, throw=False
        ).ys.q

    masses = jnp.array([0.5, 1.0, 4.0])
    batch = jax.vmap(with_mass)(masses)
    for k in range(3):
        np.testing.assert_allclose(batch[k], with_mass(masses[k]), **SAME)
    assert np.max(np.abs(batch[0] - batch[2])) > 1e-3


def test_jit_around_a_run_changes_nothing():
    numbers = tuple(x[1] for x in lanes())
    np.testing.assert_allclose(eqx.filter_jit(run)(numbers).ys.q, run(numbers).ys.q, **SAME)


def compiled_by(run, caplog):
    """The messages about the programs that a call compiles."""
    caplog.clear()
    with jax.log_compiles():
        run()
    messages = [record.getMessage() for record in caplog.records]
    return [message for message in messages if "Compiling" in message]


@pytest.mark.parametrize("scheme", long(["preserving", "decaying"], "preserving"))
def test_new_numbers_compile_nothing(scheme, caplog):
    system, start, args = problem("pendulum")
    make = SCHEMES[scheme]

    def simulate(alpha, h, g, x, v):
        y = (1 - x**2) ** 0.5
        begin = ej.initial_state(system, [x, y], [v * y, -v * x], args | dict(g=g))
        ej.simulate(system, make(alpha), begin, args | dict(g=g), h=h, num_steps=10)
        ej.step(system, make(alpha), begin, args | dict(g=g), h=h)

    first = dict(alpha=0.1, h=0.01, g=9.81, x=1.0, v=0.0)
    simulate(**first)
    simulate(**first)  # a number of rows that comes again has a program that cuts them
    changes = dict(alpha=0.2, h=0.02, g=1.6, x=0.6, v=0.5)
    for name, value in changes.items():
        changed = first | {name: value}
        compiled = compiled_by(lambda changed=changed: simulate(**changed), caplog)
        assert not compiled, f"a new {name} compiled {compiled}"


def simulate_pendulum(num_steps, g=9.81, **options):
    system, start, args = problem("pendulum")
    args = args | dict(g=g)
    return ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        args,
        h=0.01,
        num_steps=num_steps,
        **options,
    )


@pytest.mark.parametrize("transform", [jax.grad, lambda f: jax.vmap(f, axis_size=1)])
def test_traced_numbers_in_closures_with_rows_that_are_cut(transform):
    """Three steps are made by the program for four."""

    def end(stiffness, num_steps=3):
        system = ej.System(
            jnp.eye(2),
            lambda q, args: 9.81 * q[1] + 0.5 * jnp.sum(stiffness) * q[0] ** 2,
            lambda q, args: jnp.array([q @ q - 1]),
        )
        begin = ej.State(jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
        sol = ej.simulate(system, ej.EnergyPreserving(), begin, h=0.01, num_steps=num_steps)
        return sol.ys.q[3, 0]

    found, whole = transform(end), transform(lambda x: end(x, 4))
    at = jnp.array([1.2]) if transform is not jax.grad else jnp.array(1.2)
    np.testing.assert_array_equal(found(at), whole(at))


def test_results_of_equal_calls_are_equally_free_to_move():
    committed = [simulate_pendulum(11).ys.q.committed for _ in range(3)]
    assert committed == [False] * 3


def test_runs_share_a_program_up_to_the_next_power_of_two(caplog):
    longest = simulate_pendulum(16)
    simulate_pendulum(14)
    for num_steps in (9, 11, 13):
        # What remains is the program that cuts the rows off.
        names = compiled_by(lambda n=num_steps: simulate_pendulum(n), caplog)
        assert all("first_rows" in name for name in names), names
        shorter = simulate_pendulum(num_steps)
        rows = num_steps + 1
        assert shorter.result == ej.RESULTS.successful
        assert int(shorter.stats.completed_steps) == num_steps
        assert shorter.stats.newton_iterations.shape == (num_steps,)
        assert shorter.audit.leak.shape == (rows,)
        # One program: equal to the bit.
        np.testing.assert_array_equal(shorter.ys.q, longest.ys.q[:rows])
        np.testing.assert_array_equal(shorter.end.q, longest.ys.q[num_steps])
    # The count can fail: this number of steps needs another program.
    assert any(
        "_run" in name for name in compiled_by(lambda: simulate_pendulum(600), caplog)
    )


def test_rows_of_every_third_step_end_with_the_end():
    whole = simulate_pendulum(11)
    some = simulate_pendulum(11, saveat=ej.SaveAt(every=3))
    np.testing.assert_allclose(some.ts, [0.0, 0.03, 0.06, 0.09, 0.11], rtol=1e-14)
    # Solver: another program.
    np.testing.assert_allclose(some.ys.q, whole.ys.q[jnp.array([0, 3, 6, 9, 11])], **SAME)


def test_every_kind_of_number_uses_the_same_program(caplog):
    """`jnp.array(2.0)` has a weak type, which JAX compiles apart if it is kept."""
    kinds = (2.0, jnp.array(2.0), np.float64(2.0), jnp.asarray(2.0, jnp.float64))
    last = lambda g: simulate_pendulum(8, g).ys.q[-1, 0]
    for run in (last, jax.grad(last)):
        run(1.0)
        for kind in kinds:
            names = compiled_by(lambda run=run, kind=kind: run(kind), caplog)
            assert not any("_run" in name for name in names), (kind, names)


def test_the_functions_of_the_user_are_traced_once():
    count = 0

    def potential(q, args):
        nonlocal count
        count += 1
        return 0.5 * args["k"] * q @ q

    system = ej.System(jnp.eye(2), potential)

    def simulate(k, h, alpha, x):
        nonlocal count
        count = 0
        start = ej.State([x, 0.0], [0.0, 0.0])
        ej.simulate(system, ej.EnergyDecaying(alpha), start, dict(k=k), h=h, num_steps=10)
        return count

    # Once for its shape, for its value, for its slope and for a discrete gradient.
    assert 1 <= simulate(1.0, 0.1, 0.5, 1.0) <= 4
    # What remains is the check of its shape, which runs no arithmetic.
    for numbers in ((2.0, 0.1, 0.5, 1.0), (1.0, 0.2, 0.5, 1.0), (1.0, 0.1, 0.7, 2.0)):
        assert simulate(*numbers) <= 1


def test_lanes_that_finish_early_do_not_move():
    """A batched Newton iterates until the last lane is done; the others must hold."""
    numbers = lanes()
    batch = eqx.filter_vmap(run)(numbers)
    iterations = np.asarray(batch.stats.newton_iterations)
    for k in range(3):
        alone = run(tuple(x[k] for x in numbers))
        difference = np.abs(iterations[k] - alone.stats.newton_iterations)
        assert np.max(difference) <= 1


@jax.jit
def three_steps(g, h):
    system, start, args = problem("double")
    run = ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        args | dict(g=g),
        h=h,
        num_steps=3,
        throw=False,
    )
    return run.ys.q[-1], run.stats.completed_steps


@functools.cache
def many_three_steps():
    return jax.jit(jax.vmap(three_steps))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_large_batch_with_a_broken_lane(bad):
    """Reductions over many lanes are other programs: they must not overlook a NaN."""
    count = 1500
    g = jnp.linspace(5.0, 15.0, count).at[700].set(bad)
    h = jnp.linspace(1e-3, 2e-3, count)
    q, completed = many_three_steps()(g, h)
    healthy = np.arange(count) != 700
    np.testing.assert_array_equal(completed, np.where(healthy, 3, 0))
    np.testing.assert_array_equal(np.isfinite(q).all(axis=1), healthy)
    for lane in (0, 699, count - 1):
        np.testing.assert_allclose(q[lane], three_steps(g[lane], h[lane])[0], **SAME)


def test_batches_of_batches_that_share_some_of_their_numbers():
    """The start does not depend on the step: none of it is batched in the outer batch."""
    system, start, args = problem("pendulum")

    def end(h, g):
        here = args | dict(g=g)
        run = ej.simulate(system, ej.EnergyPreserving(), start, here, h=h, num_steps=10)
        return run.ys.q[-1]

    hs, gs = jnp.array([[0.01, 0.02], [0.03, 0.04]]), jnp.array([9.0, 10.0, 11.0])
    inner = jax.vmap(end, in_axes=(None, 0))
    grid = jax.jit(jax.vmap(jax.vmap(inner, in_axes=(0, None)), in_axes=(0, None)))(hs, gs)
    for i, j, k in ((0, 0, 0), (1, 0, 2), (1, 1, 1)):
        np.testing.assert_allclose(grid[i, j, k], end(hs[i, j], gs[k]), **SAME)
