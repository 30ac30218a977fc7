"""Scenes from MJCF and URDF files, beside MuJoCo's own dynamics of the same files.

The files are in `data`. MuJoCo works in joint coordinates and scenes in those of bodies, so
energies and powers of both are compared in the same states, and their motions.
"""

import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import enerjax as ej

from .helpers import long


mujoco = pytest.importorskip("mujoco")

DATA = pathlib.Path(__file__).parent / "data"
TREES = ["cartpole", "walker", "arm", "ball_chain", "rotor", "joints"]


def path(name):
    return DATA / f"{name}.xml"


def peer(name, keyframe=None):
    """A model of MuJoCo and its data in a keyframe."""
    model = mujoco.MjModel.from_xml_path(str(path(name)))
    data = mujoco.MjData(model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(model, data, model.key(keyframe).id)
    mujoco.mj_forward(model, data)
    return model, data


def energies_of_peer(model, data):
    """Kinetic and potential energy, the latter with that of what compensates gravity, which
    is no potential in MuJoCo; and the power of dampers."""
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    lift = model.body_gravcomp * model.body_mass * (data.xipos @ model.opt.gravity)
    potential, kinetic = data.energy + np.array([lift.sum(), 0.0])
    return kinetic, potential, data.qfrc_damper @ data.qvel


@eqx.filter_jit
def figures(system, q, v, args):
    """Kinetic and potential energy, the power of forces, and the residuals of constraints
    at both levels."""
    closed = jax.jvp(lambda q: system.constraint(q, args), (q,), (v,))
    power = jnp.zeros(())
    if system.force is not None:
        power = system.force(q, v, jnp.zeros(()), args) @ v
    return jnp.stack([system.kinetic(v, args), system.potential(q, args), power]), closed


# The dynamics of a file -----------------------------------------------------------------


@pytest.mark.parametrize("name", long(TREES, "joints"))
def test_energies_and_joints_are_those_of_the_file(name):
    """In two states, to round-off: the kinetic energy, the change of the potential energy,
    the power of the dampers, and all joints closed, at both levels. With the number of
    freedoms these determine the equations of motion."""
    found, wanted = [], []
    for keyframe in ("bent", "other"):
        model, data = peer(name, keyframe)
        wanted.append(energies_of_peer(model, data))
        scene = ej.scenes.from_mjcf(path(name), keyframe=keyframe)
        energies, closed = figures(scene.system, scene.q, scene.v, scene.args)
        found.append(energies)
        assert np.abs(closed[0]).max() < 1e-14
        assert np.abs(closed[1]).max() < 1e-14 * np.abs(data.qvel).max()
    found, wanted = np.array(found), np.array(wanted)
    scale = np.abs(wanted).max()
    assert np.allclose(found[:, [0, 2]], wanted[:, [0, 2]], rtol=0, atol=1e-13 * scale)
    change = np.diff(found[:, 1]) - np.diff(wanted[:, 1])
    assert abs(change[0]) < 1e-13 * scale
    assert f", {model.nv} degrees of freedom." in str(scene)


@pytest.mark.slow_for("walker")
@pytest.mark.parametrize("name", [x for x in TREES if x not in ("ball_chain", "joints")])
def test_coordinates_are_those_of_the_file(name):
    scene = ej.scenes.from_mjcf(path(name), keyframe="other")
    model, data = peer(name, "other")
    kinds = [mujoco.mjtJoint(kind).name for kind in model.jnt_type]
    scalar = [k for k, kind in enumerate(kinds) if kind in ("mjJNT_HINGE", "mjJNT_SLIDE")]
    for k in scalar[-3:]:
        now = scene.measure(ej.State(scene.q, scene.v), model.joint(k).name)
        assert now.value == pytest.approx(data.qpos[model.jnt_qposadr[k]], abs=1e-14)
        assert now.rate == pytest.approx(data.qvel[model.jnt_dofadr[k]], abs=1e-13)


def motion_of_peer(name, times):
    """The mass centres of MuJoCo's bodies at some multiples of 1e-4, by its scheme of
    fourth order with steps of 1e-4: of each body with those that are fixed to it, and with
    the armature of a free joint, which is a mass in the origin of the frame."""
    model, data = peer(name, "bent")
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = 1e-4
    masses = np.zeros((model.nbody, 2 * model.nbody))
    for k in range(model.nbody):
        masses[model.body_weldid[k], k] = model.body_mass[k]
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            body, dof = model.jnt_bodyid[joint], model.jnt_dofadr[joint]
            masses[body, model.nbody + body] = model.dof_armature[dof]
    rows = []
    for t in times:
        while data.time < t - 1e-9:
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        moments = masses @ np.concatenate([data.xipos, data.xpos])
        rows.append(moments[1:] / np.maximum(masses.sum(axis=1), 1e-300)[1:, None])
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bound"),
    [
        ("cartpole", 2e-6),
        ("walker", 4e-6),
        ("arm", 1e-5),
        ("ball_chain", 2e-5),
        ("rotor", 1e-5),
    ],
)
def test_the_motion_is_that_of_mujoco(name, bound):
    """The truncation of a scheme of second order: half the step has a quarter of it."""
    scene = ej.scenes.from_mjcf(path(name), keyframe="bent")
    system, start, args = scene.build()
    times = np.linspace(0, 0.5, 6)
    wanted = motion_of_peer(name, times)
    model, data = peer(name, "bent")
    errors = []
    for finer in (1, 2):
        sol = ej.simulate(
            system,
            ej.EnergyPreserving(),
            start,
            args,
            h=1e-3 / finer,
            num_steps=500 * finer,
        )
        ys = jax.tree.map(lambda x: x[:: 100 * finer], sol.ys)  # noqa: B023
        bodies = [model.body(k).name for k in range(1, model.nbody)]
        moving = [k for k, name in enumerate(bodies) if name in scene._kinds]
        found = np.stack([scene.position(ys, bodies[k]) for k in moving], axis=1)
        errors.append(np.abs(found - wanted[:, moving]).max())
    assert errors[0] < bound
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)


