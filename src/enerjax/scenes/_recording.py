"""Films of scenes in space that a browser plays and turns, by viser: the extra `view`."""

import contextlib
import html
import io
import tempfile
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ._frames import GROUND
from ._motion import Array, BodyMotion, LinkMotion, Motion
from ._surfaces import surface_of, upright
from .shapes import AbstractShape


_LINE = 0.008  # the thickness of lines over the size of the motion
_FIELD_OF_VIEW = 0.7  # radians
_FRAME_HEIGHT = 480  # pixels, in notebooks


class Recording:
    """A run of a scene as a page that any browser plays, without Python and offline.

    `save("run.html")` writes the page, `open()` shows it in the browser; notebooks show it
    by themselves. The bar below the picture plays, stops (space bar), scrubs and changes
    the speed; dragging turns the picture, with the right button it shifts, and the wheel
    zooms.

    - `page`: the HTML document.
    - `ts`: the times of its frames, shape `(frames,)`.
    """

    def __init__(self, page: str, ts: Array):
        self.page, self.ts = page, ts

    def save(self, path: str | Path) -> None:
        """Writes the page to a file.

        **Raises:** `ValueError` unless its name ends with ".html".
        """
        path = Path(path)
        if path.suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"A recording is saved as a page, `*.html`, got '{path}'.")
        path.write_text(self.page, encoding="utf-8")

    def open(self) -> None:
        """Shows the page in the browser, from a temporary file."""
        with tempfile.NamedTemporaryFile("wb", suffix=".html", delete=False) as file:
            file.write(self.page.encode())
        webbrowser.open(Path(file.name).as_uri())

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" width="100%" '
            f'height="{_FRAME_HEIGHT}" style="border: none"></iframe>'
        )

    def __repr__(self) -> str:
        return (
            f"Recording of {len(self.ts)} frames, {len(self.page) / 1e6:.1f} MB: "
            "`.open()` shows it, `.save('run.html')` writes it."
        )


def record(motion: Motion, gravity: Any, speed: float, fps: float) -> Recording:
    """A page that shows a motion, of which each time is a frame.

    Up is opposite to gravity; a motion in the plane is set upright.
    """
    is_flat, up = motion.bodies[0].position.shape[1] == 2, np.array([0.0, 0.0, 1.0])
    if is_flat:
        motion = upright(motion)
    elif gravity is not None and np.any(gravity):
        up = -np.asarray(gravity) / np.linalg.norm(gravity)
    extent = _extent(motion)
    with _server() as server:
        _set_camera(server, extent, up, is_flat)
        if all(body.name != GROUND for body in motion.bodies):
            _add_grid(server, extent, up)
        nodes = [_body_node(server, k, x) for k, x in enumerate(motion.bodies)]
        nodes += [_line_node(server, x, extent) for x in motion.links if _is_line(x)]
        serializer = server.get_scene_serializer()
        # The last frame stays for as long as the others.
        pauses = np.append(np.diff(motion.ts) / speed, 1 / fps)
        for k, pause in enumerate(pauses if len(motion.ts) > 1 else []):
            with server.atomic():
                for node in nodes:
                    node.show(k)
            serializer.insert_sleep(float(pause))
        return Recording(serializer.as_html(), motion.ts)


@contextlib.contextmanager
def _server() -> Iterator[Any]:
    """A server of viser, to which nobody connects: it writes the recording."""
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "`view` needs viser, which is part of the extra `view`: "
            'python -m pip install "enerjax[view]"'
        ) from error
    with contextlib.redirect_stdout(io.StringIO()):  # it tells its address
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


class _Extent(NamedTuple):
    """The middle and the radius of a sphere around the motion, and points all over it."""

    centre: Array
    radius: float
    cloud: Array


def _extent(motion: Motion) -> _Extent:
    clouds = [x.reshape(-1, 3) for link in motion.links for x in (link.start, link.end)]
    for body in motion.bodies:
        if body.name == GROUND:
            continue
        points = [shape.facets().points for shape in body.shapes]
        low, high = _bounds(np.concatenate([*points, np.zeros((1, 3))]))
        corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T
        turned = np.swapaxes(body.rotation, 1, 2)
        clouds.append((body.position[:, None] + corners @ turned).reshape(-1, 3))
    cloud = np.concatenate(clouds)
    low, high = _bounds(cloud)
    radius = 0.5 * float(np.linalg.norm(high - low))
    return _Extent((low + high) / 2, radius if radius > 0 else 1.0, cloud)


