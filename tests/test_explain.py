"""`explain` tells which way a step goes, before it is compiled."""

from typing import Any

import jax.numpy as jnp
import pytest
import space_mechanisms as space

import enerjax as ej

from .helpers import EPS, problem


def explained(name, scheme: Any = ej.EnergyPreserving()):
    system, start, args = problem(name)
    return ej.explain(system, scheme, start, args)


def test_a_small_system_is_one_function():
    found = explained("double")
    assert found.solves == 1
    assert found.unknowns == {
        "increments": 4,
        "multipliers": 2,
        "multipliers of velocity constraints": 2,
    }
    assert found.obstacles == ()
    assert found.chord is not None
    text = str(found)
    assert "chord method" in text
    assert "each of 8 unknowns" in text
    assert "one function of machine code: yes" in text


def test_forces_that_need_newton_are_noticed():
    """A pendulum in a viscous fluid: the force is one of the user's."""
    system, start, args = problem("double")
    damped = ej.System(
        system.kinetic,
        system.potential,
        system.constraint,
        force=lambda q, v, t, args: -args["c"] * v,
    )
    explained = lambda damping: ej.explain(
        damped, ej.EnergyPreserving(), start, args | dict(c=damping), h=1e-2
    )
    soft, stiff = explained(1.0), explained(1e4)
    # `h/2 c/m` with masses of one; truncation of the power iteration.
    assert soft.contraction == pytest.approx(5e-3, rel=1e-3)
    assert stiff.contraction == pytest.approx(50, rel=1e-3)
    assert "Newton's method" not in str(soft).splitlines()[4]
    assert "so steps are solved by Newton's method" in str(stiff)


def test_a_composition_has_several_solves():
    scheme = ej.Composed(ej.EnergyPreserving(), 4)
    assert explained("double", scheme).solves == len(scheme.stages) > 1


def test_lagrangians_are_one_function_too():
    system, start, args = ej.problems.double_pendulum_angles()
    found = ej.explain(system, ej.EnergyPreserving(), start, args)
    assert found.coordinates == "2 coordinates with 2 momenta"
    assert found.obstacles == ()


@pytest.mark.slow
def test_factors_of_small_matrices_and_running_sums_are_no_obstacles():
    def kinetic(q, qdot, args):
        rates = jnp.cumsum(qdot)
        mobility = 2 * jnp.eye(2) + 0.3 * jnp.cos(q[:, None] - q[None])
        return 0.5 * rates @ jnp.linalg.solve(mobility, rates)

    system = ej.System.from_lagrangian(kinetic, lambda q, args: 0.5 * q @ q)
    start = ej.State([1.0, 0.5], [0.0, 0.0])
    assert ej.explain(system, ej.EnergyPreserving(), start).obstacles == ()
    run = ej.simulate(system, ej.EnergyPreserving(), start, h=0.01, num_steps=50)
    assert jnp.ptp(run.audit.energy) <= 50 * 10 * EPS  # round-off


def test_operations_of_the_user_are_named_with_their_lines():
    def force(q, v, t, args):
        return -jnp.linalg.eigh(jnp.eye(2) + jnp.outer(q, q))[1] @ v

    system = ej.System(jnp.eye(2), lambda q, args: 0.5 * q @ q, force=force)
    start = ej.State([1.0, 0.5], [0.0, 0.0])
    found = ej.explain(system, ej.EnergyPreserving(), start)
    (of_eigh,) = [x for x in found.obstacles if x.startswith("`eigh`")]
    assert "test_explain.py" in of_eigh
    assert "force" in of_eigh
    assert "because of\n" in str(found)


def test_of_a_chain_every_other_row_is_eliminated():
    system, start, args = ej.problems.chain(24)
    found = ej.explain(system, ej.EnergyPreserving(), start, args)
    assert found.method.startswith("chord method")
    assert found.chord is not None
    rounds = "24 rows, nodes eliminated together: 12, 6, 3; then 3 rows"
    assert found.chord.startswith(rounds)
    assert "nodes of up to 4 unknowns" in found.jacobian


def test_a_long_chain_in_directors_is_eliminated_in_few_rounds():
    """From both ends, two nodes in a round, it would take about 60 rounds."""
    system, start, args = space.chain(24).scene().build()
    found = ej.explain(system, ej.Rattle(), start, args)
    assert found.chord is not None
    rounds, _ = found.chord.removeprefix("264 rows, nodes eliminated together: ").split(";")
    assert len(rounds.split(",")) <= 5  # about the logarithm of the 25 blocks


def test_a_sparse_solver_replaces_the_chord_method():
    pytest.importorskip("klujax")
    system, start, args = ej.problems.chain(24)
    by_klu = ej.explain(
        system,
        ej.EnergyPreserving(),
        start,
        args,
        root_finder=ej.Newton(linear_solver=ej.KLU()),
    )
    assert by_klu.chord is None
    assert by_klu.jacobian.endswith("entries, KLU")


@pytest.mark.parametrize(("restitution", "rests"), [(None, False), (0.8, True)])
def test_steps_that_look_for_impacts_are_one_function(restitution, rests):
    law = ej.contacts.Restitution(restitution)
    parts = [
        ej.bodies.PlanarBody("rod", 1.0, 1 / 12, [0.0, 1.0], 0.3),
        ej.contacts.OnPlane("floor", "ground", "rod", [0, 1], law, point_b=[0.5, 0]),
    ]
    system, start, args = ej.Scene(parts, gravity=[0.0, -9.81]).build()
    top = ej.Event(lambda q, v, t, args: v[1])
    text = str(ej.explain(system, ej.EnergyPreserving(), start, args, events=top))
    assert "events: 2 functions" in text
    assert ("gaps that can stay closed" in text) == rests
    assert "one function of machine code: yes" in text


def test_bad_input_is_refused_as_in_a_run():
    with pytest.raises(TypeError, match="scheme"):
        explained("double", ej.EnergyPreserving)
