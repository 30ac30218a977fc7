"""Consistent starts: positions, velocities, accelerations and multipliers."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._check import check_system
from ._linear import affine_root, largest, Symmetric
from ._model import AbstractModel, make_model, Time
from ._newton import Newton
from ._root import find_root
from ._system import AbstractSystem, HamiltonianSystem, State
from ._tracing import is_known
from ._types import Args, Coordinates, Count, Flag, Multipliers, Real, Vector, Velocities


# Coordinates from which the rank of the constraints is not counted.
_LARGE = 500


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
    system: AbstractSystem, q: Vector, v: Vector, args: Args = None, *, t: Real = 0.0
) -> State:
    """The `State` nearest to `(q, v)` that satisfies the constraints.

    As `consistent_start`, of which it returns the state alone.
    """
    return consistent_start(system, q, v, args, t=t).state


def consistent_start(
    system: AbstractSystem, q: Vector, v: Vector, args: Args = None, *, t: Real = 0.0
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

    **Returns:** a `ConsistentStart`.

    **Raises:** `ValueError` for a start that is too far away, with the residual, and for
    bad input as `simulate`. Under `jit`, `vmap` and `grad` a start too far away raises
    `equinox.EquinoxRuntimeError` at run time. The same for constraints that are not
    independent at the start, with their rank.
    """
    state, args = check_system(system, State(q, v), args, t)
    start, near, rank = _project(system, state, args)
    start = _raise_unless(
        near,
        start,
        "The start is too far from the constraints to be repaired: their linearisation "
        "does not explain the error, so the nearest admissible configuration may not be "
        "the one that was meant. Check it against the lengths and anchors in `args`.",
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


def _constraint_at(model: AbstractModel, t: Time) -> Callable[[Coordinates], Multipliers]:
    return lambda q: model.constraint(q, t)


def _raise_unless(
    good: Flag, start: ConsistentStart, message: str, figures: Callable[[], str]
) -> ConsistentStart:
    """Raises with the figures where they are known, else without and at run time."""
    if not is_known((good, start)):
        return eqx.error_if(start, ~good, message)
    if not good:
        raise ValueError(f"{message} {figures()}")
    return start


@eqx.filter_jit
def _project(
    system: AbstractSystem, guess: State, args: Args
) -> tuple[ConsistentStart, Flag, Count]:
    model = make_model(system, guess, args)
    t = guess.t
    before = model.constraint(guess.q, t)
    q, near = _project_position(model, guess)
    given = model.enter(State(q, guess.v, t))
    state = State(q, _project_velocity(model, given), t)
    acceleration, multipliers = model.accelerations(state)
    rates = State(model.lift(q, state.v), acceleration, jax.tree.map(jnp.ones_like, t))
    user_state, user_rates = jax.jvp(model.leave, (state,), (rates,))
    start = ConsistentStart(
        user_state,
        user_rates.v,
        multipliers,
        before,
        model.constraint(q, t),
        model.joint_rate(q, given.v, t),
        model.joint_rate(q, state.v, t),
    )
    return start, near, jax.lax.stop_gradient(_rank(model, state))


def _rank(model: AbstractModel, state: State) -> Count:
    """The rank of the Jacobian of the constraints; of a large one, full or less."""
    q, constraint, scales = state.q, _constraint_at(model, state.t), model.scales
    num_constraints = scales.constraint.size
    if num_constraints == 0:
        return jnp.array(0)
    if q.size <= _LARGE:
        jacobian = jax.jacfwd(constraint)(q)
        unit = jacobian / scales.coordinate[None, :] / scales.constraint[:, None]
        return jnp.linalg.matrix_rank(unit)
    # A vector is found again from its product with `B B^T` only if that is regular.
    _, transpose = jax.vjp(constraint, q)

    def product(mu: Multipliers) -> Multipliers:
        motion = transpose(mu / scales.constraint)[0] / scales.coordinate**2
        return jax.jvp(constraint, (q,), (motion,))[1] / scales.constraint

    probe = jnp.cos(jnp.arange(num_constraints, dtype=q.dtype))
    image = product(probe)
    again = affine_root(lambda mu: product(mu) - image, probe)
    found = largest(again - probe) <= jnp.finfo(q.dtype).eps ** 0.25
    return num_constraints - 1 + found.astype(int)


def _project_position(model: AbstractModel, state: State) -> tuple[Coordinates, Flag]:
    """The nearest configuration on the constraints, and whether it could be found."""
    guess, t = state.q, state.t
    if model.scales.constraint.size == 0:
        return guess, jnp.array(True)
    metric, scales = model.metric(model.enter(state)), model.scales
    size = largest(guess * scales.coordinate)
    size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))

    def conditions(x, inputs):
        """The nearest point: `metric (q - guess) + B^T mu = 0`, `Phi(q) = 0`."""
        model, metric, guess, t, size = inputs
        scales = model.scales
        shift, mu = size * x[0] / scales.coordinate, size * x[1] / scales.constraint
        constraint, pull = jax.vjp(_constraint_at(model, t), guess + shift)
        force = metric @ shift + pull(mu)[0]
        rows = size * scales.constraint + scales.constraint_size
        return force / (size * scales.coordinate), constraint / rows

    inputs = (model, metric, guess, t, size)
    zero = (jnp.zeros_like(guess), jnp.zeros_like(scales.constraint))
    tolerance = 1e2 * jnp.finfo(guess.dtype).eps
    fill = model.fill(scales.constraint.size, guess.dtype)
    fill = None if fill is None else (zero[0], fill)
    root = find_root(conditions, Newton(), zero, inputs, max_iterations=50, fill=fill)
    x, found = root.value, root.found
    # Constraints that are met are not far; whether they are independent is told apart.
    met = largest(conditions(zero, inputs)[1]) <= tolerance
    near = met | (found & _linear(model, metric, state))
    q = jnp.where(met & ~found, guess, guess + size * x[0] / scales.coordinate)
    return q, near


