"""Tables of runs: text files, pandas and xarray, with names of coordinates."""

import csv
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .helpers import problem


@functools.cache
def scene():
    return ej.Scene(
        [
            ej.bodies.PlanarBody.rod("crank", 1.0, [0.0, 0.0], [0.6, 0.8]),
            ej.bodies.PointMass("bob", 2.0, [0.6, -0.2]),
            ej.joints.Revolute("pin", "ground", "crank", [0.0, 0.0]),
            ej.joints.Distance("rod", "crank", "bob", [0.5, 0.0]),
            ej.forces.Spring("spring", "ground", "bob", 3.0, 0.5),
        ],
        gravity=[0.0, -9.81],
    )


@functools.cache
def run():
    system, start, args = scene().build()
    return ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=20)


def read(path):
    with open(path, newline="") as file:
        head, *lines = csv.reader(file)
    return dict(zip(head, np.array(lines, float).T, strict=True))


COORDINATES = ["crank.x", "crank.y", "crank.angle", "bob.x", "bob.y"]
VELOCITIES = ["crank.vx", "crank.vy", "crank.angle_rate", "bob.vx", "bob.vy"]


@pytest.mark.slow
def test_a_csv_file_has_every_digit(tmp_path):
    sol = run()
    sol.to_csv(tmp_path / "a.csv")
    found = read(tmp_path / "a.csv")
    names = [*found]
    assert names[:11] == ["t", *COORDINATES, *VELOCITIES]
    assert names[11:14] == ["multiplier.pin[0]", "multiplier.pin[1]", "multiplier.rod"]
    expected = {
        "t": sol.ts,
        "crank.angle": sol.ys.q[:, 2],
        "bob.vy": sol.ys.v[:, 4],
        "multiplier.rod": sol.multipliers[:, 2],
        "constraint_rate.pin[1]": sol.audit.constraint_rate[:, 1],
        "energy": sol.audit.energy,
        "leak": sol.audit.leak,
        "newton_iterations": np.append(0, sol.stats.newton_iterations),
        "local_error": np.append(np.nan, sol.stats.local_error),
    }
    for name, x in expected.items():
        np.testing.assert_array_equal(found[name], x, err_msg=name)


def test_the_columns_of_a_scene_are_its_motion(tmp_path):
    """Geometry and statics, which the library evaluates in another way."""
    sol, columns = run(), scene().columns(run())
    assert {x.shape for x in columns.values()} == {sol.ts.shape}
    angle = columns["crank.angle"]
    tip = np.stack([np.cos(angle), np.sin(angle)])
    centre = np.stack([columns["crank.x"], columns["crank.y"]])
    bob = np.stack([columns["bob.x"], columns["bob.y"]])
    # Solver: the constraints hold to the tolerance of Newton's method.
    close = functools.partial(np.testing.assert_allclose, rtol=1e-11, atol=1e-11)
    close(centre, tip / 2)
    close(columns["rod.length"], np.linalg.norm(bob - tip, axis=0))
    close(columns["spring.length"], np.linalg.norm(bob, axis=0))
    close(columns["spring.force"], -3.0 * (columns["spring.length"] - 0.5))
    rate = columns["bob.x"] * columns["bob.vx"] + columns["bob.y"] * columns["bob.vy"]
    close(columns["spring.length_rate"], rate / columns["spring.length"])
    close(columns["pin.angle"], angle)
    # The force of the rod on the bob is along the rod.
    pull = np.stack([columns["rod.reaction_x"], columns["rod.reaction_y"]])
    close(pull, columns["rod.force"] * (bob - tip) / columns["rod.length"])
    sol.to_csv(tmp_path / "a.csv", columns)
    found = read(tmp_path / "a.csv")
    assert [*found][: 1 + len(columns)] == ["t", *columns]
    assert "multiplier.rod" not in found
    np.testing.assert_array_equal(found["rod.force"], columns["rod.force"])
    np.testing.assert_array_equal(found["energy"], sol.audit.energy)


@pytest.mark.slow
def test_a_body_in_space_has_a_quaternion_without_jumps():
    """A free top about its axis of symmetry turns at a constant rate (closed form)."""
    body = ej.bodies.RigidBody(
        "top", 1.0, [2.0, 2.0, 3.0], [1.0, 2.0, 3.0], angular_velocity=[0.0, 0.0, 30.0]
    )
    spinning = ej.Scene([body])
    system, start, args = spinning.build()
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.01, num_steps=20)
    columns = spinning.columns(sol)
    quaternion = np.stack([columns[f"top.q{x}"] for x in "wxyz"])
    # The scheme turns by 2 atan(h omega/2) in a step.
    half = np.arctan(0.01 * 30.0 / 2) * np.arange(21)
    zero = np.zeros(21)
    expected = np.stack([np.cos(half), zero, zero, np.sin(half)])
    # Solver: twenty steps.
    np.testing.assert_allclose(quaternion, expected, atol=1e-12)
    assert half[-1] > np.pi / 2
    np.testing.assert_allclose(columns["top.omega_z"], 30.0, rtol=1e-12)
    np.testing.assert_allclose(columns["top.z"], 3.0, rtol=1e-14)