def test_a_pendulum_swings_as_in_its_angle():
    """Masses and inertias follow from shapes: a rod with round ends, and a ball."""
    scene = ej.scenes.from_mjcf(path("pendulum"))
    system, start, args = scene.build()
    steps, h = 400, 2e-3
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=steps)
    radius, length, ball, at = 0.03, 0.8, 0.1, 0.8
    cylinder, caps = np.pi * radius**2 * length, 4 / 3 * np.pi * radius**3
    sphere = 4 / 3 * np.pi * ball**3
    # Both halves of the round ends, about the pivot at one end of the rod.
    of_caps = caps * (0.4 * radius**2 + length**2 / 2 + 3 / 8 * radius * length)
    inertia = cylinder * (radius**2 / 4 + length**2 / 3) + of_caps
    inertia += sphere * (0.4 * ball**2 + at**2)
    moment = (cylinder + caps) * length / 2 + sphere * at
    run = scipy.integrate.solve_ivp(
        lambda t, y: [y[1], 9.81 * moment / inertia * np.cos(y[0])],
        (0, steps * h),
        [0.0, 0.0],
        rtol=1e-11,
        atol=1e-12,
    )
    # Truncation: the error is of second order in the step.
    assert scene.measure(sol, "pivot").value[-1] == pytest.approx(run.y[0, -1], abs=2e-5)
    assert np.ptp(sol.audit.energy) < 1e-12 * 1e3 * sphere  # of Newton's method


# Loops ----------------------------------------------------------------------------------

SHAFT, ROD = 0.2, 0.5  # lengths of the slider-crank


