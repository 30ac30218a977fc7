"""The options of Newton's method, and the initial data of one search."""

import equinox as eqx
import lineax as lx
import numpy as np
from jaxtyping import Array, PyTree

from .._programs import is_known
from .._types import Flag, Scalar
from .linear.dense import AbstractFactors
from .linear.user_solver import AbstractSparseSolver


class Newton(eqx.Module):
    """Newton's method, which solves the scaled step equations to round-off.

    **Chord method.** A search begins with it if the scheme offers it, as the energy schemes
    do. Its approximate Jacobian contains the inertia and the constraint gradients in the
    middle of the step, and for most schemes the stiffness of springs and beams. It is
    factorised once. If it does not reduce the residual quickly (other stiff forces, fast
    rotations), the exact Jacobian is used.

    **Jacobians.** One exact Jacobian is used for several corrections. Where there is no
    chord method, the approximate inverse of a small Jacobian is extrapolated from those of
    the last three steps and then improved iteratively. Let `c_k` be the size of correction
    `k`. The Jacobian is evaluated again where `c_k > 0.3 c_{k-1}`, and that correction is
    discarded, unless the residual is of round-off size.

    **Damping.** Where the second correction with a Jacobian is hardly smaller than the
    first one, the first one was too long: it is halved, up to seven times (P. Deuflhard's
    natural monotonicity test).

    **Convergence.** The search ends when one of these holds:

    - The predicted error `c_k max(c_k / c_{k-1}, c_{k-1})` is of round-off size.
    - The residual is of round-off size.
    - Corrections are small and stop decreasing. This is the limit of the precision where
      coordinates lie far from the origin.

    **Restarts.** A search that becomes non-finite, or has not converged with 12 Jacobians,
    begins again from a second guess. If that fails too, it begins again from further
    guesses without damping, because a damped search can end at a local minimum of the
    residual that is no root. The last guess of a step is rest.

    **Arguments:**

    - `rtol`: bound on the predicted error, in units of round-off of the dtype.
    - `atol`: bound on the residual, in the same units. The error that a search leaves can
      have the same sign in every step, and the energy of a run can then change by about
      one unit of round-off per step. With `Newton(rtol=1e-6, atol=1e-3)` only the random
      walk of rounding is left (heavy top: two corrections a step more).
    - `linear_solver`: the solver for the corrections and for derivatives of the root. An
      `AbstractSparseSolver`, such as `KLU()`, receives the structurally nonzero entries of
      the Jacobian; a solver of lineax receives the dense Jacobian. By default the size and
      the sparsity decide: an elimination in blocks along the graph of the bodies, or if
      that is no cheaper, an inverse in plain array operations up to 32 unknowns (without a
      chord method in any case) and LAPACK beyond. The elimination exchanges rows within
      its blocks. Derivatives are as accurate as the solutions of the solver.

    Raises a `TypeError` for a `linear_solver` of another type, and a `ValueError` for a
    bound that is not positive.
    """

    rtol: float = 1.0
    atol: float = 8.0
    linear_solver: lx.AbstractLinearSolver | AbstractSparseSolver | None = None

    def __check_init__(self):
        solvers = lx.AbstractLinearSolver | AbstractSparseSolver | None
        if not isinstance(self.linear_solver, solvers):
            raise TypeError(
                "`Newton(linear_solver=...)` must be a solver of lineax, such as "
                "`lineax.LU()`, or an `enerjax.AbstractSparseSolver`, such as "
                f"`enerjax.KLU()`; got {self.linear_solver!r}."
            )
        for name, bound in (("rtol", self.rtol), ("atol", self.atol)):
            if is_known(bound) and not (np.isreal(bound) and 0 < bound < np.inf):
                raise ValueError(
                    f"`Newton({name}={bound!r})`: give a positive number, in units of "
                    "round-off; 1 is as exact as the dtype allows."
                )


class ChordAlone(eqx.Module):
    """The chord method, where the equations have one, without Newton's method behind it.

    The exact Jacobian is more than half of the program of a step, and smooth motion does
    not need it. `newton` has the tolerances; it searches where there is no chord method.

    - `omits_dampers`: whether the matrix of the chord method has no rows of dampers,
      because they are weak.
    """

    newton: Newton
    omits_dampers: bool = eqx.field(default=False, static=True)


class Start(eqx.Module):
    """The initial data of a search.

    - `guess`: the initial values of the unknowns.
    - `others`: the guesses for further attempts. The first of these attempts is damped, the
      others are not.
    - `factors`: the factors of the Jacobian of an earlier solve; `None` where they are not
      kept.
    - `skip`: whether to return the guess without an iteration.
    - `by_chord`: whether to try the chord method first, where the equations have one.
    - `regularisation`: the numbers added to the diagonal of a Jacobian that may be
      singular, one for each unknown; see `find_root`.
    - `least`: the scaled size below which unknowns are round-off. Corrections are measured
      relative to the largest unknown, but to no less than this.
    """

    guess: PyTree[Array]
    others: tuple[PyTree[Array], ...]
    factors: AbstractFactors | None
    skip: Flag
    by_chord: Flag
    regularisation: PyTree[Array] | None
    least: Scalar
