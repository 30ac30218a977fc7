"""Small vibrations about an equilibrium, on the constraints."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._operators import make_model
from .._programs import compiled, is_known
from .._solvers import as_dense, cholesky, eigh, inverse
from .._system import AbstractSystem, State
from .._types import Args, Coordinates, Real, Scalar
from .equilibrium import at_rest
from .mobility import independent_rows, scaled_constraints


# A pose is no equilibrium if this fraction of the forces is out of balance.
_UNBALANCED = 1e-6


class Modes(eqx.Module):
    """Frequencies and shapes of small vibrations; see `modes`.

    - `eigenvalues`: squares of the angular frequencies, ascending (1/time^2); one is
      negative if the equilibrium is unstable.
    - `shapes`: displacements of the coordinates as rows, shape `(modes, nq)`, orthonormal
      in the inertia.
    """

    eigenvalues: Float[Array, " modes"]
    shapes: Float[Array, "modes nq"]

    @property
    def frequencies(self) -> Float[Array, " modes"]:
        """Angular frequencies (1/time); of an unstable mode minus its rate of growth."""
        root = jnp.sqrt(jnp.abs(self.eigenvalues))
        return jnp.where(self.eigenvalues < 0, -root, root)


def modes(
    system: AbstractSystem, state: State, args: Args = None, *, t: Real = 0.0
) -> Modes:
    """The modes of vibration about an equilibrium, with all constraints held.

    They solve the eigenvalue problem of `Hess(V + lambda . Phi)` and the inertia, within
    the admissible displacements. Simple eigenvalues are differentiable; shapes are, if no
    two eigenvalues are equal.

    **Arguments:**

    - `system`, `args`: as for `simulate`.
    - `state`: an equilibrium; its velocities are ignored.
    - `t`: the time at which `driven` constraints are frozen.

    **Returns:** `Modes`, as many as there are coordinates less independent constraints. If
    constraints are redundant the system must be declared with `redundant=True`, and the
    pose must be known: such a call cannot be inside `jit` and `vmap`.

    **Raises:** `ValueError` and `TypeError` for bad input, and for a system with a `force`
    or `nonholonomic` constraints, whose modes need not be vibrations: `eigenvalues` finds
    those of the linearised equations. If values are known, also for a pose in which forces
    are out of balance, and for redundant constraints that are not declared.
    """
    if system.force is not None:
        raise ValueError(
            "`modes` are free vibrations without damping, and this system has a `force`. "
            "Leave it out, or give its potential."
        )
    if system.nonholonomic is not None:
        raise ValueError(
            "`modes` are vibrations of systems with holonomic constraints, and this one is "
            "`nonholonomic`. `eigenvalues` finds those of its linearised equations."
        )
    rest, args = at_rest(system, state, args, t)
    kept = _independent(system, rest, args) if system.redundant else None
    found, balance = _modes(system, rest, args, kept)
    if is_known((found, balance)):
        _check_balance(balance)
    return found


def _independent(system: AbstractSystem, rest: State, args: Args) -> tuple[int, ...]:
    """Indices of constraints that are independent and determine the others."""
    rest, args = jax.lax.stop_gradient((rest, args))
    if not is_known((system, rest, args)):
        raise ValueError(
            "The number of modes of a system with `redundant=True` depends on its pose, "
            "which is not known under `jit` and `vmap`: call `modes` outside of them, or "
            "leave out the redundant constraints."
        )
    return tuple(independent_rows(scaled_constraints(system, rest, args)[0]))


class _Balance(NamedTuple):
    """The generalised forces in a pose that no constraint balances, shape `(nq,)`, and
    which fraction of all forces they are, beyond round-off."""

    remaining: Coordinates
    fraction: Scalar


def _check_balance(balance: _Balance) -> None:
    remaining, fraction = np.asarray(balance.remaining), float(balance.fraction)
    if not np.isfinite(fraction):
        raise ValueError(
            "`modes`: the constraints are not independent in this pose. Leave out those "
            "that follow from others, or declare `System(..., redundant=True)`."
        )
    if fraction > _UNBALANCED:
        k = int(np.argmax(np.abs(remaining)))
        raise ValueError(
            "`modes` are vibrations about an equilibrium, and in this state forces are out "
            f"of balance: {remaining[k]:.3g} along coordinate {k}, {fraction:.1e} of all "
            "forces. `equilibrium(system, state, args)` finds an equilibrium nearby."
        )


@compiled
def _modes(
    system: AbstractSystem, rest: State, args: Args, kept: tuple[int, ...] | None
) -> tuple[Modes, _Balance]:
    model = make_model(system, rest, args)
    q = rest.q

    def constraint(q: Coordinates) -> Array:
        rows = model.constraint(q, rest.t)
        return rows if kept is None else rows[np.array(kept, int)]

    potential = lambda q: model.potential(State(q, rest.v))
    root = cholesky(as_dense(model.metric(model.to_internal(rest))))
    inverse_root = inverse(root)
    slope, jacobian = jax.grad(potential)(q), jax.jacfwd(constraint)(q)
    rows = jacobian @ inverse_root.T
    num_constraints = rows.shape[0]
    projector, multipliers = jnp.eye(q.size, dtype=q.dtype), jnp.zeros((0,), q.dtype)
    if num_constraints > 0:
        pseudo_inverse = inverse(rows @ rows.T) @ rows
        projector = projector - rows.T @ pseudo_inverse
        multipliers = -pseudo_inverse @ (inverse_root @ slope)
    augmented = lambda q: potential(q) + multipliers @ constraint(q)
    stiffness = inverse_root @ jax.hessian(augmented)(q) @ inverse_root.T
    norm = jnp.sqrt(jnp.sum(stiffness**2))
    admissible = projector @ stiffness @ projector
    # Displacements that the constraints forbid get eigenvalues above all others.
    above_all = jax.lax.stop_gradient(2 * norm + jnp.finfo(q.dtype).tiny)
    forbidden = above_all * (jnp.eye(q.size, dtype=q.dtype) - projector)
    values, vectors = eigh(0.5 * (admissible + admissible.T) + forbidden)
    order = jnp.argsort(values)[: q.size - num_constraints]
    found = Modes(values[order], (inverse_root.T @ vectors[:, order]).T)
    length = lambda x: jnp.sqrt(x @ x)
    remaining = slope + multipliers @ jacobian
    # The forces of stiff springs carry the round-off of the coordinates.
    rounding = jnp.finfo(q.dtype).eps * norm * length(root.T @ q)
    unbalanced = jnp.maximum(length(inverse_root @ remaining) - 1e3 * rounding, 0)
    size = length(inverse_root @ slope)
    fraction = jnp.where(unbalanced == 0, 0, unbalanced / jnp.where(size > 0, size, 1))
    return found, jax.lax.stop_gradient(_Balance(remaining, fraction))