def slider_crank(t):
    """The angle of the crank, by the equation of motion in this angle alone.

    Positive angles turn the crank downwards. All masses are those of the file.
    """
    inertia_of_crank = 0.8 / 12 * (0.2**2 + 0.04**2) + 0.8 * 0.1**2
    inertia_of_rod = 0.5 / 12 * (0.5**2 + 0.02**2)

    def places(angle):
        fall = jnp.arcsin(SHAFT / ROD * jnp.sin(angle))  # of the rod, upwards
        pin = SHAFT * jnp.stack([jnp.cos(angle), -jnp.sin(angle)])
        along = jnp.stack([jnp.cos(fall), jnp.sin(fall)])
        return fall, pin, pin + ROD / 2 * along, pin + ROD * along

    def lagrangian(angle, rate):
        (fall, pin, middle, piston), (turning, _, moving, sliding) = jax.jvp(
            places, (angle,), (rate,)
        )
        kinetic = inertia_of_crank * rate**2 + inertia_of_rod * turning**2
        kinetic += 0.5 * moving @ moving + 1.2 * sliding @ sliding
        heights = 0.8 * pin[1] / 2 + 0.5 * middle[1] + 1.2 * piston[1]
        return 0.5 * kinetic - 9.81 * heights

    @jax.jit
    def field(t, y):
        angle, rate = y
        inertia = jax.grad(jax.grad(lagrangian, 1), 1)(angle, rate)
        drift = jax.grad(jax.grad(lagrangian, 1), 0)(angle, rate) * rate
        force = jax.grad(lagrangian)(angle, rate)
        return jnp.stack([rate, (force - drift) / inertia])

    run = scipy.integrate.solve_ivp(
        field, (0, t), [0.0, 8.0], method="DOP853", rtol=1e-12, atol=1e-12
    )
    return run.y[:, -1]


def test_a_loop_is_found_to_repeat_constraints():
    """In the plane of its hinges. The keyframe is closed, so energies are to round-off."""
    scene = ej.scenes.from_mjcf(path("slider_crank"), keyframe="turning")
    assert scene.system.redundant
    assert "1 degree of freedom." in str(scene)
    (kinetic, _, power), closed = figures(scene.system, scene.q, scene.v, scene.args)
    wanted, _, _ = energies_of_peer(*peer("slider_crank", "turning"))
    assert kinetic == pytest.approx(wanted, rel=1e-14)
    assert power == 0
    assert np.abs(closed).max() < 1e-14


@pytest.mark.slow
def test_a_loop_is_closed_exactly():
    """A slider-crank against its equation of motion in one coordinate: MuJoCo's own loop is
    soft."""
    scene = ej.scenes.from_mjcf(path("slider_crank"), keyframe="turning")
    system, start, args = scene.build()
    angle, rate = slider_crank(0.4)
    errors = []
    for finer in (1, 2):
        sol = ej.simulate(
            system,
            ej.EnergyPreserving(),
            start,
            args,
            h=2e-3 / finer,
            num_steps=200 * finer,
        )
        now = scene.measure(sol, "shaft")
        errors.append([abs(now.value[-1] - angle), abs(now.rate[-1] - rate)])
        assert np.abs(sol.audit.constraint).max() < 1e-11  # of Newton's method
    assert np.max(errors[0]) < 2e-3  # truncation
    assert np.all(np.array(errors[0]) / errors[1] == pytest.approx(4, rel=0.1))


def test_a_flat_body_of_a_file_is_a_rigid_body(tmp_path):
    (tmp_path / "plate.xml").write_text(
        '<mujoco><worldbody><body name="plate"><freejoint/><inertial pos="0 0 0" mass="2" '
        'diaginertia="0.1 0.2 0.3"/></body></worldbody></mujoco>'
    )
    scene = ej.scenes.from_mjcf(tmp_path / "plate.xml")
    assert scene.q.size == 12  # its mass centre and axes


# URDF -----------------------------------------------------------------------------------


def test_a_urdf_file_is_the_same_as_its_translation(tmp_path):
    """MuJoCo writes it as MJCF, with six digits. Links that are fixed to another are part
    of it."""
    scene = ej.scenes.from_urdf(DATA / "arm.urdf")
    translated = mujoco.MjSpec.from_file(str(DATA / "arm.urdf"))
    translated.compile()
    (tmp_path / "arm.xml").write_text(translated.to_xml())
    other = ej.scenes.from_mjcf(tmp_path / "arm.xml")
    assert eqx.tree_equal(scene.args, other.args, rtol=1e-5, atol=1e-5)
    assert np.allclose(scene.q, other.q, rtol=0, atol=1e-5)
    assert scene.args["bodies"]["lower"]["mass"] == pytest.approx(0.8 + 0.2)
    assert scene.args["forces"]["shoulder damper"]["damping"] == 0.05
    assert "tool" not in str(scene)


