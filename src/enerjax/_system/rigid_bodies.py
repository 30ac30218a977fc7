"""Rigid bodies in space, which a step moves by a translation and a rotation.

A body has twelve coordinates: its mass centre `x` and its axes `d_i = R e_i`, the
directors. Its velocities in a step are `xdot` and the angular velocity `W` in body axes. A
step has six unknowns, a translation and a rotation vector `Theta` in body axes, and the
rotation is Cayley's:

    R_b = R_a cay(t),   cay(t) = (I - t^)^-1 (I + t^),   t = Theta/2

It leaves the directors orthonormal, so they need no constraints. With `dm_i`, the mean of a
director at both ends, and the rotation vector in space, `theta = R_a Theta = R_b Theta`,

    d_i_b - d_i_a = theta x dm_i

exactly. A gradient `D` of any function of the directors, with `D . (q_b - q_a)` equal to
the difference of its values, therefore has the torque `sum dm_i x D_i`: its product with
`theta` is that difference, and it vanishes for a function that rotations do not change, so
that energy and angular momentum are conserved (J. C. Simo and K. K. Wong, Int. J. Numer.
Methods Eng. 31 (1991) 19-52). The change of momentum is that of `R J W` in space. All rows
are in the axes of the body at the start of the step.

Vectors are lists of three components, which are arrays with an entry for each body. Written
in components, the formulas below compile to a single loop over the bodies. With arrays of
vectors XLA would compute the operands of each vector product several times.
"""

import itertools
from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import Indices
from .._types import Coordinates, Increments, Velocities
from .kinematics import AbstractKinematics


Component: TypeAlias = Float[Array, " bodies"]
Vector3: TypeAlias = Sequence[Component]
# The mass centre and the three directors of all bodies, or their rates, or gradients.
Pose: TypeAlias = Sequence[Vector3]


def body_table(rigid_bodies: Any) -> Indices:
    """The checked indices of the coordinates of rigid bodies, shape `(bodies, 12)`."""
    table = np.asarray(rigid_bodies)
    if table.ndim != 2 or table.shape[1] != 12 or table.dtype.kind not in "iu":
        raise ValueError(
            "`System(rigid_bodies=...)` must hold the indices of the twelve coordinates of "
            "each body (its mass centre, then its three axes), integers of shape "
            f"(bodies, 12); got shape {table.shape} of {table.dtype}."
        )
    if table.min(initial=0) < 0 or np.unique(table).size != table.size:
        raise ValueError(
            "`System(rigid_bodies=...)`: indices start from 0, and no coordinate belongs "
            "to two bodies or twice to one."
        )
    return Indices(table)


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
        return _vectors(_entries(q, self.q).reshape(-1, 12))

    def vectors(self, v: Velocities) -> tuple[Vector3, Vector3]:
        """The translational and the rotational parts of the velocities."""
        moved, turned = _vectors(_entries(v, self.v).reshape(-1, 6))
        return moved, turned

    def coordinates(self, pose: Pose, others: Float[Array, " n"]) -> Coordinates:
        """The inverse of `pose`, with the values of the other coordinates."""
        return _joined(_rows(pose), self.q, others, self.other_q)

    def velocities(
        self, moved: Vector3, turned: Vector3, others: Float[Array, " n"]
    ) -> Velocities:
        """The inverse of `vectors`, with the values of the other velocities."""
        return _joined(_rows((moved, turned)), self.v, others, self.other_v)

    def others(self, q: Coordinates) -> Float[Array, " n"]:
        """The coordinates that belong to no rigid body."""
        return _entries(q, self.other_q)

    def other_rates(self, v: Velocities) -> Float[Array, " n"]:
        """The velocities that belong to no rigid body."""
        return _entries(v, self.other_v)

    def internal(self, q: Coordinates) -> Float[Array, " 6*bodies"]:
        """The products of the directors less those of orthonormal ones, body by body."""
        axes = _entries(q, self.q).reshape(-1, 4, 3)[:, 1:]
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


