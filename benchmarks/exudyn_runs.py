"""Runs in EXUDYN, in its fast version and on one thread."""

# pyright: reportArgumentType=false, reportMissingImports=false

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any


sys.exudynFast = True  # pyright: ignore[reportAttributeAccessIssue]

import exudyn as exu  # noqa: E402
import exudyn.utilities as eu  # noqa: E402, F401
import numpy as np  # noqa: E402


def settings_of(h: float, steps: int, rho: float, *, is_sparse: bool) -> Any:
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.endTime = steps * h
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.generalizedAlpha.spectralRadius = rho
    settings.solution.file.write = False
    kinds = exu.LinearSolverType
    settings.linearSolver.solverType = kinds.EigenSparse if is_sparse else kinds.EXUdense
    settings.parallel.numberOfThreads = 1
    return settings


def timed(
    build: Callable[[], tuple[Any, Any, Callable[[], np.ndarray]]],
    settings: Any,
    repeats: int,
) -> tuple[float, np.ndarray]:
    """The time of a step of the generalized-alpha method in microseconds, and the end.

    It is time of the processor, as for our own runs: other programs do not count.

    `build` returns the container, the system, and a function that reads its coordinates.
    """
    times, end = [], np.empty(0)
    for _ in range(repeats):
        container, system, read = build()
        begin = time.process_time()
        system.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
        times.append(time.process_time() - begin)
        end = np.asarray(read())
        del container
    return 1e6 * statistics.median(times) / settings.timeIntegration.numberOfSteps, end
