"""Shapes of bodies, for pictures; they have no influence on the motion.

A shape is fixed in the frame of its body, whose origin is the mass centre: `position` is
the place of its middle there, and `rotation` leads from its own axes to those of the body.
Shapes in the plane have two coordinates, those in space three. Shapes that have an axis
have it along their first coordinate in the plane, and along their third in space.

    ej.bodies.RigidBody("wheel", ..., shape=ej.shapes.Cylinder(0.3, 0.05, color="black"))
"""

import abc
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import equinox as eqx
import numpy as np
from typing_extensions import TypeAliasType

from .._programs import module_of
from .._types import Real, Vector
from ._arguments import basis, number, positive
from ._rotations import rotation_matrix


# A name that matplotlib knows, "#rrggbb", or three or four numbers from 0 to 1.
Color = TypeAliasType("Color", str | Sequence[float])

_SIDES = 24  # of the polygons that stand for circles


class Facets(NamedTuple):
    """A shape as flat polygons and lines, in the frame of its body.

    - `points`: shape `(n, d)` (length).
    - `polygons`, `lines`: each a sequence of rows of `points`. Polygons in space are
      counterclockwise if seen from outside.
    - `creased`: whether the edges of the polygons are edges of the shape.
    """

    points: np.ndarray
    polygons: tuple[np.ndarray, ...] = ()
    lines: tuple[np.ndarray, ...] = ()
    creased: bool = True


class AbstractShape(eqx.Module):
    """A shape in the frame of a body.

    - `position`: shape `(d,)` (length).
    - `rotation`: the axes of the shape along the columns of a matrix `(d, d)`.
    - `color`: four numbers from 0 to 1 (red, green, blue, opacity), or `None` where the
      picture chooses.

    `position` and `rotation` are `None` only in a sphere or capsule without a position,
    which fits into the plane and into space, until it is part of a scene.
    """

    position: Any
    rotation: Any
    color: tuple[float, ...] | None = eqx.field(static=True)

    @abc.abstractmethod
    def own_facets(self) -> Facets:
        """The shape in its own axes."""

    def facets(self) -> Facets:
        """The shape in the frame of the body, as polygons and lines."""
        own = self.own_facets()
        points = own.points @ np.asarray(self.rotation).T + np.asarray(self.position)
        return own._replace(points=points)

    def fitted(self, owner: str, dimension: int) -> Self:
        """The shape with a position and a rotation, in the plane or in space.

        **Raises:** `ValueError` for a shape of the other dimension.
        """
        pose = self.position, self.rotation
        if self.position is None:
            pose = np.zeros(dimension), np.eye(dimension)
        if pose[0].size != dimension:
            here, there = ("the plane", "space")[:: 1 if dimension == 2 else -1]
            raise ValueError(
                f"'{owner}' is in {here}, but its {type(self).__name__} has "
                f"{pose[0].size} coordinates, as shapes in {there} have."
            )
        where = lambda shape: (shape.position, shape.rotation)
        return eqx.tree_at(where, self, pose, is_leaf=lambda x: x is None)


class Box(AbstractShape):
    """A box, in the plane a rectangle.

    **Arguments:**

    - `size`: the lengths of its sides, shape `(2,)` or `(3,)`.
    - `position`: of its middle in the frame of the body, by default the mass centre.
    - `rotation`: in the plane an angle; in space a unit quaternion (scalar first) or a
      matrix `(3, 3)` with the axes of the box along its columns.
    - `color`: a name that matplotlib knows, "#rrggbb", or three or four numbers from 0
      to 1.
    """

    size: Any

    def __init__(
        self,
        size: Vector,
        position: Vector | None = None,
        rotation: Vector | Real | None = None,
        *,
        color: Color | None = None,
    ):
        self.size = number("a Box", "`size`", size, (2,), (3,), least=0.0)
        pose = _pose("Box", position, rotation, self.size.size)
        (self.position, self.rotation), self.color = pose, _color("Box", color)

    def own_facets(self) -> Facets:
        half = np.asarray(self.size) / 2
        if half.size == 2:
            signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            return Facets(signs * half, (np.arange(4),))
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        sides = (
            (0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4),
            (1, 5, 7, 3),
        )  # fmt: skip
        return Facets(signs * half, tuple(np.array(side) for side in sides))


class Sphere(AbstractShape):
    """A sphere, in the plane a disc, about a point of the body.

    **Arguments:**

    - `radius`: positive (length).
    - `position`, `color`: as for `Box`.
    """

    radius: Any

    def __init__(
        self,
        radius: Real,
        position: Vector | None = None,
        *,
        color: Color | None = None,
    ):
        self.radius = positive("a Sphere", "`radius`", radius)
        pose = _pose("Sphere", position, None)
        (self.position, self.rotation), self.color = pose, _color("Sphere", color)

    def own_facets(self) -> Facets:
        return _rounded(float(self.radius), 0.0, self.position.size)


