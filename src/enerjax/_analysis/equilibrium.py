"""Static equilibria."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import AbstractModel, make_model, Time
from .._programs import compiled, is_known, raising
from .._solvers import find_root, largest, Newton, RootFinder
from .._system import AbstractSystem, check_system, HamiltonianSystem, State, System
from .._types import Args, Coordinates, Flag, Increments, Multipliers, Real, Scalar


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
# The scale of a force is the size of all forces at the guess plus this fraction of what its
# stiffness would cause in a pose as far away as the coordinates are large. The machine
# epsilon times the latter is round-off, which no iteration removes.
_OF_STIFF_FORCES = 1e-3
# So many times this round-off is accepted.
_ROUND_OFF = 1e3
# Load steps are divided down to this fraction of those that the user asked for.
_SHORTEST_STEP = 1e-2


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
    from_args: Args = None,
    steps: int = 1,
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
    - `from_args`, `steps`: load steps. The floats of `args` change linearly from those of
      `from_args`, in this number of steps, and each step begins with the pose of the last.
      Large deflections need them: `from_args=args.set("load", force=[0, 0, 0]), steps=10`.
      A step without an equilibrium is divided, except under `jit`, `vmap` and `grad`.

    **Returns:** an `Equilibrium`.

    **Raises:** `ValueError` if no equilibrium is found, with the part of the load that had
    one (under `jit`, `vmap` and `grad` `equinox.EquinoxRuntimeError`); `ValueError` and
    `TypeError` for bad input, and for a `System.from_hamiltonian`, whose momenta need not
    vanish in equilibrium, and for `nonholonomic` constraints, with which equilibria are not
    isolated.
    """
    if system.nonholonomic is not None:
        raise ValueError(
            "`equilibrium`: a system with `nonholonomic` constraints has a family of "
            "equilibria, because friction holds it in each place. Leave these constraints "
            "out, and give constraints on positions instead where it must not move."
        )
    rest, args = at_rest(system, guess, args, t)
    rotates, is_near = _is_orthonormal(system, rest.q), from_args is not None
    solve = lambda guess, args: _solve(system, guess, args, root_finder, rotates, is_near)
    _check_steps(steps, from_args, args)
    if from_args is None:
        (found, residual, ok), reached = solve(rest, args), ""
    else:
        (found, residual, ok), part = _follow(solve, rest, from_args, args, steps)
        reached = f" The part {part:.3g} of the way from `from_args` to `args` was reached."
    message = (
        "No equilibrium was found from this guess. There may be none (a free body under "
        "gravity?), the constraints may repeat each other, or the guess is too far: let a "
        "damped run come closer, or follow the loads in `steps`."
    )
    if not is_known((ok, found)):
        return raising(lambda x: eqx.error_if(x, ~ok, message), found)
    if not ok:
        raise ValueError(f"{message}{reached} Largest residual, scaled: {residual:.1e}.")
    return found


def _is_orthonormal(system: AbstractSystem, q: Coordinates) -> bool:
    """Whether the axes of all rigid bodies are known to be orthonormal, so that rotations
    can move them. Otherwise constraints between the axes find the nearest that are."""
    if not (isinstance(system, System) and is_known(q)):
        return False
    own = system.kinematics.constraint(q)
    return bool(jnp.max(jnp.abs(own), initial=0) <= 1e3 * jnp.finfo(q.dtype).eps)


def _check_steps(steps: Any, from_args: Args, args: Args) -> None:
    if not isinstance(steps, int) or steps < 1:
        raise ValueError(f"`steps` must be a positive number of load steps, got {steps!r}.")
    if from_args is None and steps > 1:
        raise ValueError(
            "Load `steps` need `from_args`, the numbers before the first step: those of "
            "`args` with loads of zero."
        )
    structures = [jax.tree.structure(x) for x in (from_args, args)]
    if from_args is not None and structures[0] != structures[1]:
        raise ValueError(
            "`from_args` must have the structure of `args`; they differ in their entries."
        )


def _follow(
    solve: Callable[[State, Args], tuple[Equilibrium, Scalar, Flag]],
    rest: State,
    from_args: Args,
    args: Args,
    steps: int,
) -> tuple[tuple[Equilibrium, Scalar, Flag], float]:
    """The equilibrium at the end of a path of loads, and the part of it that was reached.

    Where values are known, a load step without an equilibrium is divided.
    """

    def at(part: float) -> Args:
        between = lambda x, y: x + part * (y - x) if eqx.is_inexact_array_like(y) else y
        return args if part == 1 else jax.tree.map(between, from_args, args)

    reached, length, all_ok = 0.0, 1 / steps, jnp.array(True)
    while True:
        aim = 1.0 if reached + 1.001 * length > 1 else reached + length
        found, residual, ok = solve(rest, at(aim))
        if is_known((ok, found)) and not ok:
            length = length / 2
            if length * steps < _SHORTEST_STEP:
                return (found, residual, ok), reached
            continue
        all_ok = all_ok & ok
        if aim == 1:
            return (found, residual, all_ok), aim
        rest, reached = State(found.state.q, rest.v, rest.t), aim
        rest = jax.lax.stop_gradient(rest)


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
    state, args, _ = check_system(system, state, args, t)
    return State(state.q, jnp.zeros_like(state.v), state.t), args


