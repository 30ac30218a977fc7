"""Consistent starts: positions, velocities, accelerations and multipliers."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._operators import make_model
from .._programs import is_known
from .._system import AbstractSystem, check_system, State, System
from .._types import Args, Count, Flag, Multipliers, Real, Vector, Velocities
from .projection import project_position, project_velocity, rank_of_constraints


class ConsistentStart(eqx.Module):
    """A start that satisfies the constraints, and what had to be done for it.

    - `state`: the projected `State`.
    - `accelerations`: `vdot`, shape `(nv,)`.
    - `multipliers`: `lambda`, shape `(nc,)`, of joints, driven constraints and relations
      between coordinates, in this order (energy per constraint unit).
    - `constraint_before`, `constraint_after`: residuals at position level, `(nc,)`.
    - `rate_before`, `rate_after`: residuals of the joints at velocity level, `(nj,)`;
      before the projection of `v`, but after that of `q`.
    """

    state: State
    accelerations: Velocities
    multipliers: Multipliers
    constraint_before: Multipliers
    constraint_after: Multipliers
    rate_before: Float[Array, " nj"]
    rate_after: Float[Array, " nj"]


def initial_state(
    system: AbstractSystem,
    q: Vector,
    v: Vector,
    args: Args = None,
    *,
    t: Real = 0.0,
    known_q: Sequence[int] = (),
    known_v: Sequence[int] = (),
    throw: bool = True,
) -> State:
    """The `State` nearest to `(q, v)` that satisfies the constraints.

    As `consistent_start`, of which it returns the state alone: the one that is given, where
    it satisfies them to round-off already.
    """
    known = known_q, known_v
    return _nearest(system, State(q, v), args, t, known, keep_known=True, throw=throw)


def consistent_start(
    system: AbstractSystem,
    q: Vector,
    v: Vector,
    args: Args = None,
    *,
    t: Real = 0.0,
    known_q: Sequence[int] = (),
    known_v: Sequence[int] = (),
    throw: bool = True,
) -> ConsistentStart:
    """Projects a start onto the constraints and solves for what is in balance there.

    `q` moves by the smallest change in the metric of the inertia (Euclidean along
    redundant coordinates) to `Phi(q) = 0`, then `v` by the smallest change in the inertia
    to `dPhi/dt = 0`; accelerations and multipliers follow from the equations of motion.
    All are differentiable with respect to `q`, `v` and `args`, so derivatives of a run
    with respect to its start move along the constraints.

    **Arguments:**

    - `system`: a `System`.
    - `q`, `v`: arrays or lists, `(nq,)` and `(nv,)`, close to the constraints: close
      enough for the linearised constraints to explain the error in `q`. (In numbers: a
      second correction must be less than a fifth of the first.)
    - `args`: handed to the functions of the system.
    - `t`: the time of the start, for `force` and `driven`.
    - `known_q`, `known_v`: numbers of the coordinates and velocities that stay as they are
      given; the others are solved for. Velocities may be known that follow from others.
    - `throw`: raise an error where there is no start. With `False` it is NaN, so that one
      lane of a batch does not end the others; a run from there fails and says so.

    **Returns:** a `ConsistentStart`.

    **Raises:** `ValueError` for a start that is too far away, with the residual, and for
    bad input as `simulate`. Under `jit`, `vmap` and `grad` a start too far away raises
    `equinox.EquinoxRuntimeError` at run time. The same for constraints that are not
    independent at the start, with their rank.
    """
    known = known_q, known_v
    return _start(system, State(q, v), args, t, known, keep_known=True, throw=throw)


def start_near(
    system: AbstractSystem, state: State, args: Args, t: Real, known_v: Sequence[int]
) -> State:
    """As `initial_state`, but known velocities change where joints do not admit them."""
    return _nearest(system, state, args, t, ((), known_v), keep_known=False, throw=True)


def _nearest(
    system: AbstractSystem,
    state: State,
    args: Args,
    t: Real,
    known: tuple[Sequence[int], Sequence[int]],
    *,
    keep_known: bool,
    throw: bool,
) -> State:
    given, checked = check_system(system, state, args, t)
    if is_known((system, given, checked)):
        met = _is_met(system, given, checked)
        # A small program spares the compilation of a large one.
        if is_known(met) and met:
            return State(given.q, given.v)
    return _start(system, state, args, t, known, keep_known=keep_known, throw=throw).state


def _start(
    system: AbstractSystem,
    state: State,
    args: Args,
    t: Real,
    known: tuple[Sequence[int], Sequence[int]],
    *,
    keep_known: bool,
    throw: bool,
) -> ConsistentStart:
    state, args = check_system(system, state, args, t)
    known = _numbers("known_q", known[0], state.q), _numbers("known_v", known[1], state.v)
    if known[1] and not isinstance(system, System):
        raise ValueError(
            "`known_v`: only the velocities of a plain `System` can be given in part."
        )
    start, near, kept, rank = _project(system, state, args, known)
    if not throw:
        independent = system.redundant | (rank == start.multipliers.size)
        good = (near & kept if keep_known else near) & independent
        return jax.tree.map(lambda x: jnp.where(good, x, jnp.nan), start)
    start = _raise_unless(
        near & kept if keep_known else near,
        start,
        "The start is too far from the constraints to be repaired: their linearisation "
        "does not explain the error, so the nearest admissible configuration may not be "
        "the one that was meant. Check it against the lengths and anchors in `args`"
        + (", and whether what is known leaves enough to move." if any(known) else "."),
        lambda: f"Residual of the constraints: {start.constraint_before}.",
    )
    num_constraints = start.multipliers.size
    if system.redundant:
        return start
    return _raise_unless(
        rank == num_constraints,
        start,
        "The constraints do not determine their multipliers at the start: some repeat "
        "each other, or do not depend on `q` there (a square of a distance?). Leave out "
        "those that follow from the others, or declare `System(..., redundant=True)`.",
        lambda: f"Their Jacobian has rank {rank}, of {num_constraints} rows.",
    )


@eqx.filter_jit
def _is_met(system: AbstractSystem, state: State, args: Args) -> Flag:
    """Whether nothing is left to do: the constraints hold to round-off, each for itself."""
    model = make_model(system, state, args)
    inner = model.to_internal(state)
    q, t, scales = inner.q, inner.t, model.scales
    eps = jnp.finfo(q.dtype).eps
    position = jnp.abs(model.constraint(q, t)) <= 2 * eps * scales.constraint_size
    rate = model.joint_rate(q, inner.v, t)
    speed = jnp.sqrt(2 * model.kinetic(inner))
    slow = jnp.abs(rate) <= 2 * eps * speed * scales.constraint[: rate.size]
    met = jnp.all(position) & jnp.all(slow)
    if system.redundant:
        return met
    return met & (rank_of_constraints(model, inner) == scales.constraint.size)


def _raise_unless(
    good: Flag, start: ConsistentStart, message: str, figures: Callable[[], str]
) -> ConsistentStart:
    """Raises with the figures where they are known, else without and at run time."""
    if not is_known((good, start)):
        return eqx.error_if(start, ~good, message)
    if not good:
        raise ValueError(f"{message} {figures()}")
    return start


def _numbers(name: str, numbers: Sequence[int], x: Array) -> tuple[int, ...]:
    """Checked numbers of entries of a vector."""
    array = np.asarray(numbers)
    if array.size == 0:
        return ()
    bad = array.ndim != 1 or not np.issubdtype(array.dtype, np.integer)
    if bad or np.any(array < 0) or np.any(array >= x.size):
        raise ValueError(
            f"`{name}` must be a list of numbers from 0 to {x.size - 1}, got {numbers}."
        )
    return tuple(sorted(set(array.tolist())))


@eqx.filter_jit
def _project(
    system: AbstractSystem,
    guess: State,
    args: Args,
    known: tuple[tuple[int, ...], tuple[int, ...]],
) -> tuple[ConsistentStart, Flag, Flag, Count]:
    """The start; whether it is near, and keeps known velocities; the constraints' rank."""
    model = make_model(system, guess, args)
    t = guess.t
    before = model.constraint(guess.q, t)
    q, near = project_position(model, guess, known[0])
    given = model.to_internal(State(q, guess.v, t))
    velocity, kept = project_velocity(model, given, known[1])
    state = State(q, velocity, t)
    acceleration, multipliers = model.accelerations(state)
    rates = State(model.lift(q, state.v), acceleration, jax.tree.map(jnp.ones_like, t))
    user_state, user_rates = jax.jvp(model.to_user, (state,), (rates,))
    start = ConsistentStart(
        state=user_state,
        accelerations=user_rates.v,
        multipliers=multipliers,
        constraint_before=before,
        constraint_after=model.constraint(q, t),
        rate_before=model.joint_rate(q, given.v, t),
        rate_after=model.joint_rate(q, state.v, t),
    )
    return start, near, kept, jax.lax.stop_gradient(rank_of_constraints(model, state))
