"""What modules of parts show of themselves."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx


def only_parts(names: dict[str, Any]) -> Callable[[], list[str]]:
    """A `__dir__` that shows the parts among the names of a module, not what they use."""

    def parts() -> list[str]:
        return sorted(
            name
            for name, value in names.items()
            if inspect.isclass(value)
            and issubclass(value, eqx.Module)
            and not name.startswith("Abstract")
        )

    return parts
