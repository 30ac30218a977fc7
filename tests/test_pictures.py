"""Pictures and films show what the run has: places, times, labels, and why it ended."""

import base64
import functools
import io
import re
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image
from PIL.GifImagePlugin import GifImageFile

import enerjax as ej


G, SPIN, SPIN_UP, THROW = 9.81, 7.0, 3.0, np.array([2.0, 3.0])
UNITS = {"time": "s", "length": "m", "energy": "J", "force": "N", "torque": "N m"}


@pytest.fixture(autouse=True)
def no_windows():
    matplotlib.use("agg")
    yield
    plt.close("all")


@functools.cache
def thrown():
    """A rod that is thrown, with a motor that turns it: its centre moves on a parabola, and
    its angle is a quadratic function of time. The scheme makes both exact."""
    rod = ej.bodies.PlanarBody.rod(
        "stick", 2.0, [0.0, 0.0], [1.0, 0.0], velocity=THROW, angular_velocity=SPIN
    )
    turn = lambda t, args: SPIN * t + SPIN_UP * t**2 / 2
    motor = ej.drives.Angle("motor", "ground", "stick", turn)
    scene = ej.Scene([rod, motor], gravity=[0.0, -G])
    system, start, args = scene.build()
    scheme = ej.EnergyConsistent(0.0)  # its steps are those of the angle
    return scene, ej.simulate(system, scheme, start, args, h=0.07, num_steps=10)


def thrown_pose(t):
    t = np.asarray(t)
    centre = np.array([0.5, 0.0]) + THROW * t[..., None]
    centre[..., 1] -= 0.5 * G * t**2
    return centre, SPIN * t + SPIN_UP * t**2 / 2


@functools.cache
def hung():
    """A level rod on a hinge, with a spring to its other end, released."""
    scene = ej.Scene(
        [
            ej.bodies.PlanarBody.rod("rod", 2.0, [0.0, 0.0], [1.0, 0.0]),
            ej.joints.Revolute("hinge", "ground", "rod", [0.0, 0.0]),
            ej.forces.Spring("coil", "ground", "rod", 3.0, 0.5, [1.0, 1.0], [0.5, 0.0]),
        ],
        gravity=[0.0, -G],
    )
    system, start, args = scene.build()
    scheme = ej.EnergyPreserving()
    return scene, ej.simulate(system, scheme, start, args, h=0.02, num_steps=40)


@functools.cache
def in_space():
    """A scene in space of which only the start is drawn."""
    shapes = ej.shapes
    return ej.Scene(
        [
            ej.bodies.RigidBody("arm", 1.0, [0.1, 0.1, 0.1], [0.5, 0.0, 0.0]),
            ej.bodies.RigidBody(
                "wheel",
                1.0,
                [0.1, 0.1, 0.1],
                [1.0, 0.0, 0.0],
                shape=shapes.Cylinder(0.3, 0.1, color="red"),
            ),
            ej.bodies.PointMass("bead", 1.0, [0.0, 0.0, 1.0]),
            ej.joints.Spherical("ball", "ground", "arm", [0.0, 0.0, 0.0]),
            ej.joints.Revolute(
                "pin", "arm", "wheel", [0.5, 0.0, 0.0], axis=[0.0, 0.0, 1.0]
            ),
        ],
        gravity=[0.0, 0.0, -G],
        ground=shapes.Box([3.0, 3.0, 0.1], [0.0, 0.0, -1.0]),
    )


def polygons(ax):
    """The corners of the polygons in the plane."""
    return [path.vertices[:-1] for path in ax.collections[0].get_paths()]


def rods(ax):
    """The polygons that are no triangles, as symbols are."""
    return [x for x in polygons(ax) if len(x) > 3]


def segments(ax):
    return [np.array(x) for x in ax.collections[1].get_segments()]


def dots(ax):
    return np.array(ax.collections[2].get_offsets())


def heights(line):
    return np.asarray(line.get_ydata())


def angle_of(corners):
    """The direction of a rod, from minus to plus a quarter turn."""
    centred = corners - corners.mean(axis=0)
    x, y = np.linalg.svd(centred)[2][0]
    return np.arctan(y / x)