def test_shapes_of_a_urdf_file_are_seen():
    ground, *bodies = ej.scenes.from_mjcf(path("arm")).motion().bodies
    (floor,) = ground.shapes
    assert ground.name == "ground"
    assert isinstance(floor, ej.shapes.Box)
    assert np.allclose(floor.position + [0, 0, floor.size[2] / 2], 0)  # its upper side
    shapes = {body.name: body.shapes for body in bodies}
    rod, ball = shapes["fore"]
    assert isinstance(rod, ej.shapes.Capsule)
    assert (float(rod.radius), float(rod.length)) == pytest.approx((0.03, 0.3))
    assert rod.color == pytest.approx((0.9, 0.5, 0.2, 1.0))
    assert np.linalg.norm(ball.position - rod.position) == pytest.approx(0.15)

    scene = ej.scenes.from_urdf(DATA / "arm.urdf")
    upper, lower = scene.motion().bodies
    cylinder, box = upper.shapes
    assert isinstance(cylinder, ej.shapes.Cylinder)
    assert cylinder.color == (1.0, 0.5, 0.0, 1.0)
    assert np.allclose(cylinder.position, 0, atol=1e-12)  # in the mass centre
    assert np.allclose(np.abs(cylinder.rotation[:, 2]), [1, 0, 0], atol=1e-5)
    assert isinstance(box, ej.shapes.Box)
    assert np.allclose(box.size, 0.05)
    (mesh,) = lower.shapes
    corners = mesh.facets().points + lower.position[0] @ lower.rotation[0]
    assert np.ptp(mesh.facets().points, axis=0) == pytest.approx(np.full(3, 0.1))
    assert corners.shape == (4, 3)


# What is refused ------------------------------------------------------------------------

EVERYTHING = """
<mujoco>
  <compiler angle="radian"/>
  <option density="1000"/>
  <default><geom size="0.1" mass="1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="box" pos="0 0 1">
      <joint name="hinge" range="-1 1" frictionloss="0.1"/>
      <geom type="sphere"/>
      <site name="here"/>
      <body name="ball" pos="0.3 0 0">
        <joint name="globe" type="ball" armature="0.1" stiffness="1 2 3"/>
        <geom type="sphere"/>
        <site name="there"/>
      </body>
    </body>
    <body name="block" pos="0 1 1">
      <joint name="rail" type="slide" stiffness="1" springyield="0.1"/>
      <geom type="sphere"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="rope" stiffness="3"><site site="here"/><site site="there"/></spatial>
    <spatial name="ruler"><site site="here"/><site site="there"/></spatial>
  </tendon>
  <equality><joint name="gear" joint1="hinge" joint2="rail"/></equality>
  <actuator>
    <motor name="motor" joint="hinge" gear="3" armature="0.1" damping="0.2"/>
  </actuator>
</mujoco>
"""


def written(tmp_path, text):
    file = tmp_path / "model.xml"
    file.write_text(text)
    return file


def test_all_that_is_left_out_is_named(tmp_path):
    file = written(tmp_path, EVERYTHING)
    with pytest.raises(ValueError, match="parts that a scene does not have") as error:
        ej.scenes.from_mjcf(file)
    named = dict(
        actuators="motor",
        armature="globe",
        contacts="ball with world",
        couplings="gear",
        fluid="density",
        friction="hinge",
        limits="hinge",
        plasticity="rail",
        polynomials="globe",
        tendons="rope",
    )
    told = [line.strip() for line in str(error.value).splitlines()[1:-1]]
    assert [line.partition(":")[0] for line in told] == sorted(named)
    for line in told:
        assert named[line.partition(":")[0]] in line
    assert "ruler" not in str(error.value)  # it only measures

    kinds = tuple(named)
    with pytest.raises(ValueError, match="  limits: ") as error:
        ej.scenes.from_mjcf(file, ignore=[x for x in kinds if x != "limits"])
    assert len(str(error.value).splitlines()) == 3
    scene = ej.scenes.from_mjcf(file, ignore=kinds)
    # A motor that is left out stays a rotor behind a gear.
    armature = scene.args["inerters"]["hinge armature"]["inertance"]
    assert armature == pytest.approx(9 * 0.1)
    assert scene.args["forces"]["hinge damper"]["damping"] == pytest.approx(9 * 0.2)


