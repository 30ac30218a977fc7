"""One step: predict, solve, finish; or a chain of such solves.

This is the layer where solves are counted, and where the physics scales what Newton
sees: rates by the inertia, multipliers by the gradients of their constraints, and
everything by an energy of the step.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from ._check import prepare
from ._linear import AbstractFactors, empty_factors
from ._model import AbstractModel, make_model
from ._newton import max_norm, Newton
from ._results import first_failure, from_root_finder, RESULTS
from ._root import find_root, RootFinder
from ._scaling import scales_like
from ._schemes import AbstractScheme, AbstractSingleSolve
from ._system import AbstractSystem, State
from ._types import Args, Count, Flag, Multipliers, Real, Scalar, Velocities


# Enough for the linear convergence of a locking step; a step that needs more has failed.
MAX_ITERATIONS = 50


class Warm(eqx.Module):
    """What the last steps leave for the next, for each stage.

    Pass it from one `step` to the next, with the same `h`, to start Newton closer.

    - `added`: what the last three steps added to a free flight, newest first.
    - `is_smooth`: whether extrapolating from these would have met the last step better
      than repeating.
    - `factors`: of the Jacobian of the last step.
    """

    added: PyTree[Any]
    is_smooth: Flag
    factors: AbstractFactors


class StepOutput(eqx.Module):
    """One step, done or failed.

    - `state`: at the end of the step; meaningless if the step failed.
    - `multipliers`: `lambda` of the step, `(nc,)`, joints first.
    - `dissipated`: energy that the scheme removed, by its own identity.
    - `details`: what the scheme reports of its own, or `None`.
    - `newton_iterations`: over all solves of the step.
    - `result`: a `RESULTS`; compare it with `RESULTS.successful`.
    - `warm`: pass it to the next step.
    """

    state: State
    multipliers: Multipliers
    dissipated: Scalar
    details: PyTree[Any]
    newton_iterations: Count
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
    """The memory of a run that begins: every stage predicted from the start."""

    def predict(length):
        problem = scheme.stage.problem(model, start, length * h)
        z = scheme.stage.predict(problem, acceleration, multipliers)
        flight = _free_flight(scheme.stage, problem, model, start)
        added = jax.tree.map(lambda x, x0: jnp.stack([x - x0] * 3), z, flight)
        flat, _ = ravel_pytree(flight)
        return Warm(added, jnp.array(True), empty_factors(flat.size, flat.dtype))

    lengths = jnp.asarray(scheme.stages, h.dtype)
    return jax.vmap(predict)(lengths)


def advance(
    scheme: AbstractScheme,
    model: AbstractModel,
    start: State,
    h: Scalar,
    warm: Warm,
    root_finder: RootFinder,
    skip: Flag,
) -> StepOutput:
    """One step of a scheme, without checks. With `skip` it costs no iteration."""

    def stage(state, stage_input):
        length, memory = stage_input
        end, iterations, result, memory = _solve(
            scheme.stage, model, state, length * h, memory, root_finder, skip
        )
        reported = (end.multipliers, end.dissipated, end.details, iterations, result)
        return end.state, (length, reported, memory)

    lengths = jnp.asarray(scheme.stages, h.dtype)
    state, (lengths, reported, memory) = jax.lax.scan(stage, start, (lengths, warm))
    multipliers, dissipated, details, iterations, results = reported
    return StepOutput(
        state,
        # The mean force over the step: stages count by their length, backwards ones too.
        lengths @ multipliers,
        jnp.sum(dissipated),
        jax.tree.map(lambda x: x[-1], details),
        jnp.sum(iterations),
        _first_of(results),
        memory,
    )


@eqx.filter_jit
def _single_step(system, scheme, state, args, h, warm, root_finder):
    model = make_model(system, state, args)
    state = model.enter(state)
    fresh = lambda: first_warm(scheme, model, state, h, *model.accelerations(state))
    if warm is None:
        warm = fresh()
    elif _kinds(warm) != _kinds(eqx.filter_eval_shape(fresh)):
        raise ValueError(
            "`warm` is not of this scheme and system. Pass the `warm` of the step before, "
            "or none."
        )
    out = advance(scheme, model, state, h, warm, root_finder, jnp.array(False))
    return eqx.tree_at(lambda out: out.state, out, model.leave(out.state))


def _kinds(tree: PyTree[Any]) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(jnp.shape(x), jnp.result_type(x)) for x in leaves]


def step(
    system: AbstractSystem,
    scheme: AbstractScheme,
    state: State,
    args: Args = None,
    *,
    h: Real,
    warm: Warm | None = None,
    root_finder: RootFinder = Newton(),
) -> StepOutput:
    """Advance one state by one step of length `h`, for loops of your own.

    Never raises on a failure of the step: look at `result`. All of `state`, `args`, `h`
    and the numbers of the scheme are traced, so the function can be put in `jit`, `vmap`,
    `lax.scan`, `grad` and `jvp`.

    **Arguments:**

    - `system`, `scheme`, `state`, `args`: as for `simulate`. The state must satisfy the
      constraints; see `initial_state`.
    - `h`: length of the step (time), positive.
    - `warm`: `warm` of the step before, if it had the same `h`. Without it the
      accelerations and multipliers at `state` are computed to predict the step.
    - `root_finder`: an optimistix root finder; see `simulate`.

    **Returns:** a `StepOutput`.

    **Raises:** `ValueError` or `TypeError` for wrong shapes, types and signs.
    """
    state, args, h = prepare(system, scheme, state, args, h, root_finder)
    return _single_step(system, scheme, state, args, h, warm, root_finder)


def _solve(
    scheme: AbstractSingleSolve,
    model: AbstractModel,
    start: State,
    h: Scalar,
    memory: Warm,
    root_finder: RootFinder,
    skip: Flag,
):
    problem = scheme.problem(model, start, h)
    flight = _free_flight(scheme, problem, model, start)
    unknown_scale, row_scale = scales_like(flight, model, start, h)

    def scaled(x, inputs):
        scheme, problem, unknown_scale, row_scale = inputs
        z = jax.tree.map(jnp.multiply, x, unknown_scale)
        return jax.tree.map(jnp.divide, scheme.residual(z, problem), row_scale)

    inputs = (scheme, problem, unknown_scale, row_scale)

    # Smooth motion is met by extrapolation; where it changes quickly the last step is
    # the better guess. What would have been better for the step before decides.
    smooth = jax.tree.map(lambda x: 3 * x[0] - 3 * x[1] + x[2], memory.added)
    last = jax.tree.map(lambda x: x[0], memory.added)
    choose = lambda x, y: jnp.where(memory.is_smooth, x, y)
    added = jax.tree.map(choose, smooth, last)
    guess = jax.tree.map(lambda x0, x, s: (x0 + x) / s, flight, added, unknown_scale)
    root = find_root(
        scaled,
        root_finder,
        guess,
        inputs,
        max_iterations=MAX_ITERATIONS,
        # What the last steps suggest can lie beyond a fold of the step equations; the
        # flight without force starts on the near side.
        second_guess=jax.tree.map(jnp.divide, flight, unknown_scale),
        factors=memory.factors,
        skip=skip,
    )
    z = jax.tree.map(jnp.multiply, root.value, unknown_scale)
    end = scheme.finish(z, problem)
    # What the scheme itself can tell of a failed iterate says more than that it failed.
    result = first_failure(end.result, from_root_finder(root.found, root.broken))
    added = jax.lax.stop_gradient(jax.tree.map(jnp.subtract, z, flight))
    off = lambda x: max_norm(
        jax.tree.map(lambda x, y, unit: (x - y) / unit, added, x, unknown_scale)
    )
    memory = Warm(
        jax.tree.map(
            lambda new, old: jnp.stack([new, old[0], old[1]]), added, memory.added
        ),
        off(smooth) <= off(last),
        root.factors,
    )
    return end, root.iterations, result, memory


def _free_flight(
    scheme: AbstractSingleSolve, problem: Any, model: AbstractModel, start: State
) -> PyTree[Any]:
    """The unknowns of a step in which no force acts."""
    num_constraints = jax.eval_shape(model.constraint, start.q).shape[0]
    no_force = jnp.zeros((num_constraints,), start.q.dtype)
    return scheme.predict(problem, jnp.zeros_like(start.v), no_force)


def _first_of(results: RESULTS) -> RESULTS:
    """The first failure along the leading axis of stacked results."""
    failed = results != RESULTS.successful
    first = jnp.argmax(failed)
    return jax.tree.map(lambda x: x[first], results)
