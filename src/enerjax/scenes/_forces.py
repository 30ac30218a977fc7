"""What all forces of a scene have in common."""

import abc

import equinox as eqx

from ._frames import Numbers
from ._measures import AbstractLaw
from ._start import Ends


class AbstractForce(eqx.Module):
    """A force between two bodies: `a` and `b` are names, or `"ground"`."""

    name: eqx.AbstractVar[str]
    a: eqx.AbstractVar[str]
    b: eqx.AbstractVar[str]

    @abc.abstractmethod
    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        """The law of its energy, or of its push, and its numbers, from the start pose."""
