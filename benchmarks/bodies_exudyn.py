"""A chain of hinged bodies in space in EXUDYN."""

# pyright: reportArgumentType=false, reportMissingImports=false

import functools

import numpy as np
from exudyn_runs import eu, exu, settings_of, timed


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
    read = lambda: system.GetNodeOutput(node, exu.OutputVariableType.Position)
    return container, system, read


def run(num_bodies: int, inertia: np.ndarray, h: float, steps: int, repeats: int = 3):
    """The time of a step in microseconds, and the last mass centre at the end."""
    build = functools.partial(_build, num_bodies, inertia)
    settings = settings_of(h, steps, 0.9, is_sparse=num_bodies > 3)
    return timed(build, settings, repeats)
