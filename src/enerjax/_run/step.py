"""One step: a solve, or several solves in a row."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._operators import AbstractModel, local_error
from .._programs import compiled, in_one_function
from .._results import first_of, RESULTS
from .._solvers import ChordAlone, largest, Newton, RootFinder
from .._system import AbstractSystem, order_for, State
from .._types import Args, Coordinates, Count, Flag, Multipliers, Real, Scalar, Velocities
from ..schemes import (
    AbstractScheme,
    Energies,
)
from .halving import solve_or_divide
from .inputs import check_halvings, prepare
from .model import model_for
from .prediction import Memory
from .reverse import scan
from .stage import first_memory


class Warm(eqx.Module):
    """What one step passes to the next.

    Pass it from one `step` to the next, with the same `h`: Newton's method then needs fewer
    iterations.

    - `stages`: the memory of each stage, stacked.
    - `rest`: the part of the displacements that was lost by rounding `q`, less than its
      last digit. The next step adds it to its displacement, so that rounding errors do not
      accumulate, even if bodies are far from the origin.
    """

    stages: Memory
    rest: Coordinates


class StepOutput(eqx.Module):
    """One step, done or failed.

    - `state`: at the end of the step; meaningless if the step failed.
    - `multipliers`: `lambda` of the step, `(nc,)`, of joints, driven constraints,
      nonholonomic constraints and relations between coordinates, in this order.
    - `energies`: the energy that the scheme removed, and the work of `force` and `driven`
      constraints.
    - `details`: what only this scheme reports, or `None`.
    - `newton_iterations`: over all solves of the step.
    - `residual`: of the step equations, see `Statistics`.
    - `halvings`: how often the step, or a stage of it, was halved.
    - `local_error`: an estimate; see `Statistics`.
    - `result`: a `RESULTS`; compare it with `RESULTS.successful`.
    - `warm`: pass it to the next step.
    """

    state: State
    multipliers: Multipliers
    energies: Energies
    details: PyTree[Any]
    newton_iterations: Count
    residual: Scalar
    halvings: Count
    local_error: Scalar
    result: RESULTS
    warm: Warm


def first_warm(
    scheme: AbstractScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    acceleration: Velocities,
    multipliers: Multipliers,
) -> Warm:
    """The memory at the start of a run, where every stage is predicted from the start."""

    def first(length):
        return first_memory(
            scheme.stage, model, start, length * h, acceleration, multipliers
        )

    lengths = jnp.asarray(scheme.stages, h.dtype)
    return Warm(jax.vmap(first)(lengths), jnp.zeros_like(start.q))


def advance(
    scheme: AbstractScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    warm: Warm,
    root_finder: RootFinder | ChordAlone,
    skip: Flag,
    max_halvings: int | None = None,
) -> StepOutput:
    """One step of a scheme, without checks. If `skip` is true it takes no iteration."""

    def stage(carry, stage_input):
        state, rest = carry
        length, memory = stage_input
        solved, halvings = solve_or_divide(
            scheme.stage,
            model,
            state,
            length * h,
            memory,
            root_finder,
            skip,
            max_halvings,
        )
        end = solved.end
        costs = (solved.iterations, solved.residual, halvings, solved.roughness)
        reported = (end.multipliers, end.energies, end.details, costs, solved.result)
        q, rest = _sum_and_rest(state.q, end.displacement + rest)
        state = State(q, end.state.v, end.state.t)
        return (state, rest), (length, reported, solved.memory)

    lengths = jnp.asarray(scheme.stages, h.dtype)
    begin, inputs = (start, warm.rest), (lengths, warm.stages)
    (state, rest), (lengths, reported, memory) = scan(stage, begin, inputs, lengths.size)
    multipliers, energies, details, costs, results = reported
    iterations, residuals, halvings, sizes = costs
    return StepOutput(
        state=state,
        # The mean force over the step: stages are weighted by their (signed) lengths.
        multipliers=lengths @ multipliers,
        energies=jax.tree.map(jnp.sum, energies),
        details=jax.tree.map(lambda x: x[-1], details),
        newton_iterations=jnp.sum(iterations),
        residual=largest(residuals),
        halvings=jnp.max(halvings),
        local_error=local_error(sizes, order_for(model.system, scheme.order)),
        result=first_of(results),
        warm=Warm(memory, rest),
    )


def _sum_and_rest(x: Array, y: Array) -> tuple[Array, Array]:
    """The rounded sum, and exactly what the rounding lost (D. E. Knuth's two-sum)."""
    total = x + y
    of_y = total - x
    rest = (x - (total - of_y)) + (y - of_y)
    return total, jax.lax.stop_gradient(rest)


@compiled
def _single_step(system, scheme, state, args, h, warm, root_finder, max_halvings):
    model = model_for(scheme, system, state, args)
    state = model.to_internal(state)
    fresh = lambda: first_warm(scheme, model, state, h, *model.accelerations(state))
    if warm is None:
        warm = fresh()
    elif _types(warm) != _types(eqx.filter_eval_shape(fresh)):
        raise ValueError(
            "`warm` is not of this scheme and system. Pass the `warm` of the step before, "
            "or none."
        )
    no = jnp.array(False)
    go = lambda: advance(scheme, model, state, h, warm, root_finder, no, max_halvings)
    out = in_one_function(go)()
    user = model.to_user(out.state), model.user_multipliers(out.multipliers)
    return eqx.tree_at(lambda out: (out.state, out.multipliers), out, user)


def _types(tree: PyTree[Any]) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(jnp.shape(x), jnp.result_type(x)) for x in leaves]


def step(
    system: AbstractSystem,
    scheme: AbstractScheme,
    state: State,
    args: Args = None,
    *,
    h: Real,
    t: Real = 0.0,
    warm: Warm | None = None,
    root_finder: RootFinder = Newton(),
    max_halvings: int | None = None,
) -> StepOutput:
    """Advance one state by one step of length `h`, for loops of your own.

    A failed step raises no error: check `result`. All of `state`, `args`, `h`, `t` and the
    numbers of the scheme are traced, so the function can be used in `jit`, `vmap`,
    `lax.scan`, `grad` and `jvp`.

    **Arguments:**

    - `system`, `scheme`, `state`, `args`: as for `simulate`. The state must satisfy the
      constraints; see `initial_state`.
    - `h`: length of the step (time), positive.
    - `t`: the time at which the step starts, for `force` and `driven`.
    - `warm`: that of the step before, if it had the same `h`. Otherwise the step is
      predicted from the accelerations and multipliers at `state`.
    - `root_finder`, `max_halvings`: see `simulate`.

    **Returns:** a `StepOutput`.

    **Raises:** `ValueError` or `TypeError` for wrong shapes, types and signs, and for a
    system with events.
    """
    prepared = prepare(system, scheme, state, args, h, t, root_finder)
    system, state, args, h, *_ = prepared
    check_halvings(max_halvings)
    if system.events:
        raise ValueError(
            "`step` does not look for events, and this system has some, such as impacts. "
            "Use `simulate`, or a system without them."
        )
    return _single_step(system, scheme, state, args, h, warm, root_finder, max_halvings)
