"""The double pendulum and the heavy top in EXUDYN, for `step_cost.py`."""

# pyright: reportArgumentType=false, reportMissingImports=false

import statistics
import sys
import time
from collections.abc import Callable


sys.exudynFast = True  # pyright: ignore[reportAttributeAccessIssue]

import exudyn as exu  # noqa: E402
import exudyn.utilities as eu  # noqa: E402
import numpy as np  # noqa: E402


def _pendulum():
    container = exu.SystemContainer()
    system = container.AddSystem()
    ground = system.AddObject(eu.ObjectGround())
    last = system.AddMarker(eu.MarkerBodyPosition(bodyNumber=ground))
    nodes = []
    for k in (1, 2):
        nodes.append(system.AddNode(eu.NodePoint2D(referenceCoordinates=[k, 0])))
        body = system.AddObject(eu.MassPoint2D(mass=1.0, nodeNumber=nodes[-1]))
        marker = system.AddMarker(eu.MarkerBodyPosition(bodyNumber=body))
        system.AddLoad(eu.Force(markerNumber=marker, loadVector=[0, 9.81, 0]))
        ends = [last, marker]
        system.AddObject(eu.DistanceConstraint(markerNumbers=ends, distance=1.0))
        last = marker
    system.Assemble()
    position = exu.OutputVariableType.Position
    end = lambda: np.concatenate([system.GetNodeOutput(n, position)[:2] for n in nodes])
    return container, system, end


def _top():
    container = exu.SystemContainer()
    system = container.AddSystem()
    ground = system.AddObject(eu.ObjectGround())
    inertia = eu.RigidBodyInertia(
        mass=15.0, inertiaTensor=np.diag([0.234375, 0.46875, 0.234375])
    )
    body = system.CreateRigidBody(
        inertia=inertia,
        nodeType=exu.NodeType.RotationEulerParameters,
        referencePosition=[0, 1, 0],
        initialVelocity=[4.61538, 0, 0],
        initialAngularVelocity=[0, 150, -4.61538],
        gravity=[0, 0, -9.81],
        returnDict=True,
    )
    first = system.AddMarker(eu.MarkerBodyRigid(bodyNumber=ground))
    second = system.AddMarker(
        eu.MarkerBodyRigid(bodyNumber=body["bodyNumber"], localPosition=[0, -1, 0])
    )
    system.AddObject(eu.SphericalJoint(markerNumbers=[first, second]))
    system.Assemble()
    position = exu.OutputVariableType.Position
    read = lambda kind=position: system.GetNodeOutput(body["nodeNumber"], kind)
    return container, system, read


def prepared_top(h: float, end: float) -> Callable[[], tuple[np.ndarray, ...]]:
    """A function that runs the top and returns its end.

    Position, velocity, and angular velocity in axes of the body.
    """
    container, system, read = _top()
    settings = _settings(h, round(end / h))

    def run(container=container) -> tuple[np.ndarray, ...]:
        system.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
        kinds = exu.OutputVariableType
        wanted = kinds.Position, kinds.Velocity, kinds.AngularVelocityLocal
        return tuple(np.asarray(read(kind)) for kind in wanted)

    return run


def _settings(h: float, steps: int):
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.endTime = steps * h
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.generalizedAlpha.spectralRadius = 0.9
    settings.solution.file.write = False
    settings.linearSolver.solverType = exu.LinearSolverType.EXUdense
    settings.parallel.numberOfThreads = 1
    return settings


def _row(
    work: str, build: Callable, h: float, end: float, exact: np.ndarray, repeats: int
) -> dict:
    steps = round(end / h)
    settings = _settings(h, steps)
    times, error = [], np.inf
    for _ in range(repeats):
        container, system, position = build()
        begin = time.process_time()
        system.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
        times.append(time.process_time() - begin)
        error = float(np.max(np.abs(position() - exact)))
        del container
    return dict(
        work=work,
        method="generalized-alpha, rho 0.9",
        h=h,
        error=error,
        energy=float("nan"),
        steps=steps,
        us_per_step=1e6 * statistics.median(times) / steps,
    )


def rows(
    exact: dict[str, np.ndarray], pendulum_end: float, top_end: float, repeats: int
) -> list[dict]:
    return [
        _row("pendulum", _pendulum, 1e-3, pendulum_end, exact["pendulum"], repeats),
        _row("top", _top, 1e-3, top_end, exact["top"], repeats),
    ]
