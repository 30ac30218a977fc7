"""Symbols of joints, springs, dampers and motors, in the plane and in space."""

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np

from .canvas import color_of, Dot, Drawing, Faces, Path
from .geometry import across, ball, helix, line_frame, straight, tube, zigzag


Array: TypeAlias = np.ndarray

GREY = color_of("0.6")
_DARK, _RED = color_of("0.25"), color_of("C3")
# The radius of balls in space over the size of the picture.
_BALL = 0.022


class PlaneSymbols:
    """Symbols in the plane; those of joints have the same size in every picture."""

    def __init__(self, size: float):
        self._size = size

    def joint(
        self, symbol: str, place: Array, axes: list[Array], fixed: bool, inside: float
    ) -> Drawing:
        del inside  # bodies are transparent in the plane
        size = 3.0 if symbol == "weld" else 5.0
        dot = Dot(place, _DARK, size, 0.04 * self._size, symbol == "weld")
        return Drawing(faces=self._foot(place) if fixed else (), dots=(dot,))

    def _foot(self, place: Array) -> tuple[Faces, ...]:
        s = 0.03 * self._size
        corners = np.array([[0, 0], [-s, -1.6 * s], [s, -1.6 * s]])
        return (Faces([place + corners], GREY),)

    def slider(self, low: Array, high: Array, end: Array) -> Drawing:
        guide = Path(np.array([low, high]), _DARK, 1.2, True)
        return Drawing(paths=(guide,), dots=(Dot(end, _DARK, 4.0, 0.04 * self._size),))

    def between(
        self, symbol: str, start: Array, end: Array, fixed: Array | None
    ) -> Drawing:
        dot = lambda x: Dot(x, _DARK, 3.0, 0.03 * self._size, True)
        ends = dot(start), dot(end)
        foot = () if fixed is None else self._foot(fixed)
        return Drawing(foot, tuple(self._line(symbol, start, end)), ends)

    def _line(self, symbol: str, start: Array, end: Array) -> Iterator[Path]:
        width = 0.025 * self._size
        if symbol == "spring":
            yield Path(zigzag(start, end, width), _DARK, 1.0)
            return
        if symbol == "rod":
            yield Path(np.array([start, end]), _DARK, 1.5)
            return
        side = line_frame(start, end)[2] * width
        at = lambda part, across=0.0: start + part * (end - start) + across * side
        color = _DARK if symbol == "damper" else _RED
        yield Path(np.array([at(0), at(0.55)]), color, 1.2)
        yield Path(np.array([at(0.55, -0.7), at(0.55, 0.7)]), color, 2.0)
        sleeve = [at(0.35, 1), at(0.7, 1), at(0.7, -1), at(0.35, -1)]
        yield Path(np.array(sleeve), color, 1.2)
        yield Path(np.array([at(0.7), at(1)]), color, 1.2)

    def about(self, symbol: str, place: Array, axes: list[Array]) -> Drawing:
        radius = 0.05 * self._size
        turn = np.linspace(0.1 * np.pi, 1.6 * np.pi, 40)
        if symbol == "torsion spring":
            turn = np.linspace(0, 5 * np.pi, 80)
            radius = radius * np.linspace(0.3, 1, 80)
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        path = place + np.reshape(radius, (-1, 1)) * circle
        color = _RED if symbol == "motor" else _DARK
        drawn = Path(path, color, 3.0 if symbol == "torsion damper" else 1.5)
        faces = ()
        if symbol == "motor":
            tip, head = path[-1], 0.35 * radius
            along, out = np.array([-circle[-1][1], circle[-1][0]]), circle[-1]
            corners = [tip + 1.5 * head * along, tip + head * out, tip - head * out]
            faces = (Faces([np.array(corners)], color),)
        return Drawing(faces, (drawn,))

    def mark(self, place: Array, color: Array) -> Drawing:
        """A point."""
        return Drawing(dots=(Dot(place, color, 6.0, 0.06 * self._size, True),))

    def load(self, place: Array) -> Drawing:
        return Drawing(dots=(Dot(place, _RED, 4.0, 0.04 * self._size, True),))

    def bar(self, path: Array) -> Drawing:
        """A line through points."""
        return Drawing(paths=(Path(path, _DARK, 1.5),))

    def trail(self, path: Array, color: Array) -> Drawing:
        """The path of a point."""
        return Drawing(paths=(Path(path, color, 1.2),))


