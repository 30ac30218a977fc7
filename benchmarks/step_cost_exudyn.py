"""The double pendulum and the heavy top in EXUDYN, for `step_cost.py`."""

# pyright: reportArgumentType=false, reportMissingImports=false

from collections.abc import Callable

import numpy as np
from chain_exudyn import chain
from exudyn_runs import eu, exu, settings_of, timed


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
    settings = settings_of(h, round(end / h), 0.9, is_sparse=False)

    def run(container=container) -> tuple[np.ndarray, ...]:
        system.SolveDynamic(settings, solverType=exu.DynamicSolverType.GeneralizedAlpha)
        kinds = exu.OutputVariableType
        wanted = kinds.Position, kinds.Velocity, kinds.AngularVelocityLocal
        return tuple(np.asarray(read(kind)) for kind in wanted)

    return run


def _row(
    work: str, build: Callable, h: float, end: float, exact: np.ndarray, repeats: int
) -> dict:
    steps = round(end / h)
    settings = settings_of(h, steps, 0.9, is_sparse=False)
    us_per_step, position = timed(build, settings, repeats)
    return dict(
        work=work,
        method="generalized-alpha, rho 0.9",
        h=h,
        error=float(np.max(np.abs(position - exact))),
        energy=float("nan"),
        steps=steps,
        us_per_step=us_per_step,
    )


def rows(
    exact: dict[str, np.ndarray], pendulum_end: float, top_end: float, repeats: int
) -> list[dict]:
    pendulum = lambda: chain((1.0, 1.0), 1.0)
    return [
        _row("pendulum", pendulum, 1e-3, pendulum_end, exact["pendulum"], repeats),
        _row("top", _top, 1e-3, top_end, exact["top"], repeats),
    ]
