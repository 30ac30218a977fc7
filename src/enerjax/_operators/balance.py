"""Accelerations and multipliers of a system of constant inertia, in one state."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._solvers import affine_root, product, solve
from .._system import State
from .._types import Coordinates, JointMultipliers, Multipliers, Velocities
from .interval import lapse_of


if TYPE_CHECKING:
    from .separable import SeparableModel


def accelerations(model: "SeparableModel", state: State) -> tuple[Velocities, Multipliers]:
    """The constraints enter twice differentiated; coordinate constraints have no
    acceleration level of their own (their multipliers close the `nq` rows).
    """
    q, v, t, scales = state.q, state.v, state.t, model.scales
    qdot = model.lift(q, v)
    slope = model.slope(state)
    gyroscopic = model.kinematics.gyroscopic(q, model.inertia @ v, qdot, model.args)
    if gyroscopic is not None:
        slope = slope + gyroscopic
    drift = _drift(model, state, qdot)
    unit = 1 / jnp.sqrt(model.inertia.diagonal())

    def conditions(x: Array) -> Array:
        acceleration, multipliers = unit * x[: v.size], x[v.size :] / scales.constraint
        # In here, where its indices are known, as the pattern needs them.
        _, transpose = jax.vjp(lambda x: model.constraint(x, t), q)
        pulled = model.pull(q, q, model.inertia @ acceleration)
        pulled = pulled + transpose(multipliers)[0]
        rate = model.joint_change(q, acceleration, t) + drift
        rows = (
            (pulled + slope) / scales.coordinate,
            rate / scales.constraint[: rate.size],
        )
        return jnp.concatenate(rows)

    like = jnp.zeros((v.size + scales.constraint.size,), q.dtype)
    x = affine_root(conditions, like, model.fill_behind(v, scales.constraint.size))
    return unit * x[: v.size], x[v.size :] / scales.constraint


def multipliers(model: "SeparableModel", state: State) -> Multipliers:
    """By the constraints alone where `L = I`: a smaller matrix."""
    inverse_inertia = model.inverse_inertia
    is_plain = model.has_canonical_rates and isinstance(inverse_inertia, Array)
    if not is_plain or model.system.redundant:
        return accelerations(model, state)[1]
    rows = jax.jacfwd(model.constraint)(state.q, state.t)
    rows = rows / model.scales.constraint[:, None]
    push = inverse_inertia @ model.slope(state)
    right = _drift(model, state, state.v) / model.scales.constraint - rows @ push
    mobility = product(product(rows, inverse_inertia), rows.T)
    return solve(mobility, right) / model.scales.constraint


def _drift(model: "SeparableModel", state: State, qdot: Coordinates) -> JointMultipliers:
    """What `dpsi/dt` is without acceleration."""
    rates = lambda q, t: model.joint_rate(q, state.v, t)
    return jax.jvp(rates, (state.q, state.t), (qdot, lapse_of(state.t)))[1]
