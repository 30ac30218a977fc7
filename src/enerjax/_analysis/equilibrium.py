"""Poses in which a system can rest."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._operators import AbstractModel, make_model
from .._programs import is_known
from .._solvers import find_root, largest, Newton, RootFinder
from .._system import AbstractSystem, check_system, HamiltonianSystem, State
from .._types import Args, Coordinates, Flag, Multipliers, Real, Scalar


# Newton may wander before it converges, on long chains for one.
_MAX_ITERATIONS = 200
# Of one attempt on the way down, and how many there are.
_PATIENCE = 30
_AT_ONCE = 8
_TRIES = 100
# The part of the first weight that is left out next.
_SOFTEST = 1e-6


class Equilibrium(eqx.Module):
    """A pose in which the system can rest.

    - `state`: the pose, at rest.
    - `multipliers`: `lambda` there, shape `(nc,)`, joints first (energy per constraint
      unit): the reactions are `-B^T lambda`.
    """

    state: State
    multipliers: Multipliers


def equilibrium(
    system: AbstractSystem,
    guess: State,
    args: Args = None,
    *,
    t: Real = 0.0,
    root_finder: RootFinder = Newton(),
) -> Equilibrium:
    """A pose where `dV/dq + B^T lambda = L^T f` and `Phi = 0`, from a guess.

    By Newton's method from a guess near it; from others by the way of a body that creeps
    down its potential, which ends in a pose that is stable.

    Differentiable with respect to `args` by the implicit function theorem. What is found
    at once can be unstable, as a pendulum on its head: `modes` tells.

    **Arguments:**

    - `system`, `args`: as for `simulate`.
    - `guess`: its coordinates need not satisfy the constraints, its velocities do not
      matter. Far from an equilibrium let a damped run come close to one.
    - `t`: the time at which forces and drives are taken to stand still.
    - `root_finder`: for equations that are scaled to order one; see `simulate`.

    **Returns:** an `Equilibrium`.

    **Raises:** `ValueError` if none is found, under `jit`, `vmap` and `grad`
    `equinox.EquinoxRuntimeError`; `ValueError` and `TypeError` for bad input, and for a
    `System.from_hamiltonian`, which can be in balance while its momenta do not vanish.
    """
    rest, args = at_rest(system, guess, args, t)
    found, residual, ok = _solve(system, rest, args, root_finder)
    message = (
        "No equilibrium was found from this guess. There may be none (a free body under "
        "gravity?), the constraints may repeat each other, or the guess is too far: let a "
        "damped run come closer."
    )
    if not is_known((ok, found)):
        return eqx.error_if(found, ~ok, message)
    if not ok:
        raise ValueError(f"{message} Largest residual, scaled: {residual:.1e}.")
    return found


def at_rest(
    system: AbstractSystem, state: State, args: Args, t: Real
) -> tuple[State, Args]:
    """Checked input of an analysis of a system that rests."""
    if isinstance(system, HamiltonianSystem):
        raise ValueError(
            "Equilibria and modes are those of a system at rest; that of a Hamiltonian "
            "need not have vanishing momenta. Describe it by `System` or "
            "`System.from_lagrangian`."
        )
    state, args = check_system(system, state, args, t)
    return State(state.q, jnp.zeros_like(state.v), state.t), args


@eqx.filter_jit
def _solve(
    system: AbstractSystem, guess: State, args: Args, root_finder: RootFinder
) -> tuple[Equilibrium, Scalar, Flag]:
    model = make_model(system, guess, args)
    scales = model.scales
    q0, size = guess.q, _size(model, guess)
    unit = size / scales.coordinate

    def balance(x, inputs):
        model, unit, size, held, weight = inputs
        shift, tension = x
        q = q0 + unit * shift
        constraint, pull = jax.vjp(lambda q: model.constraint(q, guess.t), q)
        slope = model.slope(State(q, guess.v, guess.t))
        force = slope + pull(size * tension / scales.constraint)[0]
        rows = size * scales.constraint + scales.constraint_size
        force = force / (size * scales.coordinate) + weight * (shift - held)
        return force, constraint / rows

    # The multipliers that come closest to balance: there are more rows than these.
    pull = jax.jacfwd(model.constraint)(q0, guess.t) / scales.coordinate[None]
    pull = pull / scales.constraint[:, None]
    slope = model.slope(guess) / scales.coordinate
    tension = jnp.linalg.lstsq(pull.T, -slope)[0] / size
    zero = (jnp.zeros_like(q0), tension)
    inputs = (model, unit, size)
    none = jnp.zeros_like(q0), jnp.zeros_like(size)
    near = lambda x, held: balance(x, (*inputs, *held))
    near = _come_near(near, root_finder, zero, _stiffness(near, zero, q0 / unit))
    root = find_root(
        balance, root_finder, near, (*inputs, *none), max_iterations=_MAX_ITERATIONS
    )
    shift, tension = root.value
    q: Coordinates = q0 + unit * shift
    multipliers = size * tension / scales.constraint
    residual = largest(jnp.concatenate(balance(root.value, (*inputs, *none))))
    return Equilibrium(State(q, guess.v), multipliers), residual, root.found


def _come_near(
    balance: Callable[[Any, tuple[Array, Scalar]], Any],
    root_finder: RootFinder,
    guess: tuple[Array, Array],
    stiff: Scalar,
) -> tuple[Array, Array]:
    """A point from which Newton's method finds the balance, or the guess.

    Where it does not find it in a few iterations it goes down the potential, step by
    step: to where springs of some stiffness, the weight, that hold it to where it was
    would let it come to rest. They are made softer where it does, and harder where that
    fails too.
    """

    def unfinished(carry):
        _, _, ok, tries = carry
        return ~ok & (tries < _TRIES)

    def attempt(carry):
        x, weight, _, tries = carry
        held = jax.lax.stop_gradient((x[0], weight))
        root = find_root(balance, root_finder, x, held, max_iterations=_PATIENCE)
        good = root.found & jnp.isfinite(root.residual)
        # A search that wanders ends in whatever pose it meets, many turns away.
        good = good & ((weight > 0) | (root.iterations <= _AT_ONCE))
        x = jax.tree.map(lambda new, old: jnp.where(good, new, old), root.value, x)
        softer = jnp.where(weight > _SOFTEST * stiff, weight / 4, 0)
        harder = jnp.where(weight > 0, 16 * weight, stiff)
        return x, jnp.where(good, softer, harder), good & (weight == 0), tries + 1

    no_weight = jnp.zeros((), guess[0].dtype)
    begin = guess, no_weight, jnp.array(False), jnp.array(0)
    x, _, ok, _ = jax.lax.while_loop(unfinished, attempt, jax.lax.stop_gradient(begin))
    return jax.tree.map(lambda new, old: jnp.where(ok, new, old), x, guess)


def _stiffness(
    balance: Callable[[Any, tuple[Array, Scalar]], Any],
    guess: tuple[Array, Array],
    place: Array,
) -> Scalar:
    """A weight that is stiffer than the potential, as the guess shows it."""
    no_weight = jnp.zeros_like(guess[0]), jnp.zeros((), place.dtype)
    along = jnp.cos(jnp.arange(place.size, dtype=place.dtype))
    (force, _), (change, _) = jax.jvp(
        lambda x: balance((x, guess[1]), no_weight), (guess[0],), (along,)
    )
    stiff = largest(change) + largest(force) / (largest(place) + 1e-3)
    return jnp.where(stiff > 0, 16 * stiff, 1)


def _size(model: AbstractModel, guess: State) -> Scalar:
    """The force that is to be balanced, in the root of an energy; no derivative."""
    length = largest(guess.q * model.scales.coordinate)
    size = jnp.maximum(largest(model.slope(guess) / model.scales.coordinate), length)
    return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
