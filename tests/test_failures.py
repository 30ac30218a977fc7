"""Failures are values: they are reported where they happen, and earlier rows stay valid."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._operators import make_model

from .helpers import failed, problem, solve, TURNOVER


# Runs that end in a failure: case d with a long step at index 3, and kappa wherever the
# kinetic energy stops changing for a moment.
FAILING = [
    ("stiff", "preserving index3", 0.0, 0.03),
    ("stiff", "decaying index3", 0.0, 0.01),
    *[("double", "kappa", alpha, 0.01) for alpha in (0.0, 0.5, 1.0)],
    *[("stiff", "kappa", alpha, 0.001) for alpha in (0.0, 0.5, 1.0)],
]
STEPS = 1000


def run(name, scheme, alpha, h):
    return solve(name, scheme, alpha, h=h, steps=STEPS)


@pytest.mark.parametrize(("name", "scheme", "alpha", "h"), FAILING)
@pytest.mark.slow_for("stiff-decaying index3-0.0-0.01")
def test_a_failure_is_reported_at_the_step_where_it_happens(name, scheme, alpha, h):
    solution = run(name, scheme, alpha, h)
    assert failed(solution)
    assert len(ej.RESULTS[solution.result]) > 50
    done = int(solution.stats.completed_steps)
    assert 0 < done < STEPS
    good, bad = slice(0, done + 1), slice(done + 1, None)
    for x in (
        solution.ys.q,
        solution.ys.v,
        solution.multipliers,
        solution.audit.energy,
        solution.audit.dissipated,
        solution.audit.constraint,
    ):
        assert np.all(np.isfinite(x[good]))
        assert np.all(np.isnan(x[bad]))
    np.testing.assert_allclose(solution.ts, h * np.arange(STEPS + 1), rtol=1e-14)
    # Everything up to there is a good run. Solver.
    assert np.max(np.abs(solution.audit.constraint[good])) <= 1e-12
    leak = np.diff(solution.audit.energy[good]) + solution.audit.dissipated[1 : done + 1]
    assert np.max(np.abs(leak)) <= 1e-12 * TURNOVER[name]
    iterations = solution.stats.newton_iterations
    assert np.all(iterations[: done + 1] > 0)
    assert np.all(iterations[done + 1 :] == 0)


@pytest.mark.parametrize(
    ("name", "scheme", "alpha", "h"), [FAILING[0], FAILING[4]], ids=["index3", "kappa"]
)
@pytest.mark.slow_for("kappa")
def test_rows_before_a_failure_are_those_of_a_shorter_run(name, scheme, alpha, h):
    solution = run(name, scheme, alpha, h)
    done = int(solution.stats.completed_steps)
    shorter = solve(name, scheme, alpha, h=h, steps=done)
    assert not failed(shorter)
    for x, y in ((solution.ys.q, shorter.ys.q), (solution.ys.v, shorter.ys.v)):
        # Round-off: the same steps, but compiled as another program.
        np.testing.assert_allclose(x[: done + 1], y, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("kappa", "is_bounded"), [(-0.1, False), (1.5, True), (2.1, False)]
)
def test_kappa_must_be_between_zero_and_two(kappa, is_bounded):
    system, start, args = problem("double")
    scheme, model = ej.KappaDecaying(0.5), make_model(system, start, args)
    step = scheme.problem(model, start, jnp.asarray(0.01))
    z = scheme.predict(step, *model.accelerations(start))
    z = eqx.tree_at(lambda z: z.kappa, z, jnp.array([kappa]))
    failed = scheme.finish(z, step).result == ej.RESULTS.kappa_out_of_range
    assert bool(failed) != is_bounded


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.02, 0.05])
@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_kappa_keeps_its_law_in_a_long_run_or_reports_where_it_fails(alpha, h):
    """In 1e5 steps the kinetic energy comes close to a standstill many times."""
    steps = 100_000
    solution = solve("pendulum", "kappa", alpha, h=h, steps=steps)
    done = int(solution.stats.completed_steps)
    assert failed(solution) == (done < steps)
    assert done > 1000
    energy = solution.audit.energy[: done + 1]
    leak = np.diff(energy) + solution.audit.dissipated[1 : done + 1]
    # Solver, in each step.
    assert np.max(np.diff(energy)) <= 1e-12 * TURNOVER["pendulum"]
    assert np.max(np.abs(leak)) <= 1e-12 * TURNOVER["pendulum"]
    assert np.all(np.abs(solution.details[:done] - 1) < 1)
    assert np.all(np.isnan(solution.details[done:]))
    # The law tells something: kappa does leave the neighbourhood of 1.
    assert np.max(np.abs(solution.details[:done] - 1)) > 1e-5


def test_throw_raises_one_error_that_names_the_step_and_the_time():
    system, start, args = problem("stiff")
    name, scheme, alpha, h = FAILING[0]
    done = int(run(name, scheme, alpha, h).stats.completed_steps)
    with pytest.raises(RuntimeError, match=f"step {done + 1}, from t = ") as caught:
        ej.simulate(
            system,
            ej.EnergyPreserving("index3"),
            start,
            args,
            h=h,
            num_steps=STEPS,
        )
    message = str(caught.value)
    assert f"t = {done * h:.6g} to {(done + 1) * h:.6g}" in message
    assert "Newton" in message
    assert "throw=False" in message


def test_throw_raises_under_jit_too():
    system, start, args = problem("pendulum")

    @jax.jit
    def fn(h):
        return ej.simulate(
            system, ej.EnergyPreserving(), start, args, h=h, num_steps=5
        ).ys.q

    assert np.all(np.isfinite(fn(0.01)))
    with pytest.raises(Exception, match="Reduce `h`|reduce `h`"):
        jax.block_until_ready(fn(50.0))


@pytest.mark.parametrize(
    ("q", "v"), [([1.1, 0.0], [0.0, 0.0]), ([1.0, 0.0], [0.1, 0.0])], ids=["q", "v"]
)
def test_an_inconsistent_start_is_a_failure_of_the_first_step(q, v):
    system, _, args = problem("pendulum")
    solution = ej.simulate(
        system,
        ej.EnergyPreserving(),
        ej.State(q, v),
        args,
        h=0.01,
        num_steps=5,
        throw=False,
    )
    assert solution.result == ej.RESULTS.inconsistent_start
    assert solution.stats.completed_steps == 0
    assert np.all(np.isfinite(solution.ys.q[0]))
    assert np.all(np.isnan(solution.ys.q[1:]))
    assert np.all(np.asarray(solution.stats.newton_iterations) == 0)


def test_index3_does_not_hold_the_velocities_of_the_start():
    """It starts from a velocity off the constraints, which its first step projects."""
    system, _, args = problem("pendulum")
    solution = ej.simulate(
        system,
        ej.EnergyPreserving("index3"),
        ej.State([1.0, 0.0], [0.01, 0.0]),
        args,
        h=0.01,
        num_steps=5,
    )
    assert solution.stats.completed_steps == 5


def test_a_failed_lane_leaves_the_others_unchanged():
    system, start, args = problem("pendulum")

    def fn(h):
        return ej.simulate(
            system, ej.EnergyDecaying(0.5), start, args, h=h, num_steps=20, throw=False
        )

    steps = jnp.array([0.01, 50.0, 0.02])
    batched = jax.jit(jax.vmap(fn))
    batch, others = batched(steps), batched(steps.at[1].set(0.015))
    healthy = np.asarray(batch.result == ej.RESULTS.successful)
    np.testing.assert_array_equal(healthy, [True, False, True])
    assert batch.stats.completed_steps[1] < 20
    assert np.all(np.asarray(others.result == ej.RESULTS.successful))
    for lane in (0, 2):
        # Solver: Newton waits for the slowest lane.
        np.testing.assert_allclose(batch.ys.q[lane], others.ys.q[lane], rtol=0, atol=1e-10)
        np.testing.assert_allclose(
            batch.audit.dissipated[lane], others.audit.dissipated[lane], rtol=0, atol=1e-10
        )


def test_a_singular_step_is_a_failure_of_its_own():
    """Two equal constraints leave their multipliers undetermined."""

    def twice(q, args):
        rod = q @ q - args["l"] ** 2
        return jnp.stack([rod, rod])

    single, start, args = problem("pendulum")
    system = ej.System(single.kinetic, single.potential, twice)
    scheme = ej.EnergyPreserving()
    out = ej.step(system, scheme, start, args, h=0.01)
    assert out.result != ej.RESULTS.successful
    with pytest.raises(RuntimeError, match="row [01] of the constraints"):
        ej.simulate(system, scheme, start, args, h=0.01, num_steps=5)


def test_a_potential_that_leaves_its_domain_is_nonfinite():
    system = ej.System(jnp.eye(1), lambda q, args: -args["k"] * jnp.sqrt(1.0 - q[0]))
    solution = ej.simulate(
        system,
        ej.EnergyPreserving(),
        ej.State([0.0], [1.0]),
        dict(k=-1.0),
        h=0.1,
        num_steps=50,
        throw=False,
    )
    assert solution.result == ej.RESULTS.nonfinite
    done = int(solution.stats.completed_steps)
    assert 5 <= done < 50
    np.testing.assert_array_equal(solution.end.q, solution.ys.q[done])
    # No row that counts as good holds what could not be evaluated.
    assert np.all(np.isfinite(solution.audit.energy[: done + 1]))
    assert np.all(solution.ys.q[: done + 1] < 1)


def test_the_first_failure_is_kept():
    """Later steps are skipped and cannot turn it into another."""
    solution = run("stiff", "kappa", 0.5, 0.001)
    done = int(solution.stats.completed_steps)
    shorter = solve("stiff", "kappa", 0.5, h=0.001, steps=done + 1)
    assert shorter.result == solution.result
    assert int(shorter.stats.completed_steps) == done


def test_derivatives_of_a_failed_run_raise():
    """Also where nobody reads its values: XLA would leave the check out."""
    system, start, args = ej.problems.double_pendulum()

    def end(v, h):
        start_ = ej.State(start.q, v)
        scheme = ej.EnergyPreserving()
        sol = ej.simulate(system, scheme, start_, args, h=h, num_steps=10)
        return jnp.sum(sol.ys.q[-1])

    slope = jax.jit(jax.grad(end))
    push = jax.jit(lambda v, h: jax.jvp(end, (v, h), (v + 1, h))[1])
    for derivative in (slope, push):
        assert np.all(np.isfinite(derivative(start.v, 0.01)))
        with pytest.raises(Exception, match="Newton's method|right angle"):
            jax.block_until_ready(derivative(start.v, 1.5))
    # Outside of `jit` the values are known, and the error is that of a run.
    with pytest.raises(RuntimeError, match="failed in step 1, from t = 0 to 1.5"):
        jax.grad(end)(start.v, 1.5)


# Kinetic energies that are checked in the program -----------------------------------------


def _rotating(q, v, args):
    return 0.5 * v @ v + args["rate"] * (q[0] * v[1] - q[1] * v[0])


def _masses(v, args):
    return 0.5 * args["rate"] * v @ v


BAD_ENERGIES = {
    "a linear term": ej.System.from_lagrangian(_rotating, lambda q, args: 0.5 * q @ q),
    "a constant": ej.System(
        lambda v, args: 0.5 * v @ v + args["rate"], lambda q, args: 0.5 * q @ q
    ),
    "a quartic term": ej.System(
        lambda v, args: 0.5 * v @ v + args["rate"] * v[0] ** 4, lambda q, args: 0.5 * q @ q
    ),
}


@pytest.mark.parametrize("name", BAD_ENERGIES)
def test_a_lane_whose_kinetic_energy_is_no_quadratic_form_fails(name):
    """The energy is valid for the rate zero."""
    start = ej.State(jnp.zeros(2), jnp.array([0.1, 0.3]))

    def run(rate, throw=False):
        args, scheme = dict(rate=rate), ej.EnergyPreserving()
        system = BAD_ENERGIES[name]
        return ej.simulate(system, scheme, start, args, h=0.1, num_steps=3, throw=throw)

    sol = jax.vmap(run)(jnp.array([0.0, 1.0]))
    expected = ("successful", "invalid_energy")
    for lane, outcome in enumerate(expected):
        assert jax.tree.map(lambda x, k=lane: x[k], sol.result) == getattr(
            ej.RESULTS, outcome
        )
    assert jnp.isfinite(sol.ys.q[0]).all()
    assert jnp.isnan(sol.ys.q[1, 1:]).all()
    # Outside of `jit` the values of a derivative are known, and the error says more.
    with pytest.raises(ValueError, match="quadratic"):
        jax.grad(lambda rate: run(rate, throw=True).ys.q[-1, 0])(1.0)


def test_a_kinetic_energy_over_a_traced_number_is_checked_too():
    start = ej.State(jnp.zeros(2), jnp.array([0.1, 0.3]))

    def failed(rate):
        system = ej.System(
            lambda v, args: 0.5 * v @ v + rate * v[0] ** 4, lambda q, args: 0.5 * q @ q
        )
        sol = ej.simulate(
            system, ej.EnergyPreserving(), start, h=0.1, num_steps=3, throw=False
        )
        return sol.result == ej.RESULTS.invalid_energy

    assert jax.vmap(failed)(jnp.array([0.0, 1.0])).tolist() == [False, True]


def test_a_negative_mass_fails_under_jit_too():
    system = ej.System(_masses, lambda q, args: 0.5 * q @ q)
    start = ej.State(jnp.zeros(2), jnp.ones(2))
    run = jax.jit(lambda rate: ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        dict(rate=rate),
        h=0.1,
        num_steps=3,
        throw=False,
    ).result)  # fmt: skip
    assert run(1.0) == ej.RESULTS.successful
    assert run(-1.0) == ej.RESULTS.invalid_energy


def test_steps_and_times_that_are_not_positive_fail_under_vmap():
    system = ej.System(jnp.eye(1), lambda q, args: 0.5 * q @ q)
    start = ej.State(jnp.ones(1), jnp.zeros(1))
    run = functools.partial(ej.simulate, system, ej.EnergyPreserving(), start, throw=False)
    fails = lambda sol: sol.result == ej.RESULTS.invalid_step
    by_step = jax.vmap(lambda h: fails(run(h=h, num_steps=3)))
    assert by_step(jnp.array([0.1, -0.1, 0.0, jnp.nan])).tolist() == [False, *[True] * 3]
    by_time = jax.vmap(lambda t1: fails(run(h=0.1, t1=t1, max_steps=20)))
    assert by_time(jnp.array([1.0, -0.5])).tolist() == [False, True]