class Cylinder(AbstractShape):
    """A cylinder or disc in space, about its third axis.

    In the plane take a `Sphere` for a disc and a `Box` for a cylinder from the side.

    **Arguments:**

    - `radius`, `length`: positive (length).
    - `position`, `rotation`, `color`: as for `Box`. `Cylinder.between` is an alternative.
    """

    radius: Any
    length: Any

    def __init__(
        self,
        radius: Real,
        length: Real,
        position: Vector | None = None,
        rotation: Vector | None = None,
        *,
        color: Color | None = None,
    ):
        self.radius = positive("a Cylinder", "`radius`", radius)
        self.length = positive("a Cylinder", "`length`", length)
        pose = _pose("Cylinder", position, rotation, 3)
        (self.position, self.rotation), self.color = pose, _color("Cylinder", color)

    @staticmethod
    def between(
        start: Vector, end: Vector, radius: Real, *, color: Color | None = None
    ) -> "Cylinder":
        """A cylinder with these ends of its axis, points of the body."""
        length, middle, axes = _along("Cylinder", start, end)
        return Cylinder(radius, length, middle, axes, color=color)

    def own_facets(self) -> Facets:
        radius, half = float(self.radius), float(self.length) / 2
        return _revolved(np.array([radius, radius]), np.array([-half, half]))


class Capsule(AbstractShape):
    """A rod with round ends: all points that are within `radius` of a line.

    **Arguments:**

    - `radius`: positive (length), or `None`, where the scene chooses one for all its rods.
    - `length`: of the line, positive; the rod is longer by twice the radius.
    - `position`, `rotation`, `color`: as for `Box`. `Capsule.between` is an alternative.
    """

    radius: Any
    length: Any

    def __init__(
        self,
        radius: Real | None,
        length: Real,
        position: Vector | None = None,
        rotation: Vector | Real | None = None,
        *,
        color: Color | None = None,
    ):
        given = radius is not None
        self.radius = positive("a Capsule", "`radius`", radius) if given else None
        self.length = positive("a Capsule", "`length`", length)
        pose = _pose("Capsule", position, rotation)
        (self.position, self.rotation), self.color = pose, _color("Capsule", color)

    @staticmethod
    def between(
        start: Vector,
        end: Vector,
        radius: Real | None = None,
        *,
        color: Color | None = None,
    ) -> "Capsule":
        """A rod whose line has these ends, points of the body."""
        length, middle, axes = _along("Capsule", start, end)
        if middle.size == 2:  # a rotation by an angle
            axes = module_of(axes).arctan2(axes[1, 0], axes[0, 0])
        return Capsule(radius, length, middle, axes, color=color)

    def with_radius(self, radius: float) -> "Capsule":
        """The same with this radius if it has none."""
        if self.radius is not None:
            return self
        return eqx.tree_at(
            lambda x: x.radius, self, np.asarray(radius), is_leaf=lambda x: x is None
        )

    def own_facets(self) -> Facets:
        return _rounded(float(self.radius), float(self.length), self.position.size)


class Polyline(AbstractShape):
    """A line through points of the body, drawn with the same width in every picture.

    **Arguments:**

    - `points`: shape `(n, 2)` or `(n, 3)`, at least two (length).
    - `color`: as for `Box`.
    """

    points: Any

    def __init__(self, points: Vector | Sequence[Vector], *, color: Color | None = None):
        self.points = _points("Polyline", "`points`", points, 2)
        pose = _pose("Polyline", None, None, self.points.shape[1])
        (self.position, self.rotation), self.color = pose, _color("Polyline", color)

    def own_facets(self) -> Facets:
        points = np.asarray(self.points)
        return Facets(points, lines=(np.arange(len(points)),))


class Mesh(AbstractShape):
    """A surface of triangles; in the plane the area that they cover.

    **Arguments:**

    - `vertices`: shape `(n, 3)`, in the plane `(n, 2)` (length).
    - `faces`: shape `(m, 3)`, the rows of the vertices of each triangle from 0,
      counterclockwise if seen from outside.
    - `position`, `rotation`, `color`: as for `Box`.
    """

    vertices: Any
    faces: np.ndarray

    def __init__(
        self,
        vertices: Vector | Sequence[Vector],
        faces: Sequence[Sequence[int]] | np.ndarray,
        position: Vector | None = None,
        rotation: Vector | Real | None = None,
        *,
        color: Color | None = None,
    ):
        self.vertices = _points("Mesh", "`vertices`", vertices, 3)
        self.faces = _faces(faces, len(self.vertices))
        pose = _pose("Mesh", position, rotation, self.vertices.shape[1])
        (self.position, self.rotation), self.color = pose, _color("Mesh", color)

    def own_facets(self) -> Facets:
        return Facets(np.asarray(self.vertices), tuple(self.faces), creased=False)


# What the `shape` of a body may be.
Shape = TypeAliasType("Shape", AbstractShape | Sequence[AbstractShape])


