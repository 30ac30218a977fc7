"""Consistent starts: positions, velocities, accelerations and multipliers."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._operators import make_model
from .._programs import compiled_for_once, is_known, raising
from .._system import AbstractSystem, check_system, State, System
from .._types import (
    Args,
    Count,
    EntryIndices,
    Flag,
    Multipliers,
    Real,
    Vector,
    Velocities,
)
from .projection import project_position, project_velocity, rank_of_constraints


class ConsistentStart(eqx.Module):
    """A start that satisfies the constraints, and how far from them it was before.

    - `state`: the projected `State`.
    - `accelerations`: `vdot`, shape `(nv,)`.
    - `multipliers`: `lambda`, shape `(nc,)`, of joints, driven constraints, nonholonomic
      constraints and relations between coordinates, in this order (energy per constraint
      unit).
    - `constraint_before`, `constraint_after`: residuals at position level, of all but the
      nonholonomic constraints.
    - `rate_before`, `rate_after`: residuals at velocity level, `(nj,)`, of joints, driven
      and nonholonomic constraints, before and after the projection of `v`; both at the
      projected `q`.
    """

    state: State
    accelerations: Velocities
    multipliers: Multipliers
    constraint_before: Float[Array, " nh"]
    constraint_after: Float[Array, " nh"]
    rate_before: Float[Array, " nj"]
    rate_after: Float[Array, " nj"]


def initial_state(
    system: AbstractSystem,
    q: Vector,
    v: Vector,
    args: Args = None,
    *,
    t: Real = 0.0,
    known_q: EntryIndices = (),
    known_v: EntryIndices = (),
    throw: bool = True,
) -> State:
    """The `State` nearest to `(q, v)` that satisfies the constraints.

    The arguments and errors are those of `consistent_start`, of which only the state is
    returned. A start that satisfies the constraints to round-off is returned unchanged.
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
    known_q: EntryIndices = (),
    known_v: EntryIndices = (),
    throw: bool = True,
) -> ConsistentStart:
    """Projects a start onto the constraints, and finds its accelerations and multipliers.

    First `q` is moved to the nearest point with `Phi(q) = 0` in the metric of the inertia
    (Euclidean along redundant coordinates), then `v` to the nearest with `dPhi/dt = 0` and
    `A qdot = 0`; accelerations and multipliers follow from the equations of motion. All of
    them are differentiable with respect to `q`, `v` and `args`, so derivatives of a run
    with respect to its start are taken along the constraints.

    **Arguments:**

    - `system`: a `System`.
    - `q`, `v`: arrays or lists, `(nq,)` and `(nv,)`. `q` must be so close to the
      constraints that their linearisation explains its error: a second correction must be
      less than a fifth of the first.
    - `args`: passed to the functions of the system.
    - `t`: the time of the start, for `force` and `driven`.
    - `known_q`, `known_v`: indices of the coordinates and velocities that are kept; the
      others are solved for. Some of the known velocities may follow from the others.
    - `throw`: raise an error if there is no consistent start. With `False` it is NaN, so
      that one lane of a batch does not stop the others; a run from there fails.

    **Returns:** a `ConsistentStart`.

    **Raises:** `ValueError` for a start that is too far from the constraints, with the
    residual, and for constraints that are not independent at the start, with their rank;
    under `jit`, `vmap` and `grad` both raise `equinox.EquinoxRuntimeError` at run time.
    `ValueError` and `TypeError` for bad input, as `simulate`.
    """
    known = known_q, known_v
    return _start(system, State(q, v), args, t, known, keep_known=True, throw=throw)


def start_near(
    system: AbstractSystem, state: State, args: Args, t: Real, known_v: EntryIndices
) -> State:
    """`initial_state`, except that known velocities are changed if joints forbid them."""
    return _nearest(system, state, args, t, ((), known_v), keep_known=False, throw=True)


def _nearest(
    system: AbstractSystem,
    state: State,
    args: Args,
    t: Real,
    known: tuple[EntryIndices, EntryIndices],
    *,
    keep_known: bool,
    throw: bool,
) -> State:
    checked_state, checked_args, _ = check_system(system, state, args, t)
    if is_known((system, checked_state, checked_args)):
        # These small programs often save the compilation of the large one.
        facts = _facts(system, checked_state, checked_args)
        if is_known(facts):
            q = checked_state.q
            if facts.has_position and facts.has_velocity:
                return State(q, checked_state.v)
            if facts.has_position:
                _, known_v = _known_entries(system, checked_state, known)
                v, kept = _moved_velocity(system, checked_state, checked_args, known_v)
                if kept or not keep_known:
                    return State(q, v)
    return _start(system, state, args, t, known, keep_known=keep_known, throw=throw).state


