"""What a picture shows of a scene: its bodies, joints, springs and motors, at each time."""

from collections.abc import Iterator

import numpy as np

from .._pictures import color_of, Dot, Drawing, Faces, Path
from .._pictures.geometry import (
    across,
    as_quadrilaterals,
    helix,
    line_frame,
    straight,
    tube,
    zigzag,
)
from ._frames import GROUND
from ._motion import Array, BodyMotion, LinkMotion, Motion
from .shapes import Sphere


_DARK, _PALE, _RED = color_of("0.25"), color_of("0.6"), color_of("C3")


class Sketch:
    """The drawings of a motion, with symbols of one size.

    `whole` is the motion over which guides of sliders extend.
    """

    def __init__(self, motion: Motion, whole: Motion):
        self.motion = motion
        self.dimension = _dimension(motion)
        self.size = _size(motion)
        kind = _PlaneSymbols if self.dimension == 2 else _SpaceSymbols
        self._symbols = kind(self.size)
        self._bodies = [
            _BodySketch(body, k, self.size) for k, body in enumerate(_ground_last(motion))
        ]
        sliders = [x for x in whole.links if x.symbol == "slider"]
        self._slides = {x.name: _range_of(x, 0.12 * self.size) for x in sliders}

    def at(self, k: int) -> Drawing:
        """The drawing at the time with this number."""
        parts = Drawing()
        for body in reversed(self._bodies):
            parts += body.at(k)
        for link in self.motion.links:
            parts += self._link(link, k)
        return parts

    def bounds(self) -> tuple[Array, Array]:
        """The least and the largest coordinates of all that is shown at any time."""
        clouds = [body.cloud() for body in self._bodies]
        clouds += [x for link in self.motion.links for x in (link.start, link.end)]
        low = np.min([cloud.min(axis=0) for cloud in clouds], axis=0)
        high = np.max([cloud.max(axis=0) for cloud in clouds], axis=0)
        room = np.where(high - low < 0.1 * self.size, 0.05 * self.size, 0.0)
        return low - room, high + room

    def _link(self, link: LinkMotion, k: int) -> Drawing:
        symbols, start, end = self._symbols, link.start[k], link.end[k]
        axes = [axis[k] for axis in link.axes]
        fixed = GROUND in link.bodies
        match link.symbol:
            case "pin" | "weld" | "plane" | "contact":
                return symbols.joint(link.symbol, end, axes, fixed)
            case "slider":
                low, high = self._slides[link.name]
                guide = start + low * axes[0], start + high * axes[0]
                return symbols.slider(*guide, end)
            case "rod" | "spring" | "damper" | "actuator":
                return symbols.between(link.symbol, start, end, _fixed_end(link, k))
            case "torsion spring" | "torsion damper" | "motor":
                return symbols.about(link.symbol, end, axes)
            case "load":
                return symbols.load(end)
            case "field":
                return Drawing(paths=(Path(np.array([start, end]), _PALE, 0.8, True),))


def _dimension(motion: Motion) -> int:
    return motion.bodies[0].position.shape[1]


def _ground_last(motion: Motion) -> list[BodyMotion]:
    """The bodies; the ground, if it is seen, comes last, so that it takes no colour."""
    return sorted(motion.bodies, key=lambda body: body.name == GROUND)


def _points_of(body: BodyMotion) -> Array:
    """All points of the shapes of a body, and its mass centre, in its frame."""
    points = [x.facets().points for x in body.shapes]
    return np.concatenate([*points, np.zeros((1, body.position.shape[1]))])


def _size(motion: Motion) -> float:
    """The size of the mechanism; that of a few bodies, where there are many."""
    clouds, own = [], []
    for body in motion.bodies:
        if body.name != GROUND:
            points = _points_of(body)
            clouds.append(body.position[:1] + points @ body.rotation[0].T)
            own.append(float(np.ptp(points, axis=0).max()))
    ends = [x[:1] for link in motion.links for x in (link.start, link.end)]
    extent = float(np.ptp(np.concatenate([*clouds, *ends]), axis=0).max())
    few = 8 * float(np.median(own))
    return min((x for x in (extent, few) if x > 0), default=1.0)


def _fixed_end(link: LinkMotion, k: int) -> Array | None:
    """The end of a link that is on the ground."""
    if GROUND not in link.bodies:
        return None
    return (link.start, link.end)[link.bodies.index(GROUND)][k]


def _range_of(link: LinkMotion, room: float) -> tuple[float, float]:
    """Where a slider is along its axis over all times, with room at both ends."""
    along = np.sum((link.end - link.start) * link.axes[0], axis=1)
    return float(along.min()) - room, float(along.max()) + room


