"""An extension of griffe, which reads the API: what is left out of the pages."""

import re

from griffe import Attribute, Class, Extension, Function


# The module in front of the name of a class.
MODULE = re.compile(r"\b(?:[a-z_]\w*\.)+(?=[A-Z])")


class PublicApi(Extension):
    """Leaves out fields, which the docstrings of their classes describe, and the private
    modules in the names of types."""

    def on_class_members(self, *, cls: Class, **kwargs) -> None:
        del kwargs
        for name, member in [*cls.members.items()]:
            if isinstance(member, Attribute) and "property" not in member.labels:
                del cls.members[name]

    def on_function(self, *, func: Function, **kwargs) -> None:
        del kwargs
        func.returns = without_modules(func.returns)
        for parameter in func.parameters:
            parameter.annotation = without_modules(parameter.annotation)


def without_modules(annotation: object) -> str | None:
    return None if annotation is None else MODULE.sub("", str(annotation))
