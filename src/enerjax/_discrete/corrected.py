"""Discrete gradients that correct a mean gradient along the increment.

Both forms are `g + c W d` with `d = b - a`, a mean gradient `g`, a metric `W` (in a step
that of the inertia, otherwise one unless `weights` are given), and the scalar `c` that
makes the directionality exact:

    c = (fn(b) - fn(a) - g . d) / (d . W d)

The numerator is a difference of nearly equal numbers: it has an error of the size of
round-off however small `d` is, which the division would amplify. Below that size no digit
of it is right, so it is dropped. The directionality then fails by no more than the
round-off of `fn` itself,

    |D . d - (fn(b) - fn(a))| <= eps (|fn(a)| + |fn(b)| + sum_k |g_k| (|a_k| + |b_k|)),

(or by that of its terms, if their size is passed: they can cancel), and the value and all
its derivatives stay finite down to `b = a`. For functions that are at most quadratic the
numerator is round-off at any `d`.
"""

import abc
import functools
from collections.abc import Callable, Iterable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar
from .base import AbstractDerivative, significant


# The diagonal of the metric of a correction, or its product with an increment.
Weights: TypeAlias = Coordinates | float | Callable[[Coordinates], Coordinates]


def _corrected(
    fn_a: Scalar,
    fn_b: Scalar,
    a: Coordinates,
    b: Coordinates,
    mean: Coordinates,
    weights: Weights,
    size: Scalar | float,
) -> Coordinates:
    d = b - a
    along = weights(d) if callable(weights) else weights * d
    defect = fn_b - fn_a - mean @ d
    terms = abs(fn_a) + abs(fn_b) + abs(mean) @ (abs(a) + abs(b))
    defect = significant(defect, size + terms)
    # The derivative of `where` multiplies the branch that is not chosen by zero, so this
    # must be finite too.
    length2 = d @ along
    length2 = jnp.where((defect != 0) & (length2 != 0), length2, 1.0)
    return mean + defect / length2 * along


class AbstractCorrected(AbstractDerivative):
    """A mean gradient by quadrature, made exact along the increment."""

    @abc.abstractmethod
    def _quadrature(self) -> Iterable[tuple[float, float]]:
        """Nodes in [-1, 1] and their weights, whose sum is 1."""

    def _mean(
        self, fn: Callable[[Coordinates], Array], a: Coordinates, b: Coordinates
    ) -> Array:
        mid, half = 0.5 * (a + b), 0.5 * (b - a)
        # Unrolled: a batched gradient hides the structure of `fn` from XLA.
        return jnp.asarray(
            sum(
                jnp.asarray(weight, a.dtype) * fn(mid + jnp.asarray(x, a.dtype) * half)
                for x, weight in self._quadrature()
            )
        )

    def gradient(
        self,
        fn: Callable[[Coordinates], Scalar],
        a: Coordinates,
        b: Coordinates,
        *,
        weights: Weights = 1.0,
        size: Scalar | float = 0.0,
    ) -> Coordinates:
        mean = self._mean(jax.grad(fn), a, b)
        return _corrected(fn(a), fn(b), a, b, mean, weights, size)

    def gradients_of_rows(
        self,
        fn: Callable[[Coordinates], Float[Array, " rows"]],
        gradients: Callable[[Coordinates], Float[Array, "rows width"]],
        select: Callable[[Coordinates], Float[Array, "rows width"]],
        a: Coordinates,
        b: Coordinates,
        weights: Coordinates,
    ) -> Float[Array, "rows width"]:
        """The discrete gradient of each row of `fn`, in the coordinates that it depends on.

        `select` picks these coordinates, and `gradients` are the derivatives with respect
        to them. A correction of each row couples only coordinates that `fn` couples.
        """
        mean = self._mean(gradients, a, b)
        correct = jax.vmap(functools.partial(_corrected, size=0.0))
        return correct(fn(a), fn(b), select(a), select(b), mean, select(weights))


class Gonzalez(AbstractCorrected):
    """Gonzalez' midpoint discrete gradient: one gradient and two evaluations.

    Second-order accurate; the midpoint gradient if `fn` is quadratic. It does not keep the
    symmetries of `fn`, so momenta are conserved to second order only.

    **Reference:** O. Gonzalez, Time integration and discrete Hamiltonian systems,
    J. Nonlinear Sci. 6 (1996) 449-467.
    """

    def _quadrature(self) -> Iterable[tuple[float, float]]:
        return ((0.0, 1.0),)


class MeanValue(AbstractCorrected):
    """The gradient averaged over the segment by Gauss quadrature, then corrected.

    With two or more points it approximates the mean-value (averaged vector field)
    discrete gradient to fourth order, so that it limits neither the third order of the
    decaying schemes nor the fourth order of `EnergyConsistent`. It costs one gradient for
    each point and two evaluations of the function.

    **Arguments:**

    - `points`: number of Gauss points, at least 1. More than 2 reduce the error for a
      strongly curved potential, but do not raise the order.

    **Reference:** G. R. W. Quispel and D. I. McLaren, A new class of energy-preserving
    numerical integration methods, J. Phys. A 41 (2008) 045206.
    """

    points: int = eqx.field(default=2, static=True)

    def __check_init__(self):
        if self.points < 1:
            raise ValueError(f"`MeanValue(points={self.points})`: use 1 point or more.")

    def _quadrature(self) -> Iterable[tuple[float, float]]:
        nodes, weights = np.polynomial.legendre.leggauss(self.points)
        return zip(nodes.tolist(), (weights / 2).tolist(), strict=True)
