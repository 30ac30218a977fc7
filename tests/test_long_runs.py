"""Runs that are watched, interrupted, written to a file and continued to the last bit."""

import dataclasses
import functools
import itertools
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej
from enerjax._run import long_run

from .helpers import EPS, problem, SCHEMES
from .long_process import motion, STEPS


ROOT = Path(__file__).parents[1]


def quietly(done, whole):
    """The progress of a run that nobody watches."""


def assert_same(found, expected):
    """Every number of two solutions is the same, bit by bit."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(x, y)


@functools.cache
def whole():
    return motion(progress=quietly)


# Neither is a multiple of the steps between rows.
@functools.cache
def first_part():
    return motion(num_steps=1000, progress=quietly)


def test_a_continued_run_is_the_same_to_the_last_bit():
    assert_same(motion(resume=first_part()), whole())


def test_a_part_that_ends_with_a_row_can_be_continued():
    part = motion(num_steps=700, progress=quietly)
    assert_same(motion(resume=part), whole())


def test_a_run_can_be_continued_from_a_file(tmp_path):
    ej.save(tmp_path / "part.npz", first_part())
    part = ej.load(tmp_path / "part.npz")
    assert_same(part, first_part())
    assert_same(motion(resume=part), whole())


@pytest.mark.slow
def test_a_run_in_pieces_is_that_in_one_piece():
    plain = motion()
    assert plain.continuation is None
    assert plain.stats.completed_steps == STEPS
    # Round-off: another program. It accumulates over two thousand steps.
    for found, expected, size in (
        (whole().ts, plain.ts, 20.0),
        (whole().ys.q, plain.ys.q, 1e3),
        (whole().multipliers, plain.multipliers, 1e5),
        (whole().audit.energy, plain.audit.energy, 1e3),
        (whole().audit.dissipated, plain.audit.dissipated, 1e3),
        (whole().stats.local_error, plain.stats.local_error, 1e6),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=size * EPS)
    # A correction of the size of round-off may be needed or not.
    difference = whole().stats.newton_iterations - plain.stats.newton_iterations
    assert np.abs(difference).max() <= 2


@pytest.mark.slow
def test_a_killed_run_is_continued(tmp_path):
    file = tmp_path / "run.npz"
    command = [sys.executable, "-m", "tests.long_process", str(file)]
    killed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert [x.name for x in tmp_path.iterdir()] == ["run.npz"]
    part = ej.load(file)
    assert part.result == ej.RESULTS.interrupted
    assert 0 < part.stats.completed_steps < STEPS
    calls = []
    found = motion(checkpoint=file, progress=lambda *times: calls.append(times))
    assert_same(found, whole())
    assert calls[0][0] > 0.01 * int(part.stats.completed_steps)
    # The file holds the whole run now, so the same call makes no step.
    calls.clear()
    written = file.stat().st_mtime_ns
    assert_same(motion(checkpoint=file, progress=lambda *times: calls.append(times)), found)
    assert calls == []
    assert file.stat().st_mtime_ns == written
    assert_same(ej.load(file), found)


def interrupt(done, total):
    """Ctrl-C after the first piece."""
    signal.raise_signal(signal.SIGINT)


def test_an_interrupted_run_raises_an_error_with_the_run_so_far():
    with pytest.raises(KeyboardInterrupt, match="after step 64, at t = 0.64") as raised:
        motion(progress=interrupt)
    so_far = raised.value.solution  # pyright: ignore
    assert_same(motion(resume=so_far), whole())


def test_an_interrupted_run_is_returned_without_throw():
    part = motion(progress=interrupt, throw=False)
    assert part.result == ej.RESULTS.interrupted
    assert part.stats.completed_steps == 64
    # Rows of whole groups of seven steps.
    np.testing.assert_array_equal(part.ys.q[:10], whole().ys.q[:10])
    assert np.all(np.isnan(part.ys.q[10:]))
    assert "interrupted" in str(part)


def test_an_interrupted_run_leaves_a_checkpoint(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        motion(progress=interrupt, checkpoint=tmp_path / "run.npz")
    assert ej.load(tmp_path / "run.npz").stats.completed_steps == 64


def test_progress_is_shown_on_one_line(capsys):
    motion(num_steps=700, progress=True)
    first, *_, last = capsys.readouterr().err.splitlines()
    assert "time 0.64 of 7, 64 steps" in first
    assert last.startswith("100 % [####################] time 7 of 7, 700 steps")


def test_a_terminal_overwrites_the_line(capsys, monkeypatch):
    """The time left is that at the speed since the first report. Here the clock advances
    by a second whenever it is read, which is twice for each report."""
    clock = itertools.count()
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr("time.monotonic", lambda: float(next(clock)))
    motion(num_steps=700, progress=True)
    lines = capsys.readouterr().err
    assert lines.count("\n") == 1
    _, first, second, *_, last = lines.split("\r")
    assert first.rstrip().endswith("64 steps")
    done, left = re.findall(r"time (\S+) of .* 0:(\d+) left", second)[0]
    assert int(left) == round(2 * (7 - float(done)) / (float(done) - 0.64))
    assert last.startswith("100 %")
    assert last.rstrip().endswith(" passed")


def test_an_interrupted_run_ends_its_line(capsys, monkeypatch):
    """As by Ctrl-C in the second piece."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    pieces = itertools.count(1)
    made = long_run._LongRun.go_on

    def go_on(*args):
        if next(pieces) == 2:
            raise KeyboardInterrupt
        return made(*args)

    monkeypatch.setattr(long_run._LongRun, "go_on", go_on)
    with pytest.raises(KeyboardInterrupt):
        motion(num_steps=700, progress=True)
    last = capsys.readouterr().err.split("\r")[-1]
    assert "time 0.64 of 7, 64 steps" in last
    assert last.endswith("\n")


