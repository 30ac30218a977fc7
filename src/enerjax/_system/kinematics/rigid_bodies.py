"""The coordinates and velocities of rigid bodies in space, as tables of indices."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._programs import at_places, Indices
from ..._types import Coordinates, Velocities
from .vectors import Axes, Vector3


# The mass centres and the directors of all bodies, or their rates, or gradients.
Pose: TypeAlias = tuple[Vector3, Axes]


def body_table(rigid_bodies: Any) -> Indices:
    """The checked indices of the coordinates of rigid bodies, shape `(bodies, 12)`, in the
    plane `(bodies, 3)`."""
    table = np.asarray(rigid_bodies)
    if table.ndim != 2 or table.shape[1] not in (3, 12) or table.dtype.kind not in "iu":
        raise ValueError(
            "`System(rigid_bodies=...)` must hold the indices of the twelve coordinates of "
            "each body (its mass centre, then its three axes), integers of shape "
            f"(bodies, 12); got shape {table.shape} of {table.dtype}. In the plane a body "
            "has three (its mass centre, then its angle), shape (bodies, 3)."
        )
    if table.min(initial=0) < 0 or np.unique(table).size != table.size:
        raise ValueError(
            "`System(rigid_bodies=...)`: indices start from 0, and no coordinate belongs "
            "to two bodies or twice to one."
        )
    return Indices(table)


def check_indices(table: np.ndarray, size: int) -> None:
    """Raises a `ValueError` if a body has coordinates that do not exist."""
    if table.max(initial=-1) >= size:
        of = "the three axes" if table.shape[1] == 12 else "the angle"
        raise ValueError(
            f"`System(rigid_bodies=...)` holds the index {table.max()}, but `q` has {size} "
            f"entries, with the indices 0 to {size - 1}. Each row holds the indices of the "
            f"mass centre and of {of} of a body."
        )


class RigidBodies(Indices):
    """The coordinates of each rigid body, and its velocities if it is moved by rotations.

    - `q`: indices of the coordinates, shape `(bodies, 12)`: those of the mass centre, then
      those of the three directors.
    - `v`: indices of the velocities `(xdot, W)`, shape `(bodies, 6)`.
    - `other_q`, `other_v`: those of the other coordinates and of their rates.

    Velocities have the order of the coordinates.
    """

    def __init__(self, table: Sequence[Sequence[int]] | np.ndarray, size: int):
        super().__init__(np.append(np.ravel(table), size))
        self.q = np.asarray(table).reshape(-1, 12)
        check_indices(self.q, size)
        self.other_q = np.setdiff1d(np.arange(size), self.q)
        firsts = np.concatenate([self.q[:, 0], self.other_q])
        counts = np.repeat([6, 1], [len(self.q), self.other_q.size])
        order = np.argsort(firsts)
        starts = np.empty(counts.size, int)
        starts[order] = np.cumsum(counts[order]) - counts[order]
        self.v = starts[: len(self.q), None] + np.arange(6)
        self.other_v = starts[len(self.q) :]
        self.num_coordinates, self.num_velocities = size, int(counts.sum())

    def pose(self, q: Coordinates) -> Pose:
        """The mass centres and directors of all bodies, or their rates or gradients."""
        rows = at_places(q, self.q).T
        return rows[:3], rows[3:].reshape(3, 3, -1)

    def vectors(self, v: Velocities) -> tuple[Vector3, Vector3]:
        """The translational and the rotational parts of the velocities."""
        rows = at_places(v, self.v).T
        return rows[:3], rows[3:]

    def coordinates(self, pose: Pose, others: Float[Array, " n"]) -> Coordinates:
        """The inverse of `pose`, with the values of the other coordinates."""
        centres, axes = pose
        rows = jnp.concatenate([centres, axes.reshape(9, -1)])
        return joined(rows.T.ravel(), self.q, others, self.other_q)

    def velocities(
        self, moved: Vector3, turned: Vector3, others: Float[Array, " n"]
    ) -> Velocities:
        """The inverse of `vectors`, with the values of the other velocities."""
        rows = jnp.concatenate([moved, turned])
        return joined(rows.T.ravel(), self.v, others, self.other_v)

    def others(self, q: Coordinates) -> Float[Array, " n"]:
        """The coordinates that belong to no rigid body."""
        return at_places(q, self.other_q)

    def other_rates(self, v: Velocities) -> Float[Array, " n"]:
        """The velocities that belong to no rigid body."""
        return at_places(v, self.other_v)

    def constraint(self, q: Coordinates) -> Float[Array, " 6*bodies"]:
        """The products of the directors less those of orthonormal ones, body by body."""
        axes = at_places(q, self.q).reshape(-1, 4, 3)[:, 1:]
        products = jnp.sum(axes[:, _LEFT] * axes[:, _RIGHT], axis=2)
        return (products - jnp.asarray(_LEFT == _RIGHT, q.dtype)[None]).ravel()

    def at_rest(self, dtype: Any) -> Coordinates:
        """Coordinates with directors along the axes of space."""
        rows = np.zeros((len(self.q), 12))
        rows[:, 3:] = np.eye(3).ravel()
        q = np.zeros(self.num_coordinates)
        q[self.q] = rows
        return jnp.asarray(q, dtype)


# The six pairs of the three directors.
_LEFT, _RIGHT = np.array([0, 1, 2, 1, 2, 0]), np.array([0, 1, 2, 2, 0, 1])


def joined(x: Array, at: np.ndarray, y: Array, others: np.ndarray) -> Array:
    """The entries of `x` at the indices `at`, and those of `y` at `others`."""
    places = np.concatenate([at.ravel(), others])
    both = x if others.size == 0 else jnp.concatenate([x, y])
    return at_places(both, np.argsort(places))
