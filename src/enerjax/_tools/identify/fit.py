from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..._programs import is_known
from ..._run import positive_integer
from .estimate import covariance, Fit, names_of, student, Unknowns


Solver: TypeAlias = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser


def fit(
    residuals: Callable[[Any, Any], PyTree[Array]],
    guess: PyTree[Any],
    data: PyTree[Any] = None,
    *,
    positive: PyTree[bool] = False,
    solver: Solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6),
    max_steps: int = 256,
    throw: bool = True,
) -> Fit:
    """Parameters of a model from data, by least squares, with their confidence intervals.

        def residuals(parameters, data):
            start = ej.State(jnp.stack([parameters["l"], 0.0]), [0.0, 0.0])
            sol = ej.simulate(
                system, scheme, start, parameters, h=0.01, num_steps=200, throw=False
            )
            return (sol.ys.q - data) / 0.01  # in units of the noise

        print(ej.fit(residuals, {"m": 1.0, "l": 0.8}, measured, positive=True))

    Derivatives go through whole runs, constraints, rotations and dampers included. A step
    to where a run fails is taken back: make runs with `throw=False`, and starts that are
    known as functions of the parameters without `initial_state`, which raises an error for
    lengths that are far off. Under `jit` and `vmap` all works with `throw=False`; and in
    `sweep`, over several guesses:

        fits = ej.sweep(lambda **guess: ej.fit(residuals, guess, data, throw=False), over)
        fits.smallest("cost").values

    Runs that are long against the time in which the motion forgets its start (chaos) have
    a cost of many minima: see `MultipleShooting`.

    **Arguments:**

    - `residuals`: a function of the parameters and the data that returns a pytree of
      arrays, what the model says less what was measured: positions, angles, energies. All
      residuals should have one standard deviation, so divide those of each kind by its
      own; what it is in common is estimated.
    - `guess`: of the parameters, a pytree of numbers.
    - `data`: handed to `residuals`; new data of the same shape compiles nothing.
    - `positive`: which parameters are positive, a pytree of flags like `guess`, or one
      flag for a part of it. Their logarithms are sought.
    - `solver`: of optimistix, for least squares or a minimiser such as `optimistix.BFGS`
      (which takes reverse derivatives: fewer runs where parameters are many). Its
      tolerances ask for no more than noisy data can tell.
    - `max_steps`: of the solver. A positive parameter that the data would rather have
      at zero, such as a damper that is not there, takes all of them.
    - `throw`: raise an error for a fit that failed; with `False` look at `result`.

    **Returns:** a `Fit`.

    **Raises:** `TypeError` or `ValueError` for bad input, for fewer residuals than
    parameters, for residuals that are not finite at the guess and, if `throw`, for
    parameters that the residuals do not determine; `equinox.EquinoxRuntimeError` for a
    solver that fails if `throw`.

    **Reference:** G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989), chapter 5.
    """
    if not isinstance(solver, Solver):
        raise TypeError(
            "`solver` must be one of optimistix for least squares or for minimisation, "
            "such as `optimistix.LevenbergMarquardt(rtol=1e-6, atol=1e-6)`; got "
            f"{solver!r}."
        )
    max_steps = positive_integer("max_steps", max_steps)
    guess = jax.tree.map(_real, guess)
    flags = _flags(positive, guess)
    numbers, unravel = ravel_pytree(guess)
    unknowns = Unknowns(flags, unravel)
    if is_known(numbers):
        _check_guess(guess, numbers, flags)
    found, weak = _fit(residuals, unknowns, numbers, data, solver, max_steps, guess)
    return _raise_failure(found, weak) if throw else found


@eqx.filter_jit
def _fit(residuals, unknowns, numbers, data, solver, max_steps, guess):
    def vector(x: Array, data: Any) -> Array:
        return ravel_pytree(residuals(unknowns.parameters(x), data))[0]

    x0 = unknowns.vector(numbers)
    count, names = jax.eval_shape(vector, x0, data).size, names_of(guess)
    freedom = count - x0.size
    if freedom < 1:
        raise ValueError(
            f"`residuals` returned {count} numbers for {x0.size} parameters: to tell how "
            "well these are known there must be more."
        )
    sought = optx.least_squares(vector, solver, x0, data, max_steps=max_steps, throw=False)
    x = sought.value
    at = lambda x: (vector(x, data),) * 2
    jacobian, rest = jax.jacfwd(at, has_aux=True)(x)
    cost = rest @ rest
    spread, weak = covariance(jacobian, cost / freedom)
    error = jnp.where(weak, jnp.inf, jnp.sqrt(jnp.diagonal(spread)))
    slopes, half = unknowns.slopes(x), student(freedom) * error
    iterations = jnp.asarray(sought.stats["num_steps"])
    each = 2 if isinstance(solver, optx.AbstractMinimiser) else x.size + 1
    found = Fit(
        parameters=unknowns.parameters(x),
        standard_errors=unknowns.unravel(slopes * error),
        lower=unknowns.parameters(x - half),
        upper=unknowns.parameters(x + half),
        covariance=slopes[:, None] * spread * slopes[None],
        cost=cost,
        iterations=iterations,
        simulations=iterations * each + x.size + 1,
        result=sought.result,
        degrees_of_freedom=freedom,
        names=names,
    )
    return found, weak


def _real(x: Any) -> Array:
    array = jnp.asarray(x)
    if jnp.iscomplexobj(array):
        raise TypeError(f"`guess` must hold real numbers, got {x!r}.")
    return array.astype(jnp.result_type(float))


def _flags(positive: PyTree[bool], guess: PyTree[Array]) -> Array:
    """A flag for each number of the guess."""
    spread = lambda flag, part: jax.tree.map(lambda x: jnp.full(x.shape, bool(flag)), part)
    try:
        flags = jax.tree.map(spread, positive, guess)
    except (ValueError, TypeError) as error:
        raise ValueError(
            "`positive` must be a flag, or a pytree of flags like `guess`: "
            f"{positive!r} does not fit to the parameters {', '.join(names_of(guess))}."
        ) from error
    return ravel_pytree(flags)[0]


def _check_guess(guess: PyTree[Array], numbers: Array, flags: Array) -> None:
    if numbers.size == 0:
        raise ValueError("`guess` holds no parameters.")
    for name, value, flag in zip(names_of(guess), numbers, flags, strict=True):
        if not np.isfinite(value) or (flag and value <= 0):
            raise ValueError(
                f"The guess of `{name}` is {value:g}; it must be "
                f"{'positive and ' if flag else ''}finite."
            )


def _raise_failure(found: Fit, weak: Array) -> Fit:
    failed = found.result != optx.RESULTS.successful
    if not is_known((found, weak)):
        return found.result.error_if(found, failed)
    if not np.isfinite(found.cost):
        raise ValueError(
            "The residuals are not finite where the fit began, or where it ended: a run "
            "fails there. Try a run with the parameters of the guess, and a shorter `h`."
        )
    if failed:
        raise eqx.EquinoxRuntimeError(
            f"The fit failed after {int(found.iterations)} iterations. "
            f"{optx.RESULTS[found.result]} (`throw=False` returns what it found.)"
        )
    if np.any(weak):
        blind = ", ".join(n for n, w in zip(found.names, weak, strict=True) if w)
        raise ValueError(
            f"The residuals do not determine {blind}: a change of these, alone or "
            "together, changes nothing. (Of a pendulum the mass cannot be seen, of masses "
            "often their quotient alone.) Keep one at a known value, or measure more. "
            "(`throw=False` returns the fit.)"
        )
    return found