@pytest.mark.parametrize("bits", ["contype", "conaffinity"])
def test_shapes_that_cannot_touch_are_no_contacts(tmp_path, bits):
    """Neither are a body and that to which it is joined, nor those that are excluded."""
    body = '<body name="{}" pos="{} 0 0"><joint/><geom size="0.1" {}/>{}</body>'
    none = 'contype="0" conaffinity="0"'
    inner = body.format("c", 2, "", "")
    pairs = {
        body.format("a", 0, none, "") + body.format("b", 1, "", ""): True,
        body.format("a", 0, f'{bits}="0"', "") + body.format("b", 1, "", ""): False,
        body.format("a", 0, "", inner): True,
        body.format("a", 0, "", body.format("b", 1, none, inner)): False,
    }
    exclude = '<contact><exclude body1="a" body2="c"/></contact>'
    for bodies, is_fine in pairs.items():
        text = f"<mujoco><worldbody>{bodies}</worldbody>{{}}</mujoco>"
        file = written(tmp_path, text.format(""))
        if is_fine:
            ej.scenes.from_mjcf(file)
            continue
        with pytest.raises(ValueError, match="contacts: contacts .a with"):
            ej.scenes.from_mjcf(file)
        if 'name="c"' in bodies:
            ej.scenes.from_mjcf(written(tmp_path, text.format(exclude)))


@pytest.mark.parametrize(
    "axes",
    [
        ("0 0 1", "0 1 1.5"),
        pytest.param(("0 0 1", "1 1 1", "2 0.5 1"), marks=pytest.mark.slow),
    ],
)
def test_armatures_of_hinges_in_a_row_are_those_of_their_angles(tmp_path, axes):
    """At oblique axes too the torque on a coordinate is its armature times its
    acceleration."""
    joints = "".join(
        f'<joint name="{k}" axis="{axis}" armature="0.1"/>' for k, axis in enumerate(axes)
    )
    velocities = " ".join(["0.3", "-0.2", "0.4"][: len(axes)])
    text = (
        f'<mujoco><worldbody><body name="w">{joints}'
        '<geom type="box" size=".1 .2 .3" pos=".2 .1 -.3"/></body></worldbody>'
        f'<keyframe><key name="k" qvel="{velocities}"/></keyframe></mujoco>'
    )
    scene = ej.scenes.from_mjcf(written(tmp_path, text), keyframe="k")
    system, start, args = scene.build()
    h = 1e-4
    sol = ej.simulate(system, ej.EnergyPreserving(), start, args, h=h, num_steps=3)
    for k in range(len(axes)):
        rates = scene.measure(sol, f"{k}").rate
        force = scene.measure(sol, f"{k} armature").force
        assert force is not None
        # Truncation, of the force in the middle of the step.
        wanted = float(-0.1 * (rates[2] - rates[1]) / h)
        assert float(force[2]) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("turns", [(4.0,), (0.3, 4.0), (-5.0, 0.2, 9.0)])
def test_springs_that_start_beyond_half_a_turn_have_the_energy_of_their_angles(
    tmp_path, turns
):
    axes = ("0 1 0", "1 0 0", "0.2 0 1")[: len(turns)]
    joints = "".join(
        f'<joint axis="{axis}" stiffness="{2 + k}" springref="{10 * k}"/>'
        for k, axis in enumerate(axes)
    )
    text = (
        f'<mujoco><option gravity="0 0 0"/><worldbody><body>{joints}'
        '<geom type="box" size=".1 .2 .3" pos=".2 .1 -.3"/></body></worldbody>'
        f'<keyframe><key name="k" qpos="{" ".join(map(str, turns))}"/></keyframe></mujoco>'
    )
    scene = ej.scenes.from_mjcf(written(tmp_path, text), keyframe="k")
    system, start, args = scene.build()
    energies = [
        (2 + k) / 2 * (turn - np.radians(10 * k)) ** 2 for k, turn in enumerate(turns)
    ]
    # Round-off.
    assert float(system.potential(start.q, args)) == pytest.approx(sum(energies), rel=1e-13)


