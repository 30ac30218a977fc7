"""Batches whose lanes run side by side, entry by entry: values, failures, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._programs import known_zeros
from enerjax._programs.entrywise import in_lanes
from enerjax._programs.jaxprs import programs_within
from enerjax._run import reverse

from .helpers import long
from .test_one_function import pytestmark


__all__ = ["pytestmark"]

LANES = 18  # which is no multiple of the width of a vector


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    """Also few lanes run side by side, although their program takes seconds to compile."""
    monkeypatch.setattr(reverse, "_FEWEST_LANES", LANES)
    monkeypatch.setattr(reverse, "_FEWEST_STEPS", 1)


def are_side_by_side(fn, *args):
    """Whether a batch runs side by side."""

    def names(jaxpr):
        for eqn in jaxpr.eqns:
            yield eqn.primitive.name
            for inner in programs_within(eqn):
                yield from names(inner)

    return "enerjax_in_lanes" in names(jax.make_jaxpr(fn)(*args).jaxpr)


# Programs entry by entry ----------------------------------------------------------------


def arithmetic(x, y):
    matrix = jnp.outer(x, x) + jnp.diag(y)
    return jnp.sin(x) @ matrix, jnp.max(x / y), x**3 - 1 / (1 + y**2), jnp.any(x > y)


def places(x, y):
    first = jnp.argmax(x > 0.3)
    chosen = jnp.where(x[0] > 0, 1, 2)
    ordered = x.at[jnp.array([2, 0])].add(y[:2])[jnp.array([1, 2, 0])]
    window = jax.lax.dynamic_slice(y, (chosen,), (1,))
    return ordered, x[chosen], window, first, jnp.pad(x, (1, 2)), x[::-1].reshape(3, 1)


def loops(x, y):
    def halves(carry):
        x, count = carry
        return jnp.where(jnp.arange(3) == count, x, 0.5 * x), count + 1

    small, count = jax.lax.while_loop(lambda c: jnp.max(c[0]) > 0.05, halves, (y, 0))
    turn = lambda c, row: (jnp.cos(c) * row + x[0], c[:2])
    end, rows = jax.lax.scan(turn, small, jnp.arange(4.0))
    last = jax.lax.cond(x[1] > 0, lambda: end + 1, lambda: 2 * end)
    return small, count, rows, last


def tables(x, y):
    row, column = jnp.where(x[0] > 0, 2, 1), jnp.where(y[0] > 0.5, 2, 0)
    table, beyond = jnp.arange(9.0).reshape(3, 3), jnp.where(x > 0, 1, 4)
    filled = [
        values.at[beyond].get(mode="fill", fill_value=other)
        for values in (y, jnp.arange(3), jnp.arange(3, dtype=jnp.uint8), y > 0.5)
        for other in (None, 1)
    ]
    one_axis = jax.lax.dynamic_slice(table, (row, 5), (1, 1))
    return table[row, 1], table[2, column], one_axis, filled


def running(x, y):
    table = jnp.stack([x, y, x * y])
    back = jax.lax.cumsum(table, axis=1, reverse=True)
    return jnp.cumsum(table, axis=0), jnp.cumprod(table, axis=1), back, jax.lax.cummin(x)


def factors(x, y):
    matrix = jnp.diag(4 + y) + x[:, None] * jnp.roll(x, 1)[None] / 9
    definite = matrix @ matrix.T
    root = jnp.linalg.cholesky(definite)
    half = jax.scipy.linalg.solve_triangular(root, x, lower=True)
    return root, half, jnp.linalg.solve(matrix, y), jnp.sort(x), jnp.linalg.inv(definite)


CASES_OF_PROGRAMS = [arithmetic, places, loops, tables, running, factors]


@pytest.mark.parametrize("fn", CASES_OF_PROGRAMS, ids=lambda fn: fn.__name__)
def test_programs_entry_by_entry(fn):
    """Known inputs, too. The differences are round-off: sums have another order."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, LANES, 3))
    y = np.abs(y) + 0.1
    closed = jax.make_jaxpr(fn)(x[0], y[0])
    for known in ((None, None), (None, y[0])):
        program = in_lanes(closed.jaxpr, [*closed.consts, *known])
        assert program is not None
        ys = y if known[1] is None else np.broadcast_to(y[0], y.shape)
        inputs = [x.T] if known[1] is not None else [x.T, y.T]
        of_chosen = lambda *rows, program=program: program(rows, LANES)
        found = jax.jit(of_chosen)(*(inputs[k] for k in program.needed))
        expected = jax.tree.leaves(jax.vmap(fn)(x, ys))
        for array, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(
                np.moveaxis(array, -1, 0), other, rtol=1e-13, atol=1e-14
            )