class SpaceSymbols:
    """Symbols in space, of which all are made of polygons."""

    def __init__(self, size: float):
        self._size = size
        self._ball = ball(_BALL * size)

    def joint(
        self, symbol: str, place: Array, axes: list[Array], fixed: bool, inside: float
    ) -> Drawing:
        """A pin along its axes, or a ball; `inside` is the radius of rods about it."""
        color = GREY if fixed else _DARK
        if symbol == "pin" and axes:
            arm, radius = 0.05 * self._size, 0.018 * self._size
            paths = [np.array([place - arm * x, place + arm * x]) for x in axes]
            return Drawing(tuple(Faces(_closed(x, radius), color) for x in paths))
        # A ball is seen where it is thicker than rods, if it is not too large for that.
        scale = np.clip(1.25 * inside / (_BALL * self._size), 1.0, 2.0)
        return Drawing((Faces(place + scale * self._ball, color),))

    def slider(self, low: Array, high: Array, end: Array) -> Drawing:
        guide = self._tube(low, high, 0.008, GREY)
        return Drawing((guide, Faces(end + self._ball, _DARK)))

    def _tube(self, start: Array, end: Array, width: float, color: Array) -> Faces:
        path = straight(start, end, 0.12 * self._size)
        return Faces(tube(path, width * self._size), color)

    def between(
        self, symbol: str, start: Array, end: Array, fixed: Array | None
    ) -> Drawing:
        foot = () if fixed is None else (Faces(fixed + self._ball, GREY),)
        return Drawing((*foot, *self._line(symbol, start, end)))

    def _line(self, symbol: str, start: Array, end: Array) -> tuple[Faces, ...]:
        size = self._size
        if symbol == "spring":
            coil = tube(helix(start, end, 0.025 * size), 0.004 * size, 4)
            return (Faces(coil, _DARK),)
        if symbol == "rod":
            return (self._tube(start, end, 0.006, _DARK),)
        color = _DARK if symbol == "damper" else _RED
        middle = start + 0.55 * (end - start)
        return (
            self._tube(start, middle, 0.007, color),
            self._tube(middle, end, 0.018, color),
        )

    def about(self, symbol: str, place: Array, axes: list[Array]) -> Drawing:
        axis = axes[0] if axes else np.array([0.0, 0.0, 1.0])
        first, second = across(axis)
        turn = np.linspace(0, 1.6 * np.pi, 32)
        radius = 0.06 * self._size
        if symbol == "torsion spring":
            turn = np.linspace(0, 5 * np.pi, 80)
            radius = np.linspace(0.4, 1, 80)[:, None] * radius
        circle = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
        width = 0.009 if symbol == "torsion damper" else 0.005
        ring = tube(place + radius * circle, width * self._size, 4)
        return Drawing((Faces(ring, _RED if symbol == "motor" else _DARK),))

    def mark(self, place: Array, color: Array) -> Drawing:
        """A point."""
        return Drawing((Faces(place + self._ball, color),))

    def load(self, place: Array) -> Drawing:
        return self.mark(place, _RED)

    def bar(self, path: Array) -> Drawing:
        """A line through points."""
        pieces = zip(path, path[1:], strict=False)
        return Drawing(tuple(self._tube(a, b, 0.006, _DARK) for a, b in pieces))

    def trail(self, path: Array, color: Array) -> Drawing:
        """The path of a point."""
        return Drawing((Faces(tube(path, 0.003 * self._size, 3), color),))


def _closed(path: Array, radius: float) -> Array:
    """A tube with its ends covered."""
    open_tube = tube(path, radius, 10)
    rings = open_tube[:10, 0], open_tube[-10:, 3][::-1]
    caps = [np.stack([x[0], x[k], x[k + 1], x[k + 1]]) for x in rings for k in range(1, 9)]
    return np.concatenate([open_tube, np.array(caps)])
