"""Runs whose program has no exact Jacobian, which smooth motion does not need.

The exact Jacobian, which Newton's method needs, is more than half of the program of a run,
and of the time of its compilation: a slider-crank compiles in 9 s without it and in 25 s
with it. A run at the top level is therefore first made by the chord method alone. If that
fails in a step, the run is made again with Newton's method too, and if this helps, so are
all later runs of the system.
"""

from typing import Any

import jax
import jax.numpy as jnp

from .._operators import SeparableModel
from .._programs import (
    compiled_for_once,
    is_known,
    jacobian_pattern,
    values_of,
)
from .._solvers import ChordAlone
from .._system import AbstractSystem, State, System
from .._types import Scalar
from .experience import Experience
from .loop import dispensable_newton
from .step import model_for
from .task import Task


# The largest contraction, the fraction of an error that a correction leaves, for which the
# chord method is tried alone.
_CONTRACTS = 0.25
# The passes of the power iteration; the estimate needs no digits.
_PASSES = 10


def chord_alone(task: Task, experience: Experience) -> ChordAlone | None:
    """The root finder of a program without the exact Jacobian, if that is worth a try.

    `task` is a run without derivatives.
    """
    system = task.system
    newton = dispensable_newton(task.root_finder, task.scheme, task.plan, task.watcher)
    if newton is None:
        return None
    is_separable = isinstance(system, System)
    has_joints = system.constraint is not None or system.driven is not None
    if not has_joints and is_separable:
        return None
    # The inertia of an arm is ill-conditioned: single precision leaves too few digits.
    if not is_separable and task.start.q.dtype == jnp.float32:
        return None
    if experience.needs_newton:
        return None
    if experience.is_linear is None:
        if _closes_over_unknown_values(system, task):
            return None
        experience.is_linear = is_separable and _is_linear(system, task)
    # NaN compares false: such a run fails in any program.
    if not experience.is_linear:
        contraction = values_of(_contraction(task))
        if bool(contraction > _CONTRACTS):
            return None
    return ChordAlone(newton)


def _closes_over_unknown_values(system: AbstractSystem, task: Task) -> bool:
    """Whether a function of the system has a value in its closure that is not known now.

    The result of such a run is traced, so it cannot be known whether the run has failed.
    """
    start, args = task.start, task.args
    t = jnp.zeros((), start.q.dtype)

    def found_by(q: jax.Array, v: jax.Array) -> Any:
        found: list[Any] = [system.energy(State(q, v), args)]
        if system.constraint is not None:
            found.append(system.constraint(q, args))
        if system.driven is not None:
            found.append(system.driven(q, t, args))
        if system.force is not None:
            found.append(system.force(q, v, t, args))
        if system.nonholonomic is not None:
            found.append(system.nonholonomic(q, args))
        return found

    return not is_known(values_of(jax.make_jaxpr(found_by)(start.q, start.v).consts))


def _is_linear(system: System, task: Task) -> bool:
    """Whether there is no force but constant ones, such as gravity."""
    if system.force is not None:
        return False
    slope = jax.grad(lambda q: system.potential(q, task.args))
    pattern = jacobian_pattern(slope, task.start.q)
    return pattern is not None and pattern.nnz == 0


@compiled_for_once
def _contraction(task: Task) -> Scalar:
    """An estimate, at the start, of the contraction of the chord method by stiff forces.

    With constant inertia it is the spectral radius of `h^2/4 M^-1 K + h/2 M^-1 D`, with the
    stiffness and damping of the forces, by power iteration.
    """
    model = model_for(task.scheme, task.system, task.start, task.args)
    start, h = model.to_internal(task.start), task.plan.unit
    is_separable = isinstance(model, SeparableModel)
    inertia = model.inertia if is_separable else model.metric(start)
    size = lambda v: jnp.sqrt(v @ inertia @ v)

    def after(v: jax.Array, _: None) -> tuple[jax.Array, Scalar]:
        change = model.neglected_by_chord(start, v, h)
        return change / jnp.maximum(size(change), jnp.finfo(h.dtype).tiny), size(change)

    v = jnp.cos(jnp.arange(1.0, start.v.size + 1)).astype(h.dtype)
    v = v / jnp.sqrt(inertia.diagonal())
    _, sizes = jax.lax.scan(after, v / size(v), None, length=_PASSES)
    return sizes[-1]