def test_rows_that_were_not_reached_are_left_out(tmp_path):
    """And what has no name has a number."""
    whole, none = run(), jnp.where(jnp.arange(21) < 8, 0.0, jnp.nan)
    cut = eqx.tree_at(
        lambda sol: (sol.audit.kinetic, sol.names),
        whole,
        (whole.audit.kinetic + none, None),
        is_leaf=lambda x: isinstance(x, ej.Names),
    )
    cut.to_csv(tmp_path / "a.csv")
    found = read(tmp_path / "a.csv")
    assert found["t"].size == 8
    assert [*found][:3] == ["t", "q0", "q1"]
    assert "multiplier.2" in found
    np.testing.assert_array_equal(found["v3"], whole.ys.v[:8, 3])


def test_pandas_has_the_same_columns(tmp_path):
    pandas = pytest.importorskip("pandas")
    run().to_csv(tmp_path / "a.csv")
    frame = run().to_pandas()
    text = pandas.read_csv(tmp_path / "a.csv", index_col="t")
    # Round-off: not every version of pandas reads the last digit.
    pandas.testing.assert_frame_equal(frame, text, check_dtype=False, rtol=1e-14)
    assert frame["newton_iterations"].dtype == int
    own = run().to_pandas({"height": run().ys.q[:, 1], "all": run().ys.q})
    assert [*own][:6] == ["height", *(f"all[{k}]" for k in range(5))]


def test_xarray_has_named_axes():
    pytest.importorskip("xarray")
    found = run().to_xarray()
    q = found["q"].sel(coordinate="bob.y", t=0.1, method=None)
    assert q == run().ys.q[10, 4]
    assert found["multipliers"].sel(multiplier="rod").shape == (21,)
    assert found["constraint_rate"].dims == ("t", "joint")
    assert found.attrs["result"] == "successful"
    assert found.attrs["completed_steps"] == 20
    np.testing.assert_array_equal(found["energy"], run().audit.energy)


@pytest.mark.slow
def test_values_of_a_function_are_columns():
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    system, start, args = problem("pendulum")

    def sampled(fn):
        saveat = ej.SaveAt(every=5, fn=fn)
        scheme = ej.EnergyPreserving()
        return ej.simulate(system, scheme, start, args, h=0.01, num_steps=10, saveat=saveat)

    sol = sampled(lambda t, y, args: {"x": y.q[0], "both": jnp.stack([y.q, y.v])})
    names = ["both[0, 0]", "both[0, 1]", "both[1, 0]", "both[1, 1]", "x", "multiplier.0"]
    assert [*sol.to_pandas()][:6] == names
    assert sol.to_xarray()["both"].dims == ("t", "both_0", "both_1")
    with pytest.raises(ValueError, match="needs the states of one run"):
        scene().columns(sol)


def test_what_is_no_table_is_refused():
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), run())
    with pytest.raises(ValueError, match=r"a batch of \(2,\): pick one"):
        batch.to_pandas()
    with pytest.raises(ValueError, match=r"`short` has the shape \(3,\).*21 rows"):
        run().to_csv("never.csv", {"short": np.ones(3)})


@pytest.mark.parametrize("method", ["to_pandas", "to_xarray"])
def test_a_missing_library_is_named(method, monkeypatch):
    library = method.removeprefix("to_")
    monkeypatch.setitem(__import__("sys").modules, library, None)
    with pytest.raises(ImportError, match=rf"{library}.*extra `tables`"):
        getattr(run(), method)()


def test_wrong_names_are_refused():
    system, start, args = problem("pendulum")
    with pytest.raises(ValueError, match="'x' occurs 2 times"):
        ej.Names(["x", "x"])

    def named(names: Any) -> ej.System:
        constraint = system.constraint
        return ej.System(system.kinetic, system.potential, constraint, names=names)

    for names, kind, message in (
        (ej.Names(["x", "y", "z"]), ValueError, "has 3 coordinates, and the system has 2"),
        (ej.Names(constraints=[]), ValueError, "has 0 constraints, and the system has 1"),
        (["x", "y"], TypeError, "`names` must be"),
    ):
        with pytest.raises(kind, match=message):
            ej.initial_state(named(names), start.q, start.v, args)
