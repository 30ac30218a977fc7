"""Over-constrained mechanisms: multipliers of least norm, and their motion."""

import functools

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import space_mechanisms as space
from scipy.integrate import solve_ivp

import enerjax as ej
from enerjax._operators import make_model

from .helpers import EPS, SCHEMES


ANGLE, SPEED, G = 1.0, 2.0, 9.81


def _bars(num_bars, length):
    """A beam of two points on two to four parallel bars of a given length."""

    def constraint(q, args):
        left, right = q[:2], q[2:]
        feet = jnp.array([0.0, 2.0, 1.0, 0.5])
        heads = [left, right, 0.5 * (left + right), 0.75 * left + 0.25 * right]
        bars = jnp.stack(heads) - jnp.stack([feet, jnp.zeros(4)], axis=1)
        rows = jnp.sum(bars**2, axis=1)[:num_bars] - length(args) ** 2
        return jnp.append(rows, (right - left) @ (right - left) - 4)

    return constraint


@functools.cache
def _beam(num_bars, redundant):
    system = ej.System(
        lambda v, args: 0.5 * args["m"] * v @ v,
        lambda q, args: args["m"] * G * (q[1] + q[3]),
        _bars(num_bars, lambda args: args["l"]),
        redundant=redundant,
    )
    args = {"m": jnp.asarray(1.5), "l": jnp.asarray(1.0)}
    return system, args


def _start(system, args):
    up = jnp.array([jnp.cos(ANGLE), jnp.sin(ANGLE)])
    across = SPEED * jnp.array([-jnp.sin(ANGLE), jnp.cos(ANGLE)])
    q = jnp.concatenate([up, up + jnp.array([2.0, 0.0])])
    return ej.initial_state(system, q, jnp.tile(across, 2), args)


def _run(num_bars, scheme, h, steps, redundant=True):
    system, args = _beam(num_bars, redundant)
    start = _start(system, args)
    return ej.simulate(
        system,
        SCHEMES[scheme](0.5),
        start,
        args,
        h=h,
        num_steps=steps,
        saveat=ej.SaveAt(every=5),
    )


@functools.cache
def _exact():
    """The bars swing as one pendulum; half a second stays clear of the flat pose."""
    rate = lambda t, y: [y[1], -G * np.cos(y[0])]
    run = solve_ivp(rate, (0, 0.5), [ANGLE, SPEED], method="DOP853", rtol=1e-12, atol=1e-12)
    angle = run.y[0, -1]
    up = np.array([np.cos(angle), np.sin(angle)])
    return np.concatenate([up, up + [2, 0]])


def test_undeclared_redundant_constraints_are_refused():
    system, args = _beam(3, redundant=False)
    with pytest.raises(ValueError, match="redundant=True"):
        _start(system, args)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "scheme",
    ["preserving", *[pytest.param(s, marks=SLOW) for s in ("decaying", "consistent")]],
)
def test_the_motion_is_that_of_the_independent_constraints(scheme):
    runs = [_run(4, scheme, h, n) for h, n in ((5e-3, 100), (2.5e-3, 200))]
    error = [np.max(np.abs(run.ys.q[-1] - _exact())) for run in runs]
    order = np.log2(error[0] / error[1])
    # Truncation.
    assert order >= {"preserving": 1.9, "decaying": 1.9, "consistent": 2.8}[scheme]
    assert error[1] <= 1e-4
    run = runs[1]
    leak = np.diff(run.audit.energy) + run.audit.dissipated[1:]
    assert np.max(np.abs(leak)) <= 1e3 * EPS * 2 * G  # solver
    assert np.max(np.abs(run.audit.constraint)) <= 1e-13  # solver
    # Solver: round-off in the directions that the equations leave open is not reduced.
    assert np.max(np.abs(run.audit.constraint_rate)) <= 2e-11


