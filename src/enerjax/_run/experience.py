"""What earlier calls have shown about systems of one structure."""

import dataclasses
import functools
from collections.abc import Hashable

from .._programs import structure_of
from .._system import AbstractSystem, State
from .._types import Args
from ..schemes import AbstractScheme


@dataclasses.dataclass
class Experience:
    """What is known of a system with a scheme, whatever its numbers are.

    - `has_valid_gradients`: whether its discrete gradients have passed their check.
    - `is_linear`: whether all forces are constant; `None` before the first run.
    - `needs_newton`: whether a run has failed without Newton's method, and not with it.
    """

    has_valid_gradients: bool = False
    is_linear: bool | None = None
    needs_newton: bool = False


def experience_of(
    scheme: AbstractScheme, system: AbstractSystem, start: State, args: Args
) -> Experience:
    """The experience with this structure; it is shared, and calls add to it."""
    structure = structure_of((scheme, system, start, args))
    return Experience() if structure is None else remembered(structure)


@functools.lru_cache(maxsize=256)
def remembered(structure: Hashable) -> Experience:
    return Experience()
