"""Recordings: the page that `scene.view` makes, its contents and what a browser shows."""

import base64
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import enerjax as ej
from enerjax.scenes._surfaces import surface_of

from .browser import CHROMIUM, open_page


pytest.importorskip("viser")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


# What a recording contains --------------------------------------------------------------


def contents(recording):
    """The messages of a page, as pairs of a time and a message, and its duration."""
    import msgspec  # pyright: ignore
    import zstandard  # pyright: ignore

    found = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', recording.page)
    packed = base64.b64decode(found.group(1))[8:]  # pyright: ignore
    data = zstandard.ZstdDecompressor().decompressobj().decompress(packed)
    size = int.from_bytes(data[:8], "little")
    decoded = msgspec.msgpack.decode(data[8 : 8 + size])
    return decoded["messages"], decoded["durationSeconds"]


def track(messages, name, kind):
    """The times and values of one property of a node."""
    key = dict(SetPositionMessage="position", SetOrientationMessage="wxyz")[kind]
    chosen = [(t, m[key]) for t, m in messages if m["type"] == kind and m["name"] == name]
    ts, values = zip(*chosen, strict=True)
    return np.array(ts), np.array(values)


@pytest.fixture(scope="module")
def flight():
    """A ball that crosses a plane in space at constant speed."""
    ball = ej.bodies.RigidBody(
        "a/ball",
        1.0,
        [0.1, 0.1, 0.1],
        [-2.0, 0.0, 0.0],
        velocity=[4.0, 0.0, 0.0],
        angular_velocity=[0.0, 0.0, 0.5],
        shape=[
            ej.shapes.Sphere(0.5, color=(1.0, 0.0, 0.0)),
            ej.shapes.Box([0.2, 0.2, 0.9], [0.0, 0.0, 0.5], color=(0.0, 0.0, 1.0)),
        ],
    )
    scene = ej.Scene([ball])
    system, start, args = scene.build()
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=0.125, num_steps=8)
    return scene, sol


def test_frames_are_in_real_time_whatever_the_steps_were(flight):
    scene, sol = flight
    recording = scene.view(sol, fps=20)
    messages, duration = contents(recording)
    assert duration == pytest.approx(1.0 + 1 / 20)  # the last frame is seen as well
    ts, places = track(messages, "/0 a|ball", "SetPositionMessage")
    assert np.allclose(ts, np.arange(21) / 20)
    assert np.allclose(places[:, 0], -2.0 + 4.0 * ts)
    moments, turns = track(messages, "/0 a|ball", "SetOrientationMessage")
    half = 0.25 * moments
    wanted = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    assert np.allclose(turns, wanted, atol=1e-3)  # truncation of the run
    assert "21 frames" in repr(recording)

    slow, duration = contents(scene.view(sol, speed=0.5, fps=20))
    assert duration == pytest.approx(2.0 + 1 / 20)
    ts, places = track(slow, "/0 a|ball", "SetPositionMessage")
    assert np.allclose(places[:, 0], -2.0 + 2.0 * ts)


def test_a_state_is_a_page_that_does_not_move(flight):
    scene, sol = flight
    for state in (None, sol.end):
        messages, duration = contents(scene.view(state))
        assert duration == 0.0
        names = {m.get("name") for _, m in messages}
        assert {"/0 a|ball", "/0 a|ball/0 surface", "/0 a|ball/1 surface", "/grid"} <= names


def test_a_scene_in_the_plane_stands_upright():
    """Points of the plane are at `(x, ., y)`, and bodies turn towards the viewer at `-y`.
    The floor of the scene takes the place of the grid."""
    rod = ej.bodies.PlanarBody.rod("rod", 1.0, [0.0, 1.0], [0.0, 3.0])
    floor = ej.shapes.Box([4.0, 0.1])
    spring = ej.forces.Spring("s", "ground", "rod", 1.0, point_a=[2.0, 0.0])
    hinge = ej.joints.Revolute("hinge", "ground", "rod", [0.0, 1.0])
    messages, _ = contents(ej.Scene([rod, hinge, spring], ground=floor).view())
    _, places = track(messages, "/1 rod", "SetPositionMessage")
    assert np.allclose(places[0, [0, 2]], [0.0, 2.0])
    assert abs(places[0, 1]) < 0.1
    _, turns = track(messages, "/1 rod", "SetOrientationMessage")
    turned = Rotation.from_quat(np.roll(turns[0], -1)).as_matrix()
    # The rod is upright; the normal of the plane points to the viewer.
    assert np.allclose(turned[:, [0, 2]], [[0, 0], [0, -1], [1, 0]], atol=1e-12)
    names = {m.get("name") for _, m in messages}
    assert "/s" in names
    # A pin and its bearing, about the normal of the plane.
    assert {"/2 hinge/0 surface", "/2 hinge/1 surface"} <= names
    _, pins = track(messages, "/2 hinge", "SetPositionMessage")
    assert np.allclose(pins[0], [0.0, 0.0, 1.0])
    assert "/grid" not in names