def test_accelerations_satisfy_redundant_constraints():
    system, args = _beam(4, redundant=True)
    state = _start(system, args)
    found = ej.consistent_start(system, state.q, state.v, args)
    constraint = system.constraint
    assert constraint is not None
    rows = lambda q: constraint(q, args)
    rate = lambda q, v: jax.jvp(rows, (q,), (v,))[1]
    change = jax.jvp(rate, (state.q, state.v), (state.v, found.accelerations))[1]
    np.testing.assert_allclose(change, 0, atol=1e-13)  # round-off of numbers of some 10
    # The bars turn alike, as a pendulum.
    up = state.q[:2]
    free = jnp.array([0, -G])
    expected = free - (free @ up + state.v[:2] @ state.v[:2]) * up
    np.testing.assert_allclose(
        found.accelerations, jnp.tile(expected, 2), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("difference", [1e-2, 1e-3])
def test_constraints_that_differ_little_have_the_forces_of_both(difference):
    """The force along the third axis is that which holds the point in the plane."""
    masses = np.array([1.0, 3.0, 1.0])
    weights = masses * np.cos(np.arange(3.0))
    system = ej.System(
        np.diag(masses),
        lambda q, args: G * q @ weights,
        lambda q, args: jnp.array([q @ q - 1, q @ q - 1 + difference * q[2]]),
        redundant=True,
    )
    q, v = jnp.array([0.6, 0.8, 0.0]), jnp.array([-0.8, 0.6, 0.0])
    found = ej.consistent_start(system, q, v)
    constraint = system.constraint
    assert constraint is not None
    jacobian = jax.jacfwd(lambda q: constraint(q, None))(q)
    # What makes the equations regular, over the square of the difference.
    np.testing.assert_allclose(
        found.multipliers @ jacobian[:, 2], -G * weights[2], rtol=1e-8 / difference**2
    )


@pytest.mark.slow
def test_multipliers_are_of_least_norm():
    system, args = _beam(4, redundant=True)
    state = _start(system, args)
    found = ej.consistent_start(system, state.q, state.v, args)
    assert system.constraint is not None
    jacobian = np.asarray(jax.jacfwd(system.constraint)(state.q, args))
    force = np.array([0, 1.5 * G, 0, 1.5 * G]) + 1.5 * np.asarray(found.accelerations)
    # Each row in the measure of its constraint.
    size = np.linalg.norm(jacobian, axis=1)
    least = np.linalg.lstsq((jacobian / size[:, None]).T, -force, rcond=1e-10)[0] / size
    # Round-off of forces of some 15, divided by what makes the equations regular.
    np.testing.assert_allclose(found.multipliers, least, atol=15 * EPS**0.5)
    for h in (1e-3, 1e-4):
        # The program of the motion above; its first row is of the fifth step.
        mean = _run(4, "preserving", h, 200).multipliers[1]
        np.testing.assert_allclose(mean, least, atol=100 * h)  # truncation: of five steps


def test_the_chord_method_solves_redundant_constraints():
    """Its multipliers are those of least norm in the middle of each step."""
    system, args = _beam(4, redundant=True)
    start = _start(system, args)
    assert "chord" in str(ej.explain(system, ej.EnergyPreserving(), start, args))
    run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=1e-3, num_steps=20)
    assert np.max(run.stats.newton_iterations) <= 6
    assert system.constraint is not None
    q = np.asarray(run.ys.q)
    jacobian = jax.jacfwd(system.constraint)
    # The measure of the multipliers is that of the start.
    size = np.linalg.norm(jacobian(start.q, args), axis=1)
    for before, after, found in zip(q[3:], q[4:], run.multipliers[4:], strict=False):
        middle = np.asarray(jacobian(jnp.asarray(0.5 * (before + after)), args))
        null = np.linalg.svd((middle / size[:, None]).T)[2][3:]
        # Solver: the matrix is that at the first guess.
        assert np.max(np.abs(null @ (size * np.asarray(found)))) <= 1e-8 * G


