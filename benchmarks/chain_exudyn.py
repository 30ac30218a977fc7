"""A chain of points on rods in EXUDYN, for `chain.py`."""

# pyright: reportArgumentType=false, reportMissingImports=false

import statistics
import sys
import time


sys.exudynFast = True  # pyright: ignore[reportAttributeAccessIssue]

import exudyn as exu  # noqa: E402
import exudyn.utilities as eu  # noqa: E402


def _build(num_links: int):
    container = exu.SystemContainer()
    system = container.AddSystem()
    ground = system.AddObject(eu.ObjectGround())
    last = system.AddMarker(eu.MarkerBodyPosition(bodyNumber=ground))
    length = mass = 1 / num_links
    for k in range(1, num_links + 1):
        node = system.AddNode(eu.NodePoint2D(referenceCoordinates=[k * length, 0]))
        body = system.AddObject(eu.MassPoint2D(mass=mass, nodeNumber=node))
        marker = system.AddMarker(eu.MarkerBodyPosition(bodyNumber=body))
        system.AddLoad(eu.Force(markerNumber=marker, loadVector=[0, 9.81 * mass, 0]))
        ends = [last, marker]
        system.AddObject(eu.DistanceConstraint(markerNumbers=ends, distance=length))
        last = marker
    system.Assemble()
    return container, system


def us_per_step(num_links: int, h: float, steps: int, repeats: int = 3) -> float:
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.endTime = steps * h
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.generalizedAlpha.spectralRadius = 0.5
    settings.solution.file.write = False
    settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
    settings.parallel.numberOfThreads = 1
    times = []
    for _ in range(repeats):
        container, system = _build(num_links)
        begin = time.perf_counter()
        system.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
        times.append(time.perf_counter() - begin)
        del container
    return 1e6 * statistics.median(times) / steps
