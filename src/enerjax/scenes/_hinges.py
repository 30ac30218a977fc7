"""Axes that joints keep common to two bodies: an angle in space is about such an axis."""

from typing import Any, NamedTuple

import numpy as np

from .._programs import is_known


# The angle between two axes, below which they are parallel.
_PARALLEL = 1e-3


class Hinge(NamedTuple):
    """A joint between two bodies, and the axis in space that it keeps common to both;
    `None` where it keeps every direction."""

    name: str
    bodies: frozenset[str]
    axis: Any

    def keeps(self, axis: Any) -> bool:
        if self.axis is None:
            return True
        return float(np.linalg.norm(np.cross(self.axis, axis))) <= _PARALLEL


class Hinges(tuple[Hinge, ...]):
    """All joints of a scene that keep a direction common to their bodies, at the start."""

    def share(self, a: str, b: str, axis: Any) -> bool:
        """Whether the joints keep an axis in space common to two bodies, directly or over
        others. Axes that are traced count as common."""
        if not is_known((axis, [hinge.axis for hinge in self])):
            return True
        found, more = set(), {a}
        while more:
            found |= more
            joined = [x.bodies for x in self if x.keeps(axis) and x.bodies & found]
            more = set().union(*joined) - found
        return b in found

    def between(self, a: str, b: str) -> list[Hinge]:
        """Those that connect two bodies."""
        return [x for x in self if x.bodies == {a, b} and x.axis is not None]
