"""The strains of beam elements, as laws of the frames of their two sections.

An element connects the sections at its ends. Between them the place is linear, and the
section in the middle, where the strains are evaluated, is turned by half of the rotation
from the first to the second. With its axes `d_i` and the length `l`,

    Gamma_i = d_i . (x_b - x_a) / l         stretch, shear 2, shear 3
    kappa_i = phi_i / l                     torsion, bending 2, bending 3

where `phi` is the rotation vector. Rigid motions do not change the strains, and one point
per element avoids locking. In space all are composed of products of the directors, so the
chain rule for difference quotients keeps energy and momenta to round-off.

**Reference:** J. C. Simo and L. Vu-Quoc, Comput. Methods Appl. Mech. Eng. 58 (1986) 79-116;
M. A. Crisfield and G. Jelenic, Proc. R. Soc. A 455 (1999) 1125-1147.
"""

import abc
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ._frames import Frame, Numbers
from ._measures import AbstractLaw


class AbstractStrains(AbstractLaw):
    """The strains of an element, with those of stretch, shear, torsion and bending in this
    order.

    - `is_coupled`: whether the stiffness is a matrix `numbers["stiffness"]`.
    - `num_forces`: the number of strains of stretch and shear, which come first.
    - `components`: the strains whose energy is that of stretch, shear, torsion and bending.
    """

    is_coupled: bool
    num_forces: int
    components: dict[str, tuple[int, ...]]

    @abc.abstractmethod
    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Array:
        """The strains, from which those of the reference are not subtracted."""

    @abc.abstractmethod
    def diagonal(self, numbers: Numbers) -> Array:
        """The stiffnesses of all strains of a section without coupling."""

    def resultants(self, strains: Array, numbers: Numbers) -> Array:
        """The forces and moments of strains `(elements, strains)`, in the axes of the
        sections."""
        if self.is_coupled:
            return strains @ numbers["stiffness"]
        return strains * self.diagonal(numbers)[None]


@dataclass(frozen=True)
class PlanarStrains(AbstractStrains):
    """Stretch, shear and bending."""

    is_coupled: bool
    reads = ("origin", "angle")
    num_forces = 2
    components = dict(stretch=(0,), shear=(1,), bending=(2,))

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Float[Array, "3"]:
        along = (b.origin - a.origin) / numbers["length"]
        middle = 0.5 * (a.angle + b.angle)
        c, s = jnp.cos(middle), jnp.sin(middle)
        stretch, shear = c * along[0] + s * along[1], c * along[1] - s * along[0]
        return jnp.stack([stretch, shear, (b.angle - a.angle) / numbers["length"]])

    def diagonal(self, numbers: Numbers) -> Float[Array, "3"]:
        return jnp.stack([numbers["EA"], numbers["GA"], numbers["EI"]])


@dataclass(frozen=True)
class SpatialStrains(AbstractStrains):
    """Stretch, two of shear, torsion and two of bending."""

    is_coupled: bool
    num_forces = 3
    components = dict(stretch=(0,), shear=(1, 2), torsion=(3,), bending=(4, 5))

    def __call__(self, a: Frame, b: Frame, numbers: Numbers) -> Float[Array, "6"]:
        # The vectors `p` and `w` are along the axis of the rotation `phi` from a to b, of
        # the lengths tan(phi/2) and tan(phi/4). The mean of the axes of a and b is the
        # middle section, shortened across this axis.
        length = numbers["length"]
        along = (b.origin - a.origin) / length
        turned = jnp.sum(a.axes[:, None] * b.axes[None], axis=2)
        sine = jnp.stack([
            turned[2, 1] - turned[1, 2],
            turned[0, 2] - turned[2, 0],
            turned[1, 0] - turned[0, 1],
        ])  # fmt: skip
        p = sine / (1 + jnp.trace(turned))
        growth = jnp.sqrt(1 + jnp.sum(p * p))
        w = p / (1 + growth)
        mean = jnp.sum(0.5 * (a.axes + b.axes) * along[None], axis=1)
        gamma = growth * mean - jnp.sum(p * mean) * w
        kappa = 4 / length * _angle_of_tangent(jnp.sum(w * w)) * w
        return jnp.concatenate([gamma, kappa])

    def diagonal(self, numbers: Numbers) -> Float[Array, "6"]:
        EA, GJ = numbers["EA"][None], numbers["GJ"][None]
        return jnp.concatenate([EA, numbers["GA"], GJ, numbers["EI"]])


def _convergent(levels: int) -> tuple[list[float], list[float]]:
    """The coefficients of numerator and denominator of a convergent of the continued
    fraction `1/(1 + x/(3 + 4x/(5 + 9x/(7 + ...))))` of `atan(sqrt x) / sqrt x`."""
    top, bottom = np.array([1.0]), np.array([2.0 * levels + 1])
    for k in range(levels, 0, -1):
        top, bottom = bottom, np.polyadd(
            (2 * k - 1) * bottom, k * k * np.append(top, 0.0)
        )  # fmt: skip
    return (top / bottom[-1]).tolist(), (bottom / bottom[-1]).tolist()


# Up to a right angle in an element the error is below 1e-14. Unlike the arc tangent of a
# root, this function is smooth where sections are parallel.
_TOP, _BOTTOM = _convergent(10)


def _angle_of_tangent(squared: Scalar) -> Scalar:
    """`atan(x) / x` of a square `x^2`."""
    top, bottom = jnp.zeros_like(squared), jnp.zeros_like(squared)
    for coefficient in _TOP:
        top = top * squared + coefficient
    for coefficient in _BOTTOM:
        bottom = bottom * squared + coefficient
    return top / bottom