@pytest.mark.parametrize(
    ("shape", "sharp", "volume", "accuracy"),
    [
        (ej.shapes.Box([1.0, 2.0, 3.0], rotation=np.eye(3)), 3, 6.0, 1e-12),
        (ej.shapes.Cylinder(0.5, 2.0), 2, 0.5 * np.pi, 0.02),
        (ej.shapes.Capsule(0.5, 2.0, [0.0] * 3), 1, (0.5 + 1 / 6) * np.pi, 0.05),
    ],
)
def test_surfaces_are_closed_and_have_sharp_edges(shape, sharp, volume, accuracy):
    """Each of the sides that meet at a sharp edge has vertices of its own. Round shapes are
    polygons of some twenty sides, whose volume is a little less."""
    facets = shape.facets()
    surface = surface_of(facets.points, facets.polygons)
    assert len(surface.vertices) == sharp * len(facets.points)
    a, b, c = surface.vertices[surface.faces].swapaxes(0, 1)
    found = np.sum(np.cross(a, b) * c) / 6
    assert found == pytest.approx(volume, rel=accuracy)


def test_wrong_requests_are_told(flight, monkeypatch, tmp_path):
    scene, sol = flight
    with pytest.raises(ValueError, match="`speed` must be positive"):
        scene.view(sol, speed=0.0)
    with pytest.raises(ValueError, match="less than two frames"):
        scene.view(sol, speed=1e3)
    recording = scene.view()
    with pytest.raises(ValueError, match=r"`\*.html`, got .*run.mp4"):
        recording.save(tmp_path / "run.mp4")
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(ImportError, match=r"enerjax\[view\]"):
        scene.view()


# What a browser shows -------------------------------------------------------------------


def middle_of_red(picture):
    """The mean column of all pixels that are red, and their number."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    _, columns = np.nonzero((red > 120) & (green < 0.5 * red) & (blue < 0.5 * red))
    return (columns.mean() if columns.size else None), columns.size


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
def test_a_browser_plays_scrubs_and_turns_the_page(flight, tmp_path):
    """The page is opened from its file. It asks for nothing else, the ball is on it and
    plays by itself until the space bar stops it, the slider moves the ball, and dragging
    turns the view, which stays turned when the slider goes back."""
    scene, sol = flight
    file = tmp_path / "run.html"
    scene.view(sol).save(file)
    width, height = 480, 320
    time_shown = "parseFloat(document.querySelectorAll('input')[0].value)"
    slider = (
        "(() => {const r = document.querySelector('.mantine-Slider-root')"
        ".getBoundingClientRect(); return [r.x, r.y, r.width, r.height]})()"
    )
    with open_page(file, tmp_path / "browser", (width, height)) as page:
        page.wait_for("document.querySelector('canvas') && true")
        page.wait_for("document.querySelector('.mantine-Slider-root') && true")
        page.wait_for(f"{time_shown} > 0")  # it plays
        page.evaluate(
            "document.querySelector('.mantine-Notification-closeButton')?.click()"
        )
        page.press_space()
        page.settled()  # fails if it still plays
        x, y, long, thick = page.evaluate(slider)

        def scrub(part):
            page.press(x + part * long, y + thick / 2)
            page.wait_for(f"Math.abs({time_shown} - {part * (1 + 1 / 30)}) < 0.06")
            return page.settled()

        early, late = scrub(0.1), scrub(0.85)
        (left, many), (right, more) = middle_of_red(early), middle_of_red(late)
        assert many > 50
        assert more > 50
        assert right - left > 0.1 * width  # pyright: ignore
        page.press(width / 2, height / 4, to=(width / 2 + 60, height / 4))
        turned = page.settled()
        assert np.abs(turned - late).mean() > 1
        scrub(0.1)
        again = scrub(0.85)
        # On slow machines the page becomes coarser when it is busy.
        assert np.abs(again - turned).mean() < 0.4 * np.abs(again - late).mean()
        assert [
            x for x in page.requests if not x.startswith(("file:", "data:", "blob:"))
        ] == []
        assert page.requests[0] == file.as_uri()