HINGES = '<joint axis="1 0 0"/><joint axis="0 1 0"/><joint axis="0 0 1"/>'


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (HINGES + '<joint axis="1 0 0"/>', "4 hinges in a row"),
        ('<joint axis="1 0 0"/><joint axis="2 0 0" pos="0 1 0"/>', "parallel axes"),
        ('<joint type="slide"/><joint type="slide"/>', "one follows from the others"),
        (HINGES.replace("0 0 1", "1 0 0"), "gimbal lock"),
        ('<joint axis="1 0 0"/><joint type="ball"/>', "a ball joint and a hinge"),
        ("", "no body with a joint"),
    ],
)
def test_joints_that_cannot_be_are_refused(tmp_path, joints, message):
    body = f'<body name="arm">{joints}<geom size="0.1"/></body>'
    # With an armature MuJoCo has no objection to any of them.
    text = '<default><joint armature="1"/></default><worldbody>{}</worldbody>'
    file = written(tmp_path, f"<mujoco>{text.format(body)}</mujoco>")
    with pytest.raises(ValueError, match=message):
        ej.scenes.from_mjcf(file)


def test_wrong_input_is_told(tmp_path):
    arm, urdf = path("arm"), DATA / "arm.urdf"
    for read, file, error, message in (
        (ej.scenes.from_mjcf, tmp_path / "none.xml", FileNotFoundError, "no file '.*none"),
        (ej.scenes.from_mjcf, urdf, ValueError, "<robot>: use `from_urdf`"),
        (ej.scenes.from_urdf, arm, ValueError, "<mujoco>: use `from_mjcf`"),
        (ej.scenes.from_mjcf, written(tmp_path, "<mujoco>"), ValueError, "is no XML"),
        (ej.scenes.from_mjcf, DATA.parent / "conftest.py", ValueError, "is no XML"),
    ):
        with pytest.raises(error, match=message):
            read(file)
    file = written(tmp_path, '<mujoco><worldbody><geom size="-1"/></worldbody></mujoco>')
    with pytest.raises(ValueError, match="MuJoCo's parser refuses '.*model.xml'"):
        ej.scenes.from_mjcf(file)
    for keyframe in ("straight", 2, -1):
        with pytest.raises(ValueError, match="no keyframe .*; it has 2, with the names"):
            ej.scenes.from_mjcf(arm, keyframe=keyframe)
    with pytest.raises(ValueError, match=r"ignore by the name \['limit'\]"):
        ej.scenes.from_mjcf(arm, ignore=("limit",))
    with pytest.raises(TypeError, match=r'write `ignore=\("limits",\)`'):
        ej.scenes.from_mjcf(arm, ignore="limits")


def test_meshes_that_do_not_exist_are_told(tmp_path):
    text = (DATA / "arm.urdf").read_text().replace("tetrahedron", "cube")
    file = written(tmp_path, text)
    with pytest.raises(ValueError, match='first of them .*cube.obj.*"meshes"'):
        ej.scenes.from_urdf(file)
    scene = ej.scenes.from_urdf(file, ignore=("meshes",))
    (default,) = scene.motion().bodies[1].shapes[:1]
    assert isinstance(default, ej.shapes.Box)


def test_names_that_the_file_has_twice_are_told_apart(tmp_path):
    body = '<body name="arm"><joint name="arm" damping="1"/><geom size="0.1"/></body>'
    file = written(tmp_path, f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    scene = ej.scenes.from_mjcf(file)
    assert [*scene.args["joints"]] == ["arm (joint)"]
    assert [*scene.args["forces"]] == ["arm (joint) damper"]


def test_further_parts_act_on_the_bodies_of_a_file():
    def servo(view, t, args):
        return args["p"] * (1.0 - view.angle("elbow")) - view.rate("elbow")

    motor = ej.forces.TorsionActuator("motor", "upper", "fore", servo, [0.0, 1.0, 0.0])
    scene = ej.scenes.from_mjcf(path("arm"), parts=[motor], args={"p": 3.0})
    assert scene.args["p"] == 3.0
    force = scene.measure(ej.State(scene.q, scene.v), "motor").force
    assert force is not None
    assert float(force) == 3.0


def test_without_mujoco_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"enerjax\[import\]"):
        ej.scenes.from_mjcf(path("arm"))
