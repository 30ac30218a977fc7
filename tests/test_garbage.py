"""Python's searches for garbage while programs are made."""

import gc
import threading

import jax
import jax.numpy as jnp
import pytest

import enerjax as ej
from enerjax._programs.garbage import _RARELY, few_searches_for_garbage


@pytest.fixture
def usual():
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield 700, 10, 10
    gc.set_threshold(*before)


def test_searches_are_rare_while_a_run_is_traced_and_derived(usual):
    seen = set()

    def potential(q, args):
        seen.add(gc.get_threshold())
        return args * jnp.sum(q * q)

    free = ej.System(jnp.eye(2), potential)

    def end(k):
        run = free, ej.EnergyPreserving(), ej.State([1.0, 0.0], [0.0, 1.0]), k
        return ej.simulate(*run, h=0.1, num_steps=3).ys.q[-1, 0]

    jax.grad(end)(2.0)
    assert seen == {_RARELY, usual}
    assert gc.get_threshold() == usual


def test_the_settings_come_back_after_an_error(usual):
    @few_searches_for_garbage()
    def fails():
        with few_searches_for_garbage():
            pass
        assert gc.get_threshold() == _RARELY
        raise KeyError

    with pytest.raises(KeyError):
        fails()
    assert gc.get_threshold() == usual


def test_the_settings_come_back_after_the_last_thread(usual):
    begun, ends = threading.Event(), threading.Event()

    def other():
        with few_searches_for_garbage():
            begun.set()
            ends.wait(10)

    thread = threading.Thread(target=other)
    with few_searches_for_garbage():
        thread.start()
        begun.wait(10)
    assert gc.get_threshold() == _RARELY
    ends.set()
    thread.join()
    assert gc.get_threshold() == usual


@pytest.mark.parametrize("asked", [(0, 10, 10), (10**6, 50, 200)])
def test_rarer_searches_stay(usual, asked):
    gc.set_threshold(*asked)
    with few_searches_for_garbage():
        assert gc.get_threshold() == asked