def _entries(x: Array, index: np.ndarray) -> Array:
    """`x[index]`, which is a slice if the indices are consecutive."""
    flat = index.ravel()
    if flat.size == 0:
        return x[:0]
    if np.array_equal(flat, np.arange(flat[0], flat[0] + flat.size)):
        return x[flat[0] : flat[0] + flat.size]
    return x[flat]


def _vectors(rows: Float[Array, "bodies n"]) -> list[Vector3]:
    columns = [rows[:, k] for k in range(rows.shape[1])]
    return [columns[k : k + 3] for k in range(0, len(columns), 3)]


def _rows(vectors: Sequence[Vector3]) -> Float[Array, " bodies*n"]:
    return jnp.stack(list(itertools.chain(*vectors)), axis=1).ravel()


def _joined(x: Array, at: np.ndarray, y: Array, others: np.ndarray) -> Array:
    """The entries of `x` at the indices `at`, and those of `y` at `others`."""
    places = np.concatenate([at.ravel(), others])
    both = x if others.size == 0 else jnp.concatenate([x, y])
    if np.array_equal(places, np.arange(places.size)):
        return both
    return both[np.argsort(places)]


class RigidKinematics(AbstractKinematics):
    """`v = (xdot, W)` of rigid bodies; the other velocities are rates of coordinates."""

    bodies: RigidBodies = eqx.field(static=True)

    def with_blocks(self, q, coordinate, args):
        return self

    def frames(self, q, coordinate_jacobian, args):
        return None

    def displacement(self, q, step):
        bodies, (_, *axes) = self.bodies, self.bodies.pose(q)
        moved, turned = bodies.vectors(step)
        half = scaled(0.5, turned)
        once = rates_of_directors(axes, half)
        twice = rates_of_directors(once, half)
        factor = 2 / (1 + dot(half, half))
        change = [scaled(factor, added(x, y)) for x, y in zip(once, twice, strict=True)]
        return bodies.coordinates([moved, *change], bodies.other_rates(step))

    def pull_back(self, qa, qb, gradient):
        bodies, (force, *torques) = self.bodies, self.bodies.pose(gradient)
        (_, *first), (_, *last) = bodies.pose(qa), bodies.pose(qb)
        mean = [scaled(0.5, added(x, y)) for x, y in zip(first, last, strict=True)]
        torque = in_axes(first, sum_of_products(mean, torques))
        return bodies.velocities(force, torque, bodies.others(gradient))

    def push(self, qa, qb, step, args):
        return step

    def pull(self, qa, qb, force, args):
        return self.pull_back(qa, qb, force)

    def rates(self, q, v, coordinate_jacobian, args):
        return v

    def lift(self, q, v, coordinate_jacobian, args):
        bodies, (_, *axes) = self.bodies, self.bodies.pose(q)
        moved, turned = bodies.vectors(v)
        rates = rates_of_directors(axes, turned)
        return bodies.coordinates([moved, *rates], bodies.other_rates(v))

    def velocity(self, q: Coordinates, rate: Coordinates) -> Velocities:
        """`L(q) qdot`"""
        bodies, (moved, *rates) = self.bodies, self.bodies.pose(rate)
        _, *axes = bodies.pose(q)
        spin = scaled(0.5, in_axes(axes, sum_of_products(axes, rates)))
        return bodies.velocities(moved, spin, bodies.others(rate))

    def coordinate_scale(self, step: Increments) -> Coordinates:
        """The scales of the coordinates, given the roots of the inertias of the velocities.

        That of a director is the root of the polar moment, the sum of the second moments.
        """
        bodies = self.bodies
        moved, turned = bodies.vectors(step)
        polar = jnp.sqrt(0.5 * dot(turned, turned))
        return bodies.coordinates([moved, *[[polar] * 3] * 3], bodies.other_rates(step))

    def momentum_rows(self, q, momentum, args):
        return momentum

    def momentum_change(self, qa, qb, change, mean, step, args):
        bodies = self.bodies
        half = scaled(0.5, bodies.vectors(step)[1])
        end = bodies.vectors(mean + 0.5 * change)[1]
        once = cross(half, end)
        rotated = scaled(2 / (1 + dot(half, half)), added(once, cross(half, once)))
        return change + self._rotational(rotated, change)

    def gyroscopic(self, q, momentum, rates, args):
        bodies = self.bodies
        torque = cross(bodies.vectors(rates)[1], bodies.vectors(momentum)[1])
        return self._rotational(torque, rates)

    def _rotational(self, torque: Vector3, like: Increments) -> Increments:
        """Rows with these torques, and zeros otherwise."""
        others = jnp.zeros_like(self.bodies.other_rates(like))
        return self.bodies.velocities([jnp.zeros_like(x) for x in torque], torque, others)

    # With a multiplier of `psi = Phi'(q) Y`, where `Y` are the rates of the coordinates,
    # the discrete gradients with respect to `q` and `Y` act on a rotation as follows. They
    # rest on the identity, for the rates `Y_i = R (W x e_i)` of the directors,
    #
    #     Y_i_b - Y_i_a = theta x Ym_i + Rm^-T ((W_b - W_a) x e_i),
    #
    # and the result conserves angular momentum, because it is equivariant under rotations.

    def spin_rows(
        self, qa: Coordinates, mean_rate: Coordinates, by_rate: Coordinates
    ) -> Increments:
        """The rows `sum Ym_i x S_i` of a discrete gradient `S` for the rates."""
        bodies, (_, *axes) = self.bodies, self.bodies.pose(qa)
        (_, *rates), (_, *of_rates) = bodies.pose(mean_rate), bodies.pose(by_rate)
        torque = in_axes(axes, sum_of_products(rates, of_rates))
        others = jnp.zeros_like(bodies.others(by_rate))
        return bodies.velocities([jnp.zeros_like(x) for x in torque], torque, others)

    def momentum_of_rates(
        self, qa: Coordinates, step: Increments, by_rate: Coordinates
    ) -> Velocities:
        """The momentum that a discrete gradient `S` with respect to the rates adds.

        In the rotations it is `sum e_i x Rm^-1 S_i`.
        """
        bodies, (_, *axes) = self.bodies, self.bodies.pose(qa)
        moved, *of_rates = bodies.pose(by_rate)
        half = scaled(0.5, bodies.vectors(step)[1])
        # In body axes `Rm^-1 S_i` is `y_i - t x y_i` with `y_i = R_a^T S_i`.
        y = [in_axes(axes, x) for x in of_rates]
        z = [added(x, scaled(-1.0, cross(half, x))) for x in y]
        spin = [z[1][2] - z[2][1], z[2][0] - z[0][2], z[0][1] - z[1][0]]
        return bodies.velocities(moved, spin, bodies.others(by_rate))


def added(a: Vector3, b: Vector3) -> Vector3:
    return [x + y for x, y in zip(a, b, strict=True)]


def scaled(factor: Array | float, a: Vector3) -> Vector3:
    return [factor * x for x in a]


def dot(a: Vector3, b: Vector3) -> Component:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector3, b: Vector3) -> Vector3:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def sum_of_products(a: Sequence[Vector3], b: Sequence[Vector3]) -> Vector3:
    """`sum a_i x b_i`"""
    x, y, z = (cross(a_i, b_i) for a_i, b_i in zip(a, b, strict=True))
    return added(added(x, y), z)


def in_axes(axes: Sequence[Vector3], vector: Vector3) -> Vector3:
    """The components of a vector in body axes."""
    return [dot(axis, vector) for axis in axes]


def rates_of_directors(axes: Sequence[Vector3], spin: Vector3) -> list[Vector3]:
    """The rates `R (W x e_i)` of the directors; linear in the directors."""
    combined = lambda p, a, q, b: added(scaled(p, a), scaled(-q, b))
    return [
        combined(spin[2], axes[1], spin[1], axes[2]),
        combined(spin[0], axes[2], spin[2], axes[0]),
        combined(spin[1], axes[0], spin[0], axes[1]),
    ]
