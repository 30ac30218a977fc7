"""Potential energies that are quadratic in strains, and say so."""

import abc
from typing import TypeAlias

import equinox as eqx
from jaxtyping import Array, Float

from .._types import Args, Coordinates, Scalar


# The strains of each kind of springs and elements, or the stresses that belong to them.
StrainArrays: TypeAlias = tuple[Array, ...]


class AbstractStrainEnergy(eqx.Module):
    """A potential energy that contains the energy of strains, `Gamma . K Gamma / 2`.

    Strains `Gamma` are functions of the coordinates, such as the stretch of a spring. The
    stiffness `K` is symmetric and does not depend on the coordinates. The rest of the
    potential is any function.
    """

    @abc.abstractmethod
    def __call__(self, q: Coordinates, args: Args = None) -> Scalar:
        """The whole potential energy."""

    @abc.abstractmethod
    def strains(self, q: Coordinates, args: Args = None) -> StrainArrays:
        """The strains, which vanish where there is no stress."""

    @abc.abstractmethod
    def stresses(self, strains: StrainArrays, args: Args = None) -> StrainArrays:
        """`K Gamma` (energy per strain), linear in the strains."""

    @abc.abstractmethod
    def angles(self, q: Coordinates, args: Args = None) -> Float[Array, " angles"]:
        """Angles between minus and plus half a turn, where the energy is not smooth.

        A step in which one of them passes half a turn fails.
        """
