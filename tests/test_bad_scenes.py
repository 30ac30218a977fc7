"""Bad scenes get one error that names the part."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import enerjax as ej


Point, Rod = ej.bodies.PointMass, ej.bodies.PlanarBody.rod
Body, Revolute = ej.bodies.RigidBody, ej.joints.Revolute
ROD = Rod("rod", 1.0, [0.0, 0.0], [1.0, 0.0])
BOX = lambda name="box", **more: Body(name, 1.0, [0.1, 0.1, 0.1], [0.0, 0, 0], **more)
DOT, ORIGIN = Point("dot", 1.0, [1.0, 0.0]), Point("dot", 1.0, [0.0, 0.0])
UP, TILTED = [0.0, 0.0, 1.0], [0.0, 0.6, 0.8]
HINGE = Revolute("hinge", "ground", "box", axis=UP)
PIN = Revolute("pin", "ground", "rod", [0.0, 0.0])
MOTOR = lambda body, **more: ej.drives.Angle(
    "motor", "ground", body, lambda t, args: 2.0 * t, **more
)


def chain(num, gap):
    parts, before = [], "ground"
    for k in range(num):
        end = [0.0, 0.0] if k == 0 else [0.5 + gap * (k == 3), 0.0]
        parts += [
            Rod(f"rod {k}", 1.0, [k, 0.0], [k + 1, 0.0]),
            Revolute(f"pin {k}", before, f"rod {k}", end, [-0.5, 0.0]),
        ]
        before = f"rod {k}"
    return parts


BAD = {
    "no body": (lambda: [Revolute("pin", "rod", "rdo"), ROD], "'pin'.*no such body"),
    "mass": (lambda: [Point("dot", 0.0, [0.0, 0.0])], "`mass` of 'dot' must be positive"),
    "inertia": (
        lambda: [Body("box", 1.0, [1.0, 1.0, 3.0], [0, 0, 0])],
        "No body has the `inertia` of 'box'",
    ),
    "rod": (
        lambda: [Body("rod", 1.0, [0.0, 1.0, 1.0], [0, 0, 0])],
        "'rod'.* must be positive.* thin rod needs a small moment",
    ),
    "rotation": (
        lambda: [BOX(rotation=[1.0, 1.0, 0.0, 0.0])],
        "`rotation` of 'box' is no rotation",
    ),
    "gap": (
        lambda: [ROD, Revolute("pin", "ground", "rod", [0.3, 0.0], [-0.5, 0.0])],
        "'pin' is off by 0.3",
    ),
    "names": (lambda: [ROD, ROD], "two parts with the name 'rod'"),
    "itself": (lambda: [ROD, Revolute("pin", "rod", "rod")], "'pin' connects 'rod' with"),
    "nothing": (lambda: [], "no body in the scene"),
    "worlds": (lambda: [ROD, BOX()], "'box' is in space, but 'rod' in the plane"),
    "orientation": (
        lambda: [
            Point("dot", 1.0, [0.0, 0, 0]), BOX(), ej.joints.Fixed("weld", "dot", "box"),
        ],
        "'weld' needs the orientation of 'dot'",
    ),
    "axis": (lambda: [BOX(), Revolute("pin", "ground", "box")], "'pin' needs `axis`"),
    "shape": (lambda: [Point("dot", 1.0, [0.0])], "`position` of 'dot' must be"),
    "driven body": (lambda: [ROD, MOTOR("rdo")], "'motor' connects 'rdo'.*no such body"),
    "driven point": (
        lambda: [Point("dot", 1.0, [0.0, 0.0]), MOTOR("dot")],
        "'motor' needs the orientation of 'dot'",
    ),
    "not connected": (
        lambda: [BOX(), MOTOR("box", axis=[0.0, 0.0, 1.0])],
        "'motor' has an angle only with a joint.*none connects 'ground' and 'box'",
    ),
    "no motion": (
        lambda: [ROD, ej.drives.Angle("motor", "ground", "rod", 3.0)],  # type: ignore
        "`motion` of 'motor' must be a function of",
    ),
    "shape of motion": (
        lambda: [ROD, ej.drives.Position("lead", "rod", lambda t, args: t)],
        "function of 'lead' must return shape",
    ),
    "shape of load": (
        lambda: [ROD, ej.forces.Load("wind", "rod", lambda t, args: t)],
        "function of 'wind' must return shape",
    ),
    "far from the drive": (
        lambda: [ROD, ej.drives.Distance("ram", "ground", "rod", lambda t, args: 2.0 + t)],
        "'ram' is off by",
    ),
    "damping": (
        lambda: [ROD, ej.forces.Damper("damper", "ground", "rod", -1.0)],
        "`damping` of 'damper' must not be below 0",
    ),
    "stranger": (lambda: [ROD, "pin"], "made of bodies, joints, forces, drives and"),
    "no list": (lambda: ROD, "a list of parts.*\\[rod\\]"),
    "ground": (lambda: [Point("ground", 1.0, [0.0, 0.0])], "'ground' is reserved"),
    "no name": (
        lambda: [ROD, Revolute("pin", "ground", ROD)],  # type: ignore
        "'pin' connects bodies by their names.*write 'rod'",
    ),
    "one link of a long chain": (
        lambda: chain(10, gap=0.3),
        "'pin 3' is off by 0.3 at the start, of bodies of size 0.8",
    ),
    "opposite": (
        lambda: [
            BOX(), HINGE,
            ej.drives.Angle("motor", "ground", "box", lambda t, args: np.pi + t, UP),
        ],
        "'motor' is off by 3.14",
    ),
    "no hinge": (
        lambda: [
            BOX(), ej.joints.Spherical("ball", "ground", "box"), MOTOR("box", axis=UP),
        ],
        "'motor' has an angle only with a joint.*none connects 'ground' and 'box'",
    ),
    "tilted motor": (
        lambda: [BOX(), HINGE, MOTOR("box", axis=TILTED)],
        r"'hinge' turns about \[0.0, 0.0, 1.0\], 'motor' about \[0.0, 0.6, 0.8\]",
    ),
    "tilted actuator": (
        lambda: [
            BOX(), HINGE,
            ej.forces.TorsionActuator("push", "ground", "box", lambda t, a: t, TILTED),
        ],
        "'push' has an angle only with",
    ),
    "tilted damper": (
        lambda: [
            BOX(), HINGE, ej.forces.TorsionDamper("brake", "ground", "box", 1.0, TILTED),
        ],
        "'brake' has an angle only with",
    ),
    "tilted spring": (
        lambda: [
            BOX(), HINGE,
            ej.forces.TorsionSpring("coil", "ground", "box", 1.0, axis=TILTED),
        ],
        "'coil' has an angle only with",
    ),
    "coil on a point": (
        lambda: [DOT, ej.forces.TorsionSpring("coil", "ground", "dot", 1.0)],
        "'coil' needs the orientation of 'dot'",
    ),
    "torque on a point": (
        lambda: [DOT, ej.forces.ConstantTorque("twist", "dot", 1.0)],
        "'twist' needs the orientation of 'dot'",
    ),
    "jerk": (
        lambda: [
            DOT,
            ej.drives.Distance("ram", "ground", "dot", lambda t, args: 1 + jnp.sqrt(t)),
        ],
        "function of 'ram' has no finite value and rate",
    ),
    "spring without length": (
        lambda: [ORIGIN, ej.forces.Spring("spring", "ground", "dot", 3.0, 1.0)],
        "'spring' acts along the line between two points.* coincide",
    ),
    "rod without length": (
        lambda: [ORIGIN, ej.joints.Distance("tie", "ground", "dot", length=1.0)],
        "'tie' acts along the line between two points.* coincide",
    ),
    "scalar curve": (
        lambda: [ORIGIN, ej.joints.OnCurve("rail", "ground", "dot", lambda x, n: x[1])],
        "function of 'rail' must return a vector",
    ),
    "scalar constraint": (
        lambda: [ORIGIN, ej.joints.Constraint("own", lambda view, args: view.q[1])],
        "function of 'own' must return a vector",
    ),
    "one axis": (
        lambda: [BOX(), ej.joints.Universal("cross", "ground", "box", axis=UP)],
        "'cross' needs `axis_b`",
    ),
    "signature": (
        lambda: [
            ROD, PIN,
            ej.drives.Angle("motor", "ground", "rod", lambda t: t),  # type: ignore
        ],
        r"`motion` of 'motor' must be a function of \(t, args\)",
    ),
    "missing number": (
        lambda: [
            ROD, PIN,
            ej.drives.Angle("motor", "ground", "rod", lambda t, args: args["w"] * t),
        ],
        "function of 'motor' asks for 'w', which does not exist",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_scenes_are_refused_by_the_name_of_the_part(name):
    parts, message = BAD[name]
    with pytest.raises((ValueError, TypeError), match=message):
        ej.Scene(parts())


PENDULUM = [
    Point("inner", 1.0, [1.0, 0.0]),
    ej.joints.Distance("upper", "ground", "inner"),
]


def test_a_joint_that_repeats_others_is_named():
    again = ej.joints.Distance("again", "ground", "inner")
    with pytest.raises(
        ValueError, match=r"`Scene\(..., redundant=True\)`.*'again' repeats"
    ):
        ej.Scene([*PENDULUM, again]).start()


def test_a_drive_along_a_constrained_direction_is_named():
    ram = ej.drives.Distance("ram", "ground", "inner", lambda t, args: 1.0 + 0.0 * t)
    with pytest.raises(ValueError, match="'ram' repeats"):
        ej.Scene([*PENDULUM, ram]).start()


def test_questions_that_a_scene_cannot_answer_are_refused():
    dot, rod, box = (ej.Scene([part]) for part in (DOT, ROD, BOX()))
    no_name: Any = ROD
    of = lambda scene: ej.State(scene.q, scene.v)
    for ask, message in (
        (lambda: box.angle(of(box), "box"), "'box' is in space, where"),
        (lambda: dot.angle(of(dot), "dot"), "'dot' is a point mass"),
        (lambda: dot.direction(of(dot), "dot", [1.0, 0.0]), "'dot' is a point mass"),
        (lambda: dot.position(of(dot), "dot", [1.0, 0.0]), "'dot' is a point mass"),
        (lambda: rod.position(of(rod), "rod", [1.0, 0.0, 0.0]), "of 'rod' must be of 2"),
        (lambda: rod.position(of(rod), no_name), "identified by name.*write 'rod'"),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            ask()
