"""Runs whose program has no exact Jacobian, which smooth motion does not need.

The exact Jacobian, for which Newton's method calls, is more than half of the program of a
run by the chord method, and of the time of its compilation: a slider-crank compiles in 9 s
without it and in 25 s with it, and two hinged bodies take 10 us a step instead of 21 us,
because the shorter step fits into one function. A run at the top level is therefore made
without it first. If the chord method fails in a step, the run is made again with Newton's
method behind it, and so are all later runs of the system.
"""

import dataclasses
import functools
from collections.abc import Hashable

import jax
import jax.numpy as jnp

from .._operators import SeparableModel
from .._programs import compiled_for_once, jacobian_pattern, structure_of
from .._results import RESULTS
from .._solvers import ChordAlone, Newton
from .._system import System
from .._types import Flag, Scalar
from ..schemes import (
    AbstractOneSolveScheme,
    AbstractSchemeWithChord,
    AbstractSchemeWithRotations,
)
from .step import model_for
from .step_sizes import EqualPlan
from .task import Task


# A run whose chord method would leave more than this part of an error in a correction is
# made with Newton's method at once: the chord method fails there.
_CONTRACTS = 0.25
# The estimate needs no digits.
_PASSES = 10
# The failures of a step that Newton's method may solve.
_OF_SEARCH = (RESULTS.not_converged, RESULTS.singular, RESULTS.nonfinite)


@dataclasses.dataclass
class _Experience:
    """What is known of the systems of one structure: whether they need the Jacobian."""

    needs_jacobian: bool | None = None


def chord_alone(task: Task) -> Task | None:
    """The same run in a program without the exact Jacobian; `None` if it would fail."""
    newton, stage, system = task.root_finder, task.scheme.stage, task.system
    if (
        not (isinstance(newton, Newton) and newton.linear_solver is None)
        or not (isinstance(stage, AbstractSchemeWithChord) and isinstance(system, System))
        or not isinstance(task.plan, EqualPlan)
        or task.watcher is not None
        or system.redundant
    ):
        return None
    experience = _experience(task)
    if experience.needs_jacobian is None:
        experience.needs_jacobian = bool(_is_stiff(task))
    if experience.needs_jacobian:
        return None
    return dataclasses.replace(task, root_finder=without_newton(newton, stage))


def without_newton(newton: Newton, stage: AbstractOneSolveScheme) -> ChordAlone:
    """The search of a run without the exact Jacobian."""
    # Newton's method evaluates the equations less often than the chord method. Those of
    # `EnergyConsistent` take so long that Newton's method is faster in small systems.
    is_short = isinstance(stage, AbstractSchemeWithRotations)
    return ChordAlone(newton, in_small_systems=is_short)


def needs_jacobian(task: Task, result: RESULTS) -> bool:
    """Whether the run without a Jacobian failed for its lack, which is remembered."""
    if not any(bool(result == failure) for failure in _OF_SEARCH):
        return False
    _experience(task).needs_jacobian = True
    return True


def _experience(task: Task) -> _Experience:
    key = task.system, task.scheme, task.start, task.args
    structure = structure_of(key)
    return _Experience() if structure is None else _remembered(structure)


@functools.lru_cache(maxsize=256)
def _remembered(structure: Hashable) -> _Experience:
    return _Experience()


def _is_stiff(task: Task) -> Flag | bool:
    """Whether forces are so stiff that the chord method, which omits them, fails."""
    system, args = task.system, task.args
    assert isinstance(system, System)
    if system.force is None:
        slope = jax.grad(lambda q: system.potential(q, args))
        pattern = jacobian_pattern(slope, task.start.q)
        if pattern is not None and pattern.nnz == 0:
            return False
    # NaN compares false: such a run fails in any program.
    return _contraction(task) > _CONTRACTS


@compiled_for_once
def _contraction(task: Task) -> Scalar:
    """The part of an error that a correction of the chord method leaves, at the start.

    It is the spectral radius of `h^2/4 M^-1 K + h/2 M^-1 D` with the stiffness and damping
    of the forces, by power iteration.
    """
    model = model_for(task.scheme, task.system, task.start, task.args)
    assert isinstance(model, SeparableModel)
    start, h = model.to_internal(task.start), task.plan.unit
    size = lambda v: jnp.sqrt(v @ model.inertia @ v)

    def after(v: jax.Array, _: None) -> tuple[jax.Array, Scalar]:
        moved = 0.5 * h * model.lift(start.q, v)
        change = 0.5 * h * model.acceleration_change(start, moved, v)
        return change / jnp.maximum(size(change), jnp.finfo(h.dtype).tiny), size(change)

    v = jnp.cos(jnp.arange(1.0, start.v.size + 1)).astype(h.dtype)
    v = v / jnp.sqrt(model.inertia.diagonal())
    _, sizes = jax.lax.scan(after, v / size(v), None, length=_PASSES)
    return sizes[-1]