def test_what_lanes_cannot_do_is_left_to_other_programs():
    table, key = jnp.arange(9.0).reshape(3, 3), jax.random.key(0)
    for fn in (
        lambda x: jnp.linalg.eigh(jnp.outer(x, x))[1],
        lambda x: table[jnp.where(x[0] > 0, 1, 2), jnp.where(x[1] > 0, 1, 2)],
        lambda x: jnp.take(x, jnp.array([0, 3])),
        lambda x: (x, jax.debug.print("a lane"))[0] + 1,
        lambda x: x + jax.random.uniform(jax.random.key(0)),
        lambda x: x + jax.random.uniform(jax.random.wrap_key_data(x.astype("uint32")[:2])),
    ):
        closed = jax.make_jaxpr(fn)(jnp.ones(3))
        assert in_lanes(closed.jaxpr, [*closed.consts, None]) is None
    closed = jax.make_jaxpr(lambda x, key: x + jax.random.uniform(key))(1.0, key)
    assert in_lanes(closed.jaxpr, [None, None]) is None


def test_zeros_that_are_known():
    @jax.jit
    def seen(m):
        energy = lambda v: 0.5 * m[0] * v[0] ** 2 + m[1] * v[1] * v[2]
        zeros = known_zeros(lambda: jax.hessian(energy)(jnp.zeros(3)))
        np.testing.assert_array_equal(zeros, [[0, 1, 1], [1, 1, 0], [1, 0, 1]])
        return m

    seen(jnp.ones(2))


# Runs -----------------------------------------------------------------------------------

STEPS = 24


def double_pendulum(m, h, **options):
    system, start, args = ej.problems.chain(2, length=2.0, mass=2.0)
    args = args | dict(m=args["m"] * jnp.stack([m, 1.0]))
    return ej.simulate(
        system, options.pop("scheme"), start, args, h=h, throw=False, **options
    )


def car_axis(m, h, **options):
    system, start, args = ej.problems.car_axis()
    args = args | dict(k=args["k"] * m)
    return ej.simulate(
        system, options.pop("scheme"), start, args, h=h, throw=False, **options
    )


def angles(m, h, **options):
    system, start, args = ej.problems.double_pendulum_angles()
    args = args | dict(m1=args["m1"] * m)
    return ej.simulate(
        system, options.pop("scheme"), start, args, h=h, throw=False, **options
    )


def parameters():
    return jnp.linspace(0.5, 2.0, LANES), 1e-3 * jnp.linspace(0.5, 1.5, LANES)


CASES = {
    "pendulum": (double_pendulum, ej.EnergyPreserving()),
    "consistent": (double_pendulum, ej.EnergyConsistent(0.5)),
    "decaying": (double_pendulum, ej.EnergyDecaying(0.5)),
    "composed": (double_pendulum, ej.Composed(ej.EnergyPreserving(), 4)),
    "rattle": (double_pendulum, ej.Rattle()),
    "axis": (car_axis, ej.EnergyPreserving()),
    "angles": (angles, ej.EnergyPreserving()),
    "angles decaying": (angles, ej.EnergyDecaying(0.5)),
    "angles consistent": (angles, ej.EnergyConsistent(0.5)),
}


