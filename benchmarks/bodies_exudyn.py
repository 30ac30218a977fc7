"""A chain of hinged bodies in space in EXUDYN."""

# pyright: reportArgumentType=false, reportMissingImports=false

import statistics
import sys
import time


sys.exudynFast = True  # pyright: ignore[reportAttributeAccessIssue]

import exudyn as exu  # noqa: E402
import exudyn.utilities as eu  # noqa: E402
import numpy as np  # noqa: E402


def _build(num_bodies: int, inertia: np.ndarray):
    container = exu.SystemContainer()
    system = container.AddSystem()
    ground = system.AddObject(eu.ObjectGround())
    last = system.AddMarker(eu.MarkerBodyRigid(bodyNumber=ground))
    node = None
    for k in range(num_bodies):
        body = system.CreateRigidBody(
            inertia=eu.RigidBodyInertia(mass=1.0, inertiaTensor=np.diag(inertia)),
            nodeType=exu.NodeType.RotationEulerParameters,
            referencePosition=[k + 0.5, 0, 0],
            gravity=[0, 0, -9.81],
            returnDict=True,
        )
        node, number = body["nodeNumber"], body["bodyNumber"]
        at = lambda x, number=number: system.AddMarker(
            eu.MarkerBodyRigid(bodyNumber=number, localPosition=[x, 0, 0])
        )
        # Free about y and z in turn.
        fixed = [1, 1, 1, 1, 0, 1] if k % 2 == 0 else [1, 1, 1, 1, 1, 0]
        system.AddObject(
            eu.GenericJoint(markerNumbers=[last, at(-0.5)], constrainedAxes=fixed)
        )
        last = at(0.5)
    system.Assemble()
    return container, system, node


def run(num_bodies: int, inertia: np.ndarray, h: float, steps: int, repeats: int = 3):
    """The time of a step in microseconds, and the last mass centre at the end."""
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.endTime = steps * h
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.generalizedAlpha.spectralRadius = 0.9
    settings.solution.file.write = False
    kinds = exu.LinearSolverType
    settings.linearSolver.solverType = (
        kinds.EigenSparse if num_bodies > 3 else kinds.EXUdense
    )
    settings.parallel.numberOfThreads = 1
    times, end = [], np.zeros(3)
    for _ in range(repeats):
        container, system, node = _build(num_bodies, inertia)
        begin = time.perf_counter()
        system.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
        times.append(time.perf_counter() - begin)
        end = np.asarray(system.GetNodeOutput(node, exu.OutputVariableType.Position))
        del container
    return 1e6 * statistics.median(times) / steps, end
