"""Mechanisms in EXUDYN, in its fast version, on one thread."""

# pyright: reportArgumentType=false, reportMissingImports=false

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any


sys.exudynFast = True  # pyright: ignore[reportAttributeAccessIssue]

import exudyn as exu  # noqa: E402
import exudyn.utilities as eu  # noqa: E402
import numpy as np  # noqa: E402
from planar_mechanisms import Linkage  # noqa: E402
from space_mechanisms import GROUND, Mechanism  # noqa: E402


Read = Callable[..., np.ndarray]
_POSITION = exu.OutputVariableType.Position


@dataclasses.dataclass(frozen=True)
class Model:
    """A mechanism in EXUDYN.

    `build` makes it at its start, as `(container, system, nodes)`. The generalized-alpha
    method has the spectral radius `rho` at infinity; without it the trapezoidal rule of
    index 2 is used.
    """

    build: Callable[[], tuple[Any, Any, list[Any]]]
    rho: float | None = 0.9
    is_sparse: bool = False
    redundant: bool = False

    def run(self, h: float, steps: int, *outputs: Any) -> tuple[float, list[np.ndarray]]:
        """The seconds of the processor, and outputs of all nodes at the end, `(n, ...)`.

        The outputs are positions by default. Building the model is not timed.
        """
        container, system, nodes = self.build()
        settings = self._settings(h, steps)
        kinds = exu.DynamicSolverType
        solver = kinds.TrapezoidalIndex2 if self.rho is None else kinds.GeneralizedAlpha
        begin = time.process_time()
        system.SolveDynamic(settings, solverType=solver)
        seconds = time.process_time() - begin
        read = lambda kind: np.array([system.GetNodeOutput(node, kind) for node in nodes])
        found = [read(kind) for kind in outputs or (_POSITION,)]
        del container
        return seconds, found

    def _settings(self, h: float, steps: int) -> Any:
        settings = exu.SimulationSettings()
        settings.timeIntegration.numberOfSteps = steps
        settings.timeIntegration.endTime = steps * h
        settings.timeIntegration.verboseMode = 0
        settings.timeIntegration.generalizedAlpha.spectralRadius = self.rho or 1.0
        settings.solution.file.write = False
        kinds = exu.LinearSolverType
        settings.linearSolver.solverType = (
            kinds.EigenSparse if self.is_sparse else kinds.EXUdense
        )
        if self.redundant:
            settings.linearSolver.solverType = kinds.EigenDense
            settings.linearSolver.ignoreSingularJacobian = True
        # Steps that fail are divided, but not for ever.
        settings.timeIntegration.minimumStepSize = h / 100
        settings.parallel.numberOfThreads = 1
        return settings


def points(masses: Sequence[float], length: float, rho: float | None) -> Model:
    """Points on rods of equal length, in the plane, horizontal; gravity along +y."""

    def build():
        container = exu.SystemContainer()
        system = container.AddSystem()
        ground = system.AddObject(eu.ObjectGround())
        last = system.AddMarker(eu.MarkerBodyPosition(bodyNumber=ground))
        nodes = []
        for k, mass in enumerate(masses, start=1):
            place = [k * length, 0]
            node = system.AddNode(eu.NodePoint2D(referenceCoordinates=place))
            nodes.append(node)
            body = system.AddObject(eu.MassPoint2D(mass=mass, nodeNumber=node))
            marker = system.AddMarker(eu.MarkerBodyPosition(bodyNumber=body))
            load = [0, 9.81 * mass, 0]
            system.AddLoad(eu.Force(markerNumber=marker, loadVector=load))
            ends = [last, marker]
            system.AddObject(eu.DistanceConstraint(markerNumbers=ends, distance=length))
            last = marker
        system.Assemble()
        return container, system, nodes

    return Model(build, rho, is_sparse=len(masses) > 8)


