"""The shapes of a file, as pictures show them."""

from typing import Any

import numpy as np

from .._rotations import rotation_matrix
from ..shapes import AbstractShape, Box, Capsule, Cylinder, Mesh, Sphere
from . import mujoco
from .tree import Place, Tree


# A plane without edges, over the size of the model; its thickness over its own size.
_FLOOR = 4.0
_THIN = 0.01
# Points of a quarter of an ellipsoid's meridian.
_POINTS = 6


def shapes_of(tree: Tree, root: int | None) -> list[AbstractShape]:
    """The shapes of a body, or of what is fixed in space for `None`.

    Where some can touch nothing they are made to be seen, and only they are shown.
    """
    model = tree.model
    own = [k for k in range(model.ngeom) if tree.root(int(model.geom_bodyid[k])) == root]
    own = [k for k in own if _color(model, k)[3] > 0]
    only_seen = [k for k in own if not model.geom_contype[k] | model.geom_conaffinity[k]]
    return [x for k in only_seen or own for x in _shape(tree, k)]


def _color(model: Any, geom: int) -> np.ndarray:
    material = int(model.geom_matid[geom])
    return model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]


def _shape(tree: Tree, geom: int) -> list[AbstractShape]:
    model = tree.model
    kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    body = tree.place(int(model.geom_bodyid[geom]))
    turned = rotation_matrix("a shape", model.geom_quat[geom])
    place = Place(body.body, body.rotation @ turned, body.point(model.geom_pos[geom]))
    look = dict(color=tuple(float(x) for x in _color(model, geom)))
    pose = place.origin, place.rotation
    size = model.geom_size[geom].copy()
    if kind == "sphere":
        return [Sphere(size[0], place.origin, **look)]
    if kind == "box":
        return [Box(2 * size, *pose, **look)]
    if kind == "cylinder":
        return [Cylinder(size[0], 2 * size[1], *pose, **look)]
    if kind == "capsule":
        return [Capsule(size[0], 2 * size[1], *pose, **look)]
    if kind == "ellipsoid":
        return [Mesh(*_ellipsoid(size), *pose, **look)]
    if kind == "plane":
        sides = np.where(size[:2] > 0, 2 * size[:2], _FLOOR * model.stat.extent)
        thick = _THIN * sides.max()
        top = place.origin - 0.5 * thick * place.rotation[:, 2]
        return [Box([*sides, thick], top, place.rotation, **look)]
    if kind == "hfield":
        return [Mesh(*_field(model, int(model.geom_dataid[geom])), *pose, **look)]
    mesh = int(model.geom_dataid[geom])  # of a mesh or a signed distance field
    return [Mesh(*_mesh(model, mesh), *pose, **look)] if mesh >= 0 else []


def _mesh(model: Any, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    first, face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[face : face + model.mesh_facenum[mesh]]
    return vertices.astype(float), faces.copy()


def _ellipsoid(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    height = np.linspace(-np.pi / 2, np.pi / 2, 2 * _POINTS + 1)
    turn = np.linspace(0, 2 * np.pi, 4 * _POINTS + 1)
    up, around = np.meshgrid(height, turn, indexing="ij")
    points = np.stack(
        [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]
    )
    return size * points.reshape(3, -1).T, _faces(*up.shape)


def _field(model: Any, field: int) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a height field."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    half_x, half_y, high, _ = model.hfield_size[field]
    first = int(model.hfield_adr[field])
    heights = high * model.hfield_data[first : first + rows * columns]
    y, x = np.meshgrid(
        np.linspace(-half_y, half_y, rows),
        np.linspace(-half_x, half_x, columns),
        indexing="ij",
    )
    return np.stack([x.ravel(), y.ravel(), heights], axis=1), _faces(rows, columns)


def _faces(rows: int, columns: int) -> np.ndarray:
    """The triangles of a grid of points."""
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    halves = [np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]
    return np.concatenate([half.reshape(-1, 3) for half in halves])
