"""Sweeps: the order of lanes, and selection by parameters."""

import functools
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej

from . import sweep_process


@functools.cache
def here():
    """The sweep in this process, on one device."""
    return sweep_process.run_sweep()


class Outcome(eqx.Enumeration):
    successful = ""
    too_large = "The sum became too large: take less."


def arithmetic(a, b):
    result = Outcome.where(a + b > 20, Outcome.too_large, Outcome.successful)
    return {"sum": a + b, "both": jnp.stack([a, b]), "result": result}


@functools.cache
def sums():
    return ej.sweep(arithmetic, {"a": [1.0, 2.0, 3.0], "b": [10.0, 20.0]}, chunk=4)


# Lanes and their places ------------------------------------------------------------------


def test_every_lane_is_in_its_place():
    found = sums().values
    np.testing.assert_array_equal(found["sum"], [[11, 21], [12, 22], [13, 23]])
    np.testing.assert_array_equal(found["both"][2, 1], [3, 20])
    assert sums().shape == (3, 2)


@pytest.mark.parametrize("chunk", [1, 4, 5, 100])
@pytest.mark.parametrize("batch_size", [None, 2])
def test_chunks_and_batches_change_nothing(chunk, batch_size):
    over = {"a": [3.0, 1.0, 2.0], "b": [10.0, 20.0, 15.0]}
    for sort_by in (None, "b"):
        found = ej.sweep(
            arithmetic, over, chunk=chunk, batch_size=batch_size, sort_by=sort_by
        )
        expected = np.add.outer(over["a"], over["b"])
        np.testing.assert_array_equal(found.values["sum"], expected)


def test_a_lane_is_its_run_alone():
    part = here().at(l=2.0, h=5e-3, g=9.81)
    alone = sweep_process.motion(2.0, 5e-3, 9.81)
    # Solver: lanes are compiled differently.
    np.testing.assert_allclose(part.values["q"], alone["q"], rtol=0, atol=1e-12)
    assert part.parameters == dict(l=2.0, h=5e-3, g=9.81)


def test_lanes_that_take_their_steps_together_are_alike():
    """A batch takes as many steps as its longest lane needs."""

    def counted(h):
        steps = lambda n: jax.lax.while_loop(lambda k: k < n, lambda k: k + 1, 0)
        batched = jax.custom_batching.custom_vmap(steps)
        batched.def_vmap(lambda size, _, n: (jnp.full(size, jnp.max(n)), True))
        return batched(jnp.round(1 / h).astype(int))

    h = 1 / np.array([10, 1000, 20, 2000, 30, 3000])
    run = lambda by: ej.sweep(counted, {"h": h}, batch_size=2, sort_by=by).values
    np.testing.assert_array_equal(run(None), [1000, 1000, 2000, 2000, 3000, 3000])
    np.testing.assert_array_equal(run("h"), [20, 1000, 20, 3000, 1000, 3000])


def test_parameters_that_change_together():
    points = [[1.0, 5.0], [2.0, 5.0], [2.0, 7.0]]
    found = ej.sweep(arithmetic, {("a", "b"): points})
    np.testing.assert_array_equal(found.values["sum"], [6, 7, 9])
    assert found.at(a=2.0, b=7.0).values["sum"] == 9
    assert found.at(a=1.0).parameters == dict(a=1.0, b=5.0)
    with pytest.raises(ValueError, match=r"a = 2.0: this selects 2 points of \(a, b\)"):
        found.at(a=2.0)


def test_parameters_can_be_pytrees():
    starts = {"q": np.arange(6.0).reshape(3, 2), "t": np.arange(3.0)}

    def fn(start, scale):
        return scale * jnp.sum(start["q"]) + start["t"]

    found = ej.sweep(fn, {"scale": [1.0, 2.0], "start": starts})
    sums = starts["q"].sum(axis=1)
    expected = np.multiply.outer([1.0, 2.0], sums) + starts["t"]
    np.testing.assert_array_equal(found.values, expected)
    assert found.at(scale=2.0).values.shape == (3,)
    best = found.smallest("value")
    np.testing.assert_array_equal(best.parameters["start"]["q"], [0.0, 1.0])