def _linear(model: AbstractModel, metric: Symmetric, state: State) -> Flag:
    """Whether the linearised constraints explain the error of a state.

    The natural monotonicity test of P. Deuflhard, Newton Methods for Nonlinear Problems
    (2004): a simplified second correction shorter than a fifth of the first. (From
    infinitely far from a sphere it is a quarter.)
    """
    q, constraint, scales = state.q, _constraint_at(model, state.t), model.scales
    _, transpose = jax.vjp(constraint, q)

    def correction(residual: Multipliers) -> Coordinates:
        """The shortest with this effect on the constraints."""

        def conditions(x: Array) -> Array:
            shift, mu = x[: q.size] / scales.coordinate, x[q.size :] / scales.constraint
            change = jax.jvp(constraint, (q,), (shift,))[1] - residual
            force = metric @ shift + transpose(mu)[0]
            return jnp.concatenate([force / scales.coordinate, change / scales.constraint])

        like = jnp.zeros((q.size + residual.size,), q.dtype)
        x = affine_root(conditions, like, model.fill_behind(q))
        return x[: q.size] / scales.coordinate

    first = correction(constraint(q))
    second = correction(constraint(q - first))
    length = lambda x: jnp.sqrt(x @ metric @ x)
    return length(second) <= 0.2 * length(first)


def _project_velocity(model: AbstractModel, state: State) -> Velocities:
    """The nearest velocities (or momenta) that the joints admit."""
    q, v, t = state.q, state.v, state.t
    if model.joint(q, t).size == 0:
        return v

    def correct(v: Velocities, _) -> tuple[Velocities, None]:
        mobility, rates = model.mobility(State(q, v)), lambda v: model.joint_rate(q, v, t)
        rate, transpose = jax.vjp(rates, v)
        unit = model.scales.constraint[: rate.size]
        change = lambda mu: mobility @ transpose(mu / unit)[0]
        remaining = lambda mu: (rate - jax.jvp(rates, (v,), (change(mu),))[1]) / unit
        fill = model.fill(rate.size, v.dtype)
        return v - change(affine_root(remaining, rate, fill)), None

    # Exact at once where the energy is a quadratic form of the momenta; else Newton.
    corrections = 8 if isinstance(model.system, HamiltonianSystem) else 1
    return jax.lax.scan(correct, v, None, length=corrections)[0]
