"""What a picture shows of a scene: its bodies, joints, springs and motors, at each time."""

import numpy as np

from .._pictures import (
    as_quadrilaterals,
    color_of,
    Drawing,
    Faces,
    GREY,
    Path,
    PlaneSymbols,
    SpaceSymbols,
    straight,
    tube,
)
from ._frames import GROUND
from ._motion import Array, BodyMotion, LinkMotion, Motion
from .shapes import Capsule


class Sketch:
    """The drawings of a motion, with symbols of one size.

    `whole` is the motion over which guides of sliders extend.
    """

    def __init__(self, motion: Motion, whole: Motion):
        self.motion = motion
        self.dimension = _dimension(motion)
        self.size = _size(motion)
        kind = PlaneSymbols if self.dimension == 2 else SpaceSymbols
        self._symbols = kind(self.size)
        self.colors = _colors(motion)
        self._bodies = [
            _BodySketch(body, self.colors[body.name], self.size) for body in motion.bodies
        ]
        self._thickness = {body.name: _thickness(body) for body in motion.bodies}
        sliders = [x for x in whole.links if x.symbol == "slider"]
        self._slides = {x.name: _range_of(x, 0.12 * self.size) for x in sliders}

    def at(self, k: int) -> Drawing:
        """The drawing at the time with this number."""
        parts = Drawing()
        for body in self._bodies:
            parts += body.at(k)
        for link in self.motion.links:
            parts += self._link(link, k)
        return parts

    def trail(self, path: Array, color: Array) -> Drawing:
        """The path of a point, shape `(n, d)`."""
        return self._symbols.trail(path, color)

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
                inside = max(self._thickness.get(body, 0.0) for body in link.bodies)
                return symbols.joint(link.symbol, end, axes, fixed, inside)
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
                return symbols.trail(np.array([start, end]), GREY)


def _dimension(motion: Motion) -> int:
    return motion.bodies[0].position.shape[1]


def middle_of(link: LinkMotion, k: int) -> Array:
    """Where the symbol of a link is."""
    has_length = link.symbol in ("rod", "spring", "damper", "actuator", "field")
    return (link.start[k] + link.end[k]) / 2 if has_length else link.end[k]


def _colors(motion: Motion) -> dict[str, Array]:
    """The colours of the bodies by name: those of their shapes, or else of a cycle."""
    moving = [body.name for body in motion.bodies if body.name != GROUND]
    cycle = {name: color_of(f"C{k % 10}") for k, name in enumerate(moving)}
    found = {}
    for body in motion.bodies:
        given = [x.color for x in body.shapes if x.color is not None]
        opaque = (color_of(x[:3]) for x in given)
        found[body.name] = next(opaque, cycle.get(body.name, GREY))
    return found


def _thickness(body: BodyMotion) -> float:
    """The radius of the rods of a body."""
    radii = [float(x.radius) for x in body.shapes if isinstance(x, Capsule)]
    return max(radii, default=0.0)


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
    spans = [np.linalg.norm(x.end[0] - x.start[0]) for x in motion.links]
    longer = [float(x) for x in spans if x > 0]  # point masses are small beside springs
    few = 8 * max(float(np.median(x)) for x in (own, longer or [0.0]))
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

    def __init__(self, body: BodyMotion, default: Array, size: float):
        self._body = body
        fixed = body.name == GROUND
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