@compiled
def _solve(
    system: AbstractSystem,
    guess: State,
    args: Args,
    root_finder: RootFinder,
    rotates: bool,
    is_near: bool,
) -> tuple[Equilibrium, Scalar, Flag]:
    model = make_model(system, guess, args, rotates_in=(3,) if rotates else ())
    guess = model.to_internal(guess)
    scales, size = model.scales, _force_size(model, guess)
    q0, unit = guess.q, size / scales.step
    at_guess = jnp.zeros_like(unit)

    def balance(x, inputs):
        model, unit, size, row, anchor, stiffness = inputs
        shift, scaled_multipliers = x
        q = q0 + model.displacement(q0, unit * shift)
        constraint, transpose = _constraint_near(model, q, guess.t, at_guess)
        slope = model.slope(State(q, guess.v, guess.t))
        force = slope + transpose(size * scaled_multipliers / scales.constraint)[0]
        rows = size * scales.constraint + scales.constraint_size
        force = force / (size * scales.step) + stiffness * (shift - anchor)
        return force / row, constraint / rows

    # The balance has more rows than there are multipliers: these come closest to it.
    _, transpose = _constraint_near(model, q0, guess.t, at_guess)
    rows = jax.vmap(transpose)(jnp.diag(1 / scales.constraint))[0] / scales.step[None]
    slope = model.slope(guess) / scales.step
    scaled_multipliers = jnp.linalg.lstsq(rows.T, -slope)[0] / size
    first, no_springs = (at_guess, scaled_multipliers), (at_guess, jnp.zeros_like(size))
    far, one = largest(q0 * scales.coordinate) / size, jnp.ones_like(unit)
    forces = lambda x: balance(x, (model, unit, size, one, *no_springs))[0]
    stiffness = _stiffness(forces, first)
    row = 1 + _OF_STIFF_FORCES * far * stiffness
    inputs = model, unit, size, row
    near, others = first, [first, first]
    if not is_near:
        with_springs = lambda x, springs: balance(x, (*inputs, *springs))
        # Above the stiffness of the potential, except that of very stiff parts: springs as
        # stiff would have to be softened too often.
        above = largest(stiffness) / largest(row) + largest(forces(first)) / (far + 1e-3)
        above = jnp.where(above > 0, 16 * above, 1)
        near, others = _descend(with_springs, root_finder, first, above), []
    root = find_root(
        balance,
        root_finder,
        near,
        (*inputs, *no_springs),
        max_iterations=_MAX_ITERATIONS,
        others=others,
    )
    shift, scaled_multipliers = root.value
    q: Coordinates = q0 + model.displacement(q0, unit * shift)
    multipliers = size * scaled_multipliers / scales.constraint
    residual = largest(jnp.concatenate(balance(root.value, (*inputs, *no_springs))))
    found = root.found & _is_balanced(forces, root.value, stiffness, far)
    state = State(q, jnp.zeros_like(model.to_user(guess).v))
    return Equilibrium(state, model.user_multipliers(multipliers)), residual, found


def _constraint_near(
    model: AbstractModel, q: Coordinates, t: Time, no_step: Increments
) -> tuple[Multipliers, Callable]:
    """The constraints, and a function from multipliers to the rows of their forces."""
    return jax.vjp(
        lambda step: model.constraint(q + model.displacement(q, step), t), no_step
    )


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


def _stiffness(
    forces: Callable[[tuple[Array, Array]], Array], at: tuple[Array, Array]
) -> Float[Array, " nu"]:
    """The size of the stiffness of each force, from a change of all coordinates at once."""
    shift, multipliers = jax.lax.stop_gradient(at)
    along = jnp.cos(jnp.arange(shift.size, dtype=shift.dtype))
    change = jax.jvp(lambda x: forces((x, multipliers)), (shift,), (along,))[1]
    return jnp.abs(jax.lax.stop_gradient(change))


def _is_balanced(
    forces: Callable[[tuple[Array, Array]], Array],
    at: tuple[Array, Array],
    stiffness: Float[Array, " nu"],
    far: Scalar,
) -> Flag:
    """Whether the forces vanish to half of the digits, or to their round-off."""
    eps = jnp.finfo(far.dtype).eps
    largest_stiffness = jnp.maximum(stiffness, _stiffness(forces, at))
    allowed = eps**0.5 + _ROUND_OFF * eps * far * largest_stiffness
    return jnp.all(jnp.abs(forces(at)) <= allowed)


def _force_size(model: AbstractModel, guess: State) -> Scalar:
    """The size of the forces at the guess, as the root of an energy; a constant."""
    length = largest(guess.q * model.scales.coordinate)
    size = jnp.maximum(largest(model.slope(guess) / model.scales.step), length)
    return jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
