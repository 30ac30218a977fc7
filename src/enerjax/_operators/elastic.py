"""The stiffness of strains and the resistance of dampers, as rows beside those of joints.

A strain energy `Gamma . K Gamma / 2` adds about `h^2/4 Gamma'^T K Gamma'` to the inertia of
a step of length `h`. With `K = R^T R` this is `S^T S`, where the rows of `S` are
`h/2 R Gamma'`. The equations `(M + S^T S) u = r` are those of an inertia `M` with one more
constraint for each row of `S`, which yields to its multiplier `x`:

    M u + S^T x = r,   S u - x = 0

So stiffness enters the matrix `B M^-1 B^T` of the joints as further rows `S`, with one
added to their diagonal, and the inertia keeps its blocks.

Dampers with the resistances `c` of measures `Gamma` add `h/2 Gamma'^T c Gamma'`. They are
taken as strains with the stiffness `2 c / h`.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._programs import call_traced_once, squares_in
from .._solvers import (
    Bounds,
    diagonal_of,
    Schur,
    schur,
    schur_tables,
    SchurTables,
    Symmetric,
)
from .._system import AbstractDampedForce, AbstractStrainEnergy, State, System
from .._types import Args, Coordinates, JointMultipliers, Scalar, Velocities


# The smallest pivot of a stiffness matrix, as a part of its largest entry.
_LEAST_PIVOT = 1e-12
# A spring acts on two bodies, with at most 24 coordinates. Penalties of areas or mean
# positions act on all bodies, and would couple all rows, as would many springs on one body.
# Chains and trees of `n` bodies need about `log n` rounds, and a large net needs many.
# Programs for these take longer to compile than those with the exact Jacobian.
_BOUNDS = Bounds(blocks=24, rows=64, rounds=16)

# What the chord method includes beside the inertia and the joints, in this order.
ChordTerms: TypeAlias = tuple[Literal["strains", "dampers"], ...]
# A potential energy `V(q, args)`.
Potential: TypeAlias = Callable[[Coordinates, Args], Scalar]
# Rates of the joints, followed by the rows of the strains.
Rates: TypeAlias = Callable[[Velocities], Float[Array, " rows"]]


class ElasticTables(NamedTuple):
    """The index tables of the joints, and those of joints, strains and dampers together.

    The colours of the columns are equal, so one set of products serves both.

    - `joints`: `None` if there are none.
    - `terms`: which rows there are behind those of the joints.
    - `num_strains`: the number of the rows of strains; those of dampers follow.
    """

    joints: SchurTables | None
    both: SchurTables
    terms: ChordTerms
    num_strains: int

    @property
    def description(self) -> str:
        count = self.both.num_rows - self._num_joints
        what = " and ".join(self.terms)
        return f"{self.both.description}; {count} of the rows are those of {what}"

    @property
    def _num_joints(self) -> int:
        return 0 if self.joints is None else self.joints.num_rows

    def schurs(
        self,
        rates: Rates,
        rest: Velocities,
        weight: Symmetric,
        added: JointMultipliers | None,
    ) -> tuple[Schur | None, Schur]:
        """The factors without and with strains; `added` is the regularisation of joints."""
        products, num_joints = self.both.products(rates, rest), self._num_joints
        ones = jnp.ones((self.both.num_rows - num_joints,), rest.dtype)
        of_joints = jnp.zeros((num_joints,), rest.dtype) if added is None else added
        diagonal = jnp.concatenate([of_joints, ones])
        both = schur(self.both, products, weight, diagonal)
        if self.joints is None:
            return None, both
        return schur(self.joints, products[:num_joints], weight, added), both


def elastic_tables(
    rates: Rates, num_joints: int, rest: Velocities, weight: Symmetric
) -> tuple[SchurTables | None, SchurTables] | None:
    """The tables of the joints, and of all `rates`; `None` where the elimination is long,
    like that of a net."""
    both = schur_tables(rates, rest, weight, bounds=_BOUNDS)
    if both is None:
        return None
    if num_joints == 0:
        return None, both
    joints = schur_tables(lambda v: rates(v)[:num_joints], rest, weight, both.colours)
    return None if joints is None else (joints, both)


class Elasticity(NamedTuple):
    """The strains of a potential as functions of the coordinates.

    - `values(q)`: strains for each kind, shape `(elements, m)`.
    - `stiffness`: their stiffness matrices, shape `(elements, m, m)`.
    """

    values: Callable[[Coordinates], list[Float[Array, "elements m"]]]
    stiffness: list[Float[Array, "elements m m"]]

    @property
    def num_strains(self) -> int:
        return sum(x.shape[0] * x.shape[1] for x in self.stiffness)

    def with_others(self, others: "Elasticity") -> "Elasticity":
        """These strains, followed by others."""
        values = lambda q: [*self.values(q), *others.values(q)]
        return Elasticity(values, [*self.stiffness, *others.stiffness])


def elasticity(potential: Potential, q: Coordinates, args: Args) -> Elasticity:
    """The strains that a potential declares, or the numbers whose squares it sums.

    For other energies, such as those of nonlinear springs, there are none.
    """
    if isinstance(potential, AbstractStrainEnergy):
        like = jax.eval_shape(lambda q: potential.strains(q, args), q)
        if like:
            values = lambda q: [_in_rows(x) for x in potential.strains(q, args)]
            return Elasticity(values, _stiffnesses(potential, args, like))
    energy = lambda q: call_traced_once(potential, q, args)
    found = lambda q: squares_in(energy, q)
    values = lambda q: [x.value.reshape(-1, 1) for x in found(q)]
    return Elasticity(values, [2 * x.coefficient.reshape(-1, 1, 1) for x in found(q)])


def resistance(system: System, state: State, args: Args, h: Scalar) -> Elasticity:
    """The measures of the dampers that the force declares, as strains.

    `h` is the length of time whose half multiplies the resistances.
    """
    force = system.force
    if not isinstance(force, AbstractDampedForce) or state.t is None:
        return Elasticity(lambda q: [], [])
    found = force.resistances(state.q, state.v, state.t, args, delay=0.5 * h)
    # The slope of a law such as `-c |v| v` may be undefined at rest.
    found = [jnp.where(jnp.isfinite(x), x, 0) for x in found]
    units = [jnp.eye(_in_rows(x).shape[1], dtype=h.dtype) for x in found]
    stiffness = [
        2 / h * _in_rows(x)[:, :, None] * unit[None]
        for x, unit in zip(found, units, strict=True)
    ]
    values = lambda q: [_in_rows(x) for x in force.measures(q, args)]
    return Elasticity(values, stiffness)


def elastic_rates(
    strains: Elasticity,
    q: Coordinates,
    h: Scalar,
    lift: Callable[[Velocities], Coordinates],
) -> Rates:
    """The linear function `S v` of the velocities, whose coordinates change as `lift(v)`.

    Strains of negative stiffness have rows of zero.
    """
    roots = list(map(_root, strains.stiffness))

    def rates(v: Velocities) -> Float[Array, " rows"]:
        changes = jax.jvp(strains.values, (q,), (lift(v),))[1]
        rows = [
            jnp.sum(root * change[:, :, None], axis=1).ravel()
            for root, change in zip(roots, changes, strict=True)
        ]
        return 0.5 * h * jnp.concatenate(rows)

    return rates


def _in_rows(strains: Array) -> Float[Array, "elements m"]:
    """Strains of one number each as a column; others have one row for each element."""
    width = strains.shape[-1] if strains.ndim > 1 else 1
    return strains.reshape(-1, width)


def _stiffnesses(
    potential: AbstractStrainEnergy, args: Args, like: tuple[jax.ShapeDtypeStruct, ...]
) -> list[Float[Array, "elements m m"]]:
    """The stiffness matrices of the elements of each kind."""
    width = max(x.shape[-1] if x.ndim > 1 else 1 for x in like)

    def unit(x: jax.ShapeDtypeStruct, k: int) -> Array:
        if x.ndim == 1:
            return jnp.full(x.shape, float(k == 0), x.dtype)
        return jnp.broadcast_to((jnp.arange(x.shape[-1]) == k).astype(x.dtype), x.shape)

    columns = [
        potential.stresses(tuple(unit(x, k) for x in like), args) for k in range(width)
    ]
    return [
        jnp.stack([_in_rows(x) for x in of_kind[: _in_rows(of_kind[0]).shape[1]]], axis=2)
        for of_kind in zip(*columns, strict=True)
    ]


def _root(matrices: Float[Array, "elements m m"]) -> Float[Array, "elements m m"]:
    """The lower Cholesky factors `R^T`, without the columns whose pivot is not positive, or
    so small that it is round-off."""
    size = matrices.shape[-1]
    least = _LEAST_PIVOT * jnp.max(diagonal_of(matrices), axis=1)
    columns, rest = [], matrices
    for k in range(size):
        pivot = rest[:, k, k]
        is_stiff = pivot > jnp.maximum(least, 0)
        scale = jnp.where(is_stiff, jnp.sqrt(jnp.where(is_stiff, pivot, 1)), jnp.inf)
        column = jnp.where(jnp.arange(size) >= k, rest[:, :, k], 0) / scale[:, None]
        rest = rest - column[:, :, None] * column[:, None, :]
        columns.append(column)
    return jnp.stack(columns, axis=2)
