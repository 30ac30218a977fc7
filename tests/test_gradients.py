"""Derivatives of a run with respect to all numbers: forward, reverse and by differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import enerjax as ej
from enerjax._operators import make_model
from enerjax._programs.jaxprs import programs_within
from enerjax._run import reverse as reverse_pass
from enerjax._solvers import equations, root

from .helpers import long, problem, SCHEMES


STEPS = 100
PENDULUM = problem("pendulum").system
# g, l, m, h, alpha, and a start that is off the rod and off the velocity level.
PARAMETERS = dict(
    g=9.81, l=1.0, m=1.3, h=0.02, alpha=0.5, q=np.array([0.95, 0.1]), v=np.array([0.0, 0.2])
)


def start_of(p):
    args = dict(g=p["g"], l=p["l"], m=p["m"])
    return ej.initial_state(PENDULUM, p["q"], p["v"], args), args


def end(p, make):
    """x(2 s), with the start projected inside: it moves along the constraints."""
    start, args = start_of(p)
    solution = ej.simulate(
        PENDULUM, make(p["alpha"]), start, args, h=p["h"], num_steps=STEPS, throw=False
    )
    return solution.ys.q[-1, 0]


def parameters(**changes):
    return jax.tree.map(jnp.asarray, PARAMETERS | changes)


def by_differences(value, p):
    """Central differences; truncation and round-off are both about 1e-8 of the value."""
    flat, unravel = ravel_pytree(p)
    eps = 1e-5
    at = lambda x: value(unravel(x))
    rows = eps * jnp.eye(flat.size)
    return jnp.stack([(at(flat + row) - at(flat - row)) / (2 * eps) for row in rows])


# Everything that converges on the pendulum. The preserving schemes have no alpha to move.
LONG = (
    "preserving index3", "decaying", "decaying index3", "kappa", "consistent", "composed 4"
)  # fmt: skip
CONVERGING = long(["preserving", *LONG], *LONG)


@pytest.mark.parametrize("scheme", CONVERGING)
def test_forward_reverse_and_differences_agree(scheme):
    p = parameters()
    fn = lambda p: end(p, SCHEMES[scheme])
    value, gradient = jax.jit(jax.value_and_grad(fn))(p)
    reverse, unravel = ravel_pytree(gradient)
    push = jax.jit(lambda p, direction: jax.jvp(fn, (p,), (direction,)))
    assert push(p, p)[0] == pytest.approx(float(value), rel=1e-12)  # round-off
    differences = by_differences(lambda x: push(x, x)[0], p)
    np.testing.assert_allclose(differences, reverse, rtol=1e-5, atol=1e-5)
    for row in jnp.eye(reverse.size):
        along = push(p, unravel(row))[1]
        # Solver: both solve the linearised steps, to round-off times their condition.
        np.testing.assert_allclose(along, row @ reverse, rtol=1e-8, atol=1e-8)
    # g, h and the start matter, alpha where it appears; the mass drops out of the motion.
    assert abs(gradient["g"]) > 1e-3
    assert abs(gradient["h"]) > 1e-3
    assert np.max(np.abs(gradient["q"])) > 1e-3
    has_alpha = not scheme.startswith(("preserving", "composed"))
    assert (abs(gradient["alpha"]) > 1e-9) == has_alpha
    assert abs(gradient["m"]) <= 1e-8


def tip(g, steps, save_every):
    system, start, args = problem("pendulum")
    solution = ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        args | dict(g=g),
        h=0.02,
        num_steps=steps,
        saveat=ej.SaveAt(every=save_every),
        throw=False,
    )
    return solution.ys.q[-1, 0]


@pytest.mark.slow
@pytest.mark.parametrize("cut", [(100, False), (101, False), (103, True)])
def test_saving_less_does_not_change_the_gradient(cut, monkeypatch):
    """The reverse pass recomputes exactly the values of the run."""
    steps, is_long = cut
    monkeypatch.setattr(reverse_pass, "LONG", 10 if is_long else reverse_pass.LONG)
    forward = jax.jit(lambda g: jax.jvp(lambda g: tip(g, steps, 1), (g,), (1.0,))[1])(9.81)
    assert abs(forward) > 1e-3
    for save_every in (1, 20 if steps == 100 else steps):
        reverse = jax.jit(jax.grad(tip), static_argnums=(1, 2))(9.81, steps, save_every)
        # Round-off, grown over the steps.
        np.testing.assert_allclose(reverse, forward, rtol=1e-10)


def memory_of_the_reverse_pass(steps):
    program = jax.jit(lambda g: jax.grad(tip)(g, steps, steps)).lower(9.81).compile()
    memory = program.memory_analysis()
    assert memory is not None
    return memory.temp_size_in_bytes


@pytest.mark.slow
def test_memory_of_the_reverse_pass():
    # Four unknowns a step: 8 bytes each, and the rest for the states in a segment.
    growth = memory_of_the_reverse_pass(3000) - memory_of_the_reverse_pass(1000)
    assert growth <= 12 * 4 * 2000


@pytest.mark.slow
def test_memory_of_the_reverse_pass_of_a_long_run():
    # 10^3 segments, whose starts hold what Newton needs to begin: 1.6 kB each. The rest is
    # for the steps of one segment.
    assert memory_of_the_reverse_pass(1_000_000) <= 2_300_000


def whiles(jaxpr):
    """The shapes of the carry of each `while`."""
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "while":
            yield [x.aval.shape for x in eqn.outvars]
        for inner in programs_within(eqn):
            yield from whiles(inner)


def test_the_reverse_pass_does_not_search_again():
    """It uses the roots that the forward pass has found."""
    system, begin, args = ej.problems.chain(8)

    def end(h):
        sol = ej.simulate(system, ej.EnergyPreserving(), begin, args, h=h, num_steps=4)
        return sol.ys.q[-1, -1]

    def searches(fn):
        """The loops over iterates, which are a vector and much else."""
        carries = list(whiles(jax.make_jaxpr(fn)(1e-3).jaxpr))
        return sum(len(x) > 6 and x[0] == (32,) for x in carries)

    assert searches(end) >= 1
    assert searches(jax.grad(end)) == searches(end)


@pytest.mark.slow
def test_second_derivatives_exist():
    fn = lambda g: end(parameters() | dict(g=g), SCHEMES["decaying"])
    both = jax.jit(lambda g: jax.jvp(jax.grad(fn), (g,), (jnp.ones_like(g),)))
    eps = 1e-4
    g = jnp.asarray(9.81)
    differences = (both(g + eps)[0] - both(g - eps)[0]) / (2 * eps)
    # Truncation of the difference.
    np.testing.assert_allclose(both(g)[1], differences, rtol=1e-5)


def test_the_start_moves_along_the_constraints():
    p = parameters()

    def residuals(p):
        start, args = start_of(p)
        rod = PENDULUM.constraint(start.q, args)
        return jnp.append(rod, start.q @ start.v)

    # Round-off: the residuals vanish for every start, so their derivatives do.
    for leaf in jax.tree.leaves(jax.jit(jax.jacrev(residuals))(p)):
        np.testing.assert_allclose(leaf, 0, atol=1e-13)


@pytest.mark.slow
def test_gradients_of_a_rigid_body():
    system, start, args = problem("body")

    def fn(inertia):
        solution = ej.simulate(
            system,
            ej.EnergyPreserving(),
            start,
            dict(J=inertia),
            h=0.005,
            num_steps=20,
            throw=False,
        )
        return solution.ys.q[-1, 1]

    direction = jnp.array([1.0, -2.0, 0.5])
    inertia = args["J"]
    push = jax.jit(lambda x: jax.jvp(fn, (x,), (direction,)))
    forward = push(inertia)[1]
    reverse = jax.jit(jax.grad(fn))(inertia) @ direction
    eps = 1e-5
    ends = [push(inertia + sign * eps * direction)[0] for sign in (1, -1)]
    differences = (ends[0] - ends[1]) / (2 * eps)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8)
    np.testing.assert_allclose(differences, reverse, rtol=1e-5)


@pytest.mark.parametrize(
    "derivative",
    [ej.Gonzalez(), pytest.param(ej.MeanValue(), marks=pytest.mark.slow)],
    ids=["1", "2"],
)
def test_gradients_stay_finite_at_rest(derivative):
    """In equilibrium every increment is zero, where a discrete gradient divides by it."""
    system, _, args = problem("pendulum")

    def fn(g):
        args_g = args | dict(g=g)
        start = ej.State([0.0, 1.0], [0.0, 0.0])
        scheme = ej.EnergyPreserving(derivative=derivative)
        solution = ej.simulate(system, scheme, start, args_g, h=0.02, num_steps=5)
        return jnp.sum(solution.ys.q) + jnp.sum(solution.multipliers)

    # Closed form: the rod carries m g, so 2 lambda = m g in each of the six rows.
    np.testing.assert_allclose(jax.grad(fn)(9.81), 6 * 0.5, rtol=1e-10)


def test_a_failed_lane_leaves_the_gradients_of_the_others_finite():
    system, start, args = problem("pendulum")

    def fn(h):
        solution = ej.simulate(
            system, ej.EnergyPreserving(), start, args, h=h, num_steps=10, throw=False
        )
        return solution.ys.q[-1, 0], solution.result == ej.RESULTS.successful

    steps = jnp.array([0.01, 50.0, 0.02])
    slopes = jax.jit(jax.vmap(jax.grad(fn, has_aux=True)))
    slope, okay = slopes(steps)
    np.testing.assert_array_equal(okay, [True, False, True])
    good = np.array([0, 2])
    assert np.all(np.isfinite(slope[good]))
    # The same program, of lanes that all succeed.
    healthy, okay = slopes(steps.at[1].set(0.015))
    assert np.all(okay)
    np.testing.assert_allclose(slope[good], healthy[good], rtol=1e-10)
    # A loss that is NaN for failed runs has a derivative of zero there, so that the mean of
    # the others has the right one.
    assert slope[1] == 0
    mean = lambda steps: jnp.nanmean(jax.vmap(lambda h: fn(h)[0] ** 2)(steps))
    found, expected = jax.grad(mean)(steps), jax.grad(mean)(steps[good])
    np.testing.assert_allclose(found[good], expected, rtol=1e-10)


@pytest.mark.slow
def test_gradient_of_divided_steps_whose_whole_step_is_infinite():
    """The search for the whole step ends far from any root, and its rates do not count."""
    count, order = 4, np.argsort(np.cos(np.arange(4)))

    def potential(q, args):
        r = q.reshape(count, 2)
        stretch = jnp.sum((r - r[order]) ** 2, axis=1) - 1.3
        return args["k"] * jnp.sum(stretch**4) + 9.81 * jnp.sum(r[:, 1])

    def rods(q, args):
        r = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(count, 2)])
        return jnp.sum(jnp.diff(r, axis=0) ** 2, axis=1) - 1.0

    system = ej.System(jnp.eye(2 * count), potential, rods)
    angles = np.linspace(0.1, 0.9, count)
    q = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], 1), 0).ravel()
    start = ej.initial_state(system, q, np.zeros(2 * count), {"k": 0.3})

    def end(k):
        scheme, args = ej.EnergyConsistent(0.0), {"k": k}
        sol = ej.simulate(system, scheme, start, args, h=0.06, num_steps=3, max_halvings=3)
        return jnp.sum(sol.ys.q[-1] * jnp.cos(jnp.arange(2 * count))), sol.stats.halvings

    (_, halvings), slope = jax.jit(jax.value_and_grad(end, has_aux=True))(0.3)
    assert np.all(halvings > 0)
    values = jax.jit(lambda k: end(k)[0])
    difference = (values(0.3 + 1e-6) - values(0.3 - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, difference, rtol=1e-7)  # round-off of the difference


def test_numbers_that_the_functions_close_over_count():
    def tip(g):
        rod = lambda q, args: jnp.array([q @ q - 1.0])
        system = ej.System(jnp.eye(2), lambda q, args: -g * q[1], rod)
        start = ej.State([1.0, 0.0], [0.0, 0.0])
        run = ej.simulate(system, ej.EnergyPreserving(), start, h=0.01, num_steps=20)
        return run.ys.q[-1, 0]

    push = jax.jit(lambda g: jax.jvp(tip, (g,), (1.0,)))
    difference = (push(9.81 + 1e-5)[0] - push(9.81 - 1e-5)[0]) / 2e-5
    forward, reverse = push(9.81)[1], jax.jit(jax.grad(tip))(9.81)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)  # solver
    np.testing.assert_allclose(reverse, difference, rtol=1e-6)  # of the difference


def test_derivatives_of_a_free_oscillator():
    """Without constraints all arrays of constraints are empty, in derivatives too."""
    kinetic = lambda v, args: 0.5 * args["m"] * v @ v
    system = ej.System(kinetic, lambda q, args: 4.5 * q @ q)
    start, t, w = ej.State(jnp.ones(1), jnp.zeros(1)), 0.2, 3.0

    def end(m):
        run = ej.simulate(
            system, ej.EnergyConsistent(0.0), start, {"m": m}, h=t / 20, num_steps=20
        )
        return run.ys.q[-1, 0]

    # Truncation, of order (w h)^4.
    exact = 0.5 * w * t * np.sin(w * t)
    np.testing.assert_allclose(jax.jit(jax.grad(end))(1.0), exact, rtol=1e-6)


@pytest.mark.slow
def test_derivatives_where_the_stiffness_has_eigenvalues_of_both_signs():
    """The dissipative stiffness is the positive part of one, in the metric of the inertia;
    differences."""
    system = ej.System(
        lambda v, k: 0.5 * k[2:] @ v**2,
        lambda q, k: 0.5 * k[0] * q[0] ** 2 - k[1] * q[0] * q[1] - q[1] ** 2,
    )
    start = ej.State([1.0, 0.2], [0.0, 0.3])

    @jax.jit
    def end(k):
        scheme = ej.EnergyConsistent(0.7)
        sol = ej.simulate(system, scheme, start, k, h=0.1, num_steps=10, throw=False)
        return jnp.sum(sol.ys.q[-1] * jnp.array([1.0, 0.7]))

    k, small = jnp.array([9.0, 2.0, 1.0, 1.5]), 1e-4
    gradient = jax.grad(end)(k)
    for along in jnp.array([[0.6, -0.8, 0.0, 0.0], [0.0, 0.0, 0.6, -0.8]]):
        difference = (end(k + small * along) - end(k - small * along)) / (2 * small)
        # Truncation of the difference, 1e-8, and its round-off, 1e-12.
        assert gradient @ along == pytest.approx(float(difference), rel=1e-6)


def test_a_derivative_traces_the_search_and_its_rule_once(monkeypatch):
    """The state at the start does not depend on `h`, and the loop over steps changes that:
    JAX would derive the loop twice, and trace the search in each of its programs."""
    calls = []

    def counted(owner, name):
        fn = getattr(owner, name)
        counting = lambda *args, **kwargs: calls.append(name) or fn(*args, **kwargs)
        monkeypatch.setattr(owner, name, counting)

    counted(root, "search")
    counted(root.Equations, "linearisable")
    counted(equations, "form_of")
    counted(equations, "_jacobian")
    system, start, args = ej.problems.double_pendulum()

    def end(h):
        run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=21)
        return run.ys.q[-1, 0]

    jax.jit(jax.grad(end)).trace(0.01)
    # The search and the rule both need the Jacobian: its form is searched for once, and its
    # program is traced once.
    once = ["_jacobian", "form_of", "search"]
    assert sorted(calls) == sorted([*once, "linearisable", "linearisable"])


def first_multipliers(p):
    """Those of a chain at the start of a run."""
    chain, _, args, *_ = ej.problems.chain(3)
    start, args = ej.State(p["q"], p["v"]), args | dict(m=p["m"], g=p["g"])
    return jnp.sum(jnp.sin(make_model(chain, start, args).multipliers(start)))


def multipliers_by_elimination(p):
    """The same from the equations of motion with a dense matrix."""
    chain, _, args, *_ = ej.problems.chain(3)
    assert isinstance(chain, ej.System)
    args, q = args | dict(m=p["m"], g=p["g"]), p["q"]
    constraint = chain.constraint
    assert constraint is not None
    rows = jax.jacrev(lambda q: constraint(q, args))
    slope = jax.grad(lambda q: chain.potential(q, args))(q)
    inertia = jax.hessian(lambda v: chain.kinetic_energy(ej.State(q, v), args))(p["v"])
    _, change = jax.jvp(lambda q: rows(q) @ p["v"], (q,), (p["v"],))
    free = jnp.linalg.solve(inertia, -slope)
    delassus = rows(q) @ jnp.linalg.solve(inertia, rows(q).T)
    return jnp.sum(jnp.sin(jnp.linalg.solve(delassus, rows(q) @ free + change)))


def test_first_and_second_derivatives_of_the_first_multipliers():
    """They are those of linear equations; see `SeparableModel.accelerations`."""
    start = ej.problems.chain(3).start
    p = dict(m=jnp.array([0.5, 0.3, 0.2]), g=jnp.array(9.81), q=start.q, v=start.v + 0.1)
    values, expected = (
        [jax.jit(of(fn))(p) for of in (jax.value_and_grad, jax.hessian)]
        for fn in (first_multipliers, multipliers_by_elimination)
    )
    for x, y in zip(jax.tree.leaves(values), jax.tree.leaves(expected), strict=True):
        # Round-off of two solutions.
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)


def level(q, args):
    """The potential energy without gravity."""
    del args
    return 0 * q[0]


def rolling(q, args):
    """A wheel on a line, `(x, angle)`."""
    del q
    return jnp.array([[1.0, -args["radius"]]])


# Systems with numbers in the constraints, a start, and the numbers for which a run with
# another value needs another start.
HELD_STARTS = dict(
    length=(PENDULUM, [1.0, 0.0], [0.0, 0.0], dict(g=9.81, l=1.0, m=1.3), {"l"}),
    driven=(
        ej.System(
            jnp.eye(1), level, driven=lambda q, t, p: q - p["a"] * jnp.sin(p["w"] * t)
        ),
        [0.0],
        [0.6],
        dict(a=0.2, w=3.0),
        {"a", "w"},
    ),
    driven_from_rest=(
        ej.System(
            jnp.eye(1), level, driven=lambda q, t, p: q - p["a"] * (1 - jnp.cos(3 * t))
        ),
        [0.0],
        [0.0],
        dict(a=0.2),
        set(),
    ),
    rolling=(
        ej.System(jnp.diag(jnp.array([2.0, 0.3])), level, nonholonomic=rolling),
        [0.0, 0.0],
        [0.5, 1.0],
        dict(radius=0.5),
        {"radius"},
    ),
)


@pytest.mark.parametrize("name", HELD_STARTS)
def test_a_start_that_does_not_move_with_a_length_has_no_derivative(name):
    system, q, v, args, wrong = HELD_STARTS[name]
    start = ej.State(jnp.array(q), jnp.array(v))

    def last(args):
        solution = ej.simulate(
            system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=5
        )
        return jnp.sum(solution.ys.q[-1])

    for key in args:
        of_one = jax.grad(lambda x, key=key: last({**args, key: x}))
        if key in wrong:
            with pytest.raises(ValueError, match=rf"respect to `args\['{key}'\]`"):
                of_one(args[key])
        else:
            assert np.isfinite(of_one(args[key]))
    # In `jit` the values are not known before the program runs.
    found = jax.jit(jax.grad(last))(args)
    assert {key for key, slope in found.items() if not np.isfinite(slope)} == wrong
    found = jax.jit(jax.jacfwd(last))(args)
    assert {key for key, slope in found.items() if not np.isfinite(slope)} == wrong


def test_a_held_start_has_derivatives_by_other_numbers():
    system, start = PENDULUM, ej.State(jnp.array([1.0, 0.0]), jnp.zeros(2))

    def last(numbers, alpha=0.5):
        g, l = numbers
        args = dict(g=g, l=l, m=jnp.array(1.3))
        scheme = ej.EnergyDecaying(alpha)
        return ej.simulate(system, scheme, start, args, h=0.01, num_steps=5).ys.q[-1, 0]

    numbers = jnp.array([9.81, 1.0])
    alone = jax.grad(lambda g: last((g, 1.0)))(9.81)
    # Numbers in one array, of which one has a derivative.
    together = jax.grad(lambda g: last(jnp.stack([g, 1.0])))(9.81)
    by_both = jax.grad(last)(numbers)
    for found in (together, by_both[0]):
        np.testing.assert_allclose(found, alone, rtol=1e-12)
    assert not np.isfinite(by_both[1])
    # The numbers of the scheme are traced too.
    with pytest.raises(ValueError, match="no derivative with respect to"):
        jax.grad(lambda l, alpha: last((9.81, l), alpha), (0, 1))(1.0, 0.5)


def test_a_number_of_the_system_itself_is_named():
    class Rod(eqx.Module):
        l: jax.Array

        def __call__(self, q, args):
            del args
            return jnp.array([q @ q - self.l**2])

    start = ej.State(jnp.array([1.0, 0.0]), jnp.zeros(2))

    def last(l):
        system = ej.System(jnp.eye(2), lambda q, _: q[1], Rod(l))
        out = ej.step(system, ej.EnergyDecaying(0.5), start, h=0.01)
        return out.state.q[0]

    with pytest.raises(ValueError, match=r"respect to `system\.constraint\.l`"):
        jax.grad(last)(jnp.array(1.0))
    held = lambda l: last(jax.lax.stop_gradient(l))
    assert jax.grad(held)(jnp.array(1.0)) == 0
