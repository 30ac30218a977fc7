"""The estimate of a fit and its uncertainty."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..._types import Count, Scalar, Vector


CONFIDENCE = 0.95


class Fit(eqx.Module):
    """Estimated parameters and their uncertainty.

    - `parameters`: the estimate, a pytree like the guess.
    - `standard_errors`: of each parameter, the same pytree; infinite if the data do not
      determine the parameter.
    - `lower`, `upper`: the ends of the 95 % confidence intervals (Student's t), from the
      linearisation at the estimate; those of positive parameters use their logarithm.
    - `covariance`: of all parameters in the order of `names`, shape `(n, n)`.
    - `cost`: the sum of the squares of the residuals.
    - `degrees_of_freedom`: the number of residuals less that of parameters.
    - `iterations`: of the solver, including rejected steps.
    - `simulations`: the number of evaluations of the residuals, of their derivative with
      respect to one parameter, and (for minimisers) of a gradient; including those for the
      covariance.
    - `result`: `optimistix.RESULTS.successful`, or why the solver stopped.
    - `names`: of the parameters, from their path in the pytree.

    `print` shows a table.
    """

    parameters: PyTree[Any]
    standard_errors: PyTree[Any]
    lower: PyTree[Any]
    upper: PyTree[Any]
    covariance: Float[Array, "n n"]
    cost: Scalar
    iterations: Count
    simulations: Count
    result: optx.RESULTS
    degrees_of_freedom: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def noise(self) -> Scalar:
        """The standard deviation of the residuals."""
        return jnp.sqrt(self.cost / self.degrees_of_freedom)

    def plot(
        self,
        predict: Callable[[Any], Any],
        data: Vector,
        ts: Vector | None = None,
        *,
        ax: Any = None,
        units: dict[str, str] | None = None,
    ) -> Any:
        """The data, and the prediction with its 95 % interval.

        The interval is that of the prediction by the uncertainty of the parameters, from
        the linearisation at the estimate; it does not include the noise of the data.

        **Arguments:**

        - `predict`: a function of the parameters that returns what was measured, shape
          `(times,)` or `(times, n)`.
        - `data`: the measurements, of the same shape.
        - `ts`: their times.
        - `ax`: axes of matplotlib, by default new ones.
        - `units`: names for the labels, such as `{"time": "s"}`.

        **Returns:** the axes.

        **Raises:** `ValueError` for shapes that differ.
        """
        from .plots import plot_prediction

        return plot_prediction(self, predict, data, ts, ax, units)

    def plot_intervals(
        self,
        truth: PyTree[Any] = None,
        *,
        names: Sequence[str] | None = None,
        ax: Any = None,
    ) -> Any:
        """The 95 % intervals of the parameters, relative to their estimates, or to `truth`,
        a pytree like the parameters. `names` chooses some of them.

        **Returns:** the axes of matplotlib, which are `ax` or new ones.

        **Raises:** `ValueError` for a name that is none, and a `truth` of other parameters.
        """
        from .plots import plot_intervals

        return plot_intervals(self, truth, names, ax)

    def __str__(self) -> str:
        columns = (self.parameters, self.standard_errors, self.lower, self.upper)
        numbers = np.stack([np.asarray(ravel_pytree(x)[0]) for x in columns], axis=1)
        width = max(map(len, (*self.names, "parameter")))
        lines = [f"{'parameter':{width}s}  {'estimate':>12s}  {'error':>8s}  95 % interval"]
        for name, (value, error, low, high) in zip(self.names, numbers, strict=True):
            lines.append(
                f"{name:{width}s}  {value:12.6g}  {error:8.2g}  {low:.6g} to {high:.6g}"
            )
        lines.append(
            f"noise {float(self.noise):.3g}, {self.degrees_of_freedom} degrees of freedom, "
            f"{int(self.iterations)} iterations"
        )
        return "\n".join(lines)


class Unknowns(eqx.Module):
    """Parameters as one vector, with the logarithms of positive ones."""

    positive: Array
    unravel: Any = eqx.field(static=True)

    def parameters(self, x: Float[Array, " n"]) -> PyTree[Any]:
        return self.unravel(self.numbers(x))

    def numbers(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        # The exponential of another parameter could overflow; its derivative would be NaN.
        return jnp.where(self.positive, jnp.exp(jnp.where(self.positive, x, 0)), x)

    def vector(self, numbers: Float[Array, " n"]) -> Float[Array, " n"]:
        return jnp.where(
            self.positive, jnp.log(jnp.where(self.positive, numbers, 1)), numbers
        )

    def slopes(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The derivatives of the parameters with respect to the unknowns."""
        return jnp.where(self.positive, self.numbers(x), 1)


def covariance(
    jacobian: Float[Array, "m n"], variance: Scalar
) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """`variance (J^T J)^-1`, and which parameters the rows of `J` do not determine."""
    size = jnp.linalg.norm(jacobian, axis=0)
    scale = jnp.where(size > 0, size, 1)
    _, values, directions = jnp.linalg.svd(jacobian / scale[None], full_matrices=False)
    eps = jnp.finfo(jacobian.dtype).eps
    # Derivatives of a run are accurate to about half the digits.
    is_null = values <= jnp.sqrt(eps) * values[0]
    in_null_space = jnp.sum(jnp.where(is_null[:, None], directions**2, 0), axis=0)
    undetermined = (in_null_space > jnp.sqrt(eps)) | (size == 0)
    inverse = jnp.where(is_null, 0, 1 / jnp.where(is_null, 1, values))
    root = directions.T * inverse[None] / scale[:, None]
    return variance * root @ root.T, undetermined


def student(degrees_of_freedom: int) -> float:
    """Half the width of the confidence interval, in standard errors."""
    return float(scipy.special.stdtrit(degrees_of_freedom, 0.5 + CONFIDENCE / 2))


def names_of(parameters: PyTree[Any]) -> tuple[str, ...]:
    """A name for each number in a pytree."""
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(parameters)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "parameter"
        indices = np.ndindex(np.shape(leaf))
        names += [f"{name}{list(k)}" if k else name for k in indices]
    assert len(names) == sum(math.prod(np.shape(x)) for x in jax.tree.leaves(parameters))
    return tuple(names)
