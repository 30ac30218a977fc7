"""Small vibrations about an equilibrium, on the constraints."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._operators import make_model
from .._programs import is_known
from .._solvers import as_dense, cholesky, eigh, inverse
from .._system import AbstractSystem, State
from .._types import Args, Coordinates, Real, Scalar
from .equilibrium import at_rest
from .mobility import independent_rows, scaled_constraints


# Forces out of balance, in parts of all forces, above which a pose is no equilibrium.
_BALANCED = 1e-6


class Modes(eqx.Module):
    """Frequencies and shapes of small vibrations; see `modes`.

    - `eigenvalues`: squares of the angular frequencies, ascending (1/time^2), negative
      where the equilibrium is unstable.
    - `shapes`: rows are displacements of the coordinates, shape `(modes, nq)`, orthonormal
      in the inertia.
    """

    eigenvalues: Float[Array, " modes"]
    shapes: Float[Array, "modes nq"]

    @property
    def frequencies(self) -> Float[Array, " modes"]:
        """Angular frequencies (1/time); rates of growth, with a minus, if unstable."""
        root = jnp.sqrt(jnp.abs(self.eigenvalues))
        return jnp.where(self.eigenvalues < 0, -root, root)


def modes(
    system: AbstractSystem, state: State, args: Args = None, *, t: Real = 0.0
) -> Modes:
    """The modes of vibration about an equilibrium, with all constraints held.

    The eigenvalues of `Hess(V + lambda . Phi)` against the inertia, on the motions that
    the constraints admit. Differentiable, the eigenvalues where they are simple and the
    shapes where no two eigenvalues are equal.

    **Arguments:**

    - `system`, `args`: as for `simulate`.
    - `state`: an equilibrium; its velocities are taken to be zero.
    - `t`: the time at which `driven` constraints are taken to stand still.

    **Returns:** `Modes`, as many as there are coordinates less constraints. Those must be
    independent, or the system declared with `redundant=True`; then those count that are,
    and the pose must be known: not within `jit` and `vmap`.

    **Raises:** `ValueError` and `TypeError` for bad input, and for a system with a `force`,
    whose modes need not be vibrations. Where values are known, for a pose in which forces
    are out of balance, with their size, and for constraints that repeat each other.
    """
    if system.force is not None:
        raise ValueError(
            "`modes` are free vibrations without damping, and this system has a `force`. "
            "Leave it out, or give its potential."
        )
    rest, args = at_rest(system, state, args, t)
    kept = _independent(system, rest, args) if system.redundant else None
    found, balance = _modes(system, rest, args, kept)
    if is_known((found, balance)):
        _check_balance(balance)
    return found


def _independent(system: AbstractSystem, rest: State, args: Args) -> tuple[int, ...]:
    """Numbers of constraints that determine the others."""
    rest, args = jax.lax.stop_gradient((rest, args))
    if not is_known((system, rest, args)):
        raise ValueError(
            "How many modes a system with `redundant=True` has depends on its pose, which "
            "is not known under `jit` and `vmap`: call `modes` outside of them, or leave "
            "out the constraints that repeat others."
        )
    return tuple(independent_rows(scaled_constraints(system, rest, args)[0]))


class _Balance(NamedTuple):
    """Generalised forces in a pose, `(nq,)`, that no constraint carries.

    `part` is their share in all forces, beyond round-off.
    """

    remaining: Coordinates
    part: Scalar


def _check_balance(balance: _Balance) -> None:
    remaining, part = np.asarray(balance.remaining), float(balance.part)
    if not np.isfinite(part):
        raise ValueError(
            "`modes`: the constraints repeat each other in this pose. Leave out those that "
            "follow from the others, or declare `System(..., redundant=True)`."
        )
    if part > _BALANCED:
        k = int(np.argmax(np.abs(remaining)))
        raise ValueError(
            "`modes` are vibrations about an equilibrium, and in this state forces are out "
            f"of balance: {remaining[k]:.3g} along coordinate {k}, {part:.1e} of all "
            "forces. `equilibrium(system, state, args)` finds one near it."
        )


@eqx.filter_jit
def _modes(
    system: AbstractSystem, rest: State, args: Args, kept: tuple[int, ...] | None
) -> tuple[Modes, _Balance]:
    model = make_model(system, rest, args)
    q = rest.q

    def held(q: Coordinates) -> Array:
        rows = model.constraint(q, rest.t)
        return rows if kept is None else rows[np.array(kept, int)]

    energy = lambda q: model.potential(State(q, rest.v))
    root = cholesky(as_dense(model.metric(model.to_internal(rest))))
    back = inverse(root)
    slope, jacobian = jax.grad(energy)(q), jax.jacfwd(held)(q)
    rows = jacobian @ back.T
    num_constraints = rows.shape[0]
    admitted, multipliers = jnp.eye(q.size, dtype=q.dtype), jnp.zeros((0,), q.dtype)
    if num_constraints > 0:
        across = inverse(rows @ rows.T) @ rows
        admitted = admitted - rows.T @ across
        multipliers = -across @ (back @ slope)
    strain = lambda q: energy(q) + multipliers @ held(q)
    stiffness = back @ jax.hessian(strain)(q) @ back.T
    inside = admitted @ stiffness @ admitted
    # Motions that the constraints forbid are moved beyond all others.
    beyond = 2 * jnp.sqrt(jnp.sum(stiffness**2)) + jnp.finfo(q.dtype).tiny
    outside = jax.lax.stop_gradient(beyond) * (jnp.eye(q.size, dtype=q.dtype) - admitted)
    values, vectors = eigh(0.5 * (inside + inside.T) + outside)
    order = jnp.argsort(values)[: q.size - num_constraints]
    found = Modes(values[order], (back.T @ vectors[:, order]).T)
    # Round-off is that of a stiff pose, `stiffness q`.
    length = lambda x: jnp.sqrt(x @ x)
    remaining = slope + multipliers @ jacobian
    rounding = jnp.finfo(q.dtype).eps * jnp.sqrt(jnp.sum(stiffness**2)) * length(root.T @ q)
    beyond = jnp.maximum(length(back @ remaining) - 1e3 * rounding, 0)
    size = length(back @ slope)
    part = jnp.where(beyond == 0, 0, beyond / jnp.where(size > 0, size, 1))
    return found, jax.lax.stop_gradient(_Balance(remaining, part))
