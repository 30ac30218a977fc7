"""The bodies of a file that move, each with all that is rigidly attached to it."""

from typing import Any, NamedTuple

import numpy as np

from .._frames import GROUND
from .._rotations import rotation_matrix
from . import mujoco
from .coefficients import armature


class Place(NamedTuple):
    """A frame of the file in a body of the scene, or on the ground: `rotation x + origin`.

    On the ground these are coordinates of space.
    """

    body: str
    rotation: np.ndarray
    origin: np.ndarray

    def point(self, x: Any) -> np.ndarray:
        return self.rotation @ np.asarray(x) + self.origin

    def direction(self, x: Any) -> np.ndarray:
        return self.rotation @ np.asarray(x)


class Weight(NamedTuple):
    """Mass, mass centre, and inertia about it, in the frame of a body."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray


class Tree:
    """The bodies of a compiled model at the start of a run.

    - `model`, `data`: of MuJoCo; `data` at the start, with positions and velocities.
    - `roots`: the bodies that have joints, in the order of the file. Each is a body of the
      scene, together with those that are attached to it without joints.
    - `weights`: of each root, in its frame.
    """

    def __init__(self, model: Any, data: Any, names: "Names"):
        self.model, self.data = model, data
        joined = model.body_dofnum > 0
        self.roots = [int(k) for k in np.flatnonzero(joined)]
        self.names = {k: names.new(self.name(k), "body") for k in self.roots}
        self.weights = {k: self._weight(k) for k in self.roots}

    def name(self, body: int) -> str:
        return self.model.body(body).name or f"body {body}"

    def root(self, body: int) -> int | None:
        """The moving body that a body belongs to; `None` for what is fixed in space."""
        root = int(self.model.body_weldid[body])
        return root if root in self.names else None

    def members(self, root: int) -> list[int]:
        return [int(k) for k in np.flatnonzero(self.model.body_weldid == root)]

    def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """The rotation matrix and the origin of the frame of a body, in space."""
        # MuJoCo's matrices are off by the round-off of the whole tree.
        return rotation_matrix("a body", self.data.xquat[body]), self.data.xpos[body]

    def place(self, body: int) -> Place:
        """The frame of a body of the file in the scene."""
        rotation, origin = self.pose(body)
        root = self.root(body)
        if root is None:
            return Place(GROUND, rotation, origin)
        axes, base = self.pose(root)
        shift = axes.T @ (origin - base) - self.weights[root].centre
        return Place(self.names[root], axes.T @ rotation, shift)

    def velocity(self, root: int) -> tuple[np.ndarray, np.ndarray]:
        """The velocity of the mass centre of a body, and its angular velocity, in space."""
        both, kind = np.zeros(6), mujoco.mjtObj.mjOBJ_XBODY
        mujoco.mj_objectVelocity(self.model, self.data, kind, root, both, 0)
        arm = self.pose(root)[0] @ self.weights[root].centre
        return both[3:] + np.cross(both[:3], arm), both[:3]

    def _weight(self, root: int) -> Weight:
        """The mass of a body and of all that is attached to it."""
        axes, base = self.pose(root)
        parts = []
        for k in self.members(root):
            centre = axes.T @ (self.data.xipos[k] - base)
            turned = axes.T @ self.data.ximat[k].reshape(3, 3)
            inertia = turned @ np.diag(self.model.body_inertia[k]) @ turned.T
            parts.append(Weight(float(self.model.body_mass[k]), centre, inertia))
        return together([*parts, *self._armature(root)])

    def _armature(self, root: int) -> list[Weight]:
        """The armature of a free joint, or of a ball joint on the ground, as a weight.

        It is an inertia against every rotation; of a free joint also a mass in the origin
        of the frame, which gravity does not pull.
        """
        found = []
        for joint in self.joints(root):
            extra = armature(self.model, joint)
            if self.kind(joint) == "free":
                found.append(Weight(extra, np.zeros(3), extra * np.eye(3)))
            elif self.kind(joint) == "ball" and self.is_on_ground(root):
                found.append(Weight(0.0, np.zeros(3), extra * np.eye(3)))
        return found

    def joints(self, root: int) -> list[int]:
        """The joints of a body, in their order."""
        first = int(self.model.body_jntadr[root])
        return list(range(first, first + int(self.model.body_jntnum[root])))

    def kind(self, joint: int) -> str:
        """`"hinge"`, `"slide"`, `"ball"` or `"free"`."""
        kind = mujoco.mjtJoint(self.model.jnt_type[joint])
        return kind.name.removeprefix("mjJNT_").lower()

    def joint_name(self, joint: int) -> str:
        own = self.model.joint(joint).name
        return own or f"joint {joint} of {self.name(int(self.model.jnt_bodyid[joint]))}"

    def is_free(self, root: int) -> bool:
        return self.kind(self.joints(root)[0]) == "free"

    def is_on_ground(self, root: int) -> bool:
        return self.root(int(self.model.body_parentid[root])) is None


def together(parts: list[Weight]) -> Weight:
    """The weight of several that are rigidly connected."""
    mass = sum(part.mass for part in parts)
    centre, inertia = np.zeros(3), np.zeros((3, 3))
    for part in parts:
        centre += part.mass / mass * part.centre
    for part in parts:
        arm = part.centre - centre
        steiner = arm @ arm * np.eye(3) - np.outer(arm, arm)
        inertia += part.inertia + part.mass * steiner
    return Weight(mass, centre, 0.5 * (inertia + inertia.T))


class Names:
    """Names for parts, of which a scene has each only once."""

    def __init__(self):
        self._taken = {GROUND}

    def new(self, name: str, kind: str) -> str:
        """`name`, or `name (kind)` if another part has it."""
        found, k = name, 1
        while found in self._taken:
            found = f"{name} ({kind})" if k == 1 else f"{name} ({kind} {k})"
            k += 1
        self._taken.add(found)
        return found
