"""Runs whose program has no exact Jacobian, which smooth motion does not need.

The exact Jacobian, which Newton's method needs, is more than half of the program of a run,
and of the time of its compilation: a slider-crank compiles in 9 s without it and in 25 s
with it. A run at the top level is therefore first made by the chord method alone. If that
fails in a step, the run is made again with Newton's method too, and if this helps, so are
all later runs of the system.
"""

import jax
import jax.numpy as jnp

from .._operators import FEW_FREE, SeparableModel
from .._programs import (
    call_traced_once,
    compiled_for_once,
    jacobian_pattern,
    values_of,
)
from .._solvers import ChordAlone
from .._system import (
    AbstractDampedForce,
    AbstractSystem,
    closes_over_traced_values,
    State,
    System,
)
from .._types import Args, Scalar
from ..schemes import AbstractScheme
from .experience import Experience
from .loop import dispensable_newton
from .model import model_for
from .task import Task


# The largest contraction, the fraction of an error that a correction leaves, for which the
# chord method is tried alone.
CONTRACTS = 0.25
# The contraction without rows of dampers below which these cost more than they save.
_WEAK = 0.02
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
    if not has_joints and is_separable and task.start.v.size <= FEW_FREE:
        return None
    # The inertia of an arm is ill-conditioned: single precision leaves too few digits.
    if not is_separable and task.start.q.dtype == jnp.float32:
        return None
    if experience.needs_newton:
        return None
    if experience.is_linear is None:
        # The result of such a run is traced, so nobody could know whether it has failed.
        if closes_over_traced_values(system, task.start, task.args):
            return None
        experience.is_linear = is_separable and _is_linear(system, task)
    # NaN compares false: such a run fails in any program.
    if not experience.is_linear:
        of_task = task.scheme, system, task.start, task.args, task.plan.unit
        if isinstance(system.force, AbstractDampedForce):
            if bool(values_of(contraction(*of_task, omits_dampers=True)) < _WEAK):
                return ChordAlone(newton, omits_dampers=True)
        if bool(values_of(contraction(*of_task)) > CONTRACTS):
            return None
    return ChordAlone(newton)


def _is_linear(system: System, task: Task) -> bool:
    """Whether there is no force but constant ones, such as gravity."""
    if system.force is not None:
        return False
    slope = jax.grad(lambda q: call_traced_once(system.potential, q, task.args))
    pattern = jacobian_pattern(slope, task.start.q)
    return pattern is not None and pattern.nnz == 0


@compiled_for_once
def contraction(
    scheme: AbstractScheme,
    system: AbstractSystem,
    start: State,
    args: Args,
    h: Scalar,
    *,
    omits_dampers: bool = False,
) -> Scalar:
    """An estimate, at the start, of the contraction of the chord method by stiff forces.

    With constant inertia it is the spectral radius of `h^2/4 M^-1 K + h/2 M^-1 D`, with the
    stiffness and damping of the forces that its matrix omits, by power iteration. With
    `omits_dampers` the matrix has no rows of dampers.
    """
    model = model_for(scheme, system, start, args, omits_dampers=omits_dampers)
    start = model.to_internal(start)
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
