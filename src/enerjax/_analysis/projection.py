"""The nearest positions and velocities that satisfy the constraints.

Functions whose pattern is sought make their transposes inside: there indices are known.
"""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._operators import AbstractModel, Time
from .._solvers import affine_root, find_root, largest, Newton, Symmetric
from .._system import HamiltonianSystem, State
from .._types import Coordinates, Count, Flag, Multipliers, Velocities


Rows: TypeAlias = Callable[[Velocities], Array]

# Coordinates from which the rank of the constraints is not counted.
_LARGE = 500


def rank_of_constraints(model: AbstractModel, state: State) -> Count:
    """The rank of the Jacobian of the constraints; of a large one, full or less."""
    q, scales = state.q, model.scales
    constraint = lambda q: model.constraint(q, state.t)
    num_constraints = scales.constraint.size
    if num_constraints == 0:
        return jnp.array(0)
    if q.size <= _LARGE:
        jacobian = jax.jacfwd(constraint)(q)
        unit = jacobian / scales.coordinate[None, :] / scales.constraint[:, None]
        return jnp.linalg.matrix_rank(unit)

    # A vector is found again from its product with `B B^T` only if that is regular.
    def product(mu: Multipliers) -> Multipliers:
        _, transpose = jax.vjp(constraint, q)
        motion = transpose(mu / scales.constraint)[0] / scales.coordinate**2
        return jax.jvp(constraint, (q,), (motion,))[1] / scales.constraint

    probe = jnp.cos(jnp.arange(num_constraints, dtype=q.dtype))
    image = product(probe)
    again = affine_root(lambda mu: product(mu) - image, probe)
    found = largest(again - probe) <= jnp.finfo(q.dtype).eps ** 0.25
    return num_constraints - 1 + found.astype(int)


class _Held(eqx.Module):
    """What a position must satisfy, with its scales: constraints and known entries."""

    model: AbstractModel
    given: Coordinates
    t: Time
    known: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q: Coordinates) -> Array:
        known = jnp.asarray(self.known, int)
        constraint = self.model.constraint(q, self.t)
        return jnp.concatenate([constraint, (q - self.given)[known]])

    def scales(self) -> tuple[Array, Array]:
        """As `constraint` and `constraint_size` of `Scales`."""
        scales, known = self.model.scales, jnp.asarray(self.known, int)
        unit = jnp.concatenate([scales.constraint, 1 / scales.coordinate[known]])
        return unit, jnp.concatenate([scales.constraint_size, jnp.abs(self.given[known])])


def project_position(
    model: AbstractModel, state: State, known: tuple[int, ...]
) -> tuple[Coordinates, Flag]:
    """The nearest configuration on the constraints, and whether it could be found."""
    guess = state.q
    if model.scales.constraint.size == 0:
        return guess, jnp.array(True)
    metric, coordinate = model.metric(model.to_internal(state)), model.scales.coordinate
    size = largest(guess * coordinate)
    size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
    held = _Held(model, guess, state.t, known)

    def conditions(x, inputs):
        """The nearest point: `metric (q - guess) + B^T mu = 0`, `Phi(q) = 0`."""
        held, metric, size = inputs
        coordinate, (unit, rounding) = held.model.scales.coordinate, held.scales()
        shift, mu = size * x[0] / coordinate, size * x[1] / unit
        constraint, pull = jax.vjp(held, held.given + shift)
        force = metric @ shift + pull(mu)[0]
        return force / (size * coordinate), constraint / (size * unit + rounding)

    inputs = (held, metric, size)
    zero = (jnp.zeros_like(guess), jnp.zeros_like(held.scales()[0]))
    tolerance = 1e2 * jnp.finfo(guess.dtype).eps
    regularisation = model.regularisation(zero[1].size, guess.dtype)
    regularisation = None if regularisation is None else (zero[0], regularisation)
    root = find_root(
        conditions, Newton(), zero, inputs, max_iterations=50, regularisation=regularisation
    )
    x, found = root.value, root.found
    # Constraints that are met are not far; whether they are independent is told apart.
    met = largest(conditions(zero, inputs)[1]) <= tolerance
    near = met | (found & _linear(held, metric))
    q = jnp.where(met & ~found, guess, guess + size * x[0] / coordinate)
    return q, near


