"""The interface of joints, forces and drives."""

import abc
import inspect
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
        """The law and the numbers of the part, from the start pose of its bodies."""


class AbstractForce(AbstractPart):
    """A force of a scene; its law is that of its energy, or of its force."""


class AbstractFunctionOfPose(eqx.Module):
    """A part that is a user's function of the pose, `function(view, args)`."""

    name: eqx.AbstractVar[str]
    function: eqx.AbstractVar[PoseFunction]

    def __check_init__(self):
        check_function(self.name, "function", self.function, "view", "args")


def only_parts(names: dict[str, Any]) -> Callable[[], list[str]]:
    """A `__dir__` that lists only the classes of parts among the names of a module."""

    def parts() -> list[str]:
        return sorted(
            name
            for name, value in names.items()
            if inspect.isclass(value)
            and "name" in getattr(value, "__dataclass_fields__", ())
            and not name.startswith("Abstract")
        )

    return parts
