"""Sweeps that are written, resumed, and shared among devices and processes."""

import os
import pathlib
import re
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from .test_sweep import arithmetic, here


ROOT = pathlib.Path(__file__).parent.parent


def counting(calls):
    def progress(done, total):
        del total
        calls.append(done)

    return progress


def test_finished_chunks_are_not_repeated(tmp_path, monkeypatch):
    over = {"a": np.arange(6.0), "b": [1.0]}
    first = ej.sweep(arithmetic, over, chunk=2, path=tmp_path)
    (tmp_path / "chunk-000001.npz").unlink()
    before = {file.name: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
    again = ej.sweep(arithmetic, over, chunk=2, path=tmp_path)
    np.testing.assert_array_equal(again.values["sum"], first.values["sum"])
    after = {file.name: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
    assert set(after) - set(before) == {"chunk-000001.npz"}
    assert all(after[name] == time for name, time in before.items())


def test_another_sweep_is_not_resumed(tmp_path):
    over = {"a": [1.0, 2.0], "b": [1.0]}
    gravity = 9.81
    weight = lambda a, b: gravity * a + b
    ej.sweep(weight, over, path=tmp_path)
    others = [
        (weight, over | {"a": [1.0, 3.0]}, {}, "parameters"),
        (weight, over, {"chunk": 1}, "chunks"),
        (lambda a, b: {"weight": 9.81 * a + b}, over, {}, "results"),
        (lambda a, b: 1.6 * a + b, over, {}, "program"),
        (lambda a, b: 9.81 * b + a, over, {}, "program"),
        (lambda a, b: np.array(9.82) * a + b, over, {}, "program"),
        (lambda a, b: jax.lax.fori_loop(0, 3, lambda _, x: x + b, a), over, {}, "program"),
    ]
    for fn, parameters, options, part in others:
        with pytest.raises(ValueError, match=f"another sweep .different: .*{part}"):
            ej.sweep(fn, parameters, path=tmp_path, **options)
    # A loop of another length is another program, though no shape tells.
    loop = lambda n: lambda a, b: jax.lax.fori_loop(0, n, lambda _, x: x + b, a)
    ej.sweep(loop(3), over, path=tmp_path / "loop")
    ej.sweep(loop(3), over, path=tmp_path / "loop")
    with pytest.raises(ValueError, match="another sweep .different: program."):
        ej.sweep(loop(4), over, path=tmp_path / "loop")
    # So is one with other numbers in a table.
    table = lambda x: lambda a, b: jnp.interp(a + b, jnp.arange(3.0), np.array(x))
    ej.sweep(table([0.0, 1.0, 3.0]), over, path=tmp_path / "table")
    ej.sweep(table([0.0, 1.0, 3.0]), over, path=tmp_path / "table")
    with pytest.raises(ValueError, match="another sweep .different: program."):
        ej.sweep(table([0.0, 1.0, 4.0]), over, path=tmp_path / "table")


def stepped(scheme, newton):
    """The end of a step of a scheme, as a function to be swept."""
    system, start, args = ej.problems.pendulum_angle()

    def step(h):
        solution = ej.simulate(
            system, scheme, start, args, h=h, num_steps=1, root_finder=newton
        )
        return solution.ys.q[-1]

    return step


def test_settings_that_change_no_shape_make_another_sweep(tmp_path):
    """Of the discrete derivative, its points, and Newton's tolerances."""
    over, newton = {"h": [0.1]}, ej.Newton()
    scheme = lambda derivative: ej.EnergyPreserving(derivative=derivative)
    ej.sweep(stepped(scheme(ej.MeanValue(2)), newton), over, path=tmp_path)
    ej.sweep(stepped(scheme(ej.MeanValue(2)), newton), over, path=tmp_path)
    for other in (
        stepped(scheme(ej.Gonzalez()), newton),
        stepped(scheme(ej.MeanValue(3)), newton),
        stepped(scheme(ej.MeanValue(2)), ej.Newton(rtol=2.0)),
        stepped(scheme(ej.MeanValue(2)), ej.Newton(atol=9.0)),
    ):
        with pytest.raises(ValueError, match="another sweep .different: program"):
            ej.sweep(other, over, path=tmp_path)


FINGERPRINT = """
import enerjax as ej
import jax
from enerjax._programs import digest
from tests.test_sweep_resume import stepped
jax.config.update("jax_enable_x64", True)
for derivative in (ej.Gonzalez(), ej.MeanValue()):
    fn = stepped(ej.EnergyPreserving(derivative=derivative), ej.Newton())
    print(digest(jax.jit(fn).trace(0.1).jaxpr))
"""


@pytest.mark.slow
def test_a_program_of_one_function_has_the_same_name_in_every_process():
    """And another where only what is inside of one function differs."""
    found = []
    for seed in ("1", "2"):
        environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
        ran = subprocess.run(
            [sys.executable, "-c", FINGERPRINT],
            cwd=ROOT,
            env=environment | {"JAX_PLATFORMS": "cpu", "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stderr
        found.append(ran.stdout.split())
    assert found[0] == found[1]
    assert found[0][0] != found[0][1]


def process(*arguments, devices=1, **options):
    """The sweep in a process of its own."""
    environment = os.environ | {
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
        "JAX_PLATFORMS": "cpu",
        # Another order of sets and dictionaries must not make another program.
        "PYTHONHASHSEED": str(devices),
    }
    command = [sys.executable, "-m", "tests.sweep_process", *map(str, arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True, **options
    )


def finished(started):
    _, errors = started.communicate(timeout=300)
    assert started.returncode == 0, errors


def compare(file):
    """Solver: other devices, other batches."""
    with np.load(file) as found:
        for name in ("q", "drift"):
            expected = here().values[name]
            np.testing.assert_allclose(found[name], expected, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_killed_sweep_is_resumed_on_other_devices(tmp_path):
    folder, result = tmp_path / "sweep", tmp_path / "result.npz"
    killed = process(result, "--path", folder, "--die-after", 16)
    killed.communicate(timeout=300)
    assert killed.returncode == -9
    assert not result.exists()
    done = {file: file.stat().st_mtime_ns for file in folder.glob("chunk-*.npz")}
    assert sorted(file.name[6:12] for file in done) == ["000000", "000001"]
    finished(process(result, "--path", folder, devices=2))
    assert all(file.stat().st_mtime_ns == time for file, time in done.items())
    assert len(list(folder.glob("chunk-*.npz"))) == 4
    compare(result)


@pytest.mark.slow
def test_two_processes_find_the_same_results_as_one(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    results = [tmp_path / f"{k}.npz" for k in range(2)]
    folder = tmp_path / "sweep"
    options = ("--path", folder, "--port", port)
    both = [process(results[k], *options, "--process", k) for k in range(2)]
    for started in both:
        finished(started)
    for file in results:
        compare(file)
    assert len(list(folder.glob("chunk-*.npz"))) == 4


def test_drafts_are_not_read_as_results(tmp_path):
    """A draft is the file of a process that was killed while it wrote."""
    old, new = (tmp_path / f".chunk-000000.npz.{k}" for k in range(2))
    for draft in (old, new):
        draft.write_bytes(b"half")
    os.utime(old, (0, 0))
    found = ej.sweep(arithmetic, {"a": [1.0], "b": [2.0]}, path=tmp_path)
    assert re.search("1 lanes", str(found))
    assert found.values["sum"] == 3
    # Another process may still be writing the new one.
    assert new.exists()
    assert not old.exists()


def test_a_full_disk_leaves_no_draft(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space left"):
        ej.sweep(arithmetic, {"a": [1.0], "b": [2.0]}, path=tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["sweep.json"]


def test_a_damaged_file_is_named(tmp_path):
    over = {"a": np.arange(4.0), "b": [2.0]}
    first = ej.sweep(arithmetic, over, chunk=2, path=tmp_path).values["sum"]
    file = tmp_path / "chunk-000001.npz"
    whole = file.read_bytes()
    flips = np.random.default_rng(0).integers(0, 8 * len(whole), 200)
    damaged = [whole[:-30], b""]
    for bit in flips:
        content = bytearray(whole)
        content[bit // 8] ^= 1 << (bit % 8)
        damaged.append(bytes(content))
    messages = []
    for content in damaged:
        file.write_bytes(content)
        try:
            again = ej.sweep(arithmetic, over, chunk=2, path=tmp_path).values["sum"]
        except ValueError as error:
            messages.append(str(error))
        else:
            # The damage was where the archive keeps dates and rights.
            np.testing.assert_array_equal(again, first)
    assert len(messages) > 150
    assert all(f"{file} is damaged" in x and "Delete" in x for x in messages)
    file.unlink()
    label = tmp_path / "sweep.json"
    label.write_bytes(b"{")
    with pytest.raises(ValueError, match=r"sweep\.json.* is damaged"):
        ej.sweep(arithmetic, over, chunk=2, path=tmp_path)
