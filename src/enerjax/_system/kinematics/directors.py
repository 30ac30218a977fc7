"""Rigid bodies in space, with their body axes (the directors) as coordinates."""

import functools

import equinox as eqx

from ..._programs import Indices
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

    def _rotations(self, num_coordinates: int) -> RigidKinematics:
        return RigidKinematics(_bodies(self.table, num_coordinates))


@functools.lru_cache(maxsize=32)
def _bodies(table: Indices, num_coordinates: int) -> RigidBodies:
    return RigidBodies(table.array, num_coordinates)
