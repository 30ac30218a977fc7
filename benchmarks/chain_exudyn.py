"""A chain of points on rods in EXUDYN."""

# pyright: reportArgumentType=false, reportMissingImports=false

from collections.abc import Callable, Sequence

import numpy as np
from exudyn_runs import eu, exu, settings_of, timed


def chain(masses: Sequence[float], length: float):
    """The container, the system, and a function that reads the positions of the nodes, or
    another output of them."""
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
    read = lambda kind=exu.OutputVariableType.Position: np.concatenate(
        [system.GetNodeOutput(node, kind)[:2] for node in nodes]
    )
    return container, system, read


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
    container, system, read = chain(masses, length)
    settings = settings_of(h, round(end / h), rho or 1.0, is_sparse=len(masses) > 8)
    kinds = exu.DynamicSolverType
    solver = kinds.TrapezoidalIndex2 if rho is None else kinds.GeneralizedAlpha

    def run(container=container) -> tuple[np.ndarray, np.ndarray]:
        system.SolveDynamic(settings, solverType=solver)
        kinds = exu.OutputVariableType
        return read(kinds.Position), read(kinds.Velocity)

    return run


def us_per_step(num_links: int, h: float, steps: int, repeats: int = 3) -> float:
    build = lambda: chain([1 / num_links] * num_links, 1 / num_links)
    settings = settings_of(h, steps, 0.5, is_sparse=True)
    return timed(build, settings, repeats)[0]
