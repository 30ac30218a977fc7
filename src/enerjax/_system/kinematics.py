"""Kinds of coordinates: how velocities and the increments of a step move them.

A step from `q_a` to `q_b` has the unknowns `step`, a displacement. A kind of coordinates
consists of four maps:

- the displacement `q_b - q_a = P step`, where `P` may depend on `q_a` and `step`, so that
  `q_b` is a retraction of the step; the transpose of `P` pulls gradients with
  respect to `q` back to the rows of the step equations;
- the velocity `Lm step`, which is the mean velocity of the step times its duration;
- the change of momentum in these rows, such that its product with `step` is the change of
  the kinetic energy.

For plain coordinates all of them are trivial. Bodies in space whose increments are
rotations have their own file, `rigid_bodies.py`.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import jacobian_pattern
from .._solvers import (
    constant_entries,
    independent_blocks,
    IndependentBlocks,
    multiply_by_blocks,
    solve_by_blocks,
)
from .._types import Args, Coordinates, Increments, Velocities


class Frames(eqx.Module):
    """The invertible matrix of `L` stacked on `B_c` at one position, shape `(nq, nq)`.

    It maps rates of coordinates to velocities and to the rates of the coordinate
    constraints.
    """

    blocks: IndependentBlocks | None = eqx.field(static=True)
    matrix: Float[Array, "nq nq"]

    def rates(self, motion: Float[Array, " nq"]) -> Coordinates:
        """The rates of the coordinates of velocities and rates of the constraints."""
        return solve_by_blocks(self.blocks, self.matrix, motion)

    def forces(self, rows: Coordinates) -> Float[Array, " nq"]:
        """The transpose of `rates`."""
        _, transpose = jax.vjp(self.rates, rows)
        return transpose(rows)[0]


class AbstractKinematics(eqx.Module):
    """A kind of coordinates `q` with velocities `v = L(q) qdot`."""

    @abc.abstractmethod
    def with_blocks(
        self,
        q: Coordinates,
        coordinate: Callable[[Coordinates], Float[Array, " ncc"]],
        args: Args,
    ) -> "AbstractKinematics":
        """The same map, with the independent blocks of `L` stacked on `B_c`."""

    @abc.abstractmethod
    def frames(
        self,
        q: Coordinates,
        coordinate_jacobian: Callable[[Coordinates], Float[Array, "ncc nq"]],
        args: Args,
    ) -> Frames | None:
        """`L` stacked on `B_c`; `None` if coordinates are not redundant."""

    @abc.abstractmethod
    def displacement(self, q: Coordinates, step: Increments) -> Coordinates:
        """`P step`, the change of the coordinates in a step from `q`."""

    @abc.abstractmethod
    def pull_back(
        self, qa: Coordinates, qb: Coordinates, gradient: Coordinates
    ) -> Increments:
        """`P^T gradient`, the rows of a gradient with respect to the coordinates."""

    @abc.abstractmethod
    def push(
        self, qa: Coordinates, qb: Coordinates, step: Increments, args: Args
    ) -> Velocities:
        """`Lm step`, the mean velocity of a step times its duration."""

    @abc.abstractmethod
    def pull(
        self, qa: Coordinates, qb: Coordinates, force: Velocities, args: Args
    ) -> Increments:
        """The rows of a force that is conjugate to the velocities of the user."""

    @abc.abstractmethod
    def rates(
        self,
        q: Coordinates,
        v: Velocities,
        coordinate_jacobian: Callable[[Coordinates], Float[Array, "ncc nq"]],
        args: Args,
    ) -> Increments:
        """The steps per time, for steps of zero length, of a motion with velocity `v`."""

    @abc.abstractmethod
    def lift(
        self,
        q: Coordinates,
        v: Velocities,
        coordinate_jacobian: Callable[[Coordinates], Float[Array, "ncc nq"]],
        args: Args,
    ) -> Coordinates:
        """`L(q)^+ v`, the rates of the coordinates.

        It solves `L qdot = v` together with `B_c qdot = 0`, where `B_c` is the Jacobian of
        the coordinate constraints.
        """

    @abc.abstractmethod
    def momentum_rows(self, q: Coordinates, momentum: Velocities, args: Args) -> Increments:
        """The rows of a momentum at a position."""

    @abc.abstractmethod
    def momentum_change(
        self,
        qa: Coordinates,
        qb: Coordinates,
        change: Velocities,
        mean: Velocities,
        step: Increments,
        args: Args,
    ) -> Increments:
        """The rows of the change of momentum in a step, including gyroscopic terms.

        `change` and `mean` are the difference and the mean of the momenta at the ends.
        """

    @abc.abstractmethod
    def gyroscopic(
        self, q: Coordinates, momentum: Velocities, rates: Increments, args: Args
    ) -> Increments | None:
        """The rows of the rate of change of momentum at constant velocities, or `None`."""


class IdentityKinematics(AbstractKinematics):
    """`v = qdot`: point masses, minimal coordinates with constant inertia."""

    def with_blocks(self, q, coordinate, args):
        return self

    def frames(self, q, coordinate_jacobian, args):
        return None

    def displacement(self, q, step):
        return step

    def pull_back(self, qa, qb, gradient):
        return gradient

    def push(self, qa, qb, step, args):
        return step

    def pull(self, qa, qb, force, args):
        return force

    def rates(self, q, v, coordinate_jacobian, args):
        return v

    def lift(self, q, v, coordinate_jacobian, args):
        return v

    def momentum_rows(self, q, momentum, args):
        return momentum

    def momentum_change(self, qa, qb, change, mean, step, args):
        return change

    def gyroscopic(self, q, momentum, rates, args):
        return None


class ConfigurationKinematics(AbstractKinematics):
    """`v = L(q) qdot` with a user's function `L(q, args)`: bodies that rotate."""

    matrix: Callable[[Coordinates, Args], Float[Array, "nv nq"]]
    # The independent blocks of `L` stacked on `B_c`, if there are several.
    blocks: IndependentBlocks | None = eqx.field(static=True, default=None)

    def with_blocks(self, q, coordinate, args):
        of_rates = constant_entries(lambda inputs: self.matrix(*inputs), (q, args))
        relations = jacobian_pattern(lambda q: coordinate(q), q)
        if of_rates is None or relations is None:
            return self
        of_relations = np.where(relations.toarray(), np.nan, 0)
        blocks = independent_blocks(np.concatenate([of_rates, of_relations]))
        return ConfigurationKinematics(self.matrix, blocks)

    def frames(self, q, coordinate_jacobian, args):
        matrix = jnp.concatenate([self.matrix(q, args), coordinate_jacobian(q)])
        return Frames(self.blocks, matrix)

    def displacement(self, q, step):
        return step

    def pull_back(self, qa, qb, gradient):
        return gradient

    def push(self, qa, qb, step, args):
        return self._push(0.5 * (qa + qb), step, args)

    def pull(self, qa, qb, force, args):
        return self.momentum_rows(0.5 * (qa + qb), force, args)

    def rates(self, q, v, coordinate_jacobian, args):
        return self.lift(q, v, coordinate_jacobian, args)

    def lift(self, q, v, coordinate_jacobian, args):
        frames = self.frames(q, coordinate_jacobian, args)
        return frames.rates(jnp.pad(v, (0, q.size - v.size)))

    def momentum_rows(self, q, momentum, args):
        if self.blocks is None:
            return momentum @ self.matrix(q, args)
        _, pull = jax.vjp(lambda step: self._push(q, step, args), jnp.zeros_like(q))
        return pull(momentum)[0]

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
