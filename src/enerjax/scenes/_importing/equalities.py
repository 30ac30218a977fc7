"""Equality constraints of a file that connect or weld two bodies."""

from typing import Any

import numpy as np

from .._laws import Alignment, SAME_DIRECTIONS
from .._rotations import rotation_matrix
from ..joints import Spherical
from . import mujoco, parts
from .coefficients import is_disabled
from .tree import Names, Place, Tree


def active(model: Any) -> list[int]:
    """The equality constraints that act from the start."""
    off = is_disabled(model, "equality", "constraint")
    return [] if off else [int(k) for k in np.flatnonzero(model.eq_active0)]


def kind_of(model: Any, k: int) -> str:
    """`"connect"`, `"weld"`, `"joint"` and so on."""
    return mujoco.mjtEq(model.eq_type[k]).name.removeprefix("mjEQ_").lower()


def equalities_of(tree: Tree, names: Names) -> list[Any]:
    """The joints that close loops."""
    found = []
    for k in active(tree.model):
        kind = kind_of(tree.model, k)
        if kind in ("connect", "weld"):
            found += _joint(tree, k, kind == "weld", names)
    return found


def _joint(tree: Tree, k: int, is_weld: bool, names: Names) -> list[Any]:
    name = tree.model.equality(k).name or f"equality {k}"
    a, b = _ends(tree, k, is_weld)
    if a.body == b.body:
        raise ValueError(
            f"The equality constraint '{name}' is between parts that cannot move against "
            f"each other, of '{a.body}'."
        )
    label = names.new(name, "equality")
    if not is_weld or tree.model.eq_data[k][10] == 0:
        return [Spherical(label, a.body, b.body, a.origin, b.origin)]
    numbers = dict(
        point_a=a.origin, point_b=b.origin, frame_a=a.rotation.T, frame_b=b.rotation.T
    )
    law = Alignment(None, SAME_DIRECTIONS, keeps="directions")
    return [parts.Weld(label, a.body, b.body, law, numbers)]


def _ends(tree: Tree, k: int, is_weld: bool) -> tuple[Place, Place]:
    """The two frames that coincide, or whose origins do."""
    model = tree.model
    ends, data = (int(model.eq_obj1id[k]), int(model.eq_obj2id[k])), model.eq_data[k]
    if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
        first, second = (_site(tree, site) for site in ends)
        return first, second
    a, b = (tree.place(body) for body in ends)
    # The pose of a weld is that of the second body in the first, at a point of the second.
    of_a, of_b = (data[3:6], data[0:3]) if is_weld else (data[0:3], data[3:6])
    turned = a.rotation
    if is_weld:
        turned = a.rotation @ rotation_matrix("weld", data[6:10])
    return Place(a.body, turned, a.point(of_a)), Place(b.body, b.rotation, b.point(of_b))


def _site(tree: Tree, site: int) -> Place:
    body = tree.place(int(tree.model.site_bodyid[site]))
    turned = rotation_matrix("site", tree.model.site_quat[site])
    return Place(body.body, body.rotation @ turned, body.point(tree.model.site_pos[site]))
