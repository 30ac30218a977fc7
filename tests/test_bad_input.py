"""Bad input raises one clear error, before any step if possible."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

import enerjax as ej

from .bad_functions import ARGS, kinetic, potential, rod, simulate
from .bad_inputs import BAD, WRONG_TYPES
from .helpers import problem


def test_the_unmodified_input_is_accepted():
    assert simulate().stats.completed_steps == 4


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_clear_error(case, is_type_checked):
    if is_type_checked and case in WRONG_TYPES:
        pytest.skip("the type checker refuses it first")
    given, error, message = BAD[case]
    with pytest.raises(error, match=message) as caught:
        simulate(**given)
    # An error of this package, not one that escaped from a library below.
    assert "enerjax" in str(caught.traceback[-1].path)


@pytest.mark.parametrize("bad", [None, "ab", {"x": 1.0}, [[1.0], [0.0, 1.0]]])
def test_a_state_is_made_of_numbers(bad, is_type_checked):
    if is_type_checked:
        pytest.skip("the type checker refuses it first")
    with pytest.raises(TypeError, match="must be arrays or lists of numbers"):
        ej.State(bad, [0.0, 0.0])


def test_bad_shapes_raise_an_error_under_jit_too():
    with pytest.raises(ValueError, match="must return a vector"):
        jax.jit(lambda h: simulate(constraint=lambda q, args: q @ q - 1, h=h))(0.01)


@pytest.mark.slow
def test_numbers_that_vary_over_devices_are_refused():
    by_device = jax.sharding.PartitionSpec("lanes")
    mesh = jax.make_mesh((1,), ("lanes",), axis_types=(jax.sharding.AxisType.Auto,))
    run = lambda m: simulate(args=ARGS | dict(m=m[0])).ys.q[None]
    many = lambda check: jax.shard_map(
        run, mesh=mesh, in_specs=by_device, out_specs=by_device, check_vma=check
    )
    with pytest.raises(ValueError, match="check_vma"):
        many(True)(jnp.ones(1))
    assert many(False)(jnp.ones(1)).shape[0] == 1


def test_masses_in_place_of_an_inertia_matrix_are_refused():
    with pytest.raises(ValueError, match="jnp.diag"):
        ej.System(jnp.ones(60), lambda q, args: 0.5 * q @ q)


def test_the_step_checks_its_input_too():
    system = ej.System(kinetic, potential, rod)
    with pytest.raises(ValueError, match="positive"):
        ej.step(system, ej.EnergyPreserving(), ej.State([1.0, 0.0], [0.0, 0.0]), ARGS, h=-1)


SINGLE = """
import warnings
import enerjax as ej
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    system, start, args = ej.problems.pendulum()
    runs = [
        ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=50)
        for h in (0.01, 0.02)
    ]
ours = [str(w.message) for w in caught if "float32" in str(w.message)]
assert len(ours) == 1, ours
assert "jax_enable_x64" in ours[0]
assert runs[1].ys.q.dtype == "float32"
# Single precision: 1e-7 of the turnover a step.
assert abs(runs[1].audit.energy).max() < 1e-4
assert abs(runs[1].audit.constraint).max() < 1e-5
"""


def test_single_precision_is_warned_of_once_and_works():
    done = subprocess.run([sys.executable, "-c", SINGLE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_exhausted_memory_raises_an_error_with_remedies():
    system, start, args = problem("pendulum")
    with pytest.raises(MemoryError, match=r"10{12} steps.*SaveAt"):
        ej.simulate(system, ej.EnergyPreserving(), start, args, h=1e-3, num_steps=10**12)


def test_a_function_without_return_raises_an_error():
    def potential(q, args):
        q @ q  # pyright: ignore

    kinetic = lambda v, args: 0.5 * v @ v
    system = ej.System(kinetic, potential)  # pyright: ignore
    with pytest.raises(TypeError, match=r"`potential` must .* Is its `return` missing\?"):
        ej.simulate(
            system, ej.EnergyPreserving(), ej.State([1.0], [0.0]), h=0.1, num_steps=1
        )
