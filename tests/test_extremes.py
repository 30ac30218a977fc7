"""Where the schemes hold, on the cheap axes of the map that `benchmarks/extremes.py` draws.

Its functions compare with closed forms and say by what errors are bounded.
"""

import functools

import extremes_numbers as numbers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extremes_runs import LAW, REPORTED, RIGHT

import enerjax as ej


def verdicts(rows):
    rows = list(rows)
    assert rows
    return rows, {row.verdict for row in rows}


@functools.cache
def steps():
    return list(numbers.step_rows(quick=True))


@pytest.mark.slow
def test_a_linear_spring_is_right_at_every_step():
    rows = [row for row in steps() if row.case != "quartic spring"]
    assert len(rows) > 30
    assert [row for row in rows if row.verdict != RIGHT] == []


@pytest.mark.slow
def test_a_stiff_quartic_spring_is_right_or_reports_a_failure():
    rows = [row for row in steps() if row.case == "quartic spring"]
    assert {row.verdict for row in rows} <= {RIGHT, LAW, REPORTED}
    assert {row.verdict for row in rows if row.x <= 1} == {RIGHT, LAW}


@pytest.mark.slow
def test_motion_that_dies_out_away_from_zero_stays_at_rest():
    """Where terms cancel, what is left of the forces is round-off, not motion."""
    _, found = verdicts(numbers.settling_rows(quick=True))
    assert found == {RIGHT}


def test_slow_motion_beside_a_stiff_spring_is_right():
    rows, _ = verdicts(numbers.stiffness_rows(quick=True))
    # The force of the stiffest is rounded more than the others; see `docs/extremes.md`.
    lost = [row for row in rows if row.verdict != RIGHT]
    assert all(row.x == 1e14 and "Consistent" in row.scheme for row in lost)
    assert all(row.error <= 1e-3 for row in lost)


@pytest.mark.parametrize(
    "scheme",
    [
        ej.EnergyPreserving(),
        pytest.param(ej.EnergyDecaying(0.5), marks=pytest.mark.slow),
    ],
)
def test_an_equilibrium_is_kept_and_can_be_differentiated(scheme):
    system, _, args = ej.problems.pendulum()
    start = ej.State([0.0, 1.0], [0.0, 0.0])

    def ends(g):
        run = ej.simulate(system, scheme, start, args | dict(g=g), h=0.01, num_steps=20)
        return run.ys.q[-1]

    push = jax.jit(jax.vmap(lambda g: jax.jvp(ends, (g,), (1.0,))))
    values, slopes = push(jnp.array([9.81, 0.0]))
    np.testing.assert_array_equal(values, [[0.0, 1.0], [0.0, 1.0]])
    # The rod takes what gravity gives: nothing moves.
    np.testing.assert_allclose(slopes, 0, atol=1e-15)
