"""The coefficients of springs, dampers and armatures of joints in a file."""

from typing import Any

import numpy as np

from . import mujoco


def is_disabled(model: Any, *what: str) -> bool:
    """Whether a flag of the file turns any of these off, such as `"gravity"`."""
    bits = [getattr(mujoco.mjtDisableBit, f"mjDSBL_{x.upper()}") for x in what]
    return any(model.opt.disableflags & bit for bit in bits)


def stiffness(model: Any, joint: int) -> np.ndarray:
    """The coefficients of a joint's spring, those of `x`, `x^2` and `x^3`."""
    if is_disabled(model, "spring"):
        return np.zeros(3)
    return np.array([model.jnt_stiffness[joint], *model.jnt_stiffnesspoly[joint]])


def damping(model: Any, joint: int) -> np.ndarray:
    """The coefficients of a joint's damper, those of `v`, `v |v|` and `v^3`."""
    if is_disabled(model, "damper"):
        return np.zeros(3)
    dof, motor = model.jnt_dofadr[joint], int(model.jnt_actuatorid[joint])
    found = np.array([model.dof_damping[dof], *model.dof_dampingpoly[dof]])
    if motor < 0:
        return found
    gear = abs(float(model.actuator_gear[motor][0]))
    own = [model.actuator_damping[motor], *model.actuator_dampingpoly[motor]]
    return found + np.array(own) * gear ** np.array([2, 3, 4])


def armature(model: Any, joint: int) -> float:
    """The armature of a joint, with that of its motor."""
    motor = int(model.jnt_actuatorid[joint])
    found = float(model.dof_armature[model.jnt_dofadr[joint]])
    if motor < 0:
        return found
    gear = float(model.actuator_gear[motor][0])
    return found + gear**2 * float(model.actuator_armature[motor])


def gravity_of(model: Any) -> np.ndarray | None:
    """The acceleration of gravity, if there is one."""
    off = is_disabled(model, "gravity") or not model.opt.gravity.any()
    return None if off else model.opt.gravity.copy()