def _start(
    system: AbstractSystem,
    state: State,
    args: Args,
    t: Real,
    known: tuple[EntryIndices, EntryIndices],
    *,
    keep_known: bool,
    throw: bool,
) -> ConsistentStart:
    state, args, _ = check_system(system, state, args, t)
    known = _known_entries(system, state, known)
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
        + (", and whether too many entries are known." if any(known) else "."),
        lambda: f"Residual of the constraints: {start.constraint_before}.",
    )
    num_constraints = start.multipliers.size
    if system.redundant:
        return start
    return _raise_unless(
        rank == num_constraints,
        start,
        "The constraints do not determine their multipliers at the start: some follow from "
        "others, or do not depend on `q` there (a square of a distance?). Leave out "
        "those that follow from others, or declare `System(..., redundant=True)`.",
        lambda: f"Their Jacobian has rank {rank}, of {num_constraints} rows.",
    )


class _Facts(NamedTuple):
    """Whether a start satisfies the constraints, and their rates too, to round-off.

    Both are false where constraints are not independent, unless the system says that they
    may be redundant.
    """

    has_position: Flag
    has_velocity: Flag


@compiled_for_once
def _facts(system: AbstractSystem, state: State, args: Args) -> _Facts:
    model = make_model(system, state, args)
    inner = model.to_internal(state)
    q, t, scales = inner.q, inner.t, model.scales
    eps = jnp.finfo(q.dtype).eps
    terms = model.holonomic(scales.constraint_size)
    position = jnp.all(jnp.abs(model.constraint(q, t)) <= 2 * eps * terms)
    rate = model.joint_rate(q, inner.v, t)
    speed = jnp.sqrt(2 * model.kinetic(inner))
    slow = jnp.all(jnp.abs(rate) <= 2 * eps * speed * scales.constraint[: rate.size])
    if not system.redundant:
        count = scales.constraint.size
        position = position & (rank_of_constraints(model, inner) == count)
    return _Facts(position, position & slow)


@compiled_for_once
def _moved_velocity(
    system: AbstractSystem, state: State, args: Args, known: tuple[int, ...]
) -> tuple[Velocities, Flag]:
    """The velocity at a consistent position, and whether it keeps known entries."""
    model = make_model(system, state, args)
    velocity, kept = project_velocity(model, model.to_internal(state), known)
    return model.to_user(State(state.q, velocity, state.t)).v, kept


def _raise_unless(
    good: Flag, start: ConsistentStart, message: str, figures: Callable[[], str]
) -> ConsistentStart:
    """Raises an error with the figures now, or without them at run time if traced."""
    if not is_known((good, start)):
        return raising(lambda x: eqx.error_if(x, ~good, message), start)
    if not good:
        raise ValueError(f"{message} {figures()}")
    return start


def _known_entries(
    system: AbstractSystem, state: State, known: tuple[EntryIndices, EntryIndices]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The checked indices `known_q` and `known_v`."""
    known_q, known_v = known
    both = _indices("known_q", known_q, state.q), _indices("known_v", known_v, state.v)
    if both[1] and not isinstance(system, System):
        raise ValueError("`known_v`: only a plain `System` can have known velocities.")
    return both


def _indices(name: str, indices: EntryIndices, x: Array) -> tuple[int, ...]:
    """Checked indices of entries of `x`."""
    array = np.asarray(indices)
    if array.size == 0:
        return ()
    bad = array.ndim != 1 or not np.issubdtype(array.dtype, np.integer)
    if bad or np.any(array < 0) or np.any(array >= x.size):
        raise ValueError(
            f"`{name}` must be a list of indices from 0 to {x.size - 1}, got {indices}."
        )
    return tuple(sorted(set(array.tolist())))


@compiled_for_once
def _project(
    system: AbstractSystem,
    guess: State,
    args: Args,
    known: tuple[tuple[int, ...], tuple[int, ...]],
) -> tuple[ConsistentStart, Flag, Flag, Count]:
    """The start, whether it is near, whether it keeps known velocities, and the rank of
    the constraints."""
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
