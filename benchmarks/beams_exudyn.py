"""A pendulum of two-node beam elements in EXUDYN."""

# pyright: reportArgumentType=false, reportMissingImports=false

from typing import Any

import numpy as np
from exudyn_runs import eu, exu, settings_of, timed


def _pendulum(numbers: dict[str, float], length: float, elements: int) -> Any:
    """The container, the system, and a function that reads the position of the tip."""
    container = exu.SystemContainer()
    system = container.AddSystem()
    element = length / elements
    nodes = [
        system.AddNode(eu.NodeRigidBody2D(referenceCoordinates=[k * element, 0, 0]))
        for k in range(elements + 1)
    ]
    for pair in zip(nodes, nodes[1:], strict=False):
        beam = eu.ObjectBeamGeometricallyExact2D(
            nodeNumbers=list(pair),
            length=element,
            massPerLength=numbers["rhoA"],
            crossSectionInertia=numbers["rhoI"],
            bendingStiffness=numbers["EI"],
            axialStiffness=numbers["EA"],
            shearStiffness=numbers["GA"],
        )
        body = system.AddObject(beam)
        marker = system.AddMarker(eu.MarkerBodyMass(bodyNumber=body))
        system.AddLoad(eu.Gravity(markerNumber=marker, loadVector=[0, -9.81, 0]))
    ground = system.AddNode(eu.NodePointGround())
    fixed = system.AddMarker(eu.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0))
    for k in range(2):
        moving = eu.MarkerNodeCoordinate(nodeNumber=nodes[0], coordinate=k)
        ends = [fixed, system.AddMarker(moving)]
        system.AddObject(eu.CoordinateConstraint(markerNumbers=ends))
    system.Assemble()
    kind = exu.OutputVariableType.Position
    return container, system, lambda: np.array(system.GetNodeOutput(nodes[-1], kind)[:2])


def timed_pendulum(
    numbers: dict[str, float], length: float, elements: int, h: float, steps: int
) -> tuple[float, np.ndarray]:
    """Microseconds of a step, and the position of the tip at the end."""
    build = lambda: _pendulum(numbers, length, elements)
    settings = settings_of(h, steps, 0.9, is_sparse=elements > 8)
    if elements > 128:
        # Its own tolerance, 1e-8, is below the round-off of so many short elements.
        settings.timeIntegration.newton.relativeTolerance = 1e-7
    return timed(build, settings, 3)
