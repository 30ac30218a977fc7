"""Machine code on disk, where JAX is asked to keep compiled programs."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from enerjax._programs import in_one_function
from enerjax._programs.jaxprs import with_constants_as_inputs
from enerjax._programs.machine_code import code_on_disk
from enerjax._programs.machine_code.code_on_disk import Code, key_of


pytestmark = pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="machine code is for CPUs"
)
SCRIPT = Path(__file__).with_name("code_process.py")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(code_on_disk, "_folder", lambda: tmp_path)
    return tmp_path


def of_process(folder):
    done = subprocess.run(
        [sys.executable, SCRIPT, folder], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_another_process_finds_programs_and_their_branches(tmp_path):
    first = of_process(tmp_path)
    assert first["graph_of"] == 2
    # A handler and a branch of each program.
    assert first["object_of"] == 4
    again = of_process(tmp_path)
    assert again == first | dict(graph_of=0, object_of=0)
    for file in (tmp_path / "enerjax").iterdir():
        file.write_bytes(file.read_bytes()[:-100])
    assert of_process(tmp_path) == first


def key(fn, *args, known=None):
    closed = jax.make_jaxpr(fn)(*args)
    known = [None] * len(closed.jaxpr.invars) if known is None else known
    return key_of(with_constants_as_inputs(closed.jaxpr), [*closed.consts, *known])


@pytest.mark.parametrize(
    "other",
    [
        lambda x: jnp.sin(x) + 2,
        lambda x: jnp.sin(x)[::-1] + 1,
        lambda x: jax.lax.cond(x[0] > 0, jnp.sin, jnp.cos, x) + 1,
        lambda x: jax.jit(lambda x: jnp.sin(x) + 1)(x),
    ],
)
def test_another_program_has_another_key(folder, other):
    x = jnp.ones(3)
    usual = key(lambda x: jnp.sin(x) + 1, x)
    assert usual == key(lambda x: jnp.sin(x) + 1, x)
    assert usual != key(other, x)
    assert usual != key(lambda x: jnp.sin(x) + 1, jnp.ones(4))


def test_known_inputs_and_constants_belong_to_the_key(folder):
    x, table = jnp.ones(3), np.arange(3.0)
    add = lambda x, table: x + table
    keys = {key(add, x, table, known=[None, known]) for known in (None, table, table + 1)}
    assert len(keys) == 3
    scaled = lambda c: lambda x: jax.lax.map(lambda x: x * np.full(1, c), x[:, None])
    assert key(scaled(1.0), x) != key(scaled(2.0), x)


def test_a_version_and_an_optimisation_belong_to_the_key(folder, monkeypatch):
    fn, x = lambda x: jnp.sin(x) + 1, jnp.ones(3)
    usual = key(fn, x)
    with monkeypatch.context() as patch:
        patch.setattr(code_on_disk, "_versions", lambda: "another")
        assert key(fn, x) != usual
    monkeypatch.setattr(code_on_disk, "machine", lambda: "another")
    assert key(fn, x) != usual


def test_a_program_that_cannot_be_compared_has_no_key(folder):
    x = jnp.ones(3)
    unknown = jax.make_jaxpr(lambda x: jnp.sin(x))(x).jaxpr
    eqn = unknown.eqns[0]
    unknown = unknown.replace(eqns=[eqn.replace(params=eqn.params | dict(other=object()))])
    assert key_of(unknown, [None]) is None


def test_a_program_with_a_random_key_has_no_key(folder):
    state = jax.random.key(3)
    noise = jax.jit(lambda: jax.random.normal(state, (2,)))
    assert key(lambda x: x + noise(), jnp.ones(2)) is None


def test_without_a_folder_nothing_is_kept():
    assert jax.config.values["jax_compilation_cache_dir"] is None
    assert key(lambda x: x + 1, 1.0) is None


def test_code_comes_back_from_disk(folder):
    code = Code(1, ["text", "branch"], np.zeros(2, np.int64), [np.arange(3)])
    assert code_on_disk.kept_code("key") is None
    code_on_disk.keep_code("key", code)
    found = code_on_disk.kept_code("key")
    assert found is not None
    assert found[:2] == code[:2]
    np.testing.assert_array_equal(found.constants, code.constants)
    np.testing.assert_array_equal(found.tables, code.tables)


def test_what_compiles_quickly_is_not_kept(folder):
    in_one_function(lambda x: 2 * jnp.sin(x))(jnp.ones(3))
    assert not list(folder.iterdir())


def test_a_folder_that_cannot_be_written_is_told(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(code_on_disk, "_folder", lambda: tmp_path / "file" / "enerjax")
    code = Code(1, ["text"], np.zeros(2, np.int64), [])
    with pytest.warns(UserWarning, match="cannot be kept in .*Choose another folder"):
        code_on_disk.keep_code("key", code)
    assert code_on_disk.kept_code("key") is None


def test_a_failed_write_leaves_no_file(folder, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.warns(UserWarning, match="No space left"):
        code_on_disk.keep_code("key", Code(1, ["text"], np.zeros(2, np.int64), []))
    assert not list(folder.iterdir())