@pytest.mark.parametrize("name", long(CASES, *list(CASES)[1:]))
def test_lanes_equal_single_runs(name):
    """They differ by the round-off of the search; the energies by that of their terms."""
    simulated, scheme = CASES[name]
    run = lambda m, h: simulated(m, h, scheme=scheme, num_steps=STEPS)
    lanes, h = parameters()
    assert are_side_by_side(jax.vmap(run), lanes, h)
    found = jax.jit(jax.vmap(run))(lanes, h)
    alone = jax.jit(run)
    for lane in (0, 7, LANES - 1):
        expected = alone(lanes[lane], h[lane])
        close = lambda a, b, lane=lane: np.testing.assert_allclose(a[lane], b, atol=1e-12)
        jax.tree.map(close, (found.ts, found.ys.q), (expected.ts, expected.ys.q))
        close(found.audit.energy, expected.audit.energy)
        # Velocities and forces amplify the error of a position by 1/h and more.
        np.testing.assert_allclose(found.ys.v[lane], expected.ys.v, atol=1e-10)
    assert np.all(found.result._value == found.result._value[0])
    assert np.all(found.stats.newton_iterations > 0)


def test_lanes_that_fail_or_end_early():
    """A lane that needs Newton's method, one that fails with it, others that end before."""
    lanes, h = parameters()
    h = h.at[3].set(0.35).at[5].set(0.2)
    lanes = lanes.at[8].set(jnp.nan)
    ends = (STEPS * h).at[11].set(5 * h[11]).at[12].set(0.5 * h[12])

    def run(m, h, end):
        return double_pendulum(
            m, h, scheme=ej.EnergyPreserving(), t1=end, max_steps=STEPS + 1
        )

    assert are_side_by_side(jax.vmap(run), lanes, h, ends)
    found = jax.jit(jax.vmap(run))(lanes, h, ends)
    alone = jax.jit(run)
    for lane in (0, 3, 5, 8, 11, 12):
        expected = alone(lanes[lane], h[lane], ends[lane])
        of_lane = jax.tree.map(lambda x, lane=lane: x[lane], found)
        assert bool(of_lane.result == expected.result)
        assert of_lane.stats.completed_steps == expected.stats.completed_steps
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
        jax.tree.map(close, (of_lane.ts, of_lane.ys), (expected.ts, expected.ys))


@pytest.mark.slow
def test_derivatives_and_batches_of_batches():
    """Derivatives of batches are those of lanes one after the other."""
    lanes, h = parameters()

    def end(m, h):
        run = double_pendulum(m, h, scheme=ej.EnergyPreserving(), num_steps=STEPS)
        return run.ys.q[-1]

    total = lambda fn: lambda m: jnp.sum(jnp.sin(fn(m, h)))
    alone = jax.jit(jax.grad(lambda m, h: jnp.sum(jnp.sin(end(m, h)))))
    expected = np.array([alone(*pair) for pair in zip(lanes, h, strict=True)])
    of_batch = jax.jit(jax.grad(total(jax.vmap(end))))(lanes)
    batch_of = jax.jit(jax.vmap(jax.grad(lambda m, h: jnp.sum(jnp.sin(end(m, h))))))
    # Round-off and the stop of the search.
    np.testing.assert_allclose(of_batch, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(batch_of(lanes, h), expected, rtol=0, atol=1e-11)
    shared = jax.vmap(jax.vmap(end, in_axes=(None, 0)), in_axes=(0, None))
    assert are_side_by_side(shared, lanes[:2], h)
    both = jax.jit(shared)(lanes[:2], h)
    single = jax.jit(end)
    for k in (0, 1):
        np.testing.assert_allclose(both[k, 4], single(lanes[k], h[4]), rtol=0, atol=1e-12)
