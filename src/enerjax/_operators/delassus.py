"""The Delassus matrix `G = B M^-1 B^T`, by which multipliers are found."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._solvers import Schur, Symmetric
from .._system import Frames
from .._types import Increments, JointMultipliers, Multipliers, Velocities
from .interval import Increment


class Reduced(NamedTuple):
    """The rows of one node without the coordinate constraints.

    - `rows`: the balance of momentum for the velocities, and the joints.
    - `relations`: the rows of the coordinate constraints.
    - `normal`: the components of the balance of momentum in their directions.
    """

    rows: Increment
    relations: Array
    normal: Array


class DelassusMatrix(eqx.Module):
    """Products and solves with the gradients `C` of all joints at one position.

    Gradients are with respect to velocities, so that `G = C M^-1 C^T`.

    - `inverse_inertia`: `M^-1`.
    - `schur`: `C`, and the factors of `G`. If coordinates are redundant, it has further
      columns for the rates of the coordinate constraints, with a weight of zero. `None` if
      there are no joints.
    - `frames`: the map to the rates of redundant coordinates; `None` if there are none.
    - `regularisation`: the diagonal matrix `E` that has been added to `G` before it was
      factorised, where joints may be redundant; else `None`.
    - `elastic`: the same as `schur` with the rows of strains and dampers behind those of
      the joints; see `elastic.py`. `None` where these are omitted.
    - `num_strains`: the number of the rows of strains; those of dampers follow.
    """

    inverse_inertia: Symmetric
    schur: Schur | None
    frames: Frames | None
    regularisation: JointMultipliers | None = None
    elastic: Schur | None = None
    num_strains: int = eqx.field(default=0, static=True)

    def product(self, velocity: Velocities) -> Multipliers:
        """`C velocity`, the rates of change of the joints."""
        if self.schur is None:
            return velocity[:0]
        rest = self.schur.tables.transposed.shape[0] - velocity.size
        return self.schur.product(jnp.pad(velocity, (0, rest)) if rest else velocity)

    def force(self, impulses: Multipliers) -> Velocities:
        """`C^T impulses`"""
        count = self.inverse_inertia.shape[0]
        if self.schur is None:
            return jnp.zeros((count,), impulses.dtype)
        return self.schur.transposed(impulses)[:count]

    def velocity(self, impulses: Multipliers) -> Velocities:
        """`M^-1 C^T impulses`, the velocities that impulses of the joints cause."""
        return self.inverse_inertia @ self.force(impulses)

    def solve(self, right: Float[Array, "k nc"]) -> Float[Array, "k nc"]:
        """`G^-1` times each of `k` vectors.

        Where `G` may be singular it is `(G + E)^-1 G (G + E)^-1` instead, which is nearly
        the inverse in the range of `G`, and zero in its null space: `(G + E)^-1` would
        divide round-off there by a small number.
        """
        return right if self.schur is None else self._solve(self.schur, right)

    def _solve(self, schur: Schur, right: Float[Array, "k n"]) -> Float[Array, "k n"]:
        found, added = schur.solve(right), self.regularisation
        if added is None:
            return found
        added = jnp.pad(added, (0, right.shape[1] - added.size))
        return found - schur.solve(added[None] * found)

    def motion(
        self, free: Velocities, rates: JointMultipliers, *others: JointMultipliers
    ) -> tuple[JointMultipliers, Velocities, tuple[JointMultipliers, ...]]:
        """The solutions `x` and `u` of

            (M + S^T S) u + C^T x = M free,   C u = rates

        where `S` are the rows of the strains, and `G^-1` times each of the `others`.
        """
        if self.elastic is None:
            impulse, *found = self.solve(jnp.stack([self.product(free) - rates, *others]))
            return impulse, free - self.velocity(impulse), tuple(found)
        found = self.solve(jnp.stack(others)) if others else ()
        right = self.elastic.product(free).at[: rates.size].add(-rates)
        (both,), (velocity,) = self._beside_strains(self.elastic, right[None], free[None])
        return both[: rates.size], velocity, tuple(found)

    def resisted(
        self, free: Float[Array, "k nv"], rates: Float[Array, "k nc"]
    ) -> tuple[Float[Array, "k nv"], Float[Array, "k n"]]:
        """The velocities `u` to which strains and dampers reduce each of `k` velocities:

            (M + S^T S) u + C^T x = M free,   C u = rates

        and `S u`, behind zeros for the joints.
        """
        assert self.elastic is not None
        right = jax.vmap(self.elastic.product)(free).at[:, : rates.shape[1]].add(-rates)
        both, velocities = self._beside_strains(self.elastic, right, free)
        return velocities, both.at[:, : rates.shape[1]].set(0)

    def pulled(self, rows: Float[Array, "k n"]) -> Float[Array, "k nv"]:
        """`M^-1 S^T rows`, with zeros for the joints in front of each row."""
        assert self.elastic is not None
        forces = jax.vmap(self.elastic.transposed)(rows)
        return jax.vmap(self.inverse_inertia.__matmul__)(forces)

    def elastic_force(self, velocity: Velocities) -> Velocities:
        """`S^T S velocity`"""
        assert self.elastic is not None
        return self.elastic.transposed(self.elastic_rates(velocity))

    def elastic_rates(self, velocity: Velocities) -> Float[Array, " n"]:
        """`S velocity`, behind zeros for the joints."""
        assert self.elastic is not None
        return self.elastic.product(velocity).at[: self._num_joints].set(0)

    @property
    def is_strain(self) -> Bool[np.ndarray, " n"]:
        """Which rows of `S`, behind those of the joints, are those of strains."""
        assert self.elastic is not None
        rows = np.arange(self.elastic.tables.num_rows)
        return rows < self._num_joints + self.num_strains

    @property
    def _num_joints(self) -> int:
        return 0 if self.schur is None else self.schur.tables.num_rows

    def _beside_strains(
        self, elastic: Schur, right: Float[Array, "k n"], free: Float[Array, "k nv"]
    ) -> tuple[Float[Array, "k n"], Float[Array, "k nv"]]:
        """The multipliers of joints and strains, and the velocities that they leave."""
        both = self._solve(elastic, right)
        pulled = jax.vmap(elastic.transposed)(both)
        return both, free - jax.vmap(self.inverse_inertia.__matmul__)(pulled)

    def effective(self, multipliers: Multipliers) -> Multipliers:
        """Multipliers of the joints without their part in the null space of `G`.

        It causes no force, and no row of the step equations determines it. The rest has the
        least norm, weighted by `E`.
        """
        schur, added = self.schur, self.regularisation
        if schur is None or added is None or multipliers.size == 0:
            return multipliers
        joints = multipliers[: schur.tables.num_rows]
        null = joints[None]
        # The second pass removes the error of first order in `E`.
        for _ in range(2):
            null = schur.solve(added[None] * null)
        return multipliers.at[: joints.size].add(-null[0])

    def reduced(self, rows: Increment) -> Reduced:
        """The rows of a node, with the coordinate constraints taken out."""
        if self.frames is None or self.schur is None:
            return Reduced(rows, rows.impulse[:0], rows.rate[:0])
        count, num_joints = self.inverse_inertia.shape[0], self.schur.tables.num_rows
        joints, relations = rows.impulse[:num_joints], rows.impulse[num_joints:]
        forces = self.frames.forces(rows.rate)
        # A change of the coordinates that repairs their relations moves the joints too.
        joints = joints - self.schur.product(jnp.pad(relations, (count, 0)))
        inner = Increment(joints, forces[:count], rows.momentum, rows.velocity_impulse)
        return Reduced(inner, relations, forces[count:])

    def rates(self, velocity: Velocities, reduced: Reduced) -> Increments:
        """The rates of an increment with this velocity that repair the relations."""
        if self.frames is None:
            return velocity
        return self.frames.rates(jnp.concatenate([velocity, reduced.relations]))

    def normal_forces(self, impulses: Multipliers) -> Array:
        """The components of `B^T impulses` in the directions of the relations."""
        count = self.inverse_inertia.shape[0]
        if self.frames is None or self.schur is None:
            return impulses[:0]
        return self.schur.transposed(impulses)[count:]
