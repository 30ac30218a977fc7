"""Shapes as surfaces of triangles in space, and flat scenes set upright in space."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ._frames import GROUND
from ._motion import Array, BodyMotion, LinkMotion, Motion
from .shapes import AbstractShape, Cylinder, Mesh, Polyline


# Edges are sharp from this angle between their sides on (radians).
_SHARP = 0.5
# The thickness of a flat body over the size of an average one, and the order of layers.
_SLAB, _LAYERS = 0.04, 3
# The radii of a pin and of its bearing on the ground, over this thickness.
_PIN, _BEARING = 0.6, 1.6
_DARK, _PALE = (0.2, 0.2, 0.2, 1.0), (0.6, 0.6, 0.6, 1.0)
# From the plane to space: x to the right, y up, and the third axis towards the viewer.
_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


class Surface(NamedTuple):
    """Triangles in the frame of a body.

    - `vertices`: shape `(n, 3)`; those of a sharp edge are there once for each side.
    - `faces`: shape `(m, 3)`, rows of the vertices.
    """

    vertices: Array
    faces: Array


def surface_of(points: Array, polygons: tuple[Array, ...]) -> Surface:
    """The surface of convex polygons, given by rows of `points`."""
    fans = [np.stack([np.full(len(x) - 2, x[0]), x[1:-1], x[2:]], axis=1) for x in polygons]
    faces = np.concatenate(fans)
    # A vertex has one normal, so a patch without sharp edges has vertices of its own.
    patch = _patches(points, faces)
    keys = patch[:, None] * len(points) + faces
    own, renumbered = np.unique(keys, return_inverse=True)
    return Surface(points[own % len(points)], renumbered.reshape(faces.shape))


def _patches(points: Array, faces: Array) -> Array:
    """The number of the patch that each triangle belongs to."""
    a, b, c = points[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    # Triangles without an area, at the tips of round ends, are part of any patch.
    is_thin = areas <= 1e-9 * areas.max()
    normals = normals / np.where(is_thin, 1, areas)[:, None]
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    edges, owner = edges[order], owner[order]
    shared = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    first, second = owner[shared], owner[shared + 1]
    smooth = np.sum(normals[first] * normals[second], axis=1) > np.cos(_SHARP)
    smooth |= is_thin[first] | is_thin[second]
    pairs = first[smooth], second[smooth]
    graph = coo_array((np.ones(len(pairs[0])), pairs), shape=(len(faces),) * 2)
    return connected_components(graph, directed=False)[1]


def upright(motion: Motion) -> Motion:
    """A motion in the plane as one in space, of flat bodies in layers, held by pins."""
    sizes = [
        np.ptp(shape.facets().points, axis=0).max()
        for body in motion.bodies
        for shape in body.shapes
        if body.name != GROUND
    ]
    thick = _SLAB * float(np.median(sizes)) if sizes else 0.0
    bodies = [_stood(body, k, thick) for k, body in enumerate(motion.bodies)]
    links = tuple(map(_stood_link, motion.links))
    if thick > 0:
        bodies += [_pin(link, thick) for link in links if link.symbol == "pin"]
    return motion._replace(bodies=tuple(bodies), links=links)


def _in_space(x: Array) -> Array:
    """Points of the plane along the last axis, in space."""
    return x @ _UPRIGHT[:, :2].T


def _stood(body: BodyMotion, number: int, thick: float) -> BodyMotion:
    # What is fixed is behind; bodies that a joint connects are mostly in other layers.
    layer = -2 if body.name == GROUND else number % _LAYERS - 1
    towards = thick * layer * _UPRIGHT[:, 2]
    rotation = np.zeros((len(body.rotation), 3, 3))
    rotation[:, :2, :2], rotation[:, 2, 2] = body.rotation, 1.0
    return BodyMotion(
        body.name,
        tuple(x for shape in body.shapes for x in _thickened(shape, thick)),
        _in_space(body.position) + towards,
        _UPRIGHT @ rotation,
    )


def _stood_link(link: LinkMotion) -> LinkMotion:
    start, end, *axes = map(_in_space, (link.start, link.end, *link.axes))
    return link._replace(start=start, end=end, axes=tuple(axes))


def _pin(link: LinkMotion, thick: float) -> BodyMotion:
    """The pin of a hinge, through all layers; on the ground it has a bearing behind."""
    middle = [0.0, 0.0, 0.0]
    shapes = [Cylinder(_PIN * thick, (_LAYERS + 0.5) * thick, middle, color=_DARK)]
    if GROUND in link.bodies:
        behind = [0.0, 0.0, -2.5 * thick]
        shapes.append(Cylinder(_BEARING * thick, thick, behind, color=_PALE))
    rotation = np.broadcast_to(_UPRIGHT, (len(link.end), 3, 3))
    return BodyMotion(link.name, tuple(shapes), link.end, rotation)


def _thickened(shape: AbstractShape, thick: float) -> list[AbstractShape]:
    """A flat shape as prisms and lines in space, in the frame of its body."""
    facets = shape.facets()
    found: list[AbstractShape] = []
    for polygon in facets.polygons:
        outline, count = facets.points[polygon], len(polygon)
        ends = [np.full((count, 1), side * thick / 2) for side in (-1, 1)]
        corners = np.concatenate([np.hstack([outline, end]) for end in ends])
        fan = np.array([(0, k, k + 1) for k in range(1, count - 1)])
        here = np.arange(count)
        beside = np.roll(here, -1)
        sides = np.stack([here, beside, beside + count], axis=1)
        others = np.stack([here, beside + count, here + count], axis=1)
        faces = np.concatenate([fan[:, ::-1], fan + count, sides, others])
        found.append(Mesh(corners, faces, color=shape.color))
    for line in facets.lines:
        points = np.hstack([facets.points[line], np.zeros((len(line), 1))])
        found.append(Polyline(points, color=shape.color))
    return found
