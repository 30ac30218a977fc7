"""Rigid bodies in space, with their body axes (the directors) as coordinates."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..._programs import Indices
from ..._solvers import hessian
from ..._types import Scalar, Velocities
from .plain import AbstractPlainKinematics
from .rigid_bodies import RigidBodies
from .rotations import RigidKinematics


class DirectorKinematics(AbstractPlainKinematics):
    """`v = qdot`, with six constraints between the directors of each body.

    - `table`: the indices of the coordinates of each body, shape `(bodies, 12)`; see
      `body_table`.
    """

    table: Indices = eqx.field(static=True)

    def has_inertia(self, energy, inertia):
        return self._rotations(inertia.shape[0]).has_inertia(energy, inertia)

    def with_rotations(self, q):
        return self._rotations(q.size)

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

    def _rotations(self, num_coordinates: int) -> RigidKinematics:
        return RigidKinematics(_bodies(self.table, num_coordinates))


@functools.lru_cache(maxsize=32)
def _bodies(table: Indices, num_coordinates: int) -> RigidBodies:
    return RigidBodies(table.array, num_coordinates)
