"""A short, fixed part of `benchmarks/fuzz.py`, which must have no findings."""

import fuzz
import fuzz_functions
import fuzz_gradients
import fuzz_systems
import jax
import numpy as np
import pytest
from fuzz_case import Result

import enerjax as ej


def rng(seed):
    return np.random.default_rng(seed)


def no_findings(results):
    results = list(results)
    assert results
    assert [found for result in results for found in result.findings] == []
    return results


@pytest.mark.parametrize(
    ("scheme", "n", "free"),
    [
        pytest.param("decaying", 8, False, marks=pytest.mark.slow),
        pytest.param("consistent", 8, False, marks=pytest.mark.slow),
        pytest.param("composed 4", 20, False, marks=pytest.mark.slow),
        pytest.param("decaying", 40, False, marks=pytest.mark.slow),
        pytest.param("preserving", 80, True, marks=pytest.mark.slow),
    ],
)
def test_random_systems_keep_their_laws_and_converge(scheme, n, free):
    results = no_findings(
        fuzz_systems.check(rng(seed), scheme, n, free, alpha)
        for seed, alpha in enumerate((0.3, 1.0, 0.7, 0.3))
    )
    assert all(np.isfinite(result.measures["leak"]) for result in results)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "family"),
    [
        ("preserving", "body"),
        ("decaying", "top"),
        ("decaying", "halved"),
        ("consistent", "net"),
    ],
)
def test_derivatives_agree_and_lanes_are_independent(scheme, family):
    programs = fuzz_gradients.Programs(scheme, family)
    no_findings(fuzz_gradients.check(rng(seed), programs, family) for seed in range(2))


PROGRAMS = [
    (("sort", "where", "norm"), (0, 1, 2)),
    (("custom jvp", "fori", "cumsum"), (0, 0, 1)),
    (("cholesky", "select", "log softmax"), (0, 1, 0)),
]


def test_random_functions_have_their_identity():
    no_findings(fuzz_functions.check(rng(0), *program) for program in PROGRAMS)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(12))
def test_every_function_alone_has_its_identity(number):
    done = fuzz.block("functions", 1, number)
    no_findings(case.result for case in done)


def test_a_crash_is_a_finding_and_the_fuzzing_continues(monkeypatch):
    """The checks would report an incorrect library."""

    def cases(rng, number):
        yield "fine", lambda: Result([], {})
        yield "broken", lambda: 1 / 0
        yield "after", lambda: Result([], {})

    monkeypatch.setattr(fuzz_functions, "cases", cases)
    done = list(fuzz.block("functions", 3, 5))
    assert [bool(case.result.findings) for case in done] == [False, True, False]
    (line,) = fuzz.lines(done[1])
    assert "--seed 3 --block 5" in line
    assert "ZeroDivisionError" in line
    assert fuzz.table(done)[1]["findings"] == 1


def test_a_derivative_that_is_off_is_a_finding(monkeypatch):
    exact = ej.discrete_grad
    off = lambda fn: lambda a, b: jax.tree.map(lambda x: x * (1 + 1e-9), exact(fn)(a, b))
    monkeypatch.setattr(ej, "discrete_grad", off)
    assert fuzz_functions.check(rng(0), ("where",), (0,)).findings