def test_one_program_for_the_whole_sweep():
    compiled = []

    def listen(event, duration_secs, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        # 5 chunks, the last of which is not full.
        ej.sweep(lambda a: jnp.sin(a) + 0.12345, {"a": np.arange(13.0)}, chunk=3)
    finally:
        jax.monitoring.clear_event_listeners()
    assert len(compiled) == 1


def test_memory_on_the_device_is_that_of_a_chunk():
    most = []
    held = lambda *_: most.append(sum(x.nbytes for x in jax.live_arrays()))
    before = sum(x.nbytes for x in jax.live_arrays())
    row = lambda a: a + jnp.arange(1000.0)
    found = ej.sweep(row, {"a": np.arange(64.0)}, chunk=4, progress=held)
    assert max(most) - before <= 2 * found.values[:4].nbytes


def test_progress(capsys):
    calls = []
    over = {"a": np.arange(5.0), "b": [1.0, 2.0]}
    ej.sweep(arithmetic, over, chunk=4, progress=lambda *x: calls.append(x))
    assert calls == [(4, 10), (8, 10), (10, 10)]
    ej.sweep(arithmetic, over, progress=True)
    assert "10 of 10 lanes" in capsys.readouterr().err


# What is found ---------------------------------------------------------------------------


def test_failed_lanes_are_marked():
    np.testing.assert_array_equal(sums().failed, [[False, True]] * 3)
    assert "3 The sum became too large" in str(sums())
    assert "3 successful" in str(sums())
    np.testing.assert_array_equal(here().at(g=9.81).failed, np.zeros((3, 5), bool))
    np.testing.assert_array_equal(here().failed[:, :, 1], np.ones((3, 5), bool))
    assert "15 The step equations became non-finite" in str(here())
    np.testing.assert_array_equal(np.isnan(here().values["q"][..., 0]), here().failed)


def test_selection_by_value():
    assert sums().at(a=2).values["sum"].tolist() == [12, 22]
    # 0.1 + 0.2 is not 0.3, and was meant.
    near = ej.sweep(lambda a: 2 * a, {"a": [0.1, 0.2, 0.3]}).at(a=0.1 + 0.2)
    assert near.values == 0.6
    smallest = sums().at(b=20.0).smallest("sum")
    assert smallest.parameters == dict(a=1.0, b=20.0)
    for chosen, message in (
        (dict(a=4.0), "was not swept"),
        (dict(c=1.0), "is no parameter to choose"),
    ):
        with pytest.raises(ValueError, match=message):
            sums().at(**chosen)
    with pytest.raises(ValueError, match="no result of one number"):
        sums().smallest("both")


def test_smallest_ignores_failed_lanes():
    found = ej.sweep(lambda a: jnp.log(a), {"a": [-1.0, 2.0, 1.0]})
    assert found.smallest("value").parameters == dict(a=1.0)
    with pytest.raises(ValueError, match="NaN in all lanes"):
        ej.sweep(lambda a: jnp.log(a), {"a": [-1.0]}).smallest("value")


def test_xarray():
    pytest.importorskip("xarray")
    data = sums().to_xarray()
    assert data["sum"].sel(a=2.0, b=20.0) == 22
    assert data["both"].dims == ("a", "b", "both_0")
    assert data["result"].sel(a=1.0).values.tolist() == [
        "successful",
        "The sum became too large",
    ]
    points = ej.sweep(arithmetic, {("a", "b"): [[1.0, 5.0], [2.0, 7.0]]}).to_xarray()
    assert points["sum"].dims == ("a_b",)
    assert points["b"].values.tolist() == [5.0, 7.0]


def test_without_xarray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=r"enerjax\[sweep\]"):
        sums().to_xarray()


@pytest.mark.parametrize(
    ("fn", "over", "options", "message"),
    [
        (arithmetic, [1.0], {}, "must be a dictionary"),
        (arithmetic, {}, {}, "must be a dictionary"),
        (arithmetic, {"a": [1.0]}, {}, r"by name \(a\): missing a required argument: 'b'"),
        (arithmetic, {"a": [1.0], "b": 2.0}, {}, "single value is a list of one"),
        (arithmetic, {"a": [1.0], "b": []}, {}, "at least one"),
        (arithmetic, {"a": [1.0], "b": ["x"]}, {}, "must be numbers"),
        (arithmetic, {"a": [1.0], ("a", "b"): [[1.0, 2.0]]}, {}, "parameter `a` twice"),
        (arithmetic, {("a", "b"): [[1.0, 2.0, 3.0]]}, {}, "a row of 2 numbers"),
        (arithmetic, {3: [1.0]}, {}, "neither the name"),
        (arithmetic, {"a": [1.0], "b": [1.0]}, {"chunk": 0}, "positive integer"),
        (arithmetic, {"a": [1.0], "b": [1.0]}, {"sort_by": "h"}, "`sort_by` must be"),
        (lambda a: "text", {"a": [1.0]}, {}, "must return a pytree of arrays"),
        (lambda a: None, {"a": [1.0]}, {}, "must return a pytree of arrays"),
    ],
)
def test_bad_input(fn, over, options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        ej.sweep(fn, over, **options)
