"""Discrete gradients that correct a mean gradient along the increment.

Both forms are `g + c W d` with `d = b - a`, a mean gradient `g`, the weights `W` of the
entries (one, unless they have different units), and the scalar `c` that makes the
directionality exact:

    c = (fn(b) - fn(a) - g . d) / (d . W d)

The bracket is a difference of nearly equal numbers: it carries an error of round-off
size however small `d` is, and the division would amplify it. Below that size it holds
no digit, so it is dropped; the directionality then fails by no more than the round-off
of `fn` itself,

    |D . d - (fn(b) - fn(a))| <= eps (|fn(a)| + |fn(b)| + sum_k |g_k| (|a_k| + |b_k|)),

(or by that of its terms, where their size is given: they can cancel), and the value and
all its derivatives stay finite down to `b = a`. For functions that are at most quadratic
the bracket is nothing but round-off at any `d`.
"""

import abc
from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar
from .base import AbstractDerivative, significant


def _closed(
    fn_a: Scalar,
    fn_b: Scalar,
    a: Coordinates,
    b: Coordinates,
    mean: Coordinates,
    weights: Coordinates | float,
    size: Scalar | float,
) -> Coordinates:
    d = b - a
    along = weights * d
    defect = fn_b - fn_a - mean @ d
    own = abs(fn_a) + abs(fn_b) + abs(mean) @ (abs(a) + abs(b))
    defect = significant(defect, size + own)
    # Both operands of the quotient are guarded: under autodiff the branch that `where`
    # does not take is multiplied by zero, and must be finite for that.
    length2 = d @ along
    length2 = jnp.where((defect != 0) & (length2 != 0), length2, 1.0)
    return mean + defect / length2 * along


class AbstractCorrected(AbstractDerivative):
    """A mean gradient by quadrature, made exact along the increment."""

    @abc.abstractmethod
    def _quadrature(self) -> Iterable[tuple[float, float]]:
        """Nodes in [-1, 1], and what they contribute, 1 in all."""

    def _mean(
        self, fn: Callable[[Coordinates], Array], a: Coordinates, b: Coordinates
    ) -> Array:
        mid, half = 0.5 * (a + b), 0.5 * (b - a)
        # Unrolled: a batched gradient hides the structure of `fn` from XLA.
        return jnp.asarray(
            sum(
                jnp.asarray(share, a.dtype) * fn(mid + jnp.asarray(x, a.dtype) * half)
                for x, share in self._quadrature()
            )
        )

    def gradient(
        self,
        fn: Callable[[Coordinates], Scalar],
        a: Coordinates,
        b: Coordinates,
        *,
        weights: Coordinates | float = 1.0,
        size: Scalar | float = 0.0,
    ) -> Coordinates:
        mean = self._mean(jax.grad(fn), a, b)
        return _closed(fn(a), fn(b), a, b, mean, weights, size)

    def gradients_of_rows(
        self,
        fn: Callable[[Coordinates], Float[Array, " rows"]],
        gradients: Callable[[Coordinates], Float[Array, "rows width"]],
        own: Callable[[Coordinates], Float[Array, "rows width"]],
        a: Coordinates,
        b: Coordinates,
    ) -> Float[Array, "rows width"]:
        """The discrete gradient of each row of `fn`, in the coordinates that it depends on.

        `own` picks these from all, and `gradients` are the derivatives with respect to
        them. Corrections by rows couple no coordinates that the function does not.
        """
        mean = self._mean(gradients, a, b)
        close = jax.vmap(lambda *ends: _closed(*ends, weights=1.0, size=0.0))
        return close(fn(a), fn(b), own(a), own(b), mean)


class Gonzalez(AbstractCorrected):
    """Gonzalez' midpoint discrete gradient: one gradient and two evaluations.

    Second-order accurate; exact midpoint gradient for quadratic functions. Keeps no
    symmetry of `fn`: momenta are conserved to second order only.

    **Reference:** O. Gonzalez, Time integration and discrete Hamiltonian systems,
    J. Nonlinear Sci. 6 (1996) 449-467.
    """

    def _quadrature(self) -> Iterable[tuple[float, float]]:
        return ((0.0, 1.0),)


class MeanValue(AbstractCorrected):
    """The gradient averaged over the segment by Gauss quadrature, then corrected.

    With two or more points it approximates the mean-value (averaged vector field)
    discrete gradient to fourth order, so that it limits neither the third order of the
    decaying schemes nor the fourth of `EnergyConsistent`. Costs one gradient a point
    and two evaluations.

    **Arguments:**

    - `points`: number of Gauss points, at least 1. More than 2 lower the error of a
      strongly curved potential, not the order.

    **Reference:** G. R. W. Quispel and D. I. McLaren, A new class of energy-preserving
    numerical integration methods, J. Phys. A 41 (2008) 045206.
    """

    points: int = eqx.field(default=2, static=True)

    def __check_init__(self):
        if self.points < 1:
            raise ValueError(f"`MeanValue(points={self.points})`: use 1 point or more.")

    def _quadrature(self) -> Iterable[tuple[float, float]]:
        nodes, shares = np.polynomial.legendre.leggauss(self.points)
        return zip(nodes.tolist(), (shares / 2).tolist(), strict=True)
