"""The runs of the main job: every scheme on every case of the paper."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed, ThreadPoolExecutor

import jax
import numpy as np

from ... import problems
from ..._results import RESULTS
from ..._run import simulate, Solution
from ...schemes import (
    AbstractScheme,
    Composed,
    EnergyConsistent,
    EnergyDecaying,
    EnergyPreserving,
    KappaDecaying,
)


@dataclasses.dataclass(frozen=True)
class Case:
    """A test case of the paper with its step length."""

    name: str
    problem: Callable[[], problems.Problem]
    h: float
    num_steps: int

    @property
    def key(self) -> tuple[str, float]:
        return self.name, self.h


@dataclasses.dataclass(frozen=True)
class Method:
    """A scheme under the name that it has in the table."""

    name: str
    alpha: float | None
    scheme: Callable[[], AbstractScheme]
    # The light mass of case d whips around: a step without a solution near the motion is
    # divided, and the table contains the number of such steps.
    max_halvings: int = 0

    @property
    def key(self) -> tuple[str, float | None]:
        return self.name, self.alpha


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run, and the time of a step."""

    case: Case
    method: Method
    solution: Solution
    seconds_per_step: float

    @property
    def rows(self) -> slice:
        """The saved rows up to the first failure."""
        return slice(0, int(self.solution.stats.completed_steps) + 1)

    @property
    def failed(self) -> bool:
        return bool(self.solution.result != RESULTS.successful)


def cases(quick: bool) -> list[Case]:
    """All cases. Runs of c and d with equal numbers of steps share one program."""
    part = 10 if quick else 1
    return [
        Case("a", problems.pendulum_angle, 0.02, 500 // part),
        Case("b", problems.pendulum, 0.02, 500 // part),
        Case("c", problems.double_pendulum, 0.01, 1000 // part),
        Case("d", problems.stiff_double_pendulum, 0.01, 1000 // part),
        Case("d", problems.stiff_double_pendulum, 0.001, 1000 // part),
    ]


def methods(quick: bool) -> list[list[Method]]:
    """The schemes, in groups that differ only in alpha and share one program."""
    three = (0.0, 0.5, 1.0)
    composed = [(EnergyPreserving(), 4)]
    if not quick:
        composed += [(EnergyPreserving(), 6), (EnergyPreserving(), 8)]
        composed += [(EnergyConsistent(0.0), 6)]
    return [
        [Method("preserving index3", None, lambda: EnergyPreserving("index3"))],
        [Method("preserving GGL", None, EnergyPreserving)],
        [
            Method("decaying index3", a, lambda a=a: EnergyDecaying(a, "index3"), 4)
            for a in (0.0, 0.1, 0.5, 1.0)
        ],
        [Method("decaying GGL", a, lambda a=a: EnergyDecaying(a), 4) for a in three],
        [Method("decaying kappa", a, lambda a=a: KappaDecaying(a)) for a in three],
        [Method("consistent", a, lambda a=a: EnergyConsistent(a), 4) for a in three],
        *(
            [Method(_composed_name(s, n), None, lambda s=s, n=n: Composed(s, n))]
            for s, n in composed
        ),
    ]


def _composed_name(scheme: AbstractScheme, order: int) -> str:
    base = "preserving" if isinstance(scheme, EnergyPreserving) else "consistent"
    return f"composed {order} of {base}"


def _applies(method: Method, case: Case) -> bool:
    # Without constraints both formulations are the same scheme.
    return case.name != "a" or method.name.split()[-1] not in ("GGL", "kappa")


def run_all(quick: bool, progress: Callable[[str], None]) -> list[Run]:
    """All runs, which are compiled two at a time, and then timed one by one."""
    groups = []
    for family in methods(quick):
        by_program: dict[str, list[tuple[Case, Method]]] = {}
        for case in cases(quick):
            pairs = [(case, m) for m in family if _applies(m, case)]
            by_program.setdefault("cd" if case.name in "cd" else case.name, []).extend(
                pairs
            )
        groups += [g for g in by_program.values() if g]
    with ThreadPoolExecutor(2) as pool:
        futures = [pool.submit(_first_runs, group) for group in groups]
        for done, future in enumerate(as_completed(futures), 1):
            case, method = future.result()[-1][:2]
            progress(f"compiled {done} of {len(groups)}: {method.name}, case {case.name}")
    first = [run for future in futures for run in future.result()]
    out = []
    for done, (case, method, solution) in enumerate(first, 1):
        progress(f"timed {done} of {len(first)}: {method.name}, case {case.name}")
        seconds = _time(case, method) / (int(solution.stats.completed_steps) + 1)
        out.append(Run(case, method, solution, seconds))
    return out


def _solve(case: Case, method: Method) -> Solution:
    system, start, args = case.problem()
    solution = simulate(
        system,
        method.scheme(),
        start,
        args,
        h=case.h,
        num_steps=case.num_steps,
        max_halvings=method.max_halvings,
        throw=False,
    )
    return jax.block_until_ready(solution)


def _first_runs(group: list[tuple[Case, Method]]) -> list[tuple[Case, Method, Solution]]:
    return [(case, method, _solve(case, method)) for case, method in group]


def _time(case: Case, method: Method) -> float:
    """The wall time of a compiled run."""

    def once() -> float:
        begin = time.perf_counter()
        _solve(case, method)
        return time.perf_counter() - begin

    return float(np.median([once() for _ in range(3)]))


def curves(runs: list[Run]) -> "Lookup":
    return Lookup({(*run.case.key, *run.method.key): run for run in runs})


class Lookup:
    """Finds runs by case, step length, scheme and alpha."""

    def __init__(self, runs: dict[tuple, Run]):
        self._runs = runs

    def __call__(
        self, case: str, h: float, name: str, *alphas: float | None
    ) -> Iterator[Run]:
        for alpha in alphas or (None,):
            run = self._runs.get((case, h, name, alpha))
            if run is not None:
                yield run
