"""Springs, dampers and armatures of joints, and what compensates gravity."""

from typing import Any

import numpy as np

from .._frames import GROUND, Numbers
from .._laws import Elastic, Flywheel, Viscous
from .._measures import AbstractLaw, AbstractMeasure, Place as PlaceOfPoint
from .._rotations import rotation_matrix
from ..forces import ConstantForce
from . import parts
from .coefficients import armature, damping, gravity_of, stiffness
from .joints import attached, Coordinate
from .laws import Anchored, CubicDamper, CubicSpring, RelativeAxes, TurnedApart
from .tree import Names, Tree


def forces_of(tree: Tree, coordinates: list[Coordinate], names: Names) -> list[Any]:
    """All springs, dampers and armatures of joints, and the forces against gravity."""
    found = []
    for coordinate in coordinates:
        found += _of_coordinate(tree, coordinate, names)
    for root in tree.roots:
        for joint in tree.joints(root):
            if tree.kind(joint) in ("ball", "free"):
                found += _of_rotation(tree, root, joint, names)
            if tree.kind(joint) == "free":
                found += _of_translation(tree, root, joint, names)
    return found + _against_gravity(tree, names)


def _of_coordinate(tree: Tree, coordinate: Coordinate, names: Names) -> list[Any]:
    model, found, joint = tree.model, [], coordinate.joint
    ends, measure = (coordinate.a, coordinate.b), coordinate.measure
    label = lambda what: names.new(f"{coordinate.name} {what}", "part")
    springs, dampers = stiffness(model, joint), damping(model, joint)
    if springs.any():
        place = model.jnt_qposadr[joint]
        rest, start = float(model.qpos_spring[place]), float(tree.data.qpos[place])
        # An angle in space jumps as far from its zero as it can: half a turn away. The zero
        # is where the spring is at rest, or else at the start.
        zero = rest if abs(start - rest) < 0.9 * np.pi else start
        law, own = _spring(measure, springs, rest - zero)
        numbers = coordinate.numbers(zero) | own
        found.append(parts.JointSpring(label("spring"), *ends, law, numbers))
    if dampers.any():
        law, own = _damper(measure, dampers)
        numbers = coordinate.numbers(0.0) | own
        found.append(parts.JointDamper(label("damper"), *ends, law, numbers))
    if inertance := armature(model, joint):
        numbers = coordinate.numbers(0.0) | dict(inertance=inertance)
        law = Flywheel(measure)
        found.append(parts.Armature(label("armature"), *ends, law, numbers))
    return found


def _spring(
    measure: AbstractMeasure, of: np.ndarray, rest: float
) -> tuple[AbstractLaw, Numbers]:
    numbers = dict(stiffness=of[0], rest=rest)
    if not of[1:].any():
        return Elastic(measure, "rest"), numbers
    return CubicSpring(measure, "rest"), numbers | dict(quadratic=of[1], cubic=of[2])


def _damper(measure: AbstractMeasure, of: np.ndarray) -> tuple[AbstractLaw, Numbers]:
    if not of[1:].any():
        return Viscous(measure), dict(damping=of[0])
    return CubicDamper(measure), dict(damping=of[0], quadratic=of[1], cubic=of[2])


def _of_rotation(tree: Tree, root: int, joint: int, names: Names) -> list[Any]:
    """The spring and the damper of the rotation of a ball joint or a free body."""
    model, name, found = tree.model, tree.joint_name(joint), []
    is_free = tree.is_free(root)
    first = int(model.jnt_qposadr[joint]) + (3 if is_free else 0)
    if is_free:
        ends, outside = (GROUND, tree.names[root]), np.eye(3)
    else:
        here = attached(tree, root)
        ends, outside = (here.outer.body, here.name), here.outer.rotation
    suffix = " of the rotation" if is_free else ""
    springs, dampers = stiffness(model, joint)[0], damping(model, joint)[0]
    if springs:
        rest = rotation_matrix(name, model.qpos_spring[first : first + 4])
        frames = dict(frame_a=(outside @ rest).T, frame_b=np.eye(3))
        label = names.new(f"{name} spring{suffix}", "part")
        numbers = frames | dict(stiffness=springs)
        found.append(parts.JointSpring(label, *ends, TurnedApart(), numbers))
    if dampers:
        label, law = names.new(f"{name} damper{suffix}", "part"), Viscous(RelativeAxes())
        found.append(parts.JointDamper(label, *ends, law, dict(damping=dampers)))
    return found


def _of_translation(tree: Tree, root: int, joint: int, names: Names) -> list[Any]:
    """The spring and the damper of the position of a free body, and the weight that its
    armature does not have."""
    model, name, found = tree.model, tree.joint_name(joint), []
    body = tree.names[root]
    origin = tree.place(root).point(np.zeros(3))
    first = int(model.jnt_qposadr[joint])
    springs, dampers = stiffness(model, joint)[0], damping(model, joint)[0]
    if springs:
        numbers = dict(
            point_a=model.qpos_spring[first : first + 3].copy(),
            point_b=origin,
            stiffness=springs,
        )
        label = names.new(f"{name} spring", "part")
        found.append(parts.JointSpring(label, GROUND, body, Anchored(), numbers))
    if dampers:
        label, law = names.new(f"{name} damper", "part"), Viscous(PlaceOfPoint())
        numbers = dict(point_b=origin, damping=dampers)
        found.append(parts.JointDamper(label, GROUND, body, law, numbers))
    extra, gravity = armature(model, joint), gravity_of(model)
    if extra and gravity is not None:
        label = names.new(f"{name} armature", "part")
        found.append(ConstantForce(label, body, -extra * gravity, origin))
    return found


def _against_gravity(tree: Tree, names: Names) -> list[Any]:
    found, model, gravity = [], tree.model, gravity_of(tree.model)
    if gravity is None:
        return found
    for k in np.flatnonzero(model.body_gravcomp):
        root = tree.root(int(k))
        if root is None or not model.body_mass[k]:
            continue
        force = -float(model.body_gravcomp[k] * model.body_mass[k]) * gravity
        centre = tree.place(int(k)).point(model.body_ipos[k])
        label = names.new(f"{tree.name(int(k))} gravcomp", "part")
        found.append(ConstantForce(label, tree.names[root], force, centre))
    return found
