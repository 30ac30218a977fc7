"""Static equilibria."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._operators import AbstractModel, make_model
from .._programs import compiled, is_known
from .._solvers import find_root, largest, Newton, RootFinder
from .._system import AbstractSystem, check_system, HamiltonianSystem, State
from .._types import Args, Coordinates, Flag, Multipliers, Real, Scalar


# Long chains need many iterations: Newton's method wanders there before it converges.
_MAX_ITERATIONS = 200
# The largest number of attempts of the descent, and of iterations in one of them.
_MAX_ATTEMPTS = 100
_ITERATIONS_OF_ATTEMPT = 30
# The largest number of iterations of an attempt without springs. A longer search can end
# in any pose, even many turns away.
_ITERATIONS_WITHOUT_SPRINGS = 8
# Springs that are softer than this fraction of the first ones are removed.
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
    """Finds a pose where `dV/dq + B^T lambda = L^T f` and `Phi = 0`, from a guess.

    If the guess is near an equilibrium, Newton's method finds it. Otherwise the pose
    descends the potential, as an overdamped body would, until it is near a stable one.

    The pose can be differentiated with respect to `args` (implicit function theorem). An
    equilibrium near the guess may be unstable, as an inverted pendulum is: `modes` tells.

    **Arguments:**

    - `system`, `args`: as for `simulate`.
    - `guess`: its coordinates need not satisfy the constraints, and its velocities are
      ignored. If it is far from an equilibrium, let a damped run come closer first.
    - `t`: the time at which forces and drives are frozen.
    - `root_finder`: for equations that are scaled to order one; see `simulate`.

    **Returns:** an `Equilibrium`.

    **Raises:** `ValueError` if no equilibrium is found (under `jit`, `vmap` and `grad`
    `equinox.EquinoxRuntimeError`); `ValueError` and `TypeError` for bad input, and for a
    `System.from_hamiltonian`, whose momenta need not vanish in equilibrium, and for
    `nonholonomic` constraints, with which equilibria are not isolated.
    """
    if system.nonholonomic is not None:
        raise ValueError(
            "`equilibrium`: a system with `nonholonomic` constraints has a family of "
            "equilibria, because friction holds it in each place. Leave these constraints "
            "out, and give constraints on positions instead where it must not move."
        )
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
    """The checked arguments of an analysis, with the system at rest."""
    if isinstance(system, HamiltonianSystem):
        raise ValueError(
            "Equilibria and modes are defined for a system at rest, and the momenta of a "
            "Hamiltonian system need not vanish there. Describe it by `System` or "
            "`System.from_lagrangian`."
        )
    state, args = check_system(system, state, args, t)
    return State(state.q, jnp.zeros_like(state.v), state.t), args


@compiled
def _solve(
    system: AbstractSystem, guess: State, args: Args, root_finder: RootFinder
) -> tuple[Equilibrium, Scalar, Flag]:
    model = make_model(system, guess, args)
    scales = model.scales
    q0, size = guess.q, _force_size(model, guess)
    unit = size / scales.coordinate

    def balance(x, inputs):
        model, unit, size, anchor, stiffness = inputs
        shift, scaled_multipliers = x
        q = q0 + unit * shift
        constraint, transpose = jax.vjp(lambda q: model.constraint(q, guess.t), q)
        slope = model.slope(State(q, guess.v, guess.t))
        force = slope + transpose(size * scaled_multipliers / scales.constraint)[0]
        rows = size * scales.constraint + scales.constraint_size
        force = force / (size * scales.coordinate) + stiffness * (shift - anchor)
        return force, constraint / rows

    # The balance has more rows than there are multipliers: these come closest to it.
    jacobian = jax.jacfwd(model.constraint)(q0, guess.t) / scales.coordinate[None]
    jacobian = jacobian / scales.constraint[:, None]
    slope = model.slope(guess) / scales.coordinate
    scaled_multipliers = jnp.linalg.lstsq(jacobian.T, -slope)[0] / size
    first = (jnp.zeros_like(q0), scaled_multipliers)
    inputs = (model, unit, size)
    no_springs = jnp.zeros_like(q0), jnp.zeros_like(size)
    with_springs = lambda x, springs: balance(x, (*inputs, *springs))
    stiffness = _stiffness_above_potential(with_springs, first, q0 / unit)
    near = _descend(with_springs, root_finder, first, stiffness)
    root = find_root(
        balance, root_finder, near, (*inputs, *no_springs), max_iterations=_MAX_ITERATIONS
    )
    shift, scaled_multipliers = root.value
    q: Coordinates = q0 + unit * shift
    multipliers = size * scaled_multipliers / scales.constraint
    residual = largest(jnp.concatenate(balance(root.value, (*inputs, *no_springs))))
    return Equilibrium(State(q, guess.v), multipliers), residual, root.found


def _descend(
    balance: Callable[[Any, tuple[Array, Scalar]], Any],
    root_finder: RootFinder,
    guess: tuple[Array, Array],
    first_stiffness: Scalar,
) -> tuple[Array, Array]:
    """A point from which Newton's method converges to an equilibrium, or the guess.

    The first attempt has no springs. If it fails, springs tie the system to its pose, and
    each attempt finds the equilibrium with these springs, which is a step down the
    potential. The springs of the next attempt are softer after a success, and stiffer
    after a failure.
    """

    def unfinished(carry):
        _, _, done, attempts = carry
        return ~done & (attempts < _MAX_ATTEMPTS)

    def attempt(carry):
        x, stiffness, _, attempts = carry
        springs = jax.lax.stop_gradient((x[0], stiffness))
        root = find_root(
            balance, root_finder, x, springs, max_iterations=_ITERATIONS_OF_ATTEMPT
        )
        was_quick = root.iterations <= _ITERATIONS_WITHOUT_SPRINGS
        good = root.found & jnp.isfinite(root.residual) & ((stiffness > 0) | was_quick)
        x = jax.tree.map(lambda new, old: jnp.where(good, new, old), root.value, x)
        softer = jnp.where(stiffness > _SOFTEST * first_stiffness, stiffness / 4, 0)
        stiffer = jnp.where(stiffness > 0, 16 * stiffness, first_stiffness)
        done = good & (stiffness == 0)
        return x, jnp.where(good, softer, stiffer), done, attempts + 1

    begin = guess, jnp.zeros((), guess[0].dtype), jnp.array(False), jnp.array(0)
    x, _, done, _ = jax.lax.while_loop(unfinished, attempt, jax.lax.stop_gradient(begin))
    return jax.tree.map(lambda new, old: jnp.where(done, new, old), x, guess)


def _stiffness_above_potential(
    balance: Callable[[Any, tuple[Array, Scalar]], Any],
    guess: tuple[Array, Array],
    scaled_q: Array,
) -> Scalar:
    """A stiffness above that of the potential, which is estimated at the guess."""
    no_springs = jnp.zeros_like(guess[0]), jnp.zeros((), scaled_q.dtype)
    along = jnp.cos(jnp.arange(scaled_q.size, dtype=scaled_q.dtype))
    (force, _), (change, _) = jax.jvp(
        lambda x: balance((x, guess[1]), no_springs), (guess[0],), (along,)
    )
    stiffness = largest(change) + largest(force) / (largest(scaled_q) + 1e-3)
    return jnp.where(stiffness > 0, 16 * stiffness, 1)


def _force_size(model: AbstractModel, guess: State) -> Scalar:
    """The size of the forces at the guess, as the root of an energy; a constant."""
    length = largest(guess.q * model.scales.coordinate)
    size = jnp.maximum(largest(model.slope(guess) / model.scales.coordinate), length)
    return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
