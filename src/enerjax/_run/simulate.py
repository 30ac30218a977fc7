from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._operators import make_model
from .._results import first_failure, RESULTS
from .._solvers import Newton, RootFinder
from .._system import AbstractSystem, State
from .._types import Args, Count, Flag, Real, Vector
from ..schemes import AbstractScheme
from .audit import audit
from .controller import StepController
from .failure import memory_told, raise_failure
from .inputs import check_halvings, positive_integer, prepare
from .reverse import keep_roots, scans
from .selection import check_start, nan_unless, select
from .solution import Solution, Statistics
from .step import advance, first_warm, Warm
from .times import check_form
from .to_time import simulate_until


class _Carry(eqx.Module):
    """What one step hands to the next; the last good state once a step has failed."""

    state: State
    warm: Warm
    result: RESULTS
    completed: Count


def simulate(
    system: AbstractSystem,
    scheme: AbstractScheme,
    start: State,
    args: Args = None,
    *,
    h: Real,
    num_steps: int | None = None,
    t1: Real | None = None,
    ts: Vector | Literal["steps"] | None = None,
    max_steps: int | None = None,
    controller: StepController | None = None,
    t0: Real = 0.0,
    save_every: int = 1,
    root_finder: RootFinder = Newton(),
    max_halvings: int | None = None,
    throw: bool = True,
) -> Solution:
    """Integrate `num_steps` steps of length `h` from `start`, or until the time `t1`.

    `h`, the numbers of the scheme (`alpha`), `start` and all inexact leaves of `args` are
    traced: new values never recompile, and `vmap`, `grad`, `jvp` and `jit` work over each.
    Write a number that you want to change as `1.0`, not `1`: Python integers are part
    of the program. For derivatives with respect to the start, make the start inside the
    differentiated function with `initial_state`, so that it stays on the constraints.

    **Arguments:**

    - `system`: what moves; see `System`.
    - `scheme`: how; see the schemes. There is no default: it is part of the model.
    - `start`: a `State` that satisfies the constraints, as `initial_state` makes it.
    - `args`: any pytree, handed to the functions of the system.
    - `h`: length of a step (time), positive.
    - `num_steps`, `save_every`: every `save_every`-th state is saved, and the start. Their
      quotient must be whole. In reverse mode the solved unknowns of each step are stored
      too, up to 10^4 steps; beyond, memory grows like the square root of the steps, at
      the cost of one more run.
    - `t1`: instead of these, the time of the end, traced. The number of steps is
      `(t1 - t0)/h`, rounded up but for round-off, and `h` is shortened to fit: lanes of
      different `h` end at the same time, in one program.
    - `ts`: with `t1`, the times of the rows, `(times,)`, ascending; or `"steps"`: the start
      and the end of every step, `max_steps + 1` rows, NaN after the last; without it `t0`
      and `t1`. Within a step the state is interpolated to the order of the scheme and moved
      onto the constraints; at its end it is the state itself. With `ts` memory grows with
      `max_steps`.
    - `max_steps`: with `t1`, a bound on the steps, rejected ones included; a run that
      needs more fails. Without it the number of steps where it is known, and with a
      controller 4096. Steps that are left cost nothing; of a batch those after its last
      lane.
    - `controller`: with `t1`, a `StepController` that varies the steps; `h` is the first.
      Derivatives are those of the steps as they were chosen, as parts of `t1 - t0`.
    - `t0`: the time of the start; step `k` begins at `t0 + k h`. Traced.
    - `root_finder`: for the step equations, which are scaled to order one (so tolerances
      are relative); one of optimistix can be given, or a solver of its for least squares.
    - `max_halvings`: a step that fails is tried again in 2, 4, up to `2 ** max_halvings`
      equal parts, in which the laws of the energy hold as in a whole one; 0 for never.
      Where it is not given: 3 for systems of many unknowns, else 0, for it makes the
      program longer. `stats.halvings` tells where it was needed.
    - `throw`: raise an error at the end of a run that failed, which names the step, the
      time and the cause (under `jit`, `vmap` and `grad` the cause alone, and for all
      lanes together). With `False` look at `result`: rows after the failure are NaN.

    **Returns:** a `Solution`.

    **Raises:** `ValueError` or `TypeError` for bad input, before any step;
    `equinox.EquinoxRuntimeError` for a failed run if `throw`.
    """
    check_form(num_steps, save_every, t1, ts, max_steps, controller)
    check_halvings(max_halvings)
    if num_steps is None:
        times = t0, t1, ts
        return simulate_until(
            system,
            scheme,
            start,
            args,
            h,
            times,
            max_steps,
            controller,
            root_finder,
            max_halvings,
            throw,
        )
    num_steps = positive_integer("num_steps", num_steps)
    save_every = positive_integer("save_every", save_every)
    if num_steps % save_every != 0:
        raise ValueError(
            f"`num_steps` ({num_steps}) must be a multiple of `save_every` ({save_every})."
        )
    start, args, h, t0 = prepare(system, scheme, start, args, h, t0, root_finder)
    with memory_told(num_steps, num_steps // save_every):
        solution = _run(
            system,
            scheme,
            start,
            args,
            h,
            t0,
            root_finder,
            max_halvings,
            num_steps,
            save_every,
        )
    if not throw:
        return solution
    reached = t0 + h * solution.stats.completed_steps.astype(h.dtype)
    return raise_failure(solution, system, args, reached, h)


@eqx.filter_jit
def _run(
    system,
    scheme,
    start,
    args,
    h,
    t0,
    root_finder,
    max_halvings,
    num_steps,
    save_every,
):
    model = make_model(system, start, args)
    start = model.enter(start)
    acceleration, multipliers0 = model.accelerations(start)
    warm = first_warm(scheme, model, start, h, acceleration, multipliers0)

    def timed(state: State, steps: Array) -> State:
        """With the time after some steps, counted and not summed up, where time enters."""
        return State(state.q, state.v, t0 + h * steps if system.is_timed else None)

    def one_step(carry: _Carry, live: Flag):
        skip = (carry.result != RESULTS.successful) | ~live
        begin = timed(carry.state, carry.completed.astype(h.dtype))
        out = advance(scheme, model, begin, h, carry.warm, root_finder, skip, max_halvings)
        result = first_failure(carry.result, out.result)
        result = RESULTS.where(live, result, carry.result)
        good = live & (result == RESULTS.successful)
        reached = State(out.state.q, out.state.v)
        state, memory = select(good, (reached, out.warm), (carry.state, carry.warm))
        completed = carry.completed + good.astype(carry.completed.dtype)
        reported = (out.multipliers, out.details)
        return _Carry(state, memory, result, completed), (
            reported,
            jax.tree.map(lambda x: jnp.where(good, x, 0), out.energies),
            jax.tree.map(
                lambda x: jnp.where(skip, 0, x),
                (out.newton_iterations, out.residual, out.halvings, out.local_error),
            ),
        )

    num_saves = num_steps // save_every
    scan_of_rows, scan_of_steps = scans(num_saves, save_every)

    def one_save(carry: _Carry, live: Flag):
        carry, (reported, energies, costs) = scan_of_steps(
            keep_roots(one_step), carry, jnp.full((save_every,), live)
        )
        last = jax.tree.map(lambda x: x[-1], reported)
        row = (carry.state, *last, jax.tree.map(jnp.sum, energies))
        good = carry.result == RESULTS.successful
        return carry, (nan_unless(good, row), costs)

    result0 = check_start(scheme, model, start, h)
    begin = _Carry(State(start.q, start.v), warm, result0, jnp.array(0))
    end, (rows, costs) = scan_of_rows(one_save, begin, jnp.ones((num_saves,), bool))
    states, multipliers, details, energies = rows
    row0 = (begin.state, multipliers0, jax.tree.map(lambda _: jnp.zeros_like(h), energies))
    states, multipliers, energies = jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest]),
        row0,
        (states, multipliers, energies),
    )
    costs = [x.reshape(-1) for x in costs]
    saved = jnp.arange(0, num_steps + 1, save_every, dtype=h.dtype)
    return Solution(
        t0 + h * saved,
        jax.vmap(model.leave)(states),
        multipliers,
        details,
        audit(model, timed(states, saved), energies),
        Statistics(*costs, completed_steps=end.completed),
        model.leave(end.state),
        end.result,
    )