def test_bodies_are_drawn_where_the_run_has_them_and_earlier_ones_paler():
    scene, sol = thrown()
    times = np.array([0.1, 0.33, 0.7])  # two of them between rows
    ax = scene.draw(sol, times)
    centres, angles = thrown_pose(times)
    shown = rods(ax)
    assert len(shown) == 3
    for corners, centre, angle in zip(shown, centres, angles, strict=True):
        # Round-off: motion and interpolation are exact for these polynomials.
        np.testing.assert_allclose(corners.mean(axis=0), centre, atol=1e-12)
        np.testing.assert_allclose(np.tan(angle_of(corners)), np.tan(angle), rtol=1e-9)
        radius = 0.5 * np.ptp((corners - centre) @ [-np.sin(angle), np.cos(angle)])
        length = np.ptp((corners - centre) @ [np.cos(angle), np.sin(angle)])
        assert 0 < radius < 0.1
        np.testing.assert_allclose(length, 1.0 + 2 * radius, atol=1e-12)
    opacity = ax.collections[0].get_facecolor()[::2, 3]  # without the motors'
    assert np.all(np.diff(opacity) > 0)


def test_without_times_the_last_row_is_drawn_and_without_a_run_the_start():
    scene, sol = thrown()
    for ax, t in ((scene.draw(sol), 0.7), (scene.draw(), 0.0), (scene.draw(sol.end), 0.7)):
        (corners,) = rods(ax)
        np.testing.assert_allclose(corners.mean(axis=0), thrown_pose(t)[0], atol=1e-12)


@pytest.mark.slow
def test_joints_springs_and_traces_are_where_the_bodies_are():
    scene, sol = hung()
    ax = scene.draw(sol, traces=[("rod", [0.5, 0.0])])
    tip = np.asarray(scene.position(sol.ys, "rod", [0.5, 0.0]))
    trail, coil = segments(ax)
    np.testing.assert_allclose(trail[:-1], tip[: len(trail) - 1], atol=1e-12)
    np.testing.assert_allclose(trail[-1], tip[-1], atol=1e-12)
    np.testing.assert_allclose(coil[[0, -1]], [[1.0, 1.0], tip[-1]], atol=1e-12)
    for place in ([0.0, 0.0], [1.0, 1.0], tip[-1]):
        assert np.abs(dots(ax) - place).max(axis=1).min() < 1e-12
    # The rod ends in the hinge and in the spring; a triangle is the ground below the hinge.
    (rod,) = rods(ax)
    for end in ([0.0, 0.0], tip[-1]):
        near = np.linalg.norm(rod - end, axis=1).min()
        assert near == pytest.approx(0.03, abs=0.01)
    tops = [x[x[:, 1].argmax()] for x in polygons(ax) if len(x) == 3]
    assert [0.0, 0.0] in [x.round(12).tolist() for x in tops]


def test_bodies_in_space_have_their_shapes_and_colours_in_perspective():
    scene = in_space()
    ax = scene.draw(units=UNITS)
    ax.figure.draw_without_rendering()
    assert (ax.get_xlabel(), ax.get_zlabel()) == ("x [m]", "z [m]")
    low, high = ax.get_tightbbox().get_points()  # with the labels: none is cut off
    assert np.all(low >= 0)
    assert np.all(high <= ax.figure.bbox.size)
    paths = ax.collections[0].get_paths()  # of all faces, projected
    colors = ax.collections[0].get_facecolor()[:, :3]
    is_red = (colors[:, 0] > 0.3) & (colors[:, 1:] < 1e-3).all(axis=1)
    corners = [x.vertices for x, red in zip(paths, is_red, strict=True) if red]
    found = np.concatenate(corners)
    wheel = next(body for body in scene.motion().bodies if body.name == "wheel")
    points = wheel.shapes[0].facets().points + wheel.position[0]
    assert np.abs(np.hypot(*(points - [1.0, 0.0, 0.0]).T[:2]) - 0.3).max() < 1e-12
    seen = project(ax, points)
    np.testing.assert_allclose(found.min(axis=0), seen.min(axis=0), atol=1e-9)
    np.testing.assert_allclose(found.max(axis=0), seen.max(axis=0), atol=1e-9)


