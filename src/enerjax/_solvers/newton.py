"""What a user decides of Newton's method, and where one of its searches begins."""

import equinox as eqx
import lineax as lx
import numpy as np
from jaxtyping import Array, PyTree

from .._programs import is_known
from .._types import Flag, Scalar
from .linear.dense import AbstractFactors
from .linear.user_solver import AbstractSparseSolver


class Newton(eqx.Module):
    """Newton's method on a problem scaled to order one, down to round-off.

    It begins with a chord iteration where the system has constant inertia and `v = qdot`:
    with the inertia and the gradients of the constraints in the middle of the step, whose
    matrix is factorised once. Where that does not contract (stiff forces, fast turns) the
    exact Jacobian follows.

    One Jacobian serves several corrections, with an approximate inverse that is
    extrapolated from those of the steps before, and improved. It is renewed where the
    corrections `c_k` would shrink by less than three; such a correction is not made. Where
    the first one after that of a new Jacobian is larger still, that went too far: it is
    halved, up to seven times (P. Deuflhard's natural monotonicity test). Stops after a
    correction whose error, predicted to be `c_k max(c_k / c_{k-1}, c_{k-1})`, is of
    round-off size, or which was computed from a residual that is, or where corrections that
    did shrink no longer do: coordinates far from the origin are too coarse for more. An
    iteration that breaks down, or has not converged with 12 Jacobians, begins again from a
    second guess, and then, without damping, from others: damping can end where the
    residual has a smallest value that is no root, which full corrections leave.

    **Arguments:**

    - `rtol`: bound on the predicted error, in units of round-off of the dtype.
    - `atol`: bound on the residual, in the same units.
    - `linear_solver`: for its corrections and for derivatives of the root: an
      `AbstractSparseSolver`, such as `KLU()`, given the entries of the Jacobian that can
      differ from zero, or one of lineax, given the dense Jacobian. Without it size and
      structure decide: plain operations up to 32 unknowns, LAPACK, and above 64 the
      narrow band that the pattern of the equations can be numbered into, if there is one.
      Derivatives are exact.

    A `linear_solver` of another type raises a `TypeError`, a bound that is not positive a
    `ValueError`.
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


class Start(eqx.Module):
    """Where a solve begins.

    - `guess`: first values of the unknowns.
    - `others`: guesses for further attempts: the first of them with damping, the rest
      without.
    - `factors`: of the Jacobian of the solve before, where it is kept.
    - `skip`: return the guess without an iteration.
    - `by_chord`: whether to try a chord iteration first, where there is one.
    - `regularisation`: for each unknown, what is added to the diagonal of a Jacobian that
      may be singular; see `find_root`.
    - `least`: where all unknowns are smaller, it is by round-off.
    """

    guess: PyTree[Array]
    others: tuple[PyTree[Array], ...]
    factors: AbstractFactors | None
    skip: Flag
    by_chord: Flag
    regularisation: PyTree[Array] | None
    least: Scalar
