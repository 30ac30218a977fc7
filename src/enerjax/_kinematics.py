"""The linear map `L` in `v = L(q) qdot`, and what follows from it.

`lift` is the inverse that the schemes need: `qdot = L^+ v` solves `L qdot = v` together
with `B_c qdot = 0`, `B_c` the Jacobian of the coordinate constraints.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._linear import inverse
from ._types import Args, Coordinates, Velocities


class AbstractKinematics(eqx.Module):
    """The map `L(q)` from rates of coordinates to velocities, `nv x nq`."""

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
        """`G(q, momentum) dq`, or `None` where `L` does not depend on `q`."""


class IdentityKinematics(AbstractKinematics):
    """`v = qdot`: point masses, minimal coordinates with constant inertia."""

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

    def push(self, q, rate, args):
        return self.matrix(q, args) @ rate

    def pull(self, q, momentum, args):
        return momentum @ self.matrix(q, args)

    def lift(self, q, v, coordinate_jacobian, args):
        square = jnp.concatenate([self.matrix(q, args), coordinate_jacobian(q)])
        return inverse(square)[:, : v.size] @ v

    def gyroscopic(self, q, momentum, dq, args):
        # G_ij = sum_k mu_k (dL_ki/dq_j - dL_kj/dq_i), paper eq. (11), applied to dq:
        # the change of L^T mu along dq minus the gradient of mu . L dq.
        _, along = jax.jvp(lambda x: self.pull(x, momentum, args), (q,), (dq,))
        return along - jax.grad(lambda x: momentum @ self.push(x, dq, args))(q)
