"""The linear map `L` in `v = L(q) qdot`, its transpose and its inverse.

The inverse `qdot = L^+ v`, which is called `lift`, solves `L qdot = v` together with
`B_c qdot = 0`, where `B_c` is the Jacobian of the coordinate constraints.
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
from .._types import Args, Coordinates, Velocities


class AbstractKinematics(eqx.Module):
    """The map `L(q)` from rates of coordinates to velocities, `nv x nq`."""

    @abc.abstractmethod
    def with_blocks(
        self,
        q: Coordinates,
        coordinate: Callable[[Coordinates], Float[Array, " ncc"]],
        args: Args,
    ) -> "AbstractKinematics":
        """The same map, with the independent blocks of `L` stacked on `B_c`."""

    @abc.abstractmethod
    def push(self, q: Coordinates, rate: Coordinates, args: Args) -> Velocities:
        """`L(q) rate`"""

    @abc.abstractmethod
    def pull(self, q: Coordinates, momentum: Velocities, args: Args) -> Coordinates:
        """`L(q)^T momentum`"""

    @abc.abstractmethod
    def lift(
        self,
        q: Coordinates,
        v: Velocities,
        coordinate_jacobian: Callable[[Coordinates], Float[Array, "ncc nq"]],
        args: Args,
    ) -> Coordinates:
        """`L(q)^+ v`"""

    @abc.abstractmethod
    def gyroscopic(
        self, q: Coordinates, momentum: Velocities, dq: Coordinates, args: Args
    ) -> Coordinates | None:
        """`G(q, momentum) dq`, or `None` if `L` does not depend on `q`."""


class IdentityKinematics(AbstractKinematics):
    """`v = qdot`: point masses, minimal coordinates with constant inertia."""

    def with_blocks(self, q, coordinate, args):
        return self

    def push(self, q, rate, args):
        return rate

    def pull(self, q, momentum, args):
        return momentum

    def lift(self, q, v, coordinate_jacobian, args):
        return v

    def gyroscopic(self, q, momentum, dq, args):
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

    def push(self, q, rate, args):
        matrix = self.matrix(q, args)
        if self.blocks is None:
            return matrix @ rate
        square = jnp.pad(matrix, ((0, q.size - len(matrix)), (0, 0)))
        return multiply_by_blocks(self.blocks, square, rate)[: len(matrix)]

    def pull(self, q, momentum, args):
        if self.blocks is None:
            return momentum @ self.matrix(q, args)
        _, pull = jax.vjp(lambda rate: self.push(q, rate, args), jnp.zeros_like(q))
        return pull(momentum)[0]

    def lift(self, q, v, coordinate_jacobian, args):
        square = jnp.concatenate([self.matrix(q, args), coordinate_jacobian(q)])
        return solve_by_blocks(self.blocks, square, jnp.pad(v, (0, q.size - v.size)))

    def gyroscopic(self, q, momentum, dq, args):
        # G_ij = sum_k mu_k (dL_ki/dq_j - dL_kj/dq_i), paper eq. (11), so G dq is the change
        # of L^T mu along dq minus the gradient of mu . L dq.
        _, along = jax.jvp(lambda x: self.pull(x, momentum, args), (q,), (dq,))
        return along - jax.grad(lambda x: momentum @ self.push(x, dq, args))(q)