def project(ax, points):
    matrix = ax.get_proj()
    x = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ matrix.T
    return x[:, :2] / x[:, 3:]


def test_default_shapes_follow_from_joints_and_inertia():
    bodies = {body.name: body for body in in_space().motion().bodies}
    assert [*bodies] == ["ground", "arm", "wheel", "bead"]
    (rod,) = bodies["arm"].shapes  # between its two joints
    assert isinstance(rod, ej.shapes.Capsule)
    ends = np.asarray(rod.position) + [[0, 0, -0.5], [0, 0, 0.5]] @ rod.rotation.T
    assert rod.length == pytest.approx(1.0)
    np.testing.assert_allclose(np.abs(ends), [[0.5, 0, 0], [0.5, 0, 0]], atol=1e-12)
    assert isinstance(bodies["bead"].shapes[0], ej.shapes.Sphere)
    mass, sides = 1.0, np.array([0.8, 0.6, 0.2])
    inertia = mass / 12 * (np.sum(sides**2) - sides**2)
    free = ej.Scene([ej.bodies.RigidBody("brick", mass, inertia, [0.0, 0.0, 0.0])])
    (box,) = free.motion().bodies[0].shapes
    np.testing.assert_allclose(np.ptp(box.facets().points, axis=0), sides, rtol=1e-9)


def test_names_stand_apart_and_at_their_parts():
    scene = ej.problems.slider_crank().scene
    assert scene is not None
    ax = scene.draw(names=True)
    ax.figure.draw_without_rendering()
    texts = {x.get_text(): x for x in ax.texts}
    parts = {"crank", "rod", "slider", "shaft", "big end", "small end", "guide"}
    assert parts <= {*texts}
    boxes = [x.get_window_extent() for x in texts.values() if x.get_visible()]
    assert len(boxes) >= len(parts)
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    slider = scene.position(ej.State(scene.q, scene.v), "slider")
    np.testing.assert_allclose(texts["guide"].xy, slider, atol=1e-12)


# Films ----------------------------------------------------------------------------------


def test_frames_are_at_real_time_whatever_the_steps_were():
    scene, sol = thrown()
    film = scene.animate(sol, speed=0.5, fps=8.0, traces=["stick"], units=UNITS)
    # 0.7 s of motion in 1.4 s, in steps of 0.07 s; the end is shown too.
    np.testing.assert_allclose(film.ts, [*np.arange(12) / 16, 0.7], rtol=1e-12)
    ax = film.figure.axes[0]
    for k in (0, 5, 12):
        film.show(k)
        (corners,) = rods(ax)
        centre, angle = thrown_pose(film.ts[k])
        np.testing.assert_allclose(corners.mean(axis=0), centre, atol=1e-12)
        np.testing.assert_allclose(np.tan(angle_of(corners)), np.tan(angle), rtol=1e-9)
        trail, _ = segments(ax)  # and the symbol of the motor
        np.testing.assert_allclose(trail[-1], centre, atol=1e-12)
        np.testing.assert_allclose(trail[0], [0.5, 0.0], atol=1e-12)
        assert any(x.get_text().startswith(f"t = {film.ts[k]:.2f} s") for x in ax.texts)
    assert "13 frames" in repr(film)


def test_files_show_each_frame_for_its_time(tmp_path):
    scene, sol = thrown()
    film = scene.animate(sol, speed=0.5, fps=8.0)
    with GifImageFile(film.save(tmp_path / "run.gif", dpi=30)) as gif:
        durations = []
        for k in range(gif.n_frames):
            gif.seek(k)
            durations.append(gif.info["duration"])
        assert gif.n_frames == 13
        np.testing.assert_allclose(gif.size, film.figure.get_size_inches() * 30, atol=1)
    assert sum(durations) == pytest.approx(1000 * 13 / 8, abs=10)  # hundredths of a second
    page = film.save(tmp_path / "run.html", dpi=30).read_text()
    frames = re.findall(r'"(iVBOR[^"]+)"', page)
    assert len(frames) == 13
    first, last = (
        np.asarray(Image.open(io.BytesIO(base64.b64decode(x))).convert("L"))
        for x in (frames[0], frames[-1])
    )
    assert np.mean(first != last) > 1e-3
    if shutil.which("ffmpeg"):
        assert film.save(tmp_path / "run.mp4", dpi=30).stat().st_size > 1000
        with pytest.raises(RuntimeError, match="ffmpeg could not write"):
            film.save(tmp_path / "missing" / "run.mp4", dpi=30)


