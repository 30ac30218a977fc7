"""Solutions in files: what was saved comes back, and nothing else is read as a solution."""

import dataclasses
import functools
import json
import zipfile
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._results import _NAMES, from_names, names_of

from .helpers import problem


STEPS = 12


def run(**options):
    system, start, args = problem("pendulum")
    scheme = ej.EnergyPreserving()
    return ej.simulate(system, scheme, start, args, h=0.01, num_steps=STEPS, **options)


@functools.cache
def solution():
    return run()


def assert_restored(path, saved):
    ej.save(path, saved)
    found = ej.load(path)
    assert jax.tree.structure(found) == jax.tree.structure(saved)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(saved), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)
    return found


def test_a_solution_is_restored(tmp_path):
    found = assert_restored(tmp_path / "a.npz", solution())
    assert found.result == ej.RESULTS.successful
    assert str(found) == str(solution())
    assert [x.name for x in tmp_path.iterdir()] == ["a.npz"]


def test_the_file_is_an_archive_of_named_arrays(tmp_path):
    ej.save(tmp_path / "a.npz", solution())
    with np.load(tmp_path / "a.npz", allow_pickle=False) as content:
        np.testing.assert_array_equal(content["ys.q"], solution().ys.q)
        np.testing.assert_array_equal(content["audit.kinetic"], solution().audit.kinetic)
        header = json.loads(content["header"].tobytes())
    assert header["version"] == 1


def test_values_of_a_function_and_failures_are_restored(tmp_path):
    def told(t, state, args):
        # A dot in a key must not lead to the array of another key.
        return {"x": [state.q, None], "x.0": (t, {"n": jnp.array(3)})}

    saveat = ej.SaveAt(every=5, fn=told)
    found = assert_restored(tmp_path / "a.npz", run(saveat=saveat))
    assert found.ys["x.0"][1]["n"].dtype == int
    failed = found.result
    for name in _NAMES:
        saved = jax.tree.map(lambda _, x=getattr(ej.RESULTS, name)._value: x, failed)
        assert names_of(saved) == name
        assert from_names(name) == getattr(ej.RESULTS, name)
    assert len(_NAMES) == len(ej.RESULTS)


@pytest.mark.slow
def test_names_and_batches_are_restored(tmp_path):
    system, start, args = problem("pendulum")
    names = ej.Names(["x", "y"], constraints=["rod"])
    named = ej.System(system.kinetic, system.potential, system.constraint, names=names)

    def of(g):
        numbers, h = args | {"g": g}, 0.01
        return ej.simulate(
            named, ej.EnergyPreserving(), start, numbers, h=h, num_steps=3, throw=False
        )

    batch = jax.vmap(of)(jnp.array([9.81, jnp.nan]))
    found = assert_restored(tmp_path / "a.npz", batch)
    assert found.names == names
    np.testing.assert_array_equal(
        found.result == ej.RESULTS.successful, np.array([True, False])
    )


class Pair(NamedTuple):
    x: jax.Array


def test_what_has_no_place_in_a_file_is_refused(tmp_path):
    with pytest.raises(TypeError, match="takes a `Solution`"):
        ej.save(tmp_path / "a.npz", solution().ys)
    pairs = dataclasses.replace(solution(), ys=Pair(solution().ys.q))
    with pytest.raises(TypeError, match="`ys` is of type Pair"):
        ej.save(tmp_path / "a.npz", pairs)
    with pytest.raises(TypeError, match="inside of `jit`"):
        jax.jit(lambda x: ej.save(tmp_path / "a.npz", x))(solution())


@pytest.mark.slow
def test_a_checkpoint_finds_out_before_the_first_step(tmp_path):
    saveat = ej.SaveAt(fn=lambda t, y, args: Pair(y.q))
    calls = []
    with pytest.raises(TypeError, match="`ys` is of type Pair"):
        run(
            saveat=saveat,
            checkpoint=tmp_path / "a.npz",
            progress=lambda *x: calls.append(x),
        )
    assert calls == []
    assert [*tmp_path.iterdir()] == []


def test_other_and_damaged_files_are_named(tmp_path):
    file = tmp_path / "a.npz"
    ej.save(file, solution())
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for content in (whole[:-40], whole[:200], b"", b"no archive", bytes(flipped)):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.npz is not a solution .* damaged"):
            ej.load(file)
    np.savez(file, x=np.ones(3))
    with pytest.raises(ValueError, match=r"a\.npz is not a solution"):
        ej.load(file)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("x.txt", "no array")
    with pytest.raises(ValueError, match=r"a\.npz is not a solution"):
        ej.load(file)
    with pytest.raises(FileNotFoundError):
        ej.load(tmp_path / "none.npz")


def test_code_in_a_file_is_not_run(tmp_path):
    file = tmp_path / "a.npz"

    class Code:
        def __reduce__(self):
            return (file.with_name("ran").write_text, ("x",))

    np.savez(file, header=np.array([Code()], dtype=object), sha256=np.array("x"))
    with pytest.raises(ValueError, match="is not a solution"):
        ej.load(file)
    assert not file.with_name("ran").exists()


def test_a_newer_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("enerjax._run.solution_file.VERSION", 2)
    ej.save(tmp_path / "a.npz", solution())
    monkeypatch.undo()
    with pytest.raises(ValueError, match="version 2 of the format.*Upgrade enerjax"):
        ej.load(tmp_path / "a.npz")


def test_double_precision_is_not_rounded(tmp_path):
    ej.save(tmp_path / "a.npz", solution())
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        ej.load(tmp_path / "a.npz")
