"""The functions of `System` that a scene compiles to.

All parts of a kind are evaluated together, from tables of their numbers.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._programs import at_places
from .._run import Impact
from .._system import Names, RigidBodies, System
from .._types import Coordinates, Multipliers, Scalar, Velocities
from ._beam_functions import numbers_of_bodies
from ._force import ForceOfScene
from ._laws import Gap
from ._layout import Layout, Links
from ._parameters import Parameters
from ._pose_view import evaluate, evaluate_all, evaluate_slip, View
from ._potential import PotentialOfScene
from ._signals import at_time
from ._user_functions import vector_of


def make_system(layout: Layout, over_constrained: bool, row_names: Sequence[str]) -> System:
    """The system of a scene; its `args` are `Parameters`."""
    names = [(body, kind.names) for body, kind in layout.bodies]
    q, v = ([f"{body}.{x}" for body, own in names for x in own[k]] for k in (0, 1))
    q += [f"{link.name}.value" for link in layout.inerters]
    v += [f"{link.name}.rate" for link in layout.inerters]
    redundant = any(group.kind.num_redundant for group in layout.body_groups)
    return System(
        eqx.Partial(kinetic, layout),
        PotentialOfScene(layout),
        eqx.Partial(constraint, layout) if layout.has_constraints else None,
        kinematics=eqx.Partial(velocity_map, layout) if redundant else None,
        coordinate_constraint=eqx.Partial(redundancy, layout) if redundant else None,
        force=ForceOfScene(layout) if layout.has_pushes else None,
        driven=eqx.Partial(driven, layout) if layout.drives else None,
        nonholonomic=eqx.Partial(no_slip, layout) if layout.nonholonomic_groups else None,
        redundant=over_constrained,
        rigid_bodies=layout.rigid_bodies,
        names=Names(q, v, row_names),
        events=impacts(layout),
    )


def impacts(layout: Layout) -> tuple[Impact, ...]:
    """An impact for each contact with a restitution."""
    found = []
    for k, link in enumerate(layout.contacts):
        assert isinstance(link.law, Gap)
        elastic = link.law.is_elastic
        restitution = 1.0 if elastic else eqx.Partial(_restitution, layout, k)
        found.append(Impact(eqx.Partial(_gap, layout, k), restitution))
    return tuple(found)


def _contact(layout: Layout, k: int, args: Parameters) -> tuple[Links, dict[str, Array]]:
    """A contact, and its numbers as tables with one row."""
    name = layout.contacts[k].name
    number, row = layout.places["contacts"][name]
    group, only = layout.contact_groups[number], slice(row, row + 1)
    table = {key: x[only] for key, x in args.tables["contacts"][number].items()}
    return Links(group.law, (name,), group.a[only], group.b[only]), table


def _gap(layout: Layout, k: int, q: Coordinates, args: Parameters) -> Scalar:
    group, numbers = _contact(layout, k, args)
    return evaluate(group, View(layout, q), numbers)[0]


def _restitution(layout: Layout, k: int, args: Parameters) -> Scalar:
    return _contact(layout, k, args)[1]["restitution"][0]


def kinetic(layout: Layout, v: Velocities, args: Parameters) -> Scalar:
    energies = [
        jnp.sum(jax.vmap(group.kind.kinetic)(at_places(v, group.v), numbers))
        for group, numbers in numbers_of_bodies(layout, args)
    ]
    groups = zip(layout.inerter_groups, args.tables["inerters"], strict=True)
    for group, numbers in groups:
        energies.append(0.5 * jnp.sum(numbers["inertance"] * at_places(v, group.v) ** 2))
    return sum(energies[1:], start=energies[0])


def constraint(layout: Layout, q: Coordinates, args: Parameters) -> Multipliers:
    view = View(layout, q)
    joints = list(zip(layout.joint_groups, args.tables["joints"], strict=True))
    rows = evaluate_all([*joints, *inerters_at(layout, q, args)], view)
    parts = [x.reshape(-1) for x in rows]
    own = [vector_of(name, fn, view, args) for name, fn in layout.constraints]
    return jnp.concatenate([*parts[: len(joints)], *own, *parts[len(joints) :]])


def no_slip(layout: Layout, q: Coordinates, args: Parameters) -> Float[Array, "k nq"]:
    """The matrix of the nonholonomic constraints: the rates at which contacts slip."""
    at = View(layout, q)

    def slip(x: Coordinates) -> Array:
        view = View(layout, x)
        found = [
            evaluate_slip(group, view, at, args.tables["joints"][k]).reshape(-1)
            for k, group in layout.nonholonomic_groups
        ]
        return jnp.concatenate(found)

    return jax.jacrev(slip)(q)


def inerters_at(
    layout: Layout, q: Coordinates, args: Parameters
) -> list[tuple[Links, dict[str, Array]]]:
    """All inerters, with numbers that include the value of their coordinate."""
    groups = zip(layout.inerter_groups, args.tables["inerters"], strict=True)
    return [
        (group.links, numbers | dict(value=at_places(q, group.q)))
        for group, numbers in groups
    ]


def internal(layout: Layout, q: Coordinates) -> Multipliers:
    """The constraints between directors, which `System` adds after those of the scene."""
    if layout.num_internal == 0:
        return q[:0]
    assert layout.rigid_bodies is not None
    return RigidBodies(layout.rigid_bodies, q.size).constraint(q)


def driven(layout: Layout, q: Coordinates, t: Scalar, args: Parameters) -> Multipliers:
    view = View(layout, q)
    rows = evaluate_all(drives_at(layout, t, args), view)
    return jnp.concatenate([x.reshape(-1) for x in rows])


def drives_at(
    layout: Layout, t: Scalar, args: Parameters
) -> list[tuple[Links, dict[str, Array]]]:
    """All drives, with numbers that include the values that they prescribe at time `t`."""
    groups = zip(layout.drive_groups, args.tables["drives"], strict=True)
    return [(group, at_time(group, numbers, t, args)) for group, numbers in groups]


def velocity_map(layout: Layout, q: Coordinates, args: Parameters) -> Float[Array, "nv nq"]:
    matrix = np.zeros((layout.num_velocities, layout.num_coordinates))
    plain = [group for group in layout.body_groups if not group.kind.num_redundant]
    for group in (*plain, *layout.inerter_groups):
        matrix[group.v, group.q] = 1
    full = jnp.asarray(matrix, q.dtype)
    for group in layout.body_groups:
        if group.kind.num_redundant:
            blocks = jax.vmap(group.kind.velocity_map)(at_places(q, group.q))
            full = full.at[group.v[:, :, None], group.q[:, None, :]].set(blocks)
    return full


def redundancy(layout: Layout, q: Coordinates, args: Parameters) -> Multipliers:
    parts = [
        jax.vmap(group.kind.redundant)(at_places(q, group.q)).reshape(-1)
        for group in layout.body_groups
        if group.kind.num_redundant
    ]
    return jnp.concatenate([jnp.zeros((0,), q.dtype), *parts])