@pytest.mark.slow
def test_a_film_of_points_needs_no_scene():
    _, sol = hung()
    along = lambda y: jnp.stack([jnp.cos(y.q[2]), jnp.sin(y.q[2])])
    points = lambda y: jnp.stack([jnp.zeros(2), y.q[:2], 2 * y.q[:2]])
    film = ej.animate(sol, points, lines=[[0, 1, 2]], traces=[2], fps=10.0, energy=True)
    np.testing.assert_allclose(film.ts, np.arange(9) / 10, atol=1e-12)
    ax, beside = film.figure.axes
    film.show(4)
    tip = np.asarray(along(jax.tree.map(lambda x: x[20], sol.ys)))  # the row of 0.4 s
    trail, line = segments(ax)
    np.testing.assert_allclose(line, np.outer([0.0, 0.5, 1.0], tip), atol=1e-9)
    np.testing.assert_allclose(trail[-1], tip, atol=1e-9)
    np.testing.assert_allclose(beside.lines[-1].get_xdata(), 0.4)


# Plots ----------------------------------------------------------------------------------


def test_a_run_plots_its_energies_and_their_account():
    _, sol = hung()
    given = plt.subplots(2, 2)[1]
    axes = sol.plot(given, units=UNITS)
    assert all(x is y for x, y in zip(axes, given.ravel(), strict=True))
    lines = {x.get_label(): heights(x) for ax in axes[:2] for x in ax.lines}
    audit = sol.audit
    np.testing.assert_array_equal(lines["kinetic"], audit.kinetic)
    np.testing.assert_array_equal(lines["total"], audit.energy)
    change = np.asarray(audit.energy - audit.energy[0])
    assert audit.energy[0] > 0.1  # of the spring
    np.testing.assert_allclose(lines["change of the energy"], change, atol=1e-15)
    assert axes[0].get_ylabel() == "energy [J]"
    assert axes[1].get_ylabel() == "energy since the start [J]"
    assert {ax.get_xlabel() for ax in axes} == {"time [s]"}
    largest = np.abs(audit.constraint).max(axis=1)
    shown = heights(axes[2].lines[0])
    np.testing.assert_array_equal(shown[largest > 0], largest[largest > 0])
    np.testing.assert_array_equal(heights(axes[3].lines[0]), sol.stats.newton_iterations)
    assert sol.plot_energy().get_ylabel() == "energy"  # no unit was given


def test_the_reaction_of_a_hinge_is_plotted_with_units():
    scene, sol = hung()
    ax = plt.subplots()[1]
    assert scene.plot_reactions(sol, "hinge", ax=ax, units=UNITS) is ax
    assert ax.get_ylabel() == "hinge: force [N]"
    found = scene.reaction(sol, "hinge")
    for k in range(2):
        np.testing.assert_array_equal(heights(ax.lines[k]), found.force[:, k])
    # Of a level rod that is released: a quarter of its weight, and half of the force that
    # lifts its other end, of the spring. Round-off.
    expected = [0.0, 2.0 * G / 4 + 3.0 * 0.5 / 2]
    np.testing.assert_allclose(found.force[0], expected, atol=1e-9)
    assert len(ax.figure.axes) == 1  # a hinge has no torque, only round-off


def test_a_drive_without_a_force_has_its_torque_alone():
    scene, sol = thrown()
    ax = scene.plot_reactions(sol, "motor", units=UNITS)
    assert (ax.get_ylabel(), len(ax.figure.axes)) == ("motor: torque [N m]", 1)
    (line,) = ax.lines
    inertia = 2.0 * 1.0**2 / 12
    np.testing.assert_allclose(heights(line), inertia * SPIN_UP, rtol=1e-9)  # round-off


