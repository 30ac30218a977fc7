"""Checks and conversions of users' rotations and inertias."""

from typing import Any

import numpy as np

from .._programs import is_known, module_of
from ._arguments import number, positive
from ._frames import Numbers


def mass_and_inertia(name: str, mass: Any, inertia: Any) -> Numbers:
    """The checked mass and inertia of a body, the latter as a matrix `(3, 3)`."""
    mass = positive(f"'{name}'", "`mass`", mass)
    matrix = number(f"'{name}'", "`inertia`", inertia, (3,), (3, 3))
    if matrix.ndim == 1:
        matrix = module_of(matrix).diag(matrix)
    if is_known(matrix):
        _check_inertia(name, matrix)
    return dict(mass=mass, inertia=matrix)


def _check_inertia(name: str, matrix: np.ndarray) -> None:
    size = np.max(np.abs(matrix))
    if np.max(np.abs(matrix - matrix.T)) > 1e-9 * size:
        raise ValueError(f"`inertia` of '{name}' is not symmetric: {matrix.tolist()}.")
    moments = np.linalg.eigvalsh(matrix)
    smallest, thinnest = moments[0], moments.sum() / 2 - moments[-1]
    if smallest <= 1e-9 * size or thinnest < -1e-9 * size:
        raise ValueError(
            f"No body has the `inertia` of '{name}', principal moments {moments.tolist()}: "
            "all must be positive, and none larger than the sum of the other two. (A thin "
            "rod needs a small moment about its own axis.)"
        )


def rotation_matrix(name: str, rotation: Any) -> Any:
    """The rotation matrix of a quaternion or matrix, with body axes along its columns."""
    if rotation is None:
        return np.eye(3)
    x = number(f"'{name}'", "`rotation`", rotation, (4,), (3, 3))
    if is_known(x):
        defect = x @ x - 1 if x.ndim == 1 else x @ x.T - np.eye(3)
        mirrored = x.ndim == 2 and np.linalg.det(x) < 0
        if np.max(np.abs(defect)) > 1e-6 or mirrored:
            raise ValueError(
                f"`rotation` of '{name}' is no rotation: give a unit quaternion (scalar "
                f"first) or an orthogonal matrix of determinant 1, got {x.tolist()}."
            )
    return x if x.ndim == 2 else _matrix_of(x)


def _matrix_of(p: Any) -> Any:
    xp = module_of(p)
    a, b, c, d = p / xp.sqrt(xp.sum(p**2))
    skew = xp.stack([0 * a, -d, c, d, 0 * a, -b, -c, b, 0 * a]).reshape(3, 3)
    return np.eye(3) + 2 * a * skew + 2 * skew @ skew


def quaternion_of(matrix: Any) -> Any:
    """The unit quaternion of a rotation matrix, scalar first."""
    xp = module_of(matrix)
    m, trace = matrix, xp.trace(matrix)
    turn = xp.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    # This is 4 p p^T, of which the column with the largest diagonal has no cancellation.
    first = xp.concatenate([(1 + trace)[None], turn])
    others = xp.concatenate([turn[:, None], m + m.T + (1 - trace) * np.eye(3)], axis=1)
    products = xp.concatenate([first[None], others])
    k = xp.argmax(xp.diagonal(products))
    return products[k] / (2 * xp.sqrt(products[k, k]))
