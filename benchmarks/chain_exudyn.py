"""A chain of points on rods in EXUDYN."""

# pyright: reportArgumentType=false, reportMissingImports=false

import statistics
import sys
import time
from collections.abc import Callable, Sequence


sys.exudynFast = True  # pyright: ignore[reportAttributeAccessIssue]

import exudyn as exu  # noqa: E402
import exudyn.utilities as eu  # noqa: E402
import numpy as np  # noqa: E402


def _build(masses: Sequence[float], length: float):
    container = exu.SystemContainer()
    system = container.AddSystem()
    ground = system.AddObject(eu.ObjectGround())
    last = system.AddMarker(eu.MarkerBodyPosition(bodyNumber=ground))
    nodes = []
    for k, mass in enumerate(masses, start=1):
        node = system.AddNode(eu.NodePoint2D(referenceCoordinates=[k * length, 0]))
        nodes.append(node)
        body = system.AddObject(eu.MassPoint2D(mass=mass, nodeNumber=node))
        marker = system.AddMarker(eu.MarkerBodyPosition(bodyNumber=body))
        system.AddLoad(eu.Force(markerNumber=marker, loadVector=[0, 9.81 * mass, 0]))
        ends = [last, marker]
        system.AddObject(eu.DistanceConstraint(markerNumbers=ends, distance=length))
        last = marker
    system.Assemble()
    return container, system, nodes


def _settings(h: float, steps: int, rho: float, is_sparse: bool):
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


def prepared(
    masses: Sequence[float],
    length: float,
    h: float,
    end: float,
    rho: float | None,
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """A function that runs the chain and returns positions and velocities at its end.

    With the generalized-alpha method, or without `rho` the trapezoidal rule of index 2.
    """
    container, system, nodes = _build(masses, length)
    settings = _settings(h, round(end / h), rho or 1.0, len(masses) > 8)
    kinds = exu.DynamicSolverType
    solver = kinds.TrapezoidalIndex2 if rho is None else kinds.GeneralizedAlpha

    def run(container=container) -> tuple[np.ndarray, np.ndarray]:
        system.SolveDynamic(settings, solverType=solver)
        read = lambda kind: np.concatenate(
            [system.GetNodeOutput(n, kind)[:2] for n in nodes]
        )
        kinds = exu.OutputVariableType
        return read(kinds.Position), read(kinds.Velocity)

    return run


def us_per_step(num_links: int, h: float, steps: int, repeats: int = 3) -> float:
    settings = _settings(h, steps, 0.5, True)
    times = []
    for _ in range(repeats):
        container, system, _ = _build([1 / num_links] * num_links, 1 / num_links)
        begin = time.perf_counter()
        system.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
        times.append(time.perf_counter() - begin)
        del container
    return 1e6 * statistics.median(times) / steps
