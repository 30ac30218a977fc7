"""Rigid bodies in the plane, with the mass centre and an angle as coordinates.

The velocities of a body are the rates of its coordinates. A step has three unknowns, a
translation and a number `Theta`, which turns the body by the angle

    theta_b - theta_a = 2 atan(t),   t = Theta/2

This is Cayley's rotation, as in space: with an axis `d` of the body, its mean `dm` at both
ends, and the rotation `J` by a right angle, `d_b - d_a = Theta J dm` exactly. So a point of
the body moves by its mean lever times `Theta`, and a gradient `D_theta` in the angle that
satisfies the chain rule for difference quotients has the torque

    D_theta (theta_b - theta_a) / Theta = D_theta atan(t)/t,

which is that of the forces at the mean lever. Its product with `Theta` is the change of the
energy, and the torques of a function that rotations do not change vanish together, so that
energy and angular momentum are conserved. (With a step in the angle itself the torque is
`D_theta`, which differs from that of the forces by a factor `1 + t^2/3 + ...`.) As the mean
of `omega` times `h` is `Theta`, a body that turns freely is late by `(h omega)^2/12` of its
angle.

Rates of the axes, which enter constraints at velocity level, have rules of their own; see
`_discrete/rotations.py`.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..._discrete import ANGLE, elementary, OTHER, RotationRule
from ..._programs import at_places, Indices
from ..._types import Increments
from .base import AbstractAddedKinematics
from .plain import AbstractIndependentKinematics
from .rigid_bodies import check_indices, joined


class AbstractPlanarKinematics(AbstractIndependentKinematics):
    """`v = qdot` of bodies in the plane.

    - `table`: the indices of the coordinates of each body, shape `(bodies, 3)`; see
      `body_table`.
    """

    table: eqx.AbstractVar[Indices]

    def has_inertia(self, energy, inertia):
        # The mass of a body is the same along both axes, and turning it moves no mass
        # centre: the energy stays the same if all mass centres move across their velocity.
        dtype, size = inertia.dtype, inertia.shape[0]
        probe = jnp.cos(jnp.arange(1, size + 1, dtype=dtype))
        table = self.table.array
        check_indices(table, size)
        across, signs = np.arange(size), np.ones(size)
        across[table[:, :2]] = table[:, 1::-1]
        signs[table[:, 0]] = -1
        other = jnp.asarray(signs, dtype) * probe[across]
        bound = jnp.abs(probe) + jnp.abs(other)
        size = bound @ (inertia.diagonal() * bound)
        return jnp.abs(energy(probe) - energy(other)) <= 1e3 * jnp.finfo(dtype).eps * size


class PlanarKinematics(AbstractPlanarKinematics, AbstractAddedKinematics):
    """Bodies in the plane with steps in their angles."""

    table: Indices = eqx.field(static=True)

    def with_rotations(self, q, dimensions):
        return PlanarRotations(self.table) if 2 in dimensions else self


class PlanarRotations(AbstractPlanarKinematics):
    """Bodies in the plane, which a step turns by Cayley's rotation."""

    table: Indices = eqx.field(static=True)

    def with_rotations(self, q, dimensions):
        return self

    def displacement(self, q, step):
        table = self.table.array
        others = np.setdiff1d(np.arange(step.size), table)
        bodies = at_places(step, table)
        turned = 2 * jnp.arctan(0.5 * bodies[:, 2:])
        moved = jnp.concatenate([bodies[:, :2], turned], axis=1).ravel()
        return joined(moved, table, at_places(step, others), others)

    def pull_back(self, qa, qb, step, gradient):
        half = self._half_turns(step)
        return gradient * elementary.angle_ratio(half, jnp.ones_like(half))

    def chain_rule(self, step):
        return RotationRule(self._kinds(step.size), self._half_turns(step))

    def _half_turns(self, step: Increments) -> Increments:
        """`Theta/2` of the angles, and zeros for all other coordinates."""
        # All formulas are the identity where this is zero, so nothing is put together.
        weights = np.zeros(step.size)
        weights[self.table.array[:, 2]] = 0.5
        return jnp.asarray(weights, step.dtype) * step

    def _kinds(self, size: int) -> Indices:
        kinds = np.full(size, OTHER)
        kinds[self.table.array[:, 2]] = ANGLE
        return Indices(kinds)
