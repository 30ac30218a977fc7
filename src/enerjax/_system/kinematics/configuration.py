"""Velocities that are a linear map, given by the user, of the rates of the coordinates."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._programs import jacobian_pattern
from ..._solvers import (
    as_dense,
    constant_entries,
    independent_blocks,
    IndependentBlocks,
    is_positive_definite,
    multiply_by_blocks,
)
from ..._types import Args, Coordinates, Increments, Velocities
from .base import AbstractAddedKinematics, Frames


class ConfigurationKinematics(AbstractAddedKinematics):
    """`v = L(q) qdot` with a user's function `L(q, args)`: bodies that rotate."""

    matrix: Callable[[Coordinates, Args], Float[Array, "nv nq"]]
    # The independent blocks of `L` stacked on `B_c`, if there are several.
    blocks: IndependentBlocks | None = eqx.field(static=True, default=None)

    @property
    def has_canonical_rates(self):
        return False

    def has_inertia(self, energy, inertia):
        return jnp.array(True)

    def is_definite(self, inertia, rounding):
        return is_positive_definite(inertia)

    def is_regular(self, inertia, rounding):
        return jnp.array(True)

    def describe(self, q, v):
        return f"{q.size} coordinates with {v.size} velocities v = L(q) qdot"

    def with_rotations(self, q, dimensions):
        return self

    def with_blocks(self, q, relations, args):
        of_rates = constant_entries(lambda inputs: self.matrix(*inputs), (q, args))
        of_relations = jacobian_pattern(lambda q: relations(q), q)
        if of_rates is None or of_relations is None:
            return self
        of_relations = np.where(of_relations.toarray(), np.nan, 0)
        blocks = independent_blocks(np.concatenate([of_rates, of_relations]))
        return ConfigurationKinematics(self.matrix, blocks)

    def constraint(self, q):
        return q[:0]

    def regular_inertia(self, q, inertia):
        return inertia

    def metric(self, q, inertia, relations, args):
        # It is `L^T M L + m sum_i b_i b_i^T`, with the normalised gradients `b_i` of the
        # coordinate constraints. `m` is the mean inertia of a coordinate, so the result
        # does not depend on the units of the constraints.
        pull = jax.vmap(self.momentum_rows, in_axes=(None, 0, None))
        metric = pull(q, pull(q, as_dense(inertia), args).T, args)
        rows = jax.jacfwd(relations)(q)
        unit = rows / jnp.linalg.norm(rows, axis=1, keepdims=True)
        return metric + jnp.trace(metric) / q.size * (unit.T @ unit)

    def velocity_scale(self, inertia):
        return jnp.sqrt(inertia.diagonal())

    def step_scale(self, q, inertia, relations, args):
        return jnp.sqrt(self.metric(q, inertia, relations, args).diagonal())

    def frames(self, q, jacobian, args):
        matrix = jnp.concatenate([self.matrix(q, args), jacobian(q)])
        return Frames(self.blocks, matrix)

    def push(self, qa, qb, step, args):
        return self._push(0.5 * (qa + qb), step, args)

    def pull(self, qa, qb, force, args):
        return self.momentum_rows(0.5 * (qa + qb), force, args)

    def rates(self, q, v, jacobian, args):
        return self.lift(q, v, jacobian, args)

    def lift(self, q, v, jacobian, args):
        frames = self.frames(q, jacobian, args)
        return frames.rates(jnp.pad(v, (0, q.size - v.size)))

    def momentum_rows(self, q, momentum, args):
        if self.blocks is None:
            return momentum @ self.matrix(q, args)
        _, pull = jax.vjp(lambda step: self._push(q, step, args), jnp.zeros_like(q))
        return pull(momentum)[0]

    def by_inertia(self, q, change, inertia, args):
        return self.momentum_rows(q, inertia @ self._push(q, change, args), args)

    def momentum_change(self, qa, qb, change, mean, step, args):
        middle = 0.5 * (qa + qb)
        rows = self.momentum_rows(middle, change, args)
        return rows + self.gyroscopic(middle, mean, step, args)

    def gyroscopic(self, q, momentum, rates, args):
        # G_ij = sum_k mu_k (dL_ki/dq_j - dL_kj/dq_i), paper eq. (11), so G dq is the change
        # of L^T mu along dq minus the gradient of mu . L dq.
        pulled = lambda x: self.momentum_rows(x, momentum, args)
        _, along = jax.jvp(pulled, (q,), (rates,))
        return along - jax.grad(lambda x: momentum @ self._push(x, rates, args))(q)

    def _push(self, q: Coordinates, step: Increments, args: Args) -> Velocities:
        matrix = self.matrix(q, args)
        if self.blocks is None:
            return matrix @ step
        square = jnp.pad(matrix, ((0, q.size - len(matrix)), (0, 0)))
        return multiply_by_blocks(self.blocks, square, step)[: len(matrix)]
