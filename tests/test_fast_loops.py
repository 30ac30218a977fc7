"""Fast loops are a setting of the process, so they are tested in separate processes."""

import os
import subprocess
import sys

import jax
import pytest


RUN = """
import jax, enerjax as ej
{}
jax.config.update("jax_enable_x64", True)
system, start, args = ej.problems.pendulum()
run = lambda start: ej.simulate(
    system, ej.EnergyPreserving(), start, args, h=1e-3, num_steps=100
).ys.q
program = jax.jit(run).lower(start).compile()
# Loops that were compiled in one piece are called, and those inside of them are gone.
print(sum("while(" in line and "small_call" not in line and "ROOT" not in line
          for line in program.as_text().splitlines()))
print(repr(float(program(start)[-1, 0])))
"""


def _in_a_process(source):
    flags = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    return subprocess.run(
        [sys.executable, "-c", source],
        capture_output=True,
        text=True,
        env=flags,
        check=False,
    )


@pytest.fixture(scope="module")
def runs():
    return [_in_a_process(RUN.format(x)) for x in ("", "ej.enable_fast_loops()")]


@pytest.mark.slow
def test_no_call_interrupts_the_loops_of_a_run(runs):
    assert all(run.returncode == 0 for run in runs), [run.stderr for run in runs]
    slow, fast = (run.stdout.split() for run in runs)
    assert int(slow[0]) > 0
    assert int(fast[0]) == 0


@pytest.mark.slow
def test_the_motion_is_the_same(runs):
    slow, fast = (float(run.stdout.split()[1]) for run in runs)
    assert fast == pytest.approx(slow, abs=1e-11)  # round-off


@pytest.mark.skipif(jax.__version_info__ >= (0, 12), reason="loops are fast without it")
def test_too_late_is_an_error():
    late = "import jax.numpy as jnp, enerjax as ej\njnp.ones(3)\nej.enable_fast_loops()"
    run = _in_a_process(late)
    assert run.returncode != 0
    assert "came too late" in run.stderr


@pytest.mark.slow
def test_twice_is_not_too_late():
    run = _in_a_process("import enerjax as ej\nej.enable_fast_loops()\n" * 2)
    assert run.returncode == 0, run.stderr
