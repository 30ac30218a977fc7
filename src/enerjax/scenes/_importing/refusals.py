"""What a file says that scenes cannot do: refused by name, or left out if the user says so.

Each kind has a name, by which `ignore` leaves it out.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from . import mujoco
from .coefficients import armature, damping, is_disabled, stiffness
from .equalities import active, kind_of
from .tree import Tree


# What `ignore` may contain, and what each is.
KINDS = {
    "actuators": "forces of actuators",
    "armature": "armatures of ball joints between two bodies that move",
    "contacts": "contacts",
    "couplings": "equality constraints other than connect and weld",
    "deformables": "deformable bodies",
    "fluid": "forces of a fluid",
    "friction": "dry friction in joints",
    "limits": "limits of joints",
    "meshes": "meshes that cannot be read",
    "plasticity": "springs that yield",
    "plugins": "plugins",
    "polynomials": "nonlinear springs and dampers of ball and free joints",
    "tendons": "forces and limits of tendons",
}
# Names of a kind that an error lists.
_LISTED = 4


def check_names(ignore: Iterable[str]) -> frozenset[str]:
    """The names in `ignore`, or an error for one that is no kind."""
    if isinstance(ignore, str):
        raise TypeError(f'`ignore` is a tuple of names: write `ignore=("{ignore}",)`.')
    names = frozenset(ignore)
    if unknown := sorted(names - {*KINDS}):
        raise ValueError(
            f"There is nothing to ignore by the name {unknown}; there are {[*KINDS]}."
        )
    return names


def refuse(tree: Tree, file: str, ignore: frozenset[str]) -> None:
    """Raises an error that names all that a scene would leave out."""
    found = {kind: names for kind, names in _unsupported(tree).items() if names}
    missing = {kind: found[kind] for kind in sorted({*found} - ignore)}
    if not missing:
        return
    lines = [f"  {kind}: {KINDS[kind]} ({_some(x)})" for kind, x in missing.items()]
    every = ", ".join(f'"{kind}"' for kind in sorted(ignore | {*missing}))
    raise ValueError(
        "\n".join([f"{file} has parts that a scene does not have:", *lines])
        + "\nTo import the rest without them, and only if the motion does not need them, "
        f"pass `ignore=({every},)`."
    )


def _some(names: list[str]) -> str:
    more = len(names) - _LISTED
    listed = ", ".join(names[:_LISTED])
    return f"{listed} and {more} more" if more > 0 else listed


def _unsupported(tree: Tree) -> dict[str, list[str]]:
    """The names of everything that is not supported, by its kind."""
    model = tree.model
    off = lambda what: is_disabled(model, what, "constraint")
    joints = range(model.njnt)
    named = lambda flags: [tree.joint_name(int(k)) for k in np.flatnonzero(flags)]
    losses = np.bincount(model.dof_jntid, model.dof_frictionloss, minlength=model.njnt)
    has_fluid = model.opt.density or model.opt.viscosity
    yields = model.jnt_plasticadr >= 0
    return dict(
        actuators=_names(
            model, "actuator", 0 if is_disabled(model, "actuation") else model.nu
        ),
        armature=[tree.joint_name(k) for k in joints if _has_relative_armature(tree, k)],
        contacts=[] if off("contact") else _contacts(tree),
        couplings=_couplings(model),
        deformables=_names(model, "flex", model.nflex),
        fluid=["density and viscosity"] if has_fluid else [],
        friction=[] if off("frictionloss") else named(losses),
        limits=[] if off("limit") else named(model.jnt_limited),
        plasticity=named(yields),
        plugins=_names(model, "plugin", model.nplugin),
        polynomials=[tree.joint_name(k) for k in joints if _is_nonlinear_ball(tree, k)],
        tendons=_tendons(model),
    )


def _names(model: Any, kind: str, count: int) -> list[str]:
    objects = dict(
        actuator=mujoco.mjtObj.mjOBJ_ACTUATOR,
        equality=mujoco.mjtObj.mjOBJ_EQUALITY,
        flex=mujoco.mjtObj.mjOBJ_FLEX,
        plugin=mujoco.mjtObj.mjOBJ_PLUGIN,
        tendon=mujoco.mjtObj.mjOBJ_TENDON,
    )
    found = [mujoco.mj_id2name(model, objects[kind], k) for k in range(count)]
    return [name or f"{kind} {k}" for k, name in enumerate(found)]


def _is_nonlinear_ball(tree: Tree, joint: int) -> bool:
    higher = [*stiffness(tree.model, joint)[1:], *damping(tree.model, joint)[1:]]
    return tree.kind(joint) in ("ball", "free") and any(higher)


def _has_relative_armature(tree: Tree, joint: int) -> bool:
    root = int(tree.model.jnt_bodyid[joint])
    is_between = tree.kind(joint) == "ball" and not tree.is_on_ground(root)
    return is_between and armature(tree.model, joint) != 0


def _couplings(model: Any) -> list[str]:
    names = _names(model, "equality", model.neq)
    known = ("connect", "weld")
    return [names[k] for k in active(model) if kind_of(model, k) not in known]


def _tendons(model: Any) -> list[str]:
    """Tendons that act; the others only measure."""
    acting = model.tendon_limited | (model.tendon_frictionloss > 0)
    for of in (model.tendon_stiffness, model.tendon_damping, model.tendon_armature):
        acting = acting | (of != 0)
    for of in (model.tendon_stiffnesspoly, model.tendon_dampingpoly):
        acting = acting | of.any(axis=1)
    names = _names(model, "tendon", model.ntendon)
    return [names[k] for k in np.flatnonzero(acting)]


def _contacts(tree: Tree) -> list[str]:
    """The pairs of shapes that would touch each other if they met."""
    model = tree.model
    body = model.geom_bodyid
    root = model.body_weldid[body]
    moves = model.body_dofnum[root] > 0
    # As the filters of MuJoCo: bits of both shapes; not both fixed, nor on one body, nor
    # on a body and that to which it is joined, unless this is fixed.
    first, second = np.triu_indices(model.ngeom, 1)
    types, masks = model.geom_contype, model.geom_conaffinity
    meet = (types[first] & masks[second]) | (types[second] & masks[first])
    found = (meet != 0) & (root[first] != root[second]) & (moves[first] | moves[second])
    if not is_disabled(model, "filterparent"):
        above = model.body_weldid[model.body_parentid[root]]
        joined = (above[first] == root[second]) | (above[second] == root[first])
        found &= ~(joined & moves[first] & moves[second])
    excluded = {(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature}
    pairs = zip(first[found], second[found], strict=True)
    kept = [(i, j) for i, j in pairs if not _excluded(body[i], body[j], excluded)]
    kept += zip(model.pair_geom1, model.pair_geom2, strict=True)
    told = {tuple(sorted((tree.name(body[i]), tree.name(body[j])))): None for i, j in kept}
    return [f"{a} with {b}" for a, b in told]


def _excluded(a: int, b: int, excluded: set[tuple[int, int]]) -> bool:
    return (int(a), int(b)) in excluded or (int(b), int(a)) in excluded