def test_sweeps_plot_maps_and_lines_and_cross_what_failed():
    def lane(c, w):
        failed = (c > 0.25) & (w > 2.5)
        result = ej.RESULTS.where(failed, ej.RESULTS.not_converged, ej.RESULTS.successful)
        return {"sum": c + w, "result": result}

    swept = ej.sweep(lane, {"c": [0.1, 0.2, 0.3], "w": [1.0, 2.0, 3.0, 4.0]})
    ax = plt.subplots()[1]
    assert swept.plot_map("sum", ax=ax, units={"c": "kg/s", "sum": "m"}) is ax
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("w", "c [kg/s]")
    shown = np.asarray(ax.collections[0].get_array())
    np.testing.assert_allclose(shown, swept.values["sum"])
    crosses = np.asarray(ax.lines[0].get_xydata())
    np.testing.assert_allclose(crosses, [[3.0, 0.3], [4.0, 0.3]])
    ax = swept.plot_lines("sum", x="c")
    values = [heights(line) for line in ax.lines if line.get_label()[0] != "_"]
    np.testing.assert_allclose(values, swept.values["sum"].T)
    assert [x.get_text() for x in ax.get_legend().get_texts()][0] == "w = 1"
    with pytest.raises(ValueError, match="no number `sums`"):
        swept.plot_map("sums")
    with pytest.raises(ValueError, match="there are \\['c', 'w'\\]"):
        swept.plot_lines(x="m")
    with pytest.raises(ValueError, match="has 1: .*plot lines"):
        swept.at(c=0.1).plot_map("sum")


def test_fits_plot_data_prediction_and_intervals():
    ts = np.linspace(0.0, 1.0, 20)
    line = lambda p: p["a"] + p["b"] * jnp.asarray(ts)
    data = np.asarray(1.0 + 2.0 * ts + 0.1 * np.random.default_rng(0).normal(size=20))
    fit = ej.fit(lambda p, data: line(p) - data, {"a": 0.0, "b": 1.0}, data)
    ax = plt.subplots()[1]
    assert fit.plot(line, data, ts, ax=ax, units={"time": "s"}) is ax
    assert ax.get_xlabel() == "time [s]"
    seen, mean = (heights(x) for x in ax.lines)
    np.testing.assert_array_equal(seen, data)
    slope, level = np.polyfit(ts, data, 1)
    np.testing.assert_allclose(mean, level + slope * ts, rtol=1e-6)
    # The band of a straight line, from the textbook: s sqrt(1/n + (t - mean)^2 / Stt) t95.
    spread = np.sqrt(np.sum((data - mean) ** 2) / 18)
    half = spread * np.sqrt(1 / 20 + (ts - 0.5) ** 2 / np.sum((ts - 0.5) ** 2)) * 2.10092
    corners = np.asarray(ax.collections[0].get_paths()[0].vertices)
    np.testing.assert_allclose(corners[:, 1].max(), np.max(mean + half), rtol=1e-4)
    ax = fit.plot_intervals({"a": 1.0, "b": 2.0}, names=["b"])
    assert [x.get_text() for x in ax.get_xticklabels()] == ["b"]
    middle = heights(ax.lines[1])
    np.testing.assert_allclose(middle, [fit.parameters["b"] / 2 - 1])
    with pytest.raises(ValueError, match="no parameter `c`"):
        fit.plot_intervals(names=["c"])
    with pytest.raises(ValueError, match="one time for each row"):
        fit.plot(line, data, ts[1:])


# Failures and bad input -----------------------------------------------------------------


def failed_run():
    """The run, as if it had failed after thirty rows."""
    scene, sol = hung()
    cut = lambda tree: jax.tree.map(lambda x: jnp.asarray(x).at[30:].set(jnp.nan), tree)
    where = lambda s: (s.ts, s.ys, s.audit, s.result)
    failed = sol.ts, cut(sol.ys), cut(sol.audit), ej.RESULTS.not_converged
    return scene, eqx.tree_at(where, sol, failed)