@pytest.mark.slow
def test_relations_between_coordinates_have_no_part_in_the_norm():
    """A body with Euler parameters on two coaxial hinges shares its weight as any other."""
    box = ej.bodies.QuaternionBody("box", 1.0, [0.3, 0.4, 0.5], [0.1, 0.0, 0.0])
    hinge = lambda name, height: ej.joints.Revolute(
        name, "ground", "box", [0.0, 0.0, height], axis=[0.0, 0.0, 1.0]
    )
    scene = ej.Scene(
        [hinge("top", 1.0), box, hinge("foot", -0.3)],
        gravity=[0.0, -2.0, -G],
        redundant=True,
    )
    system, start, args = scene.build()
    model = make_model(system, start, args)
    rates = jax.jacfwd(lambda v: model.joint_rate(start.q, v, None))(jnp.zeros(6))
    inverse = np.diag([1, 1, 1, 1 / 0.3, 1 / 0.4, 1 / 0.5])
    size = np.asarray(model.scales.constraint)[:10]
    unit = np.asarray(rates) / size[:, None]
    load = np.array([0.0, -2.0, -G, 0.0, 0.0, 0.0])
    matrix, right = unit @ inverse @ unit.T, unit @ inverse @ load
    least = np.linalg.pinv(matrix, rcond=1e-9) @ right / size
    found = ej.consistent_start(system, start.q, start.v, args).multipliers[:10]
    # Round-off of forces of some 10, divided by what makes the equations regular.
    np.testing.assert_allclose(found, least, atol=10 * EPS**0.5)
    run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=1e-3, num_steps=4)
    # Truncation: it begins to swing.
    np.testing.assert_allclose(run.multipliers[1, :10], least, atol=1e-4)


@pytest.mark.slow
def test_rods_that_contradict_each_other_are_not_followed():
    """A point on two rods whose feet are nearly the same cannot move."""

    def rods(q, foot):
        other = jnp.stack([q[0] - foot, q[1]])
        length = (0.6 - foot) ** 2 + 0.64
        third = q[2:] @ q[2:] - 4
        return jnp.stack([q[:2] @ q[:2] - 1, other @ other - length, third, 3 * third])

    system = ej.System(jnp.eye(4), lambda q, foot: G * (q[1] + q[3]), rods, redundant=True)
    start = ej.initial_state(system, [0.6, 0.8, 2.0, 0.0], jnp.zeros(4), 0.0)
    run = lambda foot: ej.simulate(
        system, ej.EnergyPreserving(), start, foot, h=1e-3, num_steps=100, throw=False
    )
    assert run(0.0).result == ej.RESULTS.successful
    assert run(1e-12).result != ej.RESULTS.successful


@pytest.mark.slow
def test_derivatives_are_unique():
    def tip(l, num_bars, redundant):
        system, args = _beam(num_bars, redundant)
        args = args | {"l": l}
        start = _start(system, args)
        run = ej.simulate(
            system, ej.EnergyPreserving(), start, args, h=5e-3, num_steps=40, throw=False
        )
        return run.ys.q[-1, 1]

    push = jax.jit(lambda l: jax.jvp(lambda l: tip(l, 4, True), (l,), (1.0,)))
    reverse = jax.jit(jax.grad(lambda l: tip(l, 4, True)))(1.0)
    assert push(1.0)[1] == pytest.approx(float(reverse), rel=1e-9)  # solver
    step = 1e-5
    change = (push(1 + step)[0] - push(1 - step)[0]) / (2 * step)
    assert reverse == pytest.approx(float(change), rel=1e-7)  # truncation
    least = jax.jit(jax.grad(lambda l: tip(l, 2, False)))(1.0)
    assert reverse == pytest.approx(float(least), rel=2e-3)  # truncation, of the scheme


