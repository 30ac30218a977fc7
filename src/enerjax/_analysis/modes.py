"""Small vibrations about an equilibrium, on the constraints."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linear import as_dense, cholesky, eigh, inverse
from .._model import make_model
from .._system import AbstractSystem, State
from .._types import Args, Real
from .equilibrium import at_rest


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

    **Returns:** `Modes`, as many as there are coordinates less constraints, which must be
    independent.

    **Raises:** `ValueError` and `TypeError` for bad input, and for a system with a `force`,
    whose modes need not be vibrations.
    """
    if system.force is not None:
        raise ValueError(
            "`modes` are free vibrations without damping, and this system has a `force`. "
            "Leave it out, or give its potential."
        )
    rest, args = at_rest(system, state, args, t)
    return _modes(system, rest, args)


@eqx.filter_jit
def _modes(system: AbstractSystem, rest: State, args: Args) -> Modes:
    model = make_model(system, rest, args)
    q = rest.q
    _, multipliers = model.accelerations(model.enter(rest))
    held = lambda q: model.constraint(q, rest.t)
    strain = lambda q: model.potential(State(q, rest.v)) + multipliers @ held(q)
    back = inverse(cholesky(as_dense(model.metric(model.enter(rest)))))
    stiffness = back @ jax.hessian(strain)(q) @ back.T
    rows = jax.jacfwd(held)(q) @ back.T
    num_constraints = rows.shape[0]
    admitted = jnp.eye(q.size, dtype=q.dtype)
    if num_constraints > 0:
        admitted = admitted - rows.T @ inverse(rows @ rows.T) @ rows
    inside = admitted @ stiffness @ admitted
    # Motions that the constraints forbid are moved beyond all others.
    beyond = 2 * jnp.sqrt(jnp.sum(stiffness**2)) + jnp.finfo(q.dtype).tiny
    outside = jax.lax.stop_gradient(beyond) * (jnp.eye(q.size, dtype=q.dtype) - admitted)
    values, vectors = eigh(0.5 * (inside + inside.T) + outside)
    order = jnp.argsort(values)[: q.size - num_constraints]
    return Modes(values[order], (back.T @ vectors[:, order]).T)
