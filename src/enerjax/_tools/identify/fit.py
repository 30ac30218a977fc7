from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree
from typing_extensions import TypeAliasType

from ..._programs import compiled, is_known
from ..._run import positive_integer
from .estimate import covariance, Fit, names_of, student, Unknowns


Residuals = TypeAliasType("Residuals", Callable[[Any, Any], PyTree[Array]])
Solver = TypeAliasType("Solver", optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser)


def fit(
    residuals: Residuals,
    guess: PyTree[Any],
    data: PyTree[Any] = None,
    *,
    positive: PyTree[bool] = False,
    solver: Solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6),
    max_steps: int = 256,
    throw: bool = True,
) -> Fit:
    """Fits parameters of a model to data by least squares, with confidence intervals.

        def residuals(parameters, data):
            start = ej.State(jnp.stack([parameters["l"], 0.0]), [0.0, 0.0])
            sol = ej.simulate(
                system, scheme, start, parameters, h=0.01, num_steps=200, throw=False
            )
            return (sol.ys.q - data) / 0.01  # in units of the noise

        print(ej.fit(residuals, {"m": 1.0, "l": 0.8}, measured, positive=True))

    The residuals may contain whole runs, with constraints, rotations and dampers. The
    solver rejects a step to parameters for which a run fails, so use `throw=False` in runs
    and in `initial_state`. With `throw=False` the fit itself works under `jit` and `vmap`,
    and in a `sweep` over several guesses:

        fits = ej.sweep(lambda **guess: ej.fit(residuals, guess, data, throw=False), over)
        fits.smallest("cost").values

    For long chaotic runs the cost has many local minima: see `MultipleShooting`.

    **Arguments:**

    - `residuals`: a function of the parameters and the data that returns a pytree of
      arrays: the prediction of the model less the measurement, of positions, angles or
      energies. Divide residuals of each kind by their standard deviation up to a common
      factor; this factor is estimated.
    - `guess`: of the parameters, a pytree of numbers.
    - `data`: passed to `residuals`; new data of the same shape does not recompile.
    - `positive`: which parameters are positive, a pytree of flags like `guess`, or one
      flag for a part of it. The fit uses their logarithms.
    - `solver`: a least-squares solver of optimistix, or a minimiser such as
      `optimistix.BFGS`, which uses reverse derivatives and needs fewer runs if there are
      many parameters. The default tolerances suit noisy data.
    - `max_steps`: of the solver. If the best value of a positive parameter is zero, such as
      that of a damper that does not exist, the fit takes all of these steps.
    - `throw`: raise an error if the fit failed; with `False` check `result`.

    **Returns:** a `Fit`.

    **Raises:** `TypeError` or `ValueError` for bad input, for fewer residuals than
    parameters, for residuals that are not finite at the guess and, if `throw`, for
    parameters that the residuals do not determine; `equinox.EquinoxRuntimeError` for a
    solver that fails if `throw`.

    **Reference:** G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989), chapter 5.
    """
    if not isinstance(solver, Solver.__value__):
        raise TypeError(
            "`solver` must be a least-squares solver or minimiser of optimistix, such as "
            f"`optimistix.LevenbergMarquardt(rtol=1e-6, atol=1e-6)`; got {solver!r}."
        )
    max_steps = positive_integer("max_steps", max_steps)
    guess = jax.tree.map(_real, guess)
    flags = _flags(positive, guess)
    numbers, unravel = ravel_pytree(guess)
    unknowns = Unknowns(flags, unravel)
    if is_known(numbers):
        _check_guess(guess, numbers, flags)
    inputs = (residuals, unknowns, numbers, data, solver, max_steps, guess)
    found, undetermined = _fit(*inputs)
    return _raise_failure(found, undetermined) if throw else found


@compiled
def _fit(residuals, unknowns, numbers, data, solver, max_steps, guess):
    def vector(x: Array, data: Any) -> Array:
        return ravel_pytree(residuals(unknowns.parameters(x), data))[0]

    x0 = unknowns.vector(numbers)
    count, names = jax.eval_shape(vector, x0, data).size, names_of(guess)
    freedom = count - x0.size
    if freedom < 1:
        raise ValueError(
            f"`residuals` returned {count} numbers for {x0.size} parameters: an estimate "
            "of their uncertainty needs more."
        )
    solution = optx.least_squares(
        vector, solver, x0, data, max_steps=max_steps, throw=False
    )
    x = solution.value
    with_value = lambda x: (vector(x, data),) * 2
    jacobian, remaining = jax.jacfwd(with_value, has_aux=True)(x)
    cost = remaining @ remaining
    spread, undetermined = covariance(jacobian, cost / freedom)
    error = jnp.where(undetermined, jnp.inf, jnp.sqrt(jnp.diagonal(spread)))
    slopes, half = unknowns.slopes(x), student(freedom) * error
    iterations = jnp.asarray(solution.stats["num_steps"])
    per_step = 2 if isinstance(solver, optx.AbstractMinimiser) else x.size + 1
    found = Fit(
        parameters=unknowns.parameters(x),
        standard_errors=unknowns.unravel(slopes * error),
        lower=unknowns.parameters(x - half),
        upper=unknowns.parameters(x + half),
        covariance=slopes[:, None] * spread * slopes[None],
        cost=cost,
        iterations=iterations,
        simulations=iterations * per_step + x.size + 1,
        result=solution.result,
        degrees_of_freedom=freedom,
        names=names,
    )
    return found, undetermined


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


def _raise_failure(found: Fit, undetermined: Array) -> Fit:
    failed = found.result != optx.RESULTS.successful
    if not is_known((found, undetermined)):
        return found.result.error_if(found, failed)
    if not np.isfinite(found.cost):
        raise ValueError(
            "The residuals are not finite at the guess, or at the end of the fit: a run "
            "fails there. Try a run with the parameters of the guess, and a shorter `h`."
        )
    if failed:
        raise eqx.EquinoxRuntimeError(
            f"The fit failed after {int(found.iterations)} iterations. "
            f"{optx.RESULTS[found.result]} (`throw=False` returns what it found.)"
        )
    if np.any(undetermined):
        pairs = zip(found.names, undetermined, strict=True)
        names = ", ".join(name for name, flag in pairs if flag)
        raise ValueError(
            f"The residuals do not determine {names}: a change of these, alone or "
            "together, changes nothing. (The mass of a pendulum does not affect its "
            "motion, and often only the ratio of two masses does.) Fix one of them at a "
            "known value, or measure more. (`throw=False` returns the fit.)"
        )
    return found
