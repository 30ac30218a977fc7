"""Rigid bodies in space, with their body axes (the directors) as coordinates."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._programs import Indices
from ..._solvers import hessian, is_positive_definite, Symmetric
from ..._types import Flag, Scalar, Velocities
from .base import AbstractAddedKinematics
from .plain import AbstractPlainKinematics
from .rigid_bodies import RigidBodies
from .rotations import RigidKinematics


class DirectorKinematics(AbstractPlainKinematics, AbstractAddedKinematics):
    """`v = qdot`, with six constraints between the directors of each body.

    - `table`: the indices of the coordinates of each body, shape `(bodies, 12)`; see
      `body_table`.
    """

    table: Indices = eqx.field(static=True)

    def has_inertia(self, energy, inertia):
        return self._rotations(inertia.shape[0]).has_inertia(energy, inertia)

    def is_definite(self, inertia, rounding):
        # One of the second moments may be zero: that along the axis of a flat body.
        margins = np.zeros(inertia.shape[0])
        margins[_bodies(self.table, inertia.shape[0]).q[:, 3:]] = rounding
        second, size = self._second_moments(inertia)
        return is_positive_definite(inertia, margins) & _is_positive_definite(
            (1 - rounding) * size - second
        )

    def is_regular(self, inertia, rounding):
        second, size = self._second_moments(inertia)
        return _is_positive_definite(second - rounding * size)

    def with_rotations(self, q, dimensions):
        return self._rotations(q.size) if 3 in dimensions else self

    def constraint(self, q):
        return _bodies(self.table, q.size).constraint(q)

    def regular_inertia(self, q, inertia):
        # A flat body has no inertia along one of its axes. The constraints forbid motions
        # along an axis, and between two of them, so these may have any inertia: the mean of
        # the axes.
        bodies = _bodies(self.table, q.size)
        axes = bodies.q[:, 3:]
        mean = jnp.repeat(jnp.mean(inertia.diagonal()[axes], axis=1), 6)

        def energy(v: Velocities) -> Scalar:
            rates = jax.jvp(self.constraint, (q,), (v,))[1]
            return 0.5 * (v @ inertia @ v + jnp.sum(mean * rates**2))

        together = np.arange(q.size)
        together[axes] = axes[:, :1]
        return hessian(energy, jnp.zeros_like(q), together)

    def velocity_scale(self, inertia):
        # An axis without inertia, as a flat body has, moves with the other axes.
        masses = inertia.diagonal()
        axes = _bodies(self.table, masses.size).q[:, 3:]
        together = np.repeat(np.arange(masses.size)[:, None], axes.shape[1], axis=1)
        together[axes] = axes[:, None]
        mean = jnp.mean(masses[together], axis=1)
        return jnp.sqrt(jnp.maximum(masses, 1e-3 * mean))

    def _second_moments(
        self, inertia: Symmetric
    ) -> tuple[Float[Array, "bodies 3 3"], Float[Array, "bodies 3 3"]]:
        """The second moments of the mass of each body in its axes, and their sum times the
        identity."""
        # All components of an axis have the same ones.
        axes = _bodies(self.table, inertia.shape[0]).q[:, 3::3]
        seeds = np.zeros((3, inertia.shape[0]))
        seeds[np.arange(3), axes] = 1
        columns = [inertia @ jnp.asarray(seed, inertia.dtype) for seed in seeds]
        moments = jnp.stack([column[axes] for column in columns], axis=2)
        trace = jnp.trace(moments, axis1=1, axis2=2)
        return moments, trace[:, None, None] * jnp.eye(3, dtype=inertia.dtype)[None]

    def _rotations(self, num_coordinates: int) -> RigidKinematics:
        return RigidKinematics(_bodies(self.table, num_coordinates))


@functools.lru_cache(maxsize=32)
def _bodies(table: Indices, num_coordinates: int) -> RigidBodies:
    return RigidBodies(table.array, num_coordinates)


def _is_positive_definite(matrices: Float[Array, "bodies 3 3"]) -> Flag:
    return jnp.all(jnp.isfinite(jnp.linalg.cholesky(matrices)))
