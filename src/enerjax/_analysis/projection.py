"""The nearest positions and velocities that satisfy the constraints.

Functions whose sparsity pattern is sought call `jax.vjp` inside: the indices that they use
are then known when the pattern is found.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._operators import AbstractModel, Time
from .._solvers import affine_root, find_root, largest, Newton, Symmetric
from .._system import HamiltonianSystem, State
from .._types import Coordinates, Count, Flag, Multipliers, Velocities


# Functions of the velocities that must vanish.
Conditions: TypeAlias = Callable[[Velocities], Array]

# With more coordinates than this a singular value decomposition takes too long.
_LARGE = 500


def rank_of_constraints(model: AbstractModel, state: State) -> Count:
    """The rank of the constraint Jacobian; of a large one, only whether it is full."""
    q, scales = state.q, model.scales
    constraint = model.constraint_near(q, state.t)
    num_constraints = scales.constraint.size
    if num_constraints == 0:
        return jnp.array(0)
    if q.size <= _LARGE:
        jacobian = jax.jacfwd(constraint)(q)
        unit = jacobian / scales.coordinate[None, :] / scales.constraint[:, None]
        return jnp.linalg.matrix_rank(unit)

    # A solve recovers a vector from its product with `B B^T` only if that is regular.
    def product(mu: Multipliers) -> Multipliers:
        _, transpose = jax.vjp(constraint, q)
        motion = transpose(mu / scales.constraint)[0] / scales.coordinate**2
        return jax.jvp(constraint, (q,), (motion,))[1] / scales.constraint

    probe = jnp.cos(jnp.arange(num_constraints, dtype=q.dtype))
    image = product(probe)
    recovered = affine_root(lambda mu: product(mu) - image, probe)
    is_full = largest(recovered - probe) <= jnp.finfo(q.dtype).eps ** 0.25
    return num_constraints - 1 + is_full.astype(int)


class _Conditions(eqx.Module):
    """The conditions on a position: the constraints, and the entries that are known."""

    model: AbstractModel
    guess: Coordinates
    t: Time
    known: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, q: Coordinates) -> Array:
        known = jnp.asarray(self.known, int)
        constraint = self.model.constraint(q, self.t)
        return jnp.concatenate([constraint, (q - self.guess)[known]])

    def pull_back(self, q: Coordinates) -> tuple[Array, Callable[[Array], Any]]:
        """The conditions, and the product of their transposed Jacobian with a vector."""
        # JAX keeps the name of a function with its derivative. That of a module is the text
        # of all its arrays, and takes seconds for a mechanism of many bodies.
        return jax.vjp(lambda q: self(q), q)

    def scales(self) -> tuple[Array, Array]:
        """The counterparts of `constraint` and `constraint_size` of `Scales`."""
        scales, known = self.model.scales, jnp.asarray(self.known, int)
        unit, size = map(self.model.holonomic, (scales.constraint, scales.constraint_size))
        unit = jnp.concatenate([unit, 1 / scales.coordinate[known]])
        return unit, jnp.concatenate([size, jnp.abs(self.guess[known])])


def project_position(
    model: AbstractModel, state: State, known: tuple[int, ...]
) -> tuple[Coordinates, Flag]:
    """The nearest configuration on the constraints, and whether it could be found."""
    guess = state.q
    if model.holonomic(model.scales.constraint).size == 0:
        return guess, jnp.array(True)
    metric, coordinate = model.metric(model.to_internal(state)), model.scales.coordinate
    size = largest(guess * coordinate)
    size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
    conditions = _Conditions(model, guess, state.t, known)

    def nearest(x, inputs):
        """`metric (q - guess) + B^T mu = 0`, `Phi(q) = 0`."""
        conditions, metric, size = inputs
        coordinate = conditions.model.scales.coordinate
        unit, rounding = conditions.scales()
        shift, mu = size * x[0] / coordinate, size * x[1] / unit
        constraint, transpose = conditions.pull_back(conditions.guess + shift)
        force = metric @ shift + transpose(mu)[0]
        return force / (size * coordinate), constraint / (size * unit + rounding)

    inputs = (conditions, metric, size)
    zero = (jnp.zeros_like(guess), jnp.zeros_like(conditions.scales()[0]))
    tolerance = 1e2 * jnp.finfo(guess.dtype).eps
    regularisation = model.regularisation(zero[1].size, guess.dtype)
    regularisation = None if regularisation is None else (zero[0], regularisation)
    root = find_root(
        nearest, Newton(), zero, inputs, max_iterations=50, regularisation=regularisation
    )
    x, found = root.value, root.found
    # A guess that satisfies dependent constraints is near, though Newton's method fails;
    # their rank is checked elsewhere.
    is_satisfied = largest(nearest(zero, inputs)[1]) <= tolerance
    near = is_satisfied | (found & _explains_error(conditions, metric))
    q = jnp.where(is_satisfied & ~found, guess, guess + size * x[0] / coordinate)
    return q, near


def _explains_error(conditions: _Conditions, metric: Symmetric) -> Flag:
    """Whether the linearised constraints explain the error of a state.

    The natural monotonicity test of P. Deuflhard, Newton Methods for Nonlinear Problems
    (2004): a simplified second correction must be shorter than a fifth of the first. (From
    a point infinitely far from a sphere it is a quarter.)
    """
    model, q, (unit, _) = conditions.model, conditions.guess, conditions.scales()
    coordinate = model.scales.coordinate

    def correction(residual: Multipliers) -> Coordinates:
        """The shortest one that changes the conditions by `residual`."""

        def linearised(x: Array) -> Array:
            shift, mu = x[: q.size] / coordinate, x[q.size :] / unit
            _, transpose = conditions.pull_back(q)
            change = jax.jvp(conditions, (q,), (shift,))[1] - residual
            force = metric @ shift + transpose(mu)[0]
            return jnp.concatenate([force / coordinate, change / unit])

        like = jnp.zeros((q.size + residual.size,), q.dtype)
        x = affine_root(linearised, like, model.regularisation_after(q, unit.size))
        return x[: q.size] / coordinate

    # In a loop, so that the equations for both are compiled once.
    def after(at: Coordinates, _: None) -> tuple[Coordinates, Coordinates]:
        step = correction(conditions(at))
        return at - step, step

    _, (first, second) = jax.lax.scan(after, q, None, length=2)
    length = lambda x: jnp.sqrt(x @ metric @ x)
    return length(second) <= 0.2 * length(first)


def project_velocity(
    model: AbstractModel, state: State, known: tuple[int, ...]
) -> tuple[Velocities, Flag]:
    """The nearest velocities (or momenta) that the joints admit, and whether these keep
    the known entries; of momenta, whether Newton's method found them."""
    q, v, t = state.q, state.v, state.t
    rates = lambda x: model.joint_rate(q, x, t)
    num_rates = jax.eval_shape(rates, v).size
    if num_rates == 0:
        return v, jnp.array(True)
    eps = jnp.finfo(v.dtype).eps
    unit = model.scales.constraint[:num_rates]
    at = lambda v: model.inverse_regular_metric(State(q, v))
    # The metric of other systems does not depend on the velocities.
    is_quadratic = not isinstance(model.system, HamiltonianSystem)
    first_metric = at(v)

    def correct(
        v: Velocities, conditions: Conditions, unit: Array, regularisation: Array | None
    ) -> Velocities:
        inverse_metric = first_metric if is_quadratic else at(v)
        rate = conditions(v)

        def change(mu: Array) -> Velocities:
            _, transpose = jax.vjp(conditions, v)
            return inverse_metric @ transpose(mu / unit)[0]

        remaining = lambda mu: (rate - jax.jvp(conditions, (v,), (change(mu),))[1]) / unit
        return v - change(affine_root(remaining, rate, regularisation))

    end, root = v, jnp.sqrt(first_metric.diagonal())
    if known:
        # Known velocities may follow from the joints, so the rows may be dependent.
        indices = jnp.asarray(known, int)
        both = lambda x: jnp.concatenate([rates(x), (x - v)[indices]])
        units = jnp.concatenate([unit, root[indices]])
        regularisation = jnp.full_like(units, -(eps**0.5))
        # Each correction after the first removes most of the error of the regularisation.
        # In a nearly singular pose two corrections leave 1e-11, four leave round-off.
        toward = lambda end, _: (correct(end, both, units, regularisation), None)
        end = jax.lax.scan(toward, end, None, length=4)[0]
    # One correction is exact if the energy is a quadratic form of the momenta. Otherwise
    # the corrections are iterations of Newton's method, which converge quadratically.
    corrections = 1 if is_quadratic else 8
    regularisation = model.regularisation(unit.size, v.dtype)
    again = lambda v, _: (correct(v, rates, unit, regularisation), v)
    end, before = jax.lax.scan(again, end, None, length=corrections)
    changed = ((end - v) / root)[jnp.asarray(known, int)]
    if corrections > 1:
        changed = (end - before[-1]) / root
    return end, largest(changed) <= eps**0.5 * largest(v / root)
