"""Derivatives, and derivatives of lanes, of programs as machine code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._programs import in_one_function, programs_within
from enerjax._solvers import eigh, find_root, Newton

from .helpers import long
from .test_machine_code import is_compiled, SMALL


def smooth(x):
    return jnp.sum(jnp.sin(x) * jnp.tanh(x[::-1])) * x


@pytest.mark.slow
def test_derivatives_and_lanes():
    whole, xs = in_one_function(smooth), jnp.stack([SMALL, 2 * SMALL, 3 * SMALL])
    total = lambda f: lambda x: jnp.sum(f(x) ** 2)
    for of in (
        lambda f: f(SMALL),
        lambda f: jax.jvp(f, (SMALL,), (SMALL,)),
        lambda f: jax.grad(total(f))(SMALL),
        lambda f: jax.jvp(jax.grad(total(f)), (SMALL,), (SMALL,)),
        lambda f: (
            jax.jacfwd(f)(SMALL),
            jax.jacrev(f)(SMALL),
            jax.hessian(total(f))(SMALL),
        ),
        lambda f: jax.grad(lambda x: total(jax.grad(total(f)))(x))(SMALL),
        lambda f: jax.linear_transpose(jax.linearize(f, SMALL)[1], SMALL)(SMALL),
        lambda f: jax.vmap(f)(xs),
        lambda f: jax.vmap(jax.grad(total(f)))(xs),
        lambda f: jax.vmap(jax.vmap(f))(xs[None]),
    ):
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=0)
        jax.tree.map(close, jax.jit(lambda of=of: of(whole))(), of(smooth))


def test_reverse_passes_know_their_index_tables():
    """Those of constants, and those that the program computes from constants.

    With unknown tables the reverse pass of a large system is left to XLA.
    """
    order, flags = np.arange(40)[::-1], np.arange(40) % 2 == 0

    def turned(x):
        places = jnp.where(flags, order, 39 - order)
        change = lambda x, _: (jnp.sin(x[order]) * x[places], None)
        return jax.lax.scan(change, x, None, length=9)[0]

    whole = jax.jit(in_one_function(turned))
    slope = jax.grad(lambda x: jnp.sum(whole(x) ** 2))
    x = jnp.linspace(0.5, 1.5, 40)
    programs = one_functions(jax.jit(slope).trace(x).jaxpr.jaxpr)
    assert len(programs) == 2
    tables = [
        known
        for program in programs
        for var, known in zip(program.jaxpr.invars, program.known, strict=True)
        if jnp.issubdtype(var.aval.dtype, jnp.integer) and var.aval.ndim
    ]
    assert len(tables) >= 2
    assert not any(known is None for known in tables)
    theirs = jax.grad(lambda x: jnp.sum(turned(x) ** 2))(x)
    np.testing.assert_allclose(jax.jit(slope)(x), theirs, rtol=1e-13)  # round-off


def one_functions(jaxpr):
    """The programs of machine code in a program, in their order."""
    found = []
    for eqn in jaxpr.eqns:
        if "program" in eqn.params:
            found.append(eqn.params["program"])
        else:
            found += [x for inner in programs_within(eqn) for x in one_functions(inner)]
    return found


# Derivatives of batches ------------------------------------------------------------------


def many_outputs(x, y):
    """A loop has its lanes second, the middle one is of `x` alone, the last of neither."""
    turn = lambda c, _: (jnp.sin(c) * y, jnp.cos(c) + c)
    end, rows = jax.lax.scan(turn, x, None, length=3)
    return rows, x**2, jnp.arange(2.0) + 0 * end[0], end


def root(x, y):
    fn = lambda z, args: z**3 + args[0] * z - args[1]
    guess = jnp.ones((2,))
    found = find_root(fn, Newton(), guess, (x, y), max_iterations=30)
    return found.value


OSCILLATOR = ej.System(
    lambda v, a: 0.5 * v @ v, lambda q, a: 0.5 * a["k"] * q @ q + q[0] ** 4
)


def vectors(x, y):
    return [eigh(y * (jnp.diag(x) + jnp.outer(x, x))[:n, :n]) for n in (1, 2)]


def run(x, y):
    start = ej.State(x, jnp.zeros((2,)))
    solution = ej.simulate(
        OSCILLATOR, ej.EnergyPreserving(), start, {"k": y}, h=0.1, num_steps=6, throw=False
    )
    return solution.ys.q, solution.audit.energy


def one_step(x, y):
    start = ej.State(x, jnp.zeros((2,)))
    return ej.step(OSCILLATOR, ej.EnergyPreserving(), start, {"k": y}, h=0.1).state.q


XS, YS = jnp.array([[0.5, 0.2], [0.9, 0.4], [0.7, 0.8]]), jnp.array([1.0, 1.5, 2.0])
# Traced before their lanes are known, as runs and steps are anyway.
FUNCTIONS = dict(
    outputs=jax.jit(in_one_function(many_outputs)),
    root=jax.jit(root),
    vectors=jax.jit(vectors),
    run=run,
    one_step=one_step,
)
RUNS = ["run", "one_step"]  # which take long to compile
# Which of the two inputs differ from lane to lane.
BATCHED = {"both": (0, 0), "first": (0, None), "second": (None, 0)}


def weighed(fn):
    """A scalar that treats no two entries alike."""

    def total(*args):
        flat = [jnp.ravel(x) for x in jax.tree.leaves(fn(*args))]
        return sum(jnp.sum(jnp.sin(jnp.arange(1.0, 1 + x.size)) * x**2) for x in flat)

    return total


def lanes_by_hand(fn, axes):
    """The definition of `vmap`, as a loop."""

    def call(x, y):
        of_lane = lambda a, axis, k: a if axis is None else a[k]
        lane = lambda k: fn(*(of_lane(*pair, k) for pair in zip((x, y), axes, strict=True)))
        return jax.tree.map(lambda *xs: jnp.stack(xs), *map(lane, range(3)))

    return call


@pytest.mark.parametrize("jit", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("axes", long(BATCHED, "first", "second"))
@pytest.mark.parametrize("name", ["one_step", pytest.param("run", marks=pytest.mark.slow)])
def test_derivatives_of_batches(name, axes, jit):
    """Values, too: JAX compares neither with those of the function alone."""
    axes = BATCHED[axes]
    fn = FUNCTIONS[name]
    point = tuple(a if axis == 0 else a[0] for a, axis in zip((XS, YS), axes, strict=True))
    along = jax.tree.map(lambda x: jnp.cos(x), point)
    wrap = jax.jit if jit else lambda f: f

    def seen(batch):
        total = weighed(batch)
        return (
            wrap(lambda *at: jax.jvp(batch, at, along))(*point),
            wrap(jax.value_and_grad(total, argnums=(0, 1)))(*point),
            wrap(lambda *at: jax.jvp(jax.grad(total, argnums=(0, 1)), at, along))(*point),
        )

    found = seen(jax.vmap(fn, in_axes=axes))
    expected = seen(lanes_by_hand(fn, axes))
    # Round-off, and where Newton stops; second derivatives are some tens in size.
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    jax.tree.map(close, found, expected)


@pytest.mark.slow
def test_inputs_that_become_constants_are_passed_as_inputs():
    """XLA must not put them inside: inputs that are not used end the process."""
    # `eigvalsh` keeps the step from being one function; the search for the start is one.
    potential = lambda q, a: (
        9.81 * q[1] + 1e-3 * jnp.linalg.eigvalsh(q[:, None] * q[None])[1]
    )
    constraint = lambda q, a: jnp.array([q @ q - a["l"] ** 2])
    system = ej.System(lambda v, a: 0.5 * v @ v, potential, constraint)

    def end(length):
        args = {"l": length}
        start = ej.initial_state(system, length * jnp.array([0.6, 0.8]), jnp.zeros(2), args)
        return ej.step(system, ej.EnergyPreserving(), start, args, h=0.05).state.q

    _, rate = jax.jit(lambda x: jax.jvp(end, (x,), (1.0,)))(1.2)
    difference = (end(1.2 + 1e-5) - end(1.2 - 1e-5)) / 2e-5
    # Truncation of the difference and round-off over its width.
    np.testing.assert_allclose(rate, difference, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "name", long(["four_bar", "car_axis", "heavy_top"], "car_axis", "heavy_top")
)
@pytest.mark.slow_for("four_bar")
def test_runs_and_their_derivatives_are_one_function(name):
    system, start, args = getattr(ej.problems, name)()
    run = lambda args: ej.simulate(
        system, ej.EnergyPreserving(), start, args, h=1e-3, num_steps=20, throw=False
    )
    assert is_compiled(run, args)
    assert is_compiled(jax.grad(lambda args: jnp.sum(run(args).ys.q)), args)


@pytest.mark.slow
def test_disable_jit_and_debug_nans_work():
    system, start, args = ej.problems.pendulum()
    step = lambda: ej.step(system, ej.EnergyPreserving(), start, args, h=0.01).state.q
    with jax.disable_jit():
        plain = step()
    np.testing.assert_allclose(plain, step(), rtol=1e-13)  # where Newton stops
    root = in_one_function(lambda x: jnp.sqrt(x - 1))
    with jax.debug_nans(True):
        np.testing.assert_array_equal(plain, plain * root(jnp.array(2.0)))
        for fn in (root, jax.jit(root)):
            with pytest.raises(FloatingPointError):
                fn(jnp.array(0.5))


def test_numbers_of_other_kinds():
    keys = jax.random.split(jax.random.key(0))
    draw = lambda keys, x: (jax.random.uniform(keys[1]), jnp.sin(x))
    assert in_one_function(draw)(keys, 1.0) == draw(keys, 1.0)
    small = jnp.ones(3, jnp.int4)
    assert (in_one_function(lambda x: x + x)(small) == small + small).all()
    assert isinstance(in_one_function(lambda x: x)(2.0), jax.Array)


def test_no_tracer_outlives_its_trace():
    @jax.jit
    def closes_over(x, a):
        return in_one_function(lambda y: jnp.sin(a * y))(x)

    with jax.checking_leaks():
        assert closes_over(1.0, 2.0) == np.sin(2.0)
