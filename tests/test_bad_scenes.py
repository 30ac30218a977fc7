"""Bad scenes get one error that names the part."""

import pytest

import enerjax as ej


Point, Rod = ej.bodies.PointMass, ej.bodies.PlanarBody.rod
Body, Revolute = ej.bodies.RigidBody, ej.joints.Revolute
ROD = Rod("rod", 1.0, [0.0, 0.0], [1.0, 0.0])
BOX = lambda name="box", **more: Body(name, 1.0, [0.1, 0.1, 0.1], [0.0, 0, 0], **more)
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
    "stranger": (lambda: [ROD, "pin"], "made of bodies, joints and forces"),
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
