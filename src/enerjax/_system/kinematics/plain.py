"""Coordinates whose rates are the velocities."""

import jax.numpy as jnp

from ..._solvers import is_positive_definite
from .base import AbstractAddedKinematics, AbstractFlatKinematics


class AbstractPlainKinematics(AbstractFlatKinematics):
    """`v = qdot`, with or without constraints between the coordinates."""

    @property
    def has_canonical_rates(self):
        return True

    def describe(self, q, v):
        return f"{q.size} coordinates, whose rates are the velocities"

    def with_blocks(self, q, relations, args):
        return self

    def metric(self, q, inertia, relations, args):
        return self.regular_inertia(q, inertia)

    def step_scale(self, q, inertia, relations, args):
        return self.velocity_scale(inertia)

    def frames(self, q, jacobian, args):
        return None

    def push(self, qa, qb, step, args):
        return step

    def pull(self, qa, qb, force, args):
        return force

    def rates(self, q, v, jacobian, args):
        return v

    def lift(self, q, v, jacobian, args):
        return v

    def momentum_rows(self, q, momentum, args):
        return momentum

    def by_inertia(self, q, change, inertia, args):
        return inertia @ change

    def momentum_change(self, qa, qb, change, mean, step, args):
        return change

    def gyroscopic(self, q, momentum, rates, args):
        return None


class AbstractIndependentKinematics(AbstractPlainKinematics):
    """`v = qdot`, without constraints between the coordinates."""

    def is_definite(self, inertia, rounding):
        return is_positive_definite(inertia)

    def is_regular(self, inertia, rounding):
        return jnp.array(True)

    def constraint(self, q):
        return q[:0]

    def regular_inertia(self, q, inertia):
        return inertia

    def velocity_scale(self, inertia):
        return jnp.sqrt(inertia.diagonal())


class IdentityKinematics(AbstractIndependentKinematics, AbstractAddedKinematics):
    """Point masses, minimal coordinates with constant inertia."""

    def has_inertia(self, energy, inertia):
        return jnp.array(True)

    def with_rotations(self, q, dimensions):
        return self