def test_progress_is_called_with_times():
    calls = []
    motion(num_steps=700, progress=lambda *times: calls.append(times))
    done, total = np.array(calls).T
    np.testing.assert_allclose(total, 7.0)
    assert np.all(np.diff(done) > 0)
    assert done[-1] == total[-1]


# A controller, and requested times --------------------------------------------------------


def controlled(max_steps=256, **options):
    system, start, args = problem("pendulum")
    given: dict[str, Any] = dict(saveat=ej.SaveAt(every=5), progress=quietly) | options
    return ej.simulate(
        system,
        ej.EnergyPreserving(),
        start,
        args,
        h=0.5,
        t1=3.0,
        controller=ej.StepController(1e-4, 1e-4),
        max_steps=max_steps,
        throw=False,
        **given,
    )


@functools.cache
def controlled_whole():
    return controlled()


@pytest.mark.slow
def test_a_controller_goes_on_with_its_memory():
    expected = controlled_whole()
    assert expected.result == ej.RESULTS.successful
    assert expected.stats.rejected_steps is not None
    assert int(expected.stats.rejected_steps) > 0
    part = controlled(max_steps=52)
    assert part.result == ej.RESULTS.out_of_steps
    assert_same(controlled(resume=part), expected)


@pytest.mark.slow
def test_the_rows_of_a_controller_are_those_of_a_run_in_one_piece():
    plain, expected = controlled(progress=False), controlled_whole()
    count = int(expected.stats.completed_steps)
    assert plain.stats.completed_steps == count
    np.testing.assert_array_equal(np.isnan(plain.ts), np.isnan(expected.ts))
    # Round-off, by which the lengths of steps differ too.
    np.testing.assert_allclose(expected.ts, plain.ts, rtol=1e-7)
    np.testing.assert_allclose(expected.ys.q, plain.ys.q, atol=1e-7)
    # Solver.
    assert np.nanmax(np.abs(expected.audit.leak)) < 1e-12


@pytest.mark.slow
def test_requested_times_are_found_in_pieces():
    # The start, ends of steps, several times in one step, and long waits.
    times = ej.SaveAt(ts=[0.0, 0.0025, 0.006, 0.007, 0.0105, 1.5, 1.501, 3.0])
    plain, found = (controlled(saveat=times, progress=p) for p in (False, quietly))
    # Round-off, by which the lengths of steps differ too.
    np.testing.assert_allclose(found.ys.q, plain.ys.q, atol=1e-7)
    np.testing.assert_allclose(found.audit.energy, plain.audit.energy, atol=1e-7)
    np.testing.assert_allclose(
        found.stats.newton_iterations, plain.stats.newton_iterations, atol=3
    )
    part = controlled(max_steps=52, saveat=times)
    assert_same(controlled(saveat=times, resume=part), found)


# Every scheme and every memory ------------------------------------------------------------