def _bounds(points: Array) -> tuple[Array, Array]:
    return points.min(axis=0), points.max(axis=0)


def _turned_to(up: Array) -> Rotation:
    """A rotation from the third axis of space to another direction."""
    return Rotation.align_vectors(up[None], [[0.0, 0.0, 1.0]])[0]


def _quaternions(turns: Rotation) -> Array:
    """Unit quaternions, scalar first."""
    return np.roll(turns.as_quat(), 1, axis=-1)


def _set_camera(server: Any, extent: _Extent, up: Array, is_flat: bool) -> None:
    server.scene.set_up_direction(up)
    towards = np.array([0.25, -1.0, 0.2] if is_flat else [0.7, -1.0, 0.5])
    towards = _turned_to(up).apply(towards / np.linalg.norm(towards))
    camera, distance = server.initial_camera, extent.radius / np.sin(_FIELD_OF_VIEW / 2)
    camera.fov, camera.near, camera.far = _FIELD_OF_VIEW, 0.01 * distance, 100 * distance
    camera.position = extent.centre + distance * towards
    camera.look_at = extent.centre


def _add_grid(server: Any, extent: _Extent, up: Array) -> None:
    """A grid below the motion, with lines in distances of a power of ten and a fifth."""
    lowest = float(np.min(extent.cloud @ up))
    width, cell = 6 * extent.radius, 10.0 ** np.floor(np.log10(extent.radius))
    server.scene.add_grid(
        "/grid",
        width=width,
        height=width,
        cell_size=cell / 5,
        section_size=cell,
        position=extent.centre + (lowest - extent.centre @ up) * up,
        wxyz=_quaternions(_turned_to(up)),
    )


class _BodyNode(NamedTuple):
    """The frame of a body in the page, and its poses."""

    frame: Any
    position: Array
    turn: Array

    def show(self, k: int) -> None:
        self.frame.position, self.frame.wxyz = self.position[k], self.turn[k]


def _body_node(server: Any, number: int, body: BodyMotion) -> _BodyNode:
    from .._pictures import color_of, GREY

    # A slash in a name would make one body the child of another.
    path = f"/{number} {body.name}".replace("/", "|").replace("|", "/", 1)
    turn = _quaternions(Rotation.from_matrix(body.rotation))
    pose = dict(position=body.position[0], wxyz=turn[0])
    frame = server.scene.add_frame(path, show_axes=False, **pose)
    default = GREY if body.name == GROUND else color_of(f"C{number % 10}")
    for k, shape in enumerate(body.shapes):
        color = np.asarray(default if shape.color is None else shape.color)
        _add_shape(server, f"{path}/{k}", shape, color)
    return _BodyNode(frame, body.position, turn)


def _add_shape(server: Any, path: str, shape: AbstractShape, color: Array) -> None:
    facets = shape.facets()
    rgb = tuple(int(x) for x in np.round(255 * color[:3]))
    if facets.polygons:
        vertices, faces = surface_of(facets.points, facets.polygons)
        opacity = None if color[3] >= 1 else float(color[3])
        look = dict(color=rgb, opacity=opacity, side="double")
        server.scene.add_mesh_simple(f"{path} surface", vertices, faces, **look)
    for k, line in enumerate(facets.lines):
        ends = np.stack([line[:-1], line[1:]], axis=1)
        points = facets.points[ends]
        width = _LINE * float(np.ptp(facets.points, axis=0).max())
        server.scene.add_line_segments(f"{path} line {k}", points, rgb, thickness=width)


class _LineNode(NamedTuple):
    """A line in the page between two points that move."""

    segments: Any
    ends: Array

    def show(self, k: int) -> None:
        self.segments.points = self.ends[k][None]


def _is_line(link: LinkMotion) -> bool:
    return link.symbol in ("rod", "spring", "damper", "actuator")


def _line_node(server: Any, link: LinkMotion, extent: _Extent) -> _LineNode:
    ends = np.stack([link.start, link.end], axis=1).astype(np.float32)
    gray = (60, 60, 60) if link.symbol == "rod" else (140, 140, 140)
    path = f"/{link.name}".replace("/", "|").replace("|", "/", 1)
    width = _LINE * extent.radius
    segments = server.scene.add_line_segments(path, ends[:1], gray, thickness=width)
    return _LineNode(segments, ends)