def _linear(held: _Held, metric: Symmetric) -> Flag:
    """Whether the linearised constraints explain the error of a state.

    The natural monotonicity test of P. Deuflhard, Newton Methods for Nonlinear Problems
    (2004): a simplified second correction shorter than a fifth of the first. (From
    infinitely far from a sphere it is a quarter.)
    """
    q, (unit, _), coordinate = held.given, held.scales(), held.model.scales.coordinate

    def correction(residual: Multipliers) -> Coordinates:
        """The shortest with this effect on the constraints."""

        def conditions(x: Array) -> Array:
            shift, mu = x[: q.size] / coordinate, x[q.size :] / unit
            _, transpose = jax.vjp(held, q)
            change = jax.jvp(held, (q,), (shift,))[1] - residual
            force = metric @ shift + transpose(mu)[0]
            return jnp.concatenate([force / coordinate, change / unit])

        like = jnp.zeros((q.size + residual.size,), q.dtype)
        x = affine_root(conditions, like, held.model.regularisation_after(q, unit.size))
        return x[: q.size] / coordinate

    first = correction(held(q))
    second = correction(held(q - first))
    length = lambda x: jnp.sqrt(x @ metric @ x)
    return length(second) <= 0.2 * length(first)


def project_velocity(
    model: AbstractModel, state: State, known: tuple[int, ...]
) -> tuple[Velocities, Flag]:
    """The nearest velocities (or momenta) that the joints admit, and whether the known
    entries are among them as they were given; of momenta, whether Newton found them."""
    q, v, t = state.q, state.v, state.t
    if model.joint(q, t).size == 0:
        return v, jnp.array(True)
    eps = jnp.finfo(v.dtype).eps
    unit = model.scales.constraint[: model.joint(q, t).size]
    rates = lambda x: model.joint_rate(q, x, t)

    def correct(
        v: Velocities, held: Rows, unit: Array, regularisation: Array | None
    ) -> Velocities:
        inverse_metric = model.inverse_metric(State(q, v))
        rate = held(v)

        def change(mu: Array) -> Velocities:
            _, transpose = jax.vjp(held, v)
            return inverse_metric @ transpose(mu / unit)[0]

        remaining = lambda mu: (rate - jax.jvp(held, (v,), (change(mu),))[1]) / unit
        return v - change(affine_root(remaining, rate, regularisation))

    end, root = v, jnp.sqrt(model.inverse_metric(state).diagonal())
    if known:
        # What is known may follow from the joints too: their rows need not be independent.
        numbers = jnp.asarray(known, int)
        both = lambda x: jnp.concatenate([rates(x), (x - v)[numbers]])
        units = jnp.concatenate([unit, root[numbers]])
        regularisation = jnp.full_like(units, -(eps**0.5))
        # The regularisation changes what the first correction does. Each further one takes
        # back most of that: in a nearly singular pose two would leave an error of 1e-11.
        toward = lambda end, _: (correct(end, both, units, regularisation), None)
        end = jax.lax.scan(toward, end, None, length=4)[0]
    # Exact at once where the energy is a quadratic form of the momenta; else Newton.
    corrections = 8 if isinstance(model.system, HamiltonianSystem) else 1
    regularisation = model.regularisation(unit.size, v.dtype)
    again = lambda v, _: (correct(v, rates, unit, regularisation), v)
    end, before = jax.lax.scan(again, end, None, length=corrections)
    changed = ((end - v) / root)[jnp.asarray(known, int)]
    if corrections > 1:
        changed = (end - before[-1]) / root
    return end, largest(changed) <= eps**0.5 * largest(v / root)