def as_shapes(owner: str, shape: Any) -> tuple[AbstractShape, ...] | None:
    """The `shape` of a body, one or several, as a tuple; `None` if it is left out."""
    if shape is None:
        return None
    shapes = (shape,) if isinstance(shape, AbstractShape) else shape
    if not isinstance(shapes, Sequence) or not all(
        isinstance(x, AbstractShape) for x in shapes
    ):
        raise TypeError(
            f"The shape of {owner} must be one of `ej.shapes`, or a list of them, got "
            f"{shape!r}."
        )
    return tuple(shapes)


# Checks ---------------------------------------------------------------------------------


def _pose(
    kind: str, position: Any, rotation: Any, dimension: int | None = None
) -> tuple[Any, Any]:
    """A position and a rotation matrix, as far as the dimension is known."""
    sizes = set() if dimension is None else {dimension}
    if position is not None:
        position = number(f"a {kind}", "`position`", position, (2,), (3,))
        sizes.add(position.size)
    if rotation is not None:
        sizes.add(2 if np.ndim(rotation) == 0 else 3)
    if len(sizes) > 1:
        raise ValueError(
            f"A {kind} is in the plane (two coordinates, a `rotation` by an angle) or in "
            "space (three coordinates, a quaternion or a matrix), but this one mixes "
            f"them: position = {position}, rotation = {rotation}."
        )
    if not sizes:
        return None, None
    (size,) = sizes
    if position is None:
        position = np.zeros(size)
    if rotation is None:
        return position, np.eye(size)
    if size == 3:
        return position, rotation_matrix(kind, rotation)
    angle = number(f"a {kind}", "`rotation`", rotation, ())
    xp = module_of(angle)
    c, s = xp.cos(angle), xp.sin(angle)
    return position, xp.stack([xp.stack([c, -s]), xp.stack([s, c])])


def _along(kind: str, start: Any, end: Any) -> tuple[Any, Any, Any]:
    """The length, the middle, and the axes of a shape between two points."""
    part = f"a {kind}"
    start = number(part, "`start`", start, (2,), (3,))
    end = number(part, "`end`", end, start.shape)
    xp = module_of(start, end)
    length = positive(part, "the length", xp.sqrt(xp.sum((end - start) ** 2)))
    return length, (start + end) / 2, basis((end - start) / length).T


def _points(kind: str, role: str, values: Any, least: int) -> Any:
    xp = module_of(values)
    points = xp.asarray(values, float)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) < least:
        raise ValueError(
            f"{role} of a {kind} must be at least {least} points, shape (n, 2) or (n, 3), "
            f"got shape {points.shape}."
        )
    return number(f"a {kind}", role, points, points.shape)


def _faces(faces: Any, num_vertices: int) -> np.ndarray:
    array = np.asarray(faces)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "iu":
        raise ValueError(
            "`faces` of a Mesh must be integers of shape (m, 3), got shape "
            f"{array.shape} and type {array.dtype}."
        )
    if array.size and not (0 <= array.min() and array.max() < num_vertices):
        raise ValueError(
            f"`faces` of a Mesh contain the vertices {array.min()} to {array.max()}, but "
            f"there are {num_vertices}, counted from 0."
        )
    return array


def _color(kind: str, color: Any) -> tuple[float, ...] | None:
    if color is None:
        return None
    from matplotlib.colors import to_rgba

    try:
        return tuple(float(x) for x in to_rgba(color))
    except ValueError:
        raise ValueError(
            f"`color` of a {kind} must be a name that matplotlib knows, '#rrggbb', or "
            f"three or four numbers from 0 to 1, got {color!r}."
        ) from None


# Polygons -------------------------------------------------------------------------------


def _rounded(radius: float, length: float, dimension: int) -> Facets:
    """All points within `radius` of a line of some length about the middle."""
    if dimension == 2:
        turn = np.linspace(-np.pi / 2, np.pi / 2, _SIDES + 1)
        x, y = length / 2 + radius * np.cos(turn), radius * np.sin(turn)
        right = np.stack([x, y], axis=1)
        return Facets(np.concatenate([right, -right]), (np.arange(2 * turn.size),))
    turn = np.linspace(-np.pi / 2, np.pi / 2, _SIDES // 2)
    height = radius * np.sin(turn)
    along = height + np.copysign(length / 2, height)
    return _revolved(radius * np.cos(turn), along)._replace(creased=False)


def _revolved(radii: np.ndarray, heights: np.ndarray) -> Facets:
    """A surface of revolution about the third axis, from below, with flat ends."""
    turn = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    rings = radii[:, None, None] * ring + heights[:, None, None] * np.array([0, 0, 1.0])
    here = np.arange(_SIDES)
    beside = np.roll(here, -1)
    bands = [
        np.stack([here, beside, beside + _SIDES, here + _SIDES], axis=1) + k * _SIDES
        for k in range(len(radii) - 1)
    ]
    last = (len(radii) - 1) * _SIDES
    ends = (here[::-1], here + last)
    sides = tuple(np.concatenate(bands))
    return Facets(rings.reshape(-1, 3), (*sides, *ends), creased=False)
