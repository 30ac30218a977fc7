"""The joints of the bodies of a file, and the coordinates that they bring.

A coordinate counts as in the file: it has the value `qpos0` in the pose in which the file
defines the body. In that pose all joints of a body are at rest, so all axes and points are
known in the frame of the body itself.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .._arguments import basis
from .._frames import Numbers
from .._laws import Alignment, SAME_AXIS, SAME_DIRECTIONS
from .._measures import AbstractMeasure, Slide, Turn
from .._rotations import rotation_matrix
from ..joints import Spherical
from . import parts
from .chains import Chain, ChainCoordinate, ChainRows, ChainSlide, ChainTurn
from .tree import Names, Place, Tree


# Axes count as parallel below this sine of their angle.
_PARALLEL = 1e-6


class Coordinate(NamedTuple):
    """The coordinate of a hinge or slide, as a measure of the bodies `a` and `b`.

    - `joint`: its index in the file.
    - `numbers`: those of the measure if it is to vanish at a given value of the coordinate.
    """

    joint: int
    name: str
    a: str
    b: str
    measure: AbstractMeasure
    numbers: Callable[[float], Numbers]


class Attached(NamedTuple):
    """Where the joints of a body are, in the pose in which the file defines the body.

    - `outer`, `own`: the frame of the body of the file in the scene: in the body (or
      ground) to which it is joined, and in the body itself.
    - `start_axes`: the axes of its joints in space, at the start.
    """

    name: str
    joints: list[int]
    kinds: tuple[str, ...]
    outer: Place
    own: Place
    axes: np.ndarray
    points: np.ndarray
    zeros: np.ndarray
    start_axes: np.ndarray


def attached(tree: Tree, root: int) -> Attached:
    """Where the joints of a body are; not for a free body."""
    model, joints = tree.model, tree.joints(root)
    outside = tree.place(int(model.body_parentid[root]))
    turned = rotation_matrix(tree.names[root], model.body_quat[root])
    origin = outside.point(model.body_pos[root])
    return Attached(
        name=tree.names[root],
        joints=joints,
        kinds=tuple(tree.kind(k) for k in joints),
        outer=Place(outside.body, outside.rotation @ turned, origin),
        own=tree.place(root),
        axes=model.jnt_axis[joints],
        points=model.jnt_pos[joints],
        zeros=model.qpos0[model.jnt_qposadr[joints]],
        start_axes=tree.data.xaxis[joints],
    )


def joints_of(tree: Tree, names: Names) -> tuple[list[Any], list[Coordinate]]:
    """The joints of all bodies, and the coordinates of all hinges and slides."""
    found, coordinates = [], []
    for root in tree.roots:
        if tree.is_free(root):
            continue
        here = attached(tree, root)
        labels = [names.new(tree.joint_name(k), "joint") for k in here.joints]
        of_body = _chain if len(here.joints) > 1 else _single[here.kinds[0]]
        joints, own = of_body(here, labels, names)
        found += joints
        coordinates += own
    return found, coordinates


def _hinge(here: Attached, labels: list[str], names: Names) -> tuple[list, list]:
    points = dict(
        point_a=here.outer.point(here.points[0]), point_b=here.own.point(here.points[0])
    )
    frames = _frames_of_hinge(here, 0)
    law = Alignment(None, SAME_AXIS, Turn(), "axis")
    ends = labels[0], here.outer.body, here.name
    joint = parts.Hinge(*ends, law, points | frames(0.0))
    return [joint], [Coordinate(here.joints[0], *ends, Turn(), frames)]


def _frames_of_hinge(here: Attached, k: int) -> Callable[[float], Numbers]:
    """The axes of one hinge, as a function of the coordinate at which they coincide."""
    axis, zero = here.axes[k], here.zeros[k]

    def frames(value: float) -> Numbers:
        rows = basis(axis)
        turned = [_rotated(row, axis, zero - value) for row in rows]
        return dict(frame_a=_all(here.outer, rows), frame_b=_all(here.own, turned))

    return frames


def _slide(here: Attached, labels: list[str], names: Names) -> tuple[list, list]:
    (axis,), (zero,) = here.axes, here.zeros
    rows = basis(axis)

    def numbers(value: float) -> Numbers:
        start = (value - zero) * axis  # a point of the file's body, in its rest pose
        return dict(
            point_a=here.outer.point(start),
            point_b=here.own.point(np.zeros(3)),
            frame_a=_all(here.outer, rows),
        )

    law = Alignment((0, 1), SAME_DIRECTIONS, Slide(), "directions")
    ends = labels[0], here.outer.body, here.name
    joint = parts.Slide(*ends, law, numbers(0.0) | dict(frame_b=_all(here.own, rows)))
    return [joint], [Coordinate(here.joints[0], *ends, Slide(), numbers)]


def _ball(here: Attached, labels: list[str], names: Names) -> tuple[list, list]:
    point = here.points[0]
    points = here.outer.point(point), here.own.point(point)
    return [Spherical(labels[0], here.outer.body, here.name, *points)], []


_single = dict(hinge=_hinge, slide=_slide, ball=_ball)


def _chain(here: Attached, labels: list[str], names: Names) -> tuple[list, list]:
    geometry = ChainGeometry(here)
    chain, numbers = geometry.chain, geometry.numbers()
    ends = here.outer.body, here.name
    name = names.new(" + ".join(labels), "joints")
    found: list[Any] = [parts.Chain(name, *ends, ChainRows(chain), numbers)]
    coordinates = []
    for k, label in enumerate(labels):
        if here.kinds[k] == "ball":
            continue
        own = geometry.coordinate(k, label)
        coordinates.append(own)
        law = ChainCoordinate(own.measure)
        found.append(parts.Coordinate(label, own.a, own.b, law, own.numbers(0.0)))
    return found, coordinates


class ChainGeometry:
    """The numbers of a chain of joints; see `chains`."""

    def __init__(self, here: Attached):
        self.here = here
        self.hinges = [k for k, kind in enumerate(here.kinds) if kind == "hinge"]
        self.turning = [k for k, kind in enumerate(here.kinds) if kind != "slide"]
        self.slides = [k for k, kind in enumerate(here.kinds) if kind == "slide"]
        points = here.points[self.turning]
        apart = np.abs(np.diff(points, axis=0)).max(initial=0.0)
        size = max(1.0, np.abs(points).max(initial=0.0))
        self.chain = Chain(here.kinds, bool(apart <= 1e-9 * size))
        self._check()

    def _check(self) -> None:
        """Raises for chains whose rows would not describe the motion."""
        axes, told = self.here.axes, f"The joints of '{self.here.name}'"
        if self.hinges and "ball" in self.here.kinds:
            raise ValueError(
                f"{told} are a ball joint and a hinge. The angle of the hinge does not "
                "follow from the pose of the body: put a body between them."
            )
        if len(self.hinges) > 3:
            raise ValueError(
                f"{told} are {len(self.hinges)} hinges in a row. At most three angles "
                "follow from the pose of a body: put other bodies between them."
            )
        for i, j in zip(self.hinges, self.hinges[1:], strict=False):
            if np.linalg.norm(np.cross(axes[i], axes[j])) < _PARALLEL:
                raise ValueError(
                    f"{told} have two hinges in a row with parallel axes. Put a body "
                    "between them."
                )
        slides = axes[self.slides]
        if np.linalg.matrix_rank(slides, tol=_PARALLEL) < len(slides):
            raise ValueError(f"{told} are slides of which one follows from the others.")
        if len(self.hinges) == 3 and abs(self._side()) < _PARALLEL:
            raise ValueError(
                f"{told} start in gimbal lock: the axes of its three hinges are in one "
                "plane. Start from another pose, a keyframe."
            )

    def _side(self) -> float:
        """On which side of the plane of the first and the last of three axes the second
        is, at the start; it stays there."""
        first, second, last = self.here.start_axes[self.hinges]
        return float(second @ np.cross(first, last))

    def numbers(self) -> Numbers:
        here, last = self.here, len(self.turning)
        points = here.points[self.turning] if last else np.zeros((1, 3))
        found = dict(
            point_a=here.outer.point(points[0]), point_b=here.own.point(points[-1])
        )
        if not last:
            found |= dict(
                frame_a=_all(here.outer, np.eye(3)), frame_b=_all(here.own, np.eye(3))
            )
        elif self.hinges:
            first, second = here.axes[self.hinges[0]], here.axes[self.hinges[-1]]
            found |= dict(
                frame_a=_all(here.outer, basis(first)),
                frame_b=_all(here.own, basis(second)),
            )
        axes = here.axes[self.hinges]
        if len(axes) > 1:
            found |= dict(cosines=np.sum(axes[1:] * axes[:-1], axis=1))
        if len(axes) == 3:
            found |= dict(branch=np.sign(self._side()))
        if not self.chain.meet:
            links = np.diff(points, axis=0)
            between = [self._in_stage(k + 1, link) for k, link in enumerate(links)]
            found |= dict(links=np.array(between))
        return found | self._of_slides()

    def _of_slides(self) -> Numbers:
        if not self.slides:
            return {}
        pairs = zip(self.chain.stages, self.here.axes[self.slides], strict=True)
        slides = np.array([self._in_stage(stage, axis) for stage, axis in pairs])
        if not self.chain.slides_together:
            return dict(slides=slides)
        normals = np.linalg.svd(slides)[2][len(slides) :]
        return dict(slides=slides, normals=normals, duals=np.linalg.pinv(slides).T)

    def coordinate(self, k: int, label: str) -> Coordinate:
        """The coordinate of one joint, which is no ball."""
        here, zero = self.here, self.here.zeros[k]
        ends = here.joints[k], label, here.outer.body, here.name
        if k in self.slides:
            measure = ChainSlide(self.chain, self.slides.index(k))
            return Coordinate(
                *ends, measure, lambda value: self.numbers() | dict(zero=zero - value)
            )
        number = self.hinges.index(k)
        if len(self.hinges) == 1:
            return Coordinate(*ends, Turn(), _frames_of_hinge(here, k))
        if len(self.hinges) == 2:
            return self._of_two(number, ends)
        own = self._turn_between if number == 1 else self._turn_at_end
        measure = ChainTurn(self.chain, number)
        return Coordinate(*ends, measure, lambda value: self.numbers() | own(k, value))

    def _of_two(self, number: int, ends: tuple[int, str, str, str]) -> Coordinate:
        """The coordinate of one of two hinges: the angle of the axis of the other one in
        the body where its own axis is fixed."""
        here, is_first = self.here, number == 0
        k, other = self.hinges[number], self.hinges[1 - number]
        turned = basis(here.axes[other])[[2, 0, 1]]
        names = ("frame_a", "frame_b") if is_first else ("frame_b", "frame_a")
        places = (here.outer, here.own) if is_first else (here.own, here.outer)

        def frames(value: float) -> Numbers:
            x, y = self._seen_from(k, other, value, is_first)
            rows = (x, y, here.axes[k]), turned
            pairs = zip(names, places, rows, strict=True)
            return {name: _all(place, own) for name, place, own in pairs}

        return Coordinate(*ends, Turn(seen_from_b=not is_first), frames)

    def _turn_at_end(self, k: int, value: float) -> Numbers:
        """The numbers of the angle of the first or the last of three hinges."""
        is_first = k == self.hinges[0]
        rows = self._seen_from(k, self.hinges[1], value, is_first)
        place = self.here.outer if is_first else self.here.own
        zero, across = _all(place, rows)
        return dict(zero=zero, across=across)

    def _turn_between(self, k: int, value: float) -> Numbers:
        """The numbers of the angle of the second of three hinges."""
        first, axis, last = self.here.axes[self.hinges]
        along = first @ last - (first @ axis) * (axis @ last)
        at_rest = np.arctan2(axis @ np.cross(first, last), along)
        angle = at_rest + value - self.here.zeros[k]
        # Both axes are seen shorter than they are.
        sines = [np.linalg.norm(np.cross(axis, x)) for x in (first, last)]
        return dict(turn=np.array([np.cos(angle), np.sin(angle)]) / np.prod(sines))

    def _seen_from(
        self, k: int, other: int, value: float, is_first: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where the axis of an `other` hinge is seen along the axis of the hinge `k` when
        the coordinate has a value, and the direction in which it turns from there.

        They are vectors of the file's body in its rest pose, and fixed in the body before
        the hinge if this `is_first`, else in the one behind it. Their length makes up for
        that of the axis, which is seen shorter than it is.
        """
        axis, zero = self.here.axes[k], self.here.zeros[k]
        seen = self.here.axes[other] - axis @ self.here.axes[other] * axis
        sign = 1 if is_first else -1
        x = _rotated(seen / (seen @ seen), axis, sign * (value - zero))
        return x, sign * np.cross(axis, x)

    def _in_stage(self, stage: int, x: np.ndarray) -> np.ndarray:
        """A direction of the file's body in its rest pose, in the axes of a stage."""
        if stage == 0:
            return self.here.outer.direction(x)
        if stage == len(self.turning):
            return self.here.own.direction(x)
        before, behind = self.here.axes[self.hinges[stage - 1 : stage + 1]]
        aside = behind - before @ behind * before
        aside = aside / np.linalg.norm(aside)
        return np.array([x @ before, x @ aside, x @ np.cross(before, aside)])


def _rotated(x: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return c * x + s * np.cross(axis, x) + (1 - c) * (axis @ x) * axis


def _all(place: Place, rows: Any) -> np.ndarray:
    """Directions of the file's body in its rest pose, in a body of the scene."""
    return np.array([place.direction(row) for row in rows])