@pytest.mark.slow
def test_derivatives_of_a_rod_that_is_declared_twice():
    rod = lambda q, l: jnp.array([1.0, 2.0]) * (q @ q - l**2)
    system = ej.System(jnp.eye(3), lambda q, args: G * q[1], rod, redundant=True)

    def tip(l):
        start = ej.State(l * jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3))
        run = ej.simulate(system, ej.EnergyPreserving(), start, l, h=0.02, num_steps=20)
        return run.ys.q[-1, 0] + run.multipliers[-1] @ jnp.array([0.01, 0.02])

    push = jax.jit(lambda l: jax.jvp(tip, (l,), (1.0,)))
    forward, reverse, step = push(1.0)[1], jax.jit(jax.grad(tip))(1.0), 1e-5
    assert forward == pytest.approx(float(reverse), rel=1e-9)  # solver
    change = (push(1 + step)[0] - push(1 - step)[0]) / (2 * step)
    assert reverse == pytest.approx(float(change), rel=1e-7)  # truncation


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["preserving index3", "decaying"])
def test_derivatives_of_multipliers_of_least_norm(scheme):
    """Of rows whose parts in the force turn with the length: which part of it each takes is
    for the norm to say, and changes too."""
    rows = lambda q, l: jnp.stack([q @ q - l**2, 2 * (q @ q - l**2), (q @ q) ** 2 - l**4])
    system = ej.System(jnp.eye(2), lambda q, args: G * q[1], rows, redundant=True)
    up, across = jnp.array([0.8, 0.6]), jnp.array([-0.6, 0.8])

    def forces(l):
        start = ej.State(l * up, across)
        run = ej.simulate(
            system, SCHEMES[scheme](0.5), start, l, h=0.01, num_steps=5, throw=False
        )
        return run.multipliers[-1], run.stats.newton_iterations

    run = jax.jit(forces)
    _, iterations = run(1.3)
    assert np.mean(iterations) < 6  # one solve, and not two
    forward, _ = jax.jit(jax.jacfwd(forces, has_aux=True))(1.3)
    reverse, _ = jax.jit(jax.jacrev(forces, has_aux=True))(1.3)
    # Round-off, divided by what makes the equations regular.
    np.testing.assert_allclose(forward, reverse, atol=1e-6)
    step = 1e-4
    change = (run(1.3 + step)[0] - run(1.3 - step)[0]) / (2 * step)
    # The same, divided by the step.
    np.testing.assert_allclose(forward, change, rtol=1e-4)


@pytest.mark.slow
def test_derivatives_of_forces_that_turn_against_each_other():
    """A point at rest on three rods: where these end decides how they share its weight."""
    feet = lambda x: jnp.array([[-1.0, 1.0], [1.0, 1.2], [0.2, 1.0]]).at[2, 0].add(x)
    rows = lambda q, x: jnp.sum((q[None] - feet(x)) ** 2 - feet(x) ** 2, axis=1)
    system = ej.System(jnp.eye(2), lambda q, x: G * q[1], rows, redundant=True)

    def forces(x):
        start = ej.State(jnp.zeros(2), jnp.zeros(2))
        run = ej.simulate(system, ej.EnergyPreserving(), start, x, h=0.01, num_steps=2)
        return run.multipliers[-1]

    def of_least_norm(x):
        size = 2 * jnp.linalg.norm(feet(x), axis=1)
        unit = -2 * feet(x) / size[:, None]
        return unit @ jnp.linalg.solve(unit.T @ unit, jnp.array([0.0, -G])) / size

    # Round-off, divided by what makes the equations regular; for the derivative, twice.
    near = lambda x, y, atol: np.testing.assert_allclose(x, y, rtol=0, atol=atol)
    near(jax.jit(forces)(0.1), of_least_norm(0.1), 1e-6)
    near(jax.jit(jax.jacfwd(forces))(0.1), jax.jacfwd(of_least_norm)(0.1), 1e-4)


