"""Poses in which a system can rest."""

import equinox as eqx
import jax
import jax.numpy as jnp

from .._check import check_system
from .._linear import largest
from .._model import AbstractModel, make_model
from .._newton import Newton
from .._root import find_root, RootFinder
from .._system import AbstractSystem, HamiltonianSystem, State
from .._tracing import is_known
from .._types import Args, Coordinates, Flag, Multipliers, Real, Scalar


# Newton may wander before it converges, on long chains for one.
_MAX_ITERATIONS = 200


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
    """A pose where `dV/dq + B^T lambda = L^T f` and `Phi = 0`, from a guess near it.

    Differentiable with respect to `args` by the implicit function theorem. What is found
    can be unstable, as a pendulum on its head: `modes` tells.

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
        model, unit, size = inputs
        shift, tension = x
        q = q0 + unit * shift
        constraint, pull = jax.vjp(lambda q: model.constraint(q, guess.t), q)
        slope = model.slope(State(q, guess.v, guess.t))
        force = slope + pull(size * tension / scales.constraint)[0]
        rows = size * scales.constraint + scales.constraint_size
        return force / (size * scales.coordinate), constraint / rows

    # The multipliers that come closest to balance: there are more rows than these.
    pull = jax.jacfwd(model.constraint)(q0, guess.t) / scales.coordinate[None]
    pull = pull / scales.constraint[:, None]
    slope = model.slope(guess) / scales.coordinate
    tension = jnp.linalg.lstsq(pull.T, -slope)[0] / size
    zero = (jnp.zeros_like(q0), tension)
    inputs = (model, unit, size)
    root = find_root(balance, root_finder, zero, inputs, max_iterations=_MAX_ITERATIONS)
    shift, tension = root.value
    q: Coordinates = q0 + unit * shift
    multipliers = size * tension / scales.constraint
    residual = largest(jnp.concatenate(balance(root.value, inputs)))
    return Equilibrium(State(q, guess.v), multipliers), residual, root.found


def _size(model: AbstractModel, guess: State) -> Scalar:
    """The force that is to be balanced, in the root of an energy; no derivative."""
    length = largest(guess.q * model.scales.coordinate)
    size = jnp.maximum(largest(model.slope(guess) / model.scales.coordinate), length)
    return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
