"""Bad scenes get one error that names the part."""

import pytest

import enerjax as ej


Point, Rod = ej.bodies.PointMass, ej.bodies.PlanarBody.rod
Body, Revolute = ej.bodies.RigidBody, ej.joints.Revolute
ROD = Rod("rod", 1.0, [0.0, 0.0], [1.0, 0.0])
BOX = lambda name="box", **more: Body(name, 1.0, [0.1, 0.1, 0.1], [0.0, 0, 0], **more)
MOTOR = lambda body, **more: ej.drives.Angle(
    "motor", "ground", body, lambda t, args: 2.0 * t, **more
)
BAD = {
    "no body": (lambda: [Revolute("pin", "rod", "rdo"), ROD], "'pin'.*no such body"),
    "mass": (lambda: [Point("dot", 0.0, [0.0, 0.0])], "`mass` of 'dot' must be positive"),
    "inertia": (
        lambda: [Body("box", 1.0, [1.0, 1.0, 3.0], [0, 0, 0])],
        "No body has the `inertia` of 'box'",
    ),
    "flat": (lambda: [Body("disc", 1.0, [1.0, 1.0, 2.0], [0, 0, 0])], "'disc' is flat"),
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
    "stranger": (lambda: [ROD, "pin"], "made of bodies, joints, forces and drives"),
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
    with pytest.raises(ValueError, match="'again' repeats"):
        ej.Scene([*PENDULUM, again]).start()


def test_a_drive_of_what_is_held_already_is_named():
    ram = ej.drives.Distance("ram", "ground", "inner", lambda t, args: 1.0 + 0.0 * t)
    with pytest.raises(ValueError, match="'ram' repeats"):
        ej.Scene([*PENDULUM, ram]).start()
