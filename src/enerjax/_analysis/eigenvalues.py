"""Eigenvalues of the equations of motion, linearised about a steady motion.

A steady motion moves along a symmetry of the equations of motion: a rotating top, a wheel
or a bicycle that rolls on. For the vector field `f(z)` of the equations of motion, with
`z = (q, v)`, and the vector field `X(z)` of the symmetry, this means `f = X` at the state
`z0`. Deviations from the motion obey, in axes that move with it,

    d(dz)/dt = D(f - X)(z0) dz

on the tangent space of all constraints at `z0`. Displacements along the symmetries are
neutral and are left out.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from .._operators import AbstractModel, make_model
from .._programs import compiled, is_known
from .._system import AbstractSystem, check_system, State, Symmetry
from .._types import Args, Coordinates, Real, Scalar, Velocities


# Below this fraction of its terms a residual counts as round-off.
_RESIDUAL = 1e-6
# Smaller singular values of the scaled constraints count as zero.
_RANK = 1e-9

# A vector field of the state, as its parts for the coordinates and the velocities.
Field = Callable[[Coordinates, Velocities], tuple[Coordinates, Velocities]]


def eigenvalues(
    system: AbstractSystem,
    state: State,
    args: Args = None,
    *,
    symmetry: Symmetry | None = None,
    t: Real = 0.0,
) -> Complex[Array, " n"]:
    """The eigenvalues of small deviations from an equilibrium or a steady motion.

    Deviations grow or decay like `exp(s t)` with these numbers `s`: the motion is unstable
    if one has a positive real part. All constraints are held, nonholonomic ones included,
    and forces may depend on velocities.

    In a steady motion the coordinates move along symmetries of the equations of motion, as
    those of a spinning top or of a bicycle that rolls straight on. Deviations along the
    symmetries themselves are left out.

    **Arguments:**

    - `system`, `args`: as for `simulate`.
    - `state`: an equilibrium with zero velocities, or a state of a steady motion. It must
      satisfy the constraints; see `initial_state`.
    - `symmetry`: `symmetry(q, args)`, shape `(ns, nv)`: rows of velocities of motions that
      do not change the equations of motion, such as translations along the ground or the
      rotation of a wheel about its axle. By default that of the system. A combination of
      them must be the velocity of the state. (A motion along a symmetry need not satisfy
      nonholonomic constraints: a translation without rolling is one.)
    - `t`: the time at which forces and drives are frozen.

    **Returns:** complex numbers (1/time), the largest real parts first. There are
    `nq + nv`, less one for each constraint, one for each velocity constraint, and one for
    each symmetry. Simple eigenvalues are differentiable. They are computed on CPUs only.

    **Raises:** `ValueError` and `TypeError` for bad input. If values are known,
    `ValueError` for a state that is not steady, for motions that are no symmetries, and for
    constraints or symmetries that are not independent.
    """
    state, args, _ = check_system(system, state, args, t)
    symmetry = system.symmetry if symmetry is None else symmetry
    found, facts = _eigenvalues(system, symmetry, state, args)
    if is_known((found, facts)):
        _check(facts, state)
    return found


class _Facts(NamedTuple):
    """What the eigenvalues rest on.

    - `moving`: the fraction of the velocity that is not along a symmetry.
    - `unsteady`: the acceleration in moving axes, as a fraction of all accelerations.
    - `broken`: how far deviations along symmetries are from neutral ones.
    - `rank`, `num_rows`: of constraints and symmetries.
    """

    moving: Scalar
    unsteady: Scalar
    broken: Scalar
    rank: Array
    num_rows: Array


def _check(facts: _Facts, state: State) -> None:
    moving, unsteady, broken = (float(x) for x in facts[:3])
    if int(facts.rank) < int(facts.num_rows):
        raise ValueError(
            "`eigenvalues`: the constraints and symmetries are not independent in this "
            f"state: their rank is {int(facts.rank)}, of {int(facts.num_rows)}. Leave out "
            "those that follow from others."
        )
    if moving > _RESIDUAL:
        raise ValueError(
            f"`eigenvalues`: {moving:.1e} of the velocity of the state, v = {state.v}, is "
            "along no symmetry. Pass the symmetries along which the steady motion moves, "
            "`symmetry(q, args)`, or a state at rest."
        )
    if not unsteady <= _RESIDUAL:
        raise ValueError(
            "`eigenvalues` are those of a steady motion or an equilibrium, and in this "
            f"state {unsteady:.1e} of the accelerations are out of balance."
        )
    if not broken <= _RESIDUAL:
        raise ValueError(
            "`eigenvalues`: a motion in `symmetry` changes the equations of motion or the "
            f"constraints (by {broken:.1e}), so it is no symmetry."
        )


@compiled
def _eigenvalues(
    system: AbstractSystem, symmetry: Symmetry | None, state: State, args: Args
) -> tuple[Complex[Array, " n"], _Facts]:
    model = make_model(system, state, args)
    inner = model.to_internal(state)
    q, v = inner.q, inner.v
    unit = jnp.concatenate([model.scales.coordinate, _velocity_units(model, inner)])
    unit = jax.lax.stop_gradient(unit)
    fields = _symmetries(model, symmetry, inner)
    along = [field(q, v)[0] for field in fields]
    parts, moving = _combination(along, model.lift(q, v), model.scales.coordinate)

    def deviation(x: Array) -> Array:
        """`f - X` in scaled variables."""
        z = x / unit
        at = z[: q.size], z[q.size :]
        fall, steady = _motion(model, inner, *at), [field(*at) for field in fields]
        total = [
            sum((-c * s[k] for c, s in zip(parts, steady, strict=True)), start=fall[k])
            for k in (0, 1)
        ]
        return unit * jnp.concatenate(total)

    def conditions(x: Array) -> Array:
        z = x / unit
        position, speed = z[: q.size], z[q.size :]
        rows = [model.constraint(position, inner.t)]
        return jnp.concatenate([*rows, model.joint_rate(position, speed, inner.t)])

    z0 = unit * jnp.concatenate([q, v])
    neutral = [unit * jnp.concatenate(field(q, v)) for field in fields]
    rows = jnp.concatenate([jax.jacfwd(conditions)(z0), *(x[None] for x in neutral)])
    rows = rows / _never_zero(jnp.linalg.norm(rows, axis=1))[:, None]
    falling = jnp.linalg.norm(model.slope(inner) / model.scales.step)
    speed = jnp.linalg.norm(z0[q.size :])
    return _on_tangent_space(deviation, z0, rows, neutral, (moving, falling, speed))


def _on_tangent_space(
    deviation: Callable[[Array], Array],
    z0: Array,
    rows: Float[Array, "m n"],
    neutral: list[Array],
    sizes: tuple[Scalar, Scalar, Scalar],
) -> tuple[Complex[Array, " k"], _Facts]:
    """The eigenvalues on the space that is orthogonal to all `rows`."""
    count, size = rows.shape
    projector = jnp.eye(size, dtype=z0.dtype) - jnp.linalg.pinv(rows, _RANK) @ rows
    jacobian = jax.jacfwd(deviation)(z0)
    # A basis does not depend smoothly on the state. The projection of a constant one does.
    known = jax.lax.stop_gradient(rows)
    fixed = jnp.linalg.svd(known)[2][count:].T
    basis = projector @ fixed
    inside = jnp.linalg.solve(fixed.T @ basis, basis.T @ jacobian @ basis)
    values = jnp.linalg.eigvals(inside)
    values = values[jnp.argsort(-values.real)]
    norm = jnp.linalg.norm(jacobian)
    length = lambda x: jnp.linalg.norm(x) / norm
    broken = [
        length(basis.T @ (jacobian @ x)) / _never_zero(jnp.linalg.norm(x)) for x in neutral
    ]
    moving, falling, speed = sizes
    facts = _Facts(
        moving=moving,
        unsteady=jnp.linalg.norm(deviation(z0)) / _never_zero(falling + norm * speed),
        broken=jnp.max(jnp.stack([jnp.zeros_like(norm), *broken])),
        rank=jnp.linalg.matrix_rank(known, _RANK),
        num_rows=jnp.array(count),
    )
    return values, jax.lax.stop_gradient(facts)


def _motion(
    model: AbstractModel, state: State, q: Coordinates, v: Velocities
) -> tuple[Coordinates, Velocities]:
    """The equations of motion as a vector field."""
    return model.lift(q, v), model.accelerations(State(q, v, state.t))[0]


def _symmetries(
    model: AbstractModel, symmetry: Symmetry | None, state: State
) -> list[Field]:
    """The vector fields of the symmetries on coordinates and velocities (or momenta)."""
    if symmetry is None:
        return []
    rows = jax.eval_shape(lambda q: symmetry(q, model.args), state.q)
    if len(rows.shape) != 2 or rows.shape[1] != state.v.size:
        raise ValueError(
            f"`symmetry` returned shape {rows.shape}: give one row of {state.v.size} "
            "velocities for each symmetry."
        )

    def field(k: int) -> Field:
        def rates(q: Coordinates) -> Coordinates:
            row = symmetry(q, model.args)[k]
            return row if model.has_canonical_rates else model.lift(q, row)

        def of_state(q: Coordinates, v: Velocities) -> tuple[Coordinates, Velocities]:
            moved = rates(q)
            if model.has_own_momenta:
                _, transpose = jax.vjp(rates, q)
                return moved, -transpose(v)[0]
            qdot = model.lift(q, v)
            change = jax.jvp(rates, (q,), (qdot,))[1]
            velocity = lambda q, qdot: model.push(q, q, qdot)
            return moved, jax.jvp(velocity, (q, qdot), (moved, change))[1]

        return of_state

    return [field(k) for k in range(rows.shape[0])]


def _combination(
    along: list[Coordinates], rates: Coordinates, unit: Array
) -> tuple[Array, Scalar]:
    """The combination of symmetries that is nearest to these rates, and the fraction of
    the rates that it leaves."""
    rates, size = rates * unit, jnp.linalg.norm(rates * unit)
    if not along:
        moving = jnp.where(size > 0, 1.0, 0.0).astype(rates.dtype)
        return jnp.zeros((0,), rates.dtype), moving
    matrix = jnp.stack([x * unit for x in along], axis=1)
    parts = jnp.linalg.pinv(matrix, _RANK) @ rates
    return parts, jnp.linalg.norm(rates - matrix @ parts) / _never_zero(size)


def _velocity_units(model: AbstractModel, state: State) -> Array:
    """The scales of velocities, or of momenta, in the size of a coordinate."""
    return 1 / jnp.sqrt(model.inverse_regular_metric(state).diagonal())


def _never_zero(x: Array) -> Array:
    return jnp.where(x == 0, 1, x)