class _BodySketch:
    """The polygons and lines of a body, in its frame."""

    def __init__(self, body: BodyMotion, number: int, size: float):
        self._body = body
        fixed = body.name == GROUND
        default = _PALE if fixed else color_of(f"C{number % 10}")
        flat = body.position.shape[1] == 2
        self._faces: list[Faces] = []
        self._paths: list[Path] = []
        for shape in body.shapes:
            own = shape.facets()
            color = default if shape.color is None else np.array(shape.color)
            if own.polygons and flat:
                paler = color * np.array([1, 1, 1, 0.35 if fixed else 0.6])
                polygons = [own.points[x] for x in own.polygons]
                self._faces.append(Faces(polygons, paler, own.creased))
            elif own.polygons:
                quads = as_quadrilaterals(own.points, own.polygons, 0.12 * size)
                self._faces.append(Faces(quads, color))
            for line in own.lines:
                path = own.points[line]
                if flat:
                    self._paths.append(Path(path, color, 2.5))
                else:
                    self._faces.append(Faces(tube(_fine(path, size), 0.008 * size), color))

    def at(self, k: int) -> Drawing:
        position, turned = self._body.position[k], self._body.rotation[k].T
        place = lambda x: position + x @ turned
        faces = tuple(
            x._replace(
                polygons=place(x.polygons)
                if isinstance(x.polygons, np.ndarray)
                else [place(polygon) for polygon in x.polygons]
            )
            for x in self._faces
        )
        paths = tuple(x._replace(points=place(x.points)) for x in self._paths)
        return Drawing(faces, paths)

    def cloud(self) -> Array:
        """All points of the body at all times."""
        body = self._body
        points = _points_of(body)
        turned = np.swapaxes(body.rotation, 1, 2)
        return (body.position[:, None] + points @ turned).reshape(-1, points.shape[1])


def _fine(path: Array, size: float) -> Array:
    pieces = [straight(a, b, 0.12 * size) for a, b in zip(path, path[1:], strict=False)]
    return np.concatenate([pieces[0], *(x[1:] for x in pieces[1:])])


class _PlaneSymbols:
    """Symbols in the plane; those of joints have the same size in every picture."""

    def __init__(self, size: float):
        self._size = size

    def joint(self, symbol: str, place: Array, axes: list[Array], fixed: bool) -> Drawing:
        size = 3.0 if symbol == "weld" else 5.0
        dot = Dot(place, _DARK, size, 0.04 * self._size, symbol == "weld")
        return Drawing(faces=self._foot(place) if fixed else (), dots=(dot,))

    def _foot(self, place: Array) -> tuple[Faces, ...]:
        s = 0.03 * self._size
        corners = np.array([[0, 0], [-s, -1.6 * s], [s, -1.6 * s]])
        return (Faces([place + corners], _PALE),)

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

    def load(self, place: Array) -> Drawing:
        return Drawing(dots=(Dot(place, _RED, 4.0, 0.04 * self._size, True),))


class _SpaceSymbols:
    """Symbols in space, of which all are made of polygons."""

    def __init__(self, size: float):
        self._size = size
        ball = Sphere(0.022 * size, np.zeros(3)).facets()
        self._ball = as_quadrilaterals(ball.points, ball.polygons, size)

    def joint(self, symbol: str, place: Array, axes: list[Array], fixed: bool) -> Drawing:
        color = _PALE if fixed else _DARK
        if symbol == "pin" and axes:
            arm, radius = 0.05 * self._size, 0.018 * self._size
            paths = [np.array([place - arm * x, place + arm * x]) for x in axes]
            return Drawing(tuple(Faces(_closed(x, radius), color) for x in paths))
        return Drawing((Faces(place + self._ball, color),))

    def slider(self, low: Array, high: Array, end: Array) -> Drawing:
        guide = self._tube(low, high, 0.008, _PALE)
        return Drawing((guide, Faces(end + self._ball, _DARK)))

    def _tube(self, start: Array, end: Array, width: float, color: Array) -> Faces:
        path = straight(start, end, 0.12 * self._size)
        return Faces(tube(path, width * self._size), color)

    def between(
        self, symbol: str, start: Array, end: Array, fixed: Array | None
    ) -> Drawing:
        foot = () if fixed is None else (Faces(fixed + self._ball, _PALE),)
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

    def load(self, place: Array) -> Drawing:
        return Drawing((Faces(place + self._ball, _RED),))


def _closed(path: Array, radius: float) -> Array:
    """A tube with its ends covered."""
    open_tube = tube(path, radius, 10)
    rings = open_tube[:10, 0], open_tube[-10:, 3][::-1]
    caps = [np.stack([x[0], x[k], x[k + 1], x[k + 1]]) for x in rings for k in range(1, 9)]
    return np.concatenate([open_tube, np.array(caps)])