def test_a_run_that_failed_is_shown_as_far_as_it_came_with_the_reason():
    scene, sol = failed_run()
    film = scene.animate(sol, fps=10.0)
    assert film.ts[-1] == pytest.approx(0.58)
    pictures = [scene.draw(sol), film.figure.axes[0]]
    assert all(ax.get_title().startswith("the run ends at t = 0.58") for ax in pictures)
    for ax in (sol.plot_energy(), scene.plot_reactions(sol, "hinge")):
        assert np.isfinite(heights(ax.lines[0])).all()
        assert any("t = 0.58: " in x.get_text() for x in ax.texts)


def batch():
    scene, sol = hung()
    return scene, jax.tree.map(lambda x: jnp.stack([x, x]), sol)


def coarse():
    scene, sol = hung()
    keep = lambda x: x[::20] if jnp.ndim(x) and len(x) == 41 else x
    return scene, jax.tree.map(keep, sol)


BAD = {
    "a batch": (lambda s, y: s.animate(batch()[1]), "batch of .2,."),
    "a batch to plot": (lambda s, y: batch()[1].plot(), "pick one"),
    "rows": (lambda s, y: s.draw(y.ys), "A picture is of one state, but here are 41"),
    "coordinates": (lambda s, y: s.draw(y.ys.q), "`Solution` .* or a `State`"),
    "another scene": (lambda s, y: s.draw(ej.State(jnp.ones(4), jnp.ones(4))), "not one"),
    "no run": (lambda s, y: s.animate(y.end), "A run is needed"),
    "NaN": (
        lambda s, y: s.draw(ej.State(jnp.full(3, jnp.nan), jnp.zeros(3))),
        "the state has NaN",
    ),
    "other lengths": (
        lambda s, y: s.draw(y, args=s.args.set("hinge", point_b=[0.5, 0.0])),
        "'hinge' is open by",
    ),
    "times": (lambda s, y: s.draw(y, [0.0, 5.0]), "`times` must be within the rows"),
    "traces": (lambda s, y: s.draw(y, traces=["rood"]), "'rood', but there is none"),
    "a point": (lambda s, y: s.draw(y, traces=[("rod", [0, 0, 0])]), "of 2 entries"),
    "a joint": (lambda s, y: s.plot_reactions(y, "hing"), "hing"),
    "units": (lambda s, y: s.draw(y, units={"mass": "kg"}), "no dimension `mass`"),
    "a figure": (lambda s, y: s.draw(y, ax=plt.figure()), "must be axes of matplotlib"),
    "axes in space": (
        lambda s, y: s.draw(y, ax=plt.figure().add_subplot(projection="3d")),
        "The picture is in the plane",
    ),
    "axes in the plane": (
        lambda s, y: in_space().draw(ax=plt.subplots()[1]), 'projection=.3d'
    ),
    "three axes": (lambda s, y: y.plot(plt.subplots(3)[1]), "needs 4 axes, got 3"),
    "speed": (lambda s, y: s.animate(y, speed=-1.0), "`speed` must be positive"),
    "a short film": (lambda s, y: s.animate(y, speed=1e3), "pass `speed=0.08`"),
    "a long film": (lambda s, y: s.animate(y, speed=1e-6), "frames. For ten seconds"),
    "energy in axes": (
        lambda s, y: s.animate(y, energy=True, ax=plt.subplots()[1]), "leave out `ax`"
    ),
    "a suffix": (lambda s, y: s.animate(y).save("run.avi"), ".gif, .mp4 or .html"),
    "points": (lambda s, y: ej.animate(y, lambda row: row.q), "must return points"),
    "a number": (
        lambda s, y: ej.animate(y, lambda row: row.q[None, :2], traces=[3]),
        "no point 3",
    ),
    "a traced state": (lambda s, y: jax.jit(s.draw)(y.end), "need values"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_has_one_clear_error(name):
    call, text = BAD[name]
    with pytest.raises((ValueError, TypeError), match=text):
        call(*hung())


def test_rows_that_are_too_far_apart_are_told():
    scene, sol = coarse()
    with pytest.warns(UserWarning, match="too far apart to draw what is between"):
        scene.animate(sol)


def test_mp4_without_ffmpeg_is_refused(monkeypatch):
    scene, sol = thrown()
    monkeypatch.setenv("PATH", "")
    with pytest.raises(RuntimeError, match="install it, or save 'run.gif'"):
        scene.animate(sol, fps=10.0).save("run.mp4")
