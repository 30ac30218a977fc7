"""What a picture shows at one time, and the artists of matplotlib that show it."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import matplotlib.patheffects as effects
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from .geometry import normals


Array: TypeAlias = np.ndarray

# Where a text may stand beside its point, in points of the printer.
_PLACES = [(x, y) for reach in (5, 16) for y in (reach, -reach) for x in (5, -5)]

# Light falls from here, in space.
_LIGHT = np.array([0.35, -0.55, 0.75]) / np.linalg.norm([0.35, -0.55, 0.75])


class Faces(NamedTuple):
    """Filled polygons of one colour: `(n, d)` each, or an array `(m, n, d)`."""

    polygons: Any
    color: Array
    outlined: bool = True


class Path(NamedTuple):
    """A line through points, shape `(n, d)`; `width` in points of the printer."""

    points: Array
    color: Array
    width: float = 1.5
    dashed: bool = False


class Dot(NamedTuple):
    """A marker at a point, shape `(d,)`.

    `size` is in points of the printer, but where that is more than `extent`, in units of
    the axes, the marker has this extent.
    """

    point: Array
    color: Array
    size: float
    extent: float
    filled: bool = False


class Drawing(NamedTuple):
    """All that a picture shows at one time, from back to front. Paths and dots are in the
    plane only."""

    faces: tuple[Faces, ...] = ()
    paths: tuple[Path, ...] = ()
    dots: tuple[Dot, ...] = ()

    def recolored(self, change: Callable[[Array], Array]) -> "Drawing":
        """The same in other colours."""
        of = lambda parts: tuple(x._replace(color=change(x.color)) for x in parts)
        return Drawing(of(self.faces), of(self.paths), of(self.dots))

    def __add__(self, other: Any) -> "Drawing":
        """Both, the other in front."""
        return Drawing(*(x + y for x, y in zip(tuple(self), tuple(other), strict=True)))


def color_of(name: Any, opacity: float = 1.0) -> Array:
    return np.array(to_rgba(name)) * np.array([1, 1, 1, opacity])


class AbstractCanvas(abc.ABC):
    """The artists in one axes that show a drawing; `show` replaces what they show."""

    def __init__(self, ax: Axes):
        self.ax = ax

    @property
    @abc.abstractmethod
    def artists(self) -> list[Artist]:
        """The artists that `show` changes."""

    @abc.abstractmethod
    def show(self, drawing: Drawing) -> None: ...

    @abc.abstractmethod
    def pale(self, color: Array, strength: float) -> Array:
        """A paler colour; that of strength 1 is the colour itself."""

    @abc.abstractmethod
    def frame(self, low: Array, high: Array) -> None:
        """Sets limits that include this range, with equal scales along all axes."""

    @abc.abstractmethod
    def write(self, point: Array, text: str, color: Array) -> Any:
        """A small text beside a point."""

    def move_apart(self, texts: list[Any]) -> None:
        """Moves texts around their points, so that none covers another, and into the axes
        where there is room. Those that find no room are left out."""
        figure: Any = self.ax.figure
        figure.draw_without_rendering()
        taken: list[Array] = []
        for text in texts:
            found = self._free_places(text, taken)
            if not found:
                text.set_visible(False)
                continue
            # The first of those that are within the axes, or else the first of all.
            place, box, _ = next((x for x in found if x[2]), found[0])
            _put(text, place)
            taken.append(box)

    def _free_places(
        self, text: Any, taken: list[Array]
    ) -> list[tuple[tuple[int, int], Array, bool]]:
        """The places of a text beside others, its corners there, and whether all of them
        are within the axes."""
        inside, found = self.ax.get_window_extent(), []
        for place in _PLACES:
            _put(text, place)
            box = text.get_window_extent().get_points()
            is_free = all((x[0] > box[1]).any() or (x[1] < box[0]).any() for x in taken)
            if is_free and inside.contains(*box.mean(axis=0)):
                found.append((place, box, all(inside.contains(*x) for x in box)))
        return found


class PlaneCanvas(AbstractCanvas):
    """A picture in the plane."""

    def __init__(self, ax: Axes):
        super().__init__(ax)
        self._faces = ax.add_collection(PolyCollection([], zorder=2), autolim=False)
        self._paths = ax.add_collection(LineCollection([], zorder=3), autolim=False)
        self._dots = ax.scatter([], [], zorder=4)

    @property
    def artists(self) -> list[Artist]:
        return [self._faces, self._paths, self._dots]

    def show(self, drawing: Drawing) -> None:
        polygons, fills, edges = [], [], []
        for face in drawing.faces:
            polygons += [*face.polygons]
            fills += [face.color] * len(face.polygons)
            edges += [_darker(face.color) if face.outlined else face.color] * len(
                face.polygons
            )
        self._faces.set(verts=polygons, facecolors=fills, edgecolors=edges, linewidths=0.8)
        paths = drawing.paths
        self._paths.set(
            segments=[x.points for x in paths],
            colors=[x.color for x in paths],
            linewidths=[x.width for x in paths],
            linestyles=["--" if x.dashed else "-" for x in paths],
            capstyle="round",
        )
        dots, white = drawing.dots, np.ones(4)
        points = np.array([x.point for x in dots]).reshape(-1, 2)
        self._dots.set(
            offsets=points,
            sizes=[self._size(x) ** 2 for x in dots],
            facecolors=[
                x.color if x.filled else np.append(white[:3], x.color[3]) for x in dots
            ],
            edgecolors=[x.color for x in dots],
            linewidths=1.0,
        )

    def pale(self, color: Array, strength: float) -> Array:
        return color * np.array([1, 1, 1, strength])

    def frame(self, low: Array, high: Array) -> None:
        room = 0.05 * np.max(high - low)
        self.ax.update_datalim([low - room, high + room])
        self.ax.margins(0)
        self.ax.autoscale_view()
        self.ax.set_aspect("equal")

    def _size(self, dot: Dot) -> float:
        """The size of a marker, by the room that the axes have before their layout."""
        figure: Any = self.ax.figure
        room = 72 * np.array(figure.get_size_inches()) * self.ax.get_position(True).size
        units = np.abs(np.diff([self.ax.get_xlim(), self.ax.get_ylim()], axis=1))[:, 0]
        return max(1.5, min(dot.size, dot.extent * float(np.min(room / units))))

    def write(self, point: Array, text: str, color: Array) -> Any:
        return _annotate(self.ax, point, text, color)


class SpaceCanvas(AbstractCanvas):
    """A picture in space, all of faces, quadrilaterals `(m, 4, 3)`.

    These are ordered by the depth of their middles, which matplotlib does only within one
    collection of polygons. So lines are thin tubes.
    """

    def __init__(self, ax: Any):
        super().__init__(ax)
        faces = Poly3DCollection(np.zeros((1, 4, 3)))
        self._faces = ax.add_collection3d(faces, autolim=False)

    @property
    def artists(self) -> list[Artist]:
        return [self._faces]

    def show(self, drawing: Drawing) -> None:
        quads, colors = [np.zeros((0, 4, 3))], [np.zeros((0, 4))]
        for face in drawing.faces:
            found = np.reshape(face.polygons, (-1, 4, 3))
            light = 0.65 + 0.35 * normals(found) @ _LIGHT
            shaded = np.tile(face.color, (len(found), 1))
            shaded[:, :3] *= light[:, None]
            quads.append(found)
            colors.append(shaded)
        shaded = np.concatenate(colors)
        self._faces.set_verts(np.concatenate(quads))
        # Edges in the colour of their face close the seams between opaque faces.
        edges = np.where(shaded[:, 3:] < 1, 0.0, shaded)
        self._faces.set(facecolor=shaded, edgecolor=edges, linewidth=0.3)

    def pale(self, color: Array, strength: float) -> Array:
        # With less opacity the inside of bodies would be seen.
        return np.append(1 - strength * (1 - color[:3]), color[3])

    def frame(self, low: Array, high: Array) -> None:
        ax: Any = self.ax
        ax.auto_scale_xyz(*np.stack([low, high], axis=1))
        limits = np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()])
        middle, size = limits.mean(axis=1), np.ptp(limits, axis=1)
        # A mechanism in a plane keeps some depth: ticks need room.
        size = np.maximum(size, 0.3 * size.max())
        for set_limits, m, s in zip(
            (ax.set_xlim, ax.set_ylim, ax.set_zlim), middle, size, strict=True
        ):
            set_limits(m - s / 2, m + s / 2)
        for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
            axis.labelpad = 10  # their ticks can be long
        for zoom in (0.95, 0.9, 0.85, 0.8, 0.75):
            ax.set_box_aspect(size, zoom=zoom)
            ax.figure.draw_without_rendering()
            room, needed = (x.get_points() for x in (ax.figure.bbox, ax.get_tightbbox()))
            if np.all(room[0] <= needed[0]) and np.all(needed[1] <= room[1]):
                break  # the labels of the axes are not cut off

    def write(self, point: Array, text: str, color: Array) -> Any:
        ax: Any = self.ax
        x, y, _ = proj3d.proj_transform(point[0], point[1], point[2], ax.get_proj())
        return _annotate(self.ax, np.array([x, y]), text, color)


def _darker(color: Array) -> Array:
    return color * np.array([0.6, 0.6, 0.6, 1.0])


def _put(text: Any, place: tuple[int, int]) -> None:
    text.set_position(place)
    text.set_ha("left" if place[0] > 0 else "right")


def _annotate(ax: Axes, point: Array, text: str, color: Array) -> Any:
    return ax.annotate(
        text,
        (point[0], point[1]),
        xytext=(5, 5),
        textcoords="offset points",
        fontsize="small",
        color=_darker(color),
        zorder=6,
        path_effects=[effects.withStroke(linewidth=2, foreground="white")],
    )
