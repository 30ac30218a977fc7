"""Shapes of the bodies for which the user gives none: from their inertia and joints."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import scipy

from ._frames import GROUND, Numbers
from ._laws import Alignment
from ._layout import Layout
from .bodies import AbstractBody
from .shapes import AbstractShape, as_shapes, Box, Capsule, Mesh, Shape, Sphere


Shapes: TypeAlias = tuple[AbstractShape, ...]

# The radius of all rods over their median length, and at most over that of a rod.
_SLENDER, _THICKEST = 0.03, 0.08
# The radius of a point mass over the size of the scene.
_BEAD = 0.03
# The least side of a box over its longest: flat bodies must be seen.
_FLAT = 0.02


def given_shapes(bodies: Sequence[AbstractBody], ground: Shape) -> dict[str, Shapes | None]:
    """The shapes that users gave to the bodies and the ground, `None` for the default."""
    given = {GROUND: as_shapes("the ground", ground)}
    given |= {body.name: body.shapes for body in bodies}
    dimension = bodies[0].kind.dimension
    return {
        name: None if shapes is None else tuple(x.fitted(name, dimension) for x in shapes)
        for name, shapes in given.items()
        if name != GROUND or shapes
    }


def all_shapes(
    layout: Layout,
    numbers: dict[str, dict[str, Numbers]],
    q: Any,
    given: dict[str, Shapes | None],
) -> dict[str, Shapes]:
    """The shapes of all bodies by name, by default from their inertia and joints.

    `numbers` are those of all parts, by section and name, `q` the coordinates of the start.

    A body with two points that joints hold is a rod, one with more a plate in the plane and
    a star of rods in space. Another is a box with its mass and inertia, with a rod from the
    mass centre to each point of a joint or force outside.
    """
    points = _Points(layout, numbers)
    size = _size(points, layout, np.asarray(q))
    masses = [own["mass"] for own in numbers["bodies"].values() if "mass" in own]
    heaviest = max((np.max(mass) for mass in masses), default=1.0)
    kinds, found = dict(layout.bodies), {}
    for name, shapes in given.items():
        own = numbers["bodies"].get(name, {})
        if shapes is not None:
            found[name] = shapes
        elif not kinds[name].turns:
            weight = max(np.cbrt(own["mass"] / heaviest), 0.4)
            found[name] = (Sphere(_BEAD * size * weight, np.zeros(layout.dimension)),)
        elif len(points.held[name]) > 1:
            found[name] = _linkage(points.of(name))
        else:
            found[name] = _box_with_arms(own, points.of(name))
    return _with_radii(found)


def _with_radii(shapes: dict[str, Shapes]) -> dict[str, Shapes]:
    """The shapes, with one radius for all rods that have none."""
    rods = [x for own in shapes.values() for x in own if isinstance(x, Capsule)]
    lengths = [float(x.length) for x in rods if x.radius is None]
    if not lengths:
        return shapes
    radius = _SLENDER * float(np.median(lengths))
    fitted = lambda x: x.with_radius(min(radius, _THICKEST * float(x.length)))
    return {
        name: tuple(fitted(x) if isinstance(x, Capsule) else x for x in own)
        for name, own in shapes.items()
    }


class _Points:
    """The points of joints and forces on every body, in its frame.

    - `held`: those that a joint holds on another body.
    - `others`: those that slide, or that rods and forces end in.
    - `lengths`: of the rods and springs between bodies, where they have one.
    """

    def __init__(self, layout: Layout, numbers: dict[str, dict[str, Numbers]]):
        names = {k: name for name, k in layout.numbers_of_bodies.items()}
        self.held: dict[str, list[np.ndarray]] = {name: [] for name in names.values()}
        self.others: dict[str, list[np.ndarray]] = {name: [] for name in names.values()}
        self.lengths: list[float] = []
        for section, links in (
            ("joints", layout.joints), ("forces", layout.forces), ("drives", layout.drives)
        ):  # fmt: skip
            for link in links:
                own = numbers[section][link.name]
                law = link.law
                holds = isinstance(law, Alignment) and law.along is None
                where = self.held if holds else self.others
                for k, key in ((link.a, "point_a"), (link.b, "point_b")):
                    if key in own:
                        _add(where[names[k]], own[key])
                if "length" in own:
                    self.lengths.append(float(own["length"]))

    def of(self, body: str) -> np.ndarray:
        points: list[np.ndarray] = []
        for point in (*self.held[body], *self.others[body]):
            _add(points, point)
        return np.array(points)


def _add(points: list[np.ndarray], point: np.ndarray) -> None:
    """Adds a point that is none of the others but for round-off."""
    size = max((np.abs(x).max() for x in (*points, point)), default=0.0)
    if all(np.abs(point - x).max() > 1e-6 * size for x in points):
        points.append(np.asarray(point))


def _size(points: _Points, layout: Layout, q: np.ndarray) -> float:
    """The size of the scene at the start; that of a few links, where there are many."""
    # Every kind of body has its mass centre first among its coordinates.
    origins = [q[group.q[:, : layout.dimension]] for group in layout.body_groups]
    fixed = np.reshape(points.of(GROUND), (-1, layout.dimension))
    extent = np.ptp(np.concatenate([*origins, fixed]), axis=0).max()
    names = dict(layout.bodies)
    arms = [2 * float(np.linalg.norm(x)) for name in names for x in points.of(name)]
    lengths = [x for x in (*points.lengths, *arms) if x > 0]
    few_links = 8 * float(np.median(lengths)) if lengths else 0.0
    return min((float(x) for x in (extent, few_links) if x > 0), default=1.0)


def _linkage(points: np.ndarray) -> Shapes:
    """A rod, a plate or a star through the points of a body."""
    middle = points.mean(axis=0)
    spread = np.linalg.svd(points - middle)[1]
    if len(points) == 2 or spread[1] <= 1e-3 * spread[0]:
        along = (points - middle) @ np.linalg.svd(points - middle)[2][0]
        return (_rod(points[along.argmin()], points[along.argmax()]),)
    if points.shape[1] == 3:
        return tuple(_rod(middle, x) for x in points if np.linalg.norm(x - middle) > 0)
    try:
        corners = scipy.spatial.ConvexHull(points).vertices
    except scipy.spatial.QhullError:  # almost on a line
        return (_rod(points[0], points[-1]),)
    fan = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
    return (Mesh(points[corners], fan),)


def _rod(start: np.ndarray, end: np.ndarray) -> Capsule:
    return Capsule.between(start, end)


def _box_with_arms(own: Numbers, points: np.ndarray) -> Shapes:
    mass, inertia = float(own["mass"]), np.asarray(own["inertia"])
    if inertia.ndim == 0:
        # Of a square; the inertia does not tell the ratio of the sides.
        box = Box(np.full(2, np.sqrt(6 * inertia / mass)))
    else:
        moments, axes = np.linalg.eigh(inertia)
        axes = axes * np.sign(np.linalg.det(axes))
        squared = np.maximum(6 * (moments.sum() - 2 * moments) / mass, 0)
        sides = np.sqrt(squared)
        box = Box(np.maximum(sides, _FLAT * sides.max()), rotation=axes)
    half, turned = np.asarray(box.size) / 2, np.asarray(box.rotation)
    outside = [x for x in points if np.any(np.abs(x @ turned) > half)]
    return (box, *(_rod(0 * x, x) for x in outside))
