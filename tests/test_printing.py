"""The texts of `print`, and read-only mappings of numbers."""

import jax
import jax.numpy as jnp
import pytest

import enerjax as ej


@pytest.fixture(scope="module")
def pendulum():
    parts = [
        ej.bodies.PointMass("bob", 2.0, [1.0, 0.0]),
        ej.joints.Distance("rod", "ground", "bob"),
    ]
    return ej.Scene(parts, args={"k": 3.0}).build()


def run(problem, h, **options):
    scheme = ej.EnergyPreserving("index3")
    return ej.simulate(
        problem.system,
        scheme,
        problem.start,
        problem.args,
        h=h,
        num_steps=20,
        throw=False,
        **options,
    )


def test_numbers_of_a_scene_are_changed_by_set_alone(pendulum):
    _, _, args = pendulum
    assignments = [
        (args["bodies"]["bob"], "mass"),
        (args["bodies"], "bob"),
        (args, "k"),
    ]
    for holder, key in assignments:
        with pytest.raises(TypeError, match=rf"'{key}'\]` cannot .* `args\.set`"):
            holder[key] = 5.0
    with pytest.raises(TypeError, match="`args.set`"):
        del args["bodies"]["bob"]["mass"]
    assert args["bodies"]["bob"]["mass"] == 2.0
    assert args.set("bob", mass=5.0)["bodies"]["bob"]["mass"] == 5.0
    # What is read is a tree of numbers, as a dictionary is.
    doubled = jax.jit(lambda part: jax.tree.map(lambda x: 2 * x, part))
    assert doubled(args["bodies"]["bob"])["mass"] == 4.0


def test_numbers_of_a_scene_are_printed_by_name(pendulum):
    text = str(pendulum[2])
    assert "k = 3." in text
    assert "bob: mass = 2." in text
    shown = []
    jax.jit(lambda args: shown.append(str(args)))(pendulum[2])
    assert "bob: mass = float64[]" in shown[0]


def test_a_run_prints_outcome_steps_iterations_and_audit():
    problem = ej.problems.stiff_double_pendulum()
    good = str(run(problem, 1e-3))
    assert good.splitlines()[0] == "successful"
    assert good.splitlines()[1] == "20 steps, rows from t = 0 to 0.02"
    assert " iterations a step" in good
    assert "unaccounted for" in good
    assert "divided" not in good
    bad = str(run(problem, 0.03))
    assert bad.startswith("Newton's method did not converge\n12 steps")
    divided = str(run(problem, 0.03, max_halvings=6))
    assert "steps divided, into up to" in divided


def test_a_run_that_an_event_ends_prints_when():
    system = ej.System(jnp.eye(1), lambda q, args: q[0])
    start = ej.State(jnp.array([1.0]), jnp.array([0.0]))
    ground = ej.Event(lambda q, v, t, args: q[0], terminal=True)
    text = str(
        ej.simulate(
            system, ej.EnergyPreserving(), start, h=0.1, num_steps=20, events=ground
        )
    )
    assert "an event ended the run at t = 1.41421, behind the last row" in text


def test_a_batch_prints_the_number_of_lanes_with_each_outcome():
    problem = ej.problems.pendulum()
    batch = jax.vmap(lambda h: run(problem, h))(jnp.array([0.01, 0.02, 50.0]))
    lines = str(batch).splitlines()
    assert lines[0].startswith("3 lanes: ")
    assert "2 successful" in lines[0]
    assert lines[1].startswith("0 to 20 steps, rows from t = 0 to ")
    assert str(ej.RESULTS.successful) == "enerjax._results.RESULTS<successful>"


def test_a_mobility_prints_its_results():
    system = ej.System(
        lambda v, args: 0.5 * v @ v,
        lambda q, args: 0.0 * q[0],
        lambda q, args: jnp.array([q @ q - 1, 2 * q @ q - 2]),
        redundant=True,
    )
    text = str(ej.mobility(system, ej.State([1.0, 0.0], [0.0, 0.0])))
    assert text.splitlines()[0] == "1 degrees of freedom, 1 independent of 2 constraints"
    assert "follow from others: 1" in text