def in_space(mechanism: Mechanism) -> Model:
    """Bodies in Euler parameters on hinges and ball joints."""
    moving = mechanism.in_motion()

    def build():
        container = exu.SystemContainer()
        system = container.AddSystem()
        ground = system.AddObject(eu.ObjectGround())
        made = [
            system.CreateRigidBody(
                inertia=eu.RigidBodyInertia(
                    mass=body.mass, inertiaTensor=np.diag(body.inertia)
                ),
                nodeType=exu.NodeType.RotationEulerParameters,
                referencePosition=list(body.position),
                initialVelocity=list(body.velocity),
                initialAngularVelocity=list(body.spin),
                gravity=list(moving.gravity),
                returnDict=True,
            )
            for body in moving.bodies
        ]
        number = lambda k: ground if k == GROUND else made[k]["bodyNumber"]
        for joint in moving.joints:
            pair = dict(bodyNumbers=[number(joint.first), number(joint.second)])
            at = dict(position=list(joint.point), show=False, useGlobalFrame=True)
            if joint.axis is None:
                system.CreateSphericalJoint(**pair, **at)
                continue
            at |= dict(axis=list(joint.axis))
            system.CreateRevoluteJoint(**pair, **at)
            if joint.stiffness or joint.damping or joint.torque:
                # Its torque is that on the first body.
                law = dict(stiffness=joint.stiffness, damping=joint.damping)
                law |= dict(torque=-joint.torque)
                system.CreateTorsionalSpringDamper(**pair, **at, **law)
        system.Assemble()
        return container, system, [x["nodeNumber"] for x in made]

    is_sparse = len(mechanism.bodies) > 3
    return Model(build, is_sparse=is_sparse, redundant=mechanism.redundant)


def in_plane(linkage: Linkage) -> Model:
    """Bodies in the plane on pins and guides."""

    def build():
        container = exu.SystemContainer()
        system = container.AddSystem()
        ground = system.AddObject(eu.ObjectGround())
        nodes, made = [], []
        for body in linkage.bodies:
            node = system.AddNode(
                eu.NodeRigidBody2D(
                    referenceCoordinates=[float(x) for x in body.pose],
                    initialVelocities=[float(x) for x in body.velocity],
                )
            )
            nodes.append(node)
            made.append(
                system.AddObject(
                    eu.RigidBody2D(
                        physicsMass=body.mass, physicsInertia=body.inertia, nodeNumber=node
                    )
                )
            )
            centre = system.AddMarker(eu.MarkerBodyMass(bodyNumber=made[-1]))
            weight = [0, -9.81, 0]
            system.AddLoad(eu.LoadMassProportional(markerNumber=centre, loadVector=weight))

        def marker(body: int, point: Any) -> Any:
            number = ground if body == GROUND else made[body]
            local = [*(float(x) for x in point), 0.0]
            kind = eu.MarkerBodyPosition if body == GROUND else eu.MarkerBodyRigid
            return system.AddMarker(kind(bodyNumber=number, localPosition=local))

        for pin in linkage.pins:
            ends = [marker(pin.first, pin.point_a), marker(pin.second, pin.point_b)]
            system.AddObject(eu.RevoluteJoint2D(markerNumbers=ends))
        for body in linkage.guided:
            # A body that slides along x and does not turn.
            for coordinate in (1, 2):
                own = system.AddMarker(
                    eu.MarkerNodeCoordinate(nodeNumber=nodes[body], coordinate=coordinate)
                )
                fixed = _fixed(system)
                ends = [fixed, own]
                system.AddObject(eu.CoordinateConstraint(markerNumbers=ends))
        system.Assemble()
        return container, system, nodes

    return Model(build, is_sparse=len(linkage.bodies) > 6)


def _fixed(system: Any) -> Any:
    """A coordinate that is zero."""
    node = system.AddNode(eu.NodePointGround())
    return system.AddMarker(eu.MarkerNodeCoordinate(nodeNumber=node, coordinate=0))