CASES: dict[str, tuple] = {
    name: ("pendulum", make(0.5), dict(h=0.01)) for name, make in SCHEMES.items()
} | {
    "generalized alpha": ("pendulum", ej.GeneralizedAlpha(0.8), dict(h=0.01)),
    "rattle": ("pendulum", ej.Rattle(), dict(h=0.01)),
    "rotations": ("top directors", ej.EnergyPreserving(), dict(h=0.002)),
    "momenta": ("top canonical", ej.EnergyPreserving(), dict(h=0.002)),
    "chord": ("chain", ej.EnergyConsistent(0.0), dict(h=0.01)),
    "halvings": ("double", ej.EnergyPreserving(), dict(h=0.35, max_halvings=4)),
    "halvings of a memory": (
        "double",
        ej.GeneralizedAlpha(0.8),
        dict(h=0.2, max_halvings=4),
    ),
    "failure": ("double", ej.EnergyPreserving(), dict(h=0.5)),
    "function": (
        "pendulum",
        ej.EnergyPreserving(),
        dict(h=0.01, saveat=ej.SaveAt(every=4, fn=lambda t, y, args: {"x": [y.q[0], t]})),
    ),
    "both ends": ("pendulum", ej.Rattle(), dict(h=0.01, saveat=ej.SaveAt(t1=True))),
    "redundant": ("particles", ej.EnergyPreserving(), dict(h=0.01)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_every_memory_is_continued_to_the_last_bit(name, tmp_path):
    of, scheme, options = CASES[name]
    system, start, args = problem(of)

    def run(num_steps, **more):
        return ej.simulate(
            system, scheme, start, args, num_steps=num_steps, throw=False, **options, **more
        )

    expected, part = (run(n, progress=quietly) for n in (60, 23))
    ej.save(tmp_path / "part.npz", part)
    assert_same(run(60, resume=ej.load(tmp_path / "part.npz")), expected)
    assert expected.stats.completed_steps > (3 if name == "failure" else 23)


# What is refused --------------------------------------------------------------------------


def test_a_run_in_one_piece_cannot_be_continued():
    plain = dataclasses.replace(first_part(), continuation=None)
    with pytest.raises(ValueError, match="without what the next step needs"):
        motion(resume=plain)


def test_another_run_is_not_continued(tmp_path):
    system, start, args = problem("pendulum")
    scheme, every = ej.EnergyConsistent(0.5), ej.SaveAt(every=7)
    run = functools.partial(
        ej.simulate, num_steps=STEPS, saveat=every, resume=first_part(), h=0.01
    )
    with pytest.raises(ValueError, match=r"another run \(different: args\)"):
        run(system, scheme, start, args | {"g": 9.80})
    with pytest.raises(ValueError, match=r"another run \(different: steps\)"):
        run(system, scheme, start, args, t0=1.0)
    with pytest.raises(ValueError, match=r"another run \(different: scheme\)"):
        run(system, ej.EnergyConsistent(0.4), start, args)
    ej.save(tmp_path / "a.npz", first_part())
    with pytest.raises(ValueError, match=r"The file .*a\.npz is part of another run"):
        ej.simulate(
            system,
            scheme,
            ej.State(start.q, start.v + 0.1 * jnp.array([0.0, 1.0])),
            args,
            h=0.01,
            num_steps=STEPS,
            saveat=every,
            checkpoint=tmp_path / "a.npz",
        )


def test_a_longer_run_is_not_continued():
    with pytest.raises(ValueError, match="longer than this run: it has made 1000 steps"):
        motion(num_steps=999, resume=first_part())


BAD = {
    "progress": (dict(progress="yes"), TypeError, "`progress` must be `True`"),
    "resume": (dict(resume="run.npz"), TypeError, "`resume` must be a `Solution`"),
    "seconds": (dict(checkpoint="a.npz", checkpoint_seconds=-1), ValueError, "seconds"),
    "folder": (dict(checkpoint="no/such/a.npz"), ValueError, "existing folder"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_options_are_refused(name):
    options, kind, message = BAD[name]
    with pytest.raises(kind, match=message):
        motion(**options)


@pytest.mark.parametrize("transform", [jax.jit, jax.grad, jax.vmap])
def test_transformations_are_refused(transform):
    system, start, args = problem("pendulum")

    def end(g):
        numbers, scheme = args | {"g": g}, ej.EnergyConsistent(0.5)
        return ej.simulate(
            system, scheme, start, numbers, h=0.01, num_steps=5, progress=True
        ).end.q[0]

    with pytest.raises(ValueError, match="are for single runs"):
        transform(end)(jnp.full((2,), 9.81) if transform is jax.vmap else 9.81)


@pytest.mark.slow
def test_derivatives_with_respect_to_a_closure_are_refused():
    system, start, args = problem("pendulum")

    def end(g):
        weight = lambda q, args: -args["m"] * g * q[1]
        heavy = ej.System(system.kinetic, weight, system.constraint)
        return ej.simulate(
            heavy, ej.Rattle(), start, args, h=0.01, num_steps=5, progress=True
        ).end.q[0]

    with pytest.raises(ValueError, match="are for single runs"):
        jax.grad(end)(9.81)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="needs Linux")
@pytest.mark.slow
def test_long_runs_need_no_more_memory_than_short_ones():
    """Rows alone take memory: a hundred times the steps, as many rows."""
    code = """
import resource, jax, enerjax as ej
jax.config.update("jax_enable_x64", True)
system, start, args = ej.problems.pendulum()
def run(num_steps):
    ej.simulate(
        system, ej.EnergyConsistent(0.5), start, args, h=0.01, num_steps=num_steps,
        saveat=ej.SaveAt(every=num_steps // 100), progress=lambda *times: None,
    )
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(run(100_000), run(5_000_000))
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    short, long = map(int, ran.stdout.split())
    assert long < 1.05 * short
