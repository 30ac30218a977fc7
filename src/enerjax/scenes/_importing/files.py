"""Scenes from files."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ..bodies import RigidBody
from ..scene import Scene
from . import mujoco
from .coefficients import gravity_of
from .equalities import equalities_of
from .forces import forces_of
from .joints import joints_of
from .reading import read_mjcf, read_urdf
from .refusals import check_names, refuse
from .tree import Names, Tree
from .visuals import shapes_of


def from_mjcf(
    path: str | Path,
    *,
    keyframe: str | int | None = None,
    ignore: Iterable[str] = (),
    parts: Sequence[Any] = (),
    args: dict[str, Any] | None = None,
) -> Scene:
    """The scene that a file in MuJoCo's format MJCF describes.

        scene = ej.scenes.from_mjcf("arm.xml", ignore=("limits", "actuators"))
        system, start, args = scene.build()

    Each body of the file that has joints becomes a body of the scene, of the same name,
    together with all that is attached to it without joints. Masses and inertias are those
    that MuJoCo uses, also where they follow from shapes. The frame of a body has the axes
    of that in the file, and its origin in the mass centre. Supported are hinges, slides,
    ball and free joints, several of them on one body, their springs, dampers and
    armatures, `connect` and `weld`, gravity and its compensation. The coordinate of a hinge
    or slide is `scene.measure(sol, name).value`, as MuJoCo counts it.

    Equality constraints hold exactly, which those of MuJoCo do not. Solver settings,
    sensors, cameras, and constraints that are not active have no effect. Everything else
    that has one is refused, unless `ignore` names it.

    **Arguments:**

    - `path`: of the file.
    - `keyframe`: the name or number of the keyframe from which the run starts; by default
      the start is the pose in which the file defines the bodies, at rest.
    - `ignore`: names of what is left out: `"actuators"`, `"armature"` (of ball joints
      between two bodies that move), `"contacts"`, `"couplings"` (equality constraints
      other than `connect` and `weld`), `"deformables"`, `"fluid"`, `"friction"` (dry, in
      joints), `"limits"`, `"plasticity"` (springs that yield), `"plugins"`,
      `"polynomials"` (nonlinear springs and dampers of ball and free joints),
      `"tendons"`. Motors that are left out still count with the armature and damping that
      they bring to their joint.
    - `parts`, `args`: further parts and numbers, as for `Scene`.

    **Returns:** a `Scene`.

    **Raises:** `ImportError` without the extra `import`. `FileNotFoundError` for a file
    that does not exist. `ValueError` for what MuJoCo's parser refuses; for parts that a
    scene does not have, with the names of all of them; for joints on one body whose
    coordinates do not follow from its pose; for a loop that is far from closed at the
    start; for a keyframe that does not exist.

    **Reference:** the format is that of the XML reference of MuJoCo.
    """
    kinds, path = check_names(ignore), Path(path)
    return _scene_of(read_mjcf(path), path, keyframe, kinds, parts, args)


def from_urdf(
    path: str | Path,
    *,
    ignore: Iterable[str] = (),
    parts: Sequence[Any] = (),
    args: dict[str, Any] | None = None,
) -> Scene:
    """The scene that a file in the format URDF describes.

    It is read by MuJoCo's parser: as `from_mjcf`, from the pose in which all joints are at
    zero. The root link is fixed in space, unless its joint is `floating`. A link without
    an `inertial` element has no mass, and must be fixed to one that has. Gravity is 9.81
    along `-z`. Transmissions, and elements that only other programs read, have no effect.

    **Arguments:**

    - `path`: of the file. Meshes of a `package://` are looked for in a folder with the
      name of the package, next to any folder that contains the file.
    - `ignore`: as for `from_mjcf`, and `"meshes"`: shapes whose mesh cannot be read. A
      `mimic` is among the `"couplings"`.
    - `parts`, `args`: further parts and numbers, as for `Scene`.

    **Returns:** a `Scene`.

    **Raises:** as `from_mjcf`.
    """
    kinds, path = check_names(ignore), Path(path)
    return _scene_of(read_urdf(path, kinds), path, None, kinds, parts, args)


def _scene_of(
    model: Any,
    path: Path,
    keyframe: str | int | None,
    ignore: frozenset[str],
    parts: Sequence[Any],
    args: dict[str, Any] | None,
) -> Scene:
    """The scene of a compiled model."""
    names = Names()
    told = f"'{path}'"
    tree = Tree(model, _start_of(model, told, keyframe), names)
    if not tree.roots:
        raise ValueError(f"{told} has no body with a joint: nothing can move.")
    refuse(tree, told, ignore)
    joints, coordinates = joints_of(tree, names)
    loops = equalities_of(tree, names)
    forces = forces_of(tree, coordinates, names)
    bodies = [_body(tree, root) for root in tree.roots]
    every = [*bodies, *joints, *loops, *forces, *parts]
    ground = shapes_of(tree, None)
    build = lambda redundant: Scene(
        every, gravity_of(model), args, redundant=redundant, ground=ground
    )
    scene = build(False)
    # Loops of hinges with parallel axes repeat constraints; trees never do.
    return build(True) if loops and scene.mobility().redundant else scene


def _start_of(model: Any, told: str, keyframe: str | int | None) -> Any:
    """The positions and velocities of the start."""
    data = mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    if keyframe is not None:
        names = [model.key(k).name for k in range(model.nkey)]
        number = names.index(keyframe) if keyframe in names else keyframe
        if not isinstance(number, int) or not 0 <= number < model.nkey:
            raise ValueError(
                f"{told} has no keyframe {keyframe!r}; it has {model.nkey}"
                + (f", with the names {names}." if names else ".")
            )
        mujoco.mj_resetDataKeyframe(model, data, number)
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    return data


def _body(tree: Tree, root: int) -> RigidBody:
    rotation, origin = tree.pose(root)
    weight, name = tree.weights[root], tree.names[root]
    # Without velocities at the start they all follow from the joints: they are zero.
    velocity = angular = None
    if tree.data.qvel.any():
        velocity, angular = tree.velocity(root)
    return RigidBody(
        name,
        weight.mass,
        weight.inertia,
        origin + rotation @ weight.centre,
        rotation,
        velocity=velocity,
        angular_velocity=angular,
        shape=shapes_of(tree, root) or None,
    )
