"""What joints, forces and drives have in common."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array
from typing_extensions import TypeAliasType

from .._types import Args
from ._ends import Ends
from ._frames import Numbers
from ._measures import AbstractLaw
from ._user_functions import check_function


# A function of the user's, `function(view, args)`.
PoseFunction = TypeAliasType("PoseFunction", Callable[[Any, Args], Array])


class AbstractPart(eqx.Module):
    """A part between two bodies: `a` and `b` are their names, or `"ground"`."""

    name: str
    a: str
    b: str

    @abc.abstractmethod
    def resolve(self, ends: Ends) -> tuple[AbstractLaw, Numbers]:
        """Its law and its numbers, from the start pose of its bodies."""


class AbstractForce(AbstractPart):
    """A force of a scene; its law is that of its energy, or of its force."""


class AbstractFunctionOfPose(eqx.Module):
    """What a scene takes from a function of its user, `function(view, args)`."""

    name: eqx.AbstractVar[str]
    function: eqx.AbstractVar[PoseFunction]

    def __check_init__(self):
        check_function(self.name, "function", self.function, "view", "args")
