"""Open mechanisms in MuJoCo, in the coordinates of their joints."""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import dataclasses
import time
from typing import Any

import mujoco
import numpy as np
from space_mechanisms import Body, GROUND, Joint, Mechanism


@dataclasses.dataclass(frozen=True)
class Model:
    """An open mechanism, whose joint `k` leads to body `k`."""

    mechanism: Mechanism

    def run(self, h: float, steps: int) -> tuple[float, np.ndarray]:
        """The seconds of the processor, and the mass centres at the end, `(n, 3)`.

        By the classical Runge-Kutta method of order 4.
        """
        model, data = self._built(h)
        begin = time.process_time()
        mujoco.mj_step(model, data, steps)
        seconds = time.process_time() - begin
        mujoco.mj_kinematics(model, data)
        # MuJoCo numbers bodies in another order.
        places = [data.body(f"body {k}").xpos for k in range(len(self.mechanism.bodies))]
        return seconds, np.array(places)

    def _built(self, h: float) -> tuple[Any, Any]:
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = h, self.mechanism.gravity
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        spec.option.disableflags = (
            mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        )
        made = []
        pairs = zip(self.mechanism.bodies, self.mechanism.joints, strict=True)
        for k, (body, joint) in enumerate(pairs):
            parent = spec.worldbody if joint.first == GROUND else made[joint.first]
            made.append(_added(parent, body, joint, self.mechanism.place(joint.first)))
            made[-1].name = f"body {k}"
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qvel[:], data.qfrc_applied[:] = self._rates(), self._torques()
        return model, data

    def _rates(self) -> np.ndarray:
        """The rates of the joints at the start: axes of bodies and space coincide."""
        rates, bodies = [], self.mechanism.in_motion().bodies
        for joint, body in zip(self.mechanism.joints, bodies, strict=True):
            before = np.zeros(3) if joint.first == GROUND else bodies[joint.first].spin
            turn = np.asarray(body.spin) - before
            rates += list(turn) if joint.axis is None else [turn @ joint.axis]
        return np.array(rates)

    def _torques(self) -> np.ndarray:
        torques: list[float] = []
        for joint in self.mechanism.joints:
            torques += [0.0] * 3 if joint.axis is None else [joint.torque]
        return np.array(torques)


def _added(parent: Any, body: Body, joint: Joint, place: np.ndarray) -> Any:
    made = parent.add_body(
        pos=body.position - place,
        mass=body.mass,
        inertia=body.inertia,
        ipos=np.zeros(3),
        explicitinertial=True,
    )
    at = joint.point - body.position
    if joint.axis is None:
        made.add_joint(type=mujoco.mjtJoint.mjJNT_BALL, pos=at)
    else:
        law = dict(stiffness=joint.stiffness, damping=joint.damping)
        made.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, pos=at, axis=joint.axis, **law)
    return made