def beam_of_parts(angle, **more):
    """On three parallel cranks, `angle` above the horizontal; `length` of the last."""
    up = np.array([np.cos(angle), np.sin(angle)])
    feet = dict(left=np.zeros(2), right=np.array([2.0, 0.0]), middle=np.array([1.0, 0.0]))
    beam = ej.bodies.PlanarBody.rod("beam", 1.0, feet["left"] + up, feet["right"] + up)
    cranks = [
        ej.joints.Distance(
            name, "ground", "beam", foot, foot - feet["middle"],
            length=more.get("length", 1.0) if name == "middle" else 1.0,
        )
        for name, foot in feet.items()
    ]  # fmt: skip
    return ej.Scene([beam, *cranks], gravity=[0.0, -G], redundant=True)


def pulls_of(scene, sol):
    """The forces of the cranks, of least norm: all carry."""
    forces = [scene.reaction(sol, name).force for name in ("left", "right", "middle")]
    return np.linalg.norm(np.asarray(forces).reshape(3, -1, 2)[:, -1], axis=1)


@pytest.mark.slow
def test_a_beam_of_parts_moves_on_a_crank_too_many():
    scene = beam_of_parts(ANGLE)
    system, start, args = scene.build()
    run = ej.simulate(system, ej.EnergyPreserving(), start, args, h=5e-3, num_steps=60)
    assert np.ptp(run.audit.energy) <= 1e3 * EPS * G  # solver
    assert min(pulls_of(scene, run)) > 0.1 * max(pulls_of(scene, run))


def test_a_scene_names_the_rows_that_repeat_others():
    """A third crank of a parallelogram."""
    scene = beam_of_parts(ANGLE)
    found = scene.mobility()
    assert (found.degrees_of_freedom, found.rank) == (1, 2)
    assert found.redundant == ("middle",)  # the last
    assert "1 degree of freedom" in str(scene)
    rest = ej.consistent_start(scene.system, scene.q, scene.v, scene.args)
    assert min(pulls_of(scene, rest)) > 0.1 * max(pulls_of(scene, rest))
    # What cannot be closed: as many as if nothing were repeated.
    assert "at least 0 degrees of freedom" in str(beam_of_parts(ANGLE, length=1.02))


def test_a_repeated_hinge_is_the_one_that_is_redundant():
    """Not the rows within the body, which it repeats too."""
    box = ej.bodies.RigidBody("box", 1.0, [0.3, 0.4, 0.5], [0.0, 0.0, 0.0])
    hinge = lambda name, height: ej.joints.Revolute(
        name, "ground", "box", [0.0, 0.0, height], axis=[0.0, 0.0, 1.0]
    )
    found = ej.Scene([hinge("top", 1.0), box, hinge("foot", 0.0)], redundant=True)
    found = found.mobility()
    assert found.redundant == tuple(f"foot[{k}]" for k in range(5))
    assert found.degrees_of_freedom == 1


@pytest.mark.slow
def test_modes_of_an_over_constrained_scene():
    """The beam hangs from three bars, and swings as one point does."""
    system, start, args = beam_of_parts(-np.pi / 2).build()
    found = ej.modes(system, start, args)
    np.testing.assert_allclose(found.frequencies, [np.sqrt(G)], rtol=1e-12)
    first = lambda g: ej.modes(
        system, start, args.set(gravity=jnp.stack([0 * g, -g]))
    ).frequencies[0]
    slope = jax.grad(first)(G)
    assert float(slope) == pytest.approx(0.5 / np.sqrt(G), rel=1e-12)
    with pytest.raises(ValueError, match="depends on its pose"):
        jax.jit(first)(G)


@pytest.mark.slow
def test_newton_finds_the_step_of_redundant_joints_beside_stiff_springs():
    """The step back to multipliers of least norm must not leave the root."""
    loop = space.with_springs(space.bricard(), 1e7)
    system, start, args = loop.scene().build()
    newton = ej.Newton(linear_solver=lx.LU())
    sol = ej.simulate(
        system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=10, root_finder=newton
    )
    # Round-off of the energies, about 10 J, and of the positions.
    assert jnp.max(jnp.abs(sol.audit.leak)) <= 1e3 * EPS
    assert jnp.max(jnp.abs(sol.audit.constraint)) <= 100 * EPS
