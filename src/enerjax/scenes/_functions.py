"""The functions of `System` that a scene compiles to.

All parts of a kind are evaluated at once, over tables of their numbers; parts that a scene
does not have leave no trace. A force that is no potential, or a constraint that is driven,
is one more function here: a law of frames (and their rates), summed or concatenated over
its groups like the others.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._system import System
from .._types import Coordinates, Multipliers, Scalar, Velocities
from ._layout import Layout, Links
from ._parameters import Parameters
from ._view import rows, View


def make_system(layout: Layout) -> System:
    """The system of a scene; its `args` are `Parameters`."""
    kinds = [group.kind for group in layout.body_groups]
    joined = layout.joints or layout.constraints or any(k.num_internal for k in kinds)
    redundant = any(kind.num_redundant for kind in kinds)
    return System(
        eqx.Partial(kinetic, layout),
        eqx.Partial(potential, layout),
        eqx.Partial(constraint, layout) if joined else None,
        kinematics=eqx.Partial(velocity_map, layout) if redundant else None,
        coordinate_constraint=eqx.Partial(redundancy, layout) if redundant else None,
    )


def kinetic(layout: Layout, v: Velocities, args: Parameters) -> Scalar:
    energies = [
        jnp.sum(jax.vmap(group.kind.kinetic)(rows(v, group.v), numbers))
        for group, numbers in zip(layout.body_groups, args.tables["bodies"], strict=True)
    ]
    return sum(energies[1:], start=energies[0])


def potential(layout: Layout, q: Coordinates, args: Parameters) -> Scalar:
    view = View(layout, q)
    energy = jnp.zeros((), q.dtype)
    if layout.has_gravity:
        energy = energy - _weight(view, args)
    for group, numbers in zip(layout.force_groups, args.tables["forces"], strict=True):
        energy = energy + jnp.sum(evaluate(group, view, numbers))
    for _, function in layout.potentials:
        energy = energy + function(view, args)
    return energy


def _weight(view: View, args: Parameters) -> Scalar:
    """The work of gravity from the origin."""
    work = jnp.zeros((), view.q.dtype)
    groups = view.layout.body_groups
    for group, numbers in zip(groups, args.tables["bodies"], strict=True):
        origins = jax.vmap(group.kind.origin)(rows(view.q, group.q))
        forces = numbers["mass"][:, None] * args["gravity"][None, :]
        work = work + jnp.sum(forces * origins)
    return work


def constraint(layout: Layout, q: Coordinates, args: Parameters) -> Multipliers:
    view = View(layout, q)
    parts = [
        evaluate(group, view, numbers).reshape(-1)
        for group, numbers in zip(layout.joint_groups, args.tables["joints"], strict=True)
    ]
    parts += [function(view, args) for _, function in layout.constraints]
    parts += [
        jax.vmap(group.kind.internal)(rows(q, group.q)).reshape(-1)
        for group in layout.body_groups
        if group.kind.num_internal
    ]
    return jnp.concatenate(parts)


def evaluate(group: Links, view: View, numbers: dict[str, Array]) -> Array:
    """The rows or energies of all links of a law, one row each."""
    a, b = (view.frames(bodies, group.law.reads) for bodies in (group.a, group.b))
    return jax.vmap(group.law)(a, b, numbers)


def velocity_map(layout: Layout, q: Coordinates, args: Parameters) -> Float[Array, "nv nq"]:
    matrix = np.zeros((layout.num_velocities, layout.num_coordinates))
    plain = [group for group in layout.body_groups if not group.kind.num_redundant]
    for group in plain:
        matrix[group.v, group.q] = 1
    full = jnp.asarray(matrix, q.dtype)
    for group in layout.body_groups:
        if group.kind.num_redundant:
            blocks = jax.vmap(group.kind.velocity_map)(rows(q, group.q))
            full = full.at[group.v[:, :, None], group.q[:, None, :]].set(blocks)
    return full


def redundancy(layout: Layout, q: Coordinates, args: Parameters) -> Multipliers:
    parts = [
        jax.vmap(group.kind.redundant)(rows(q, group.q)).reshape(-1)
        for group in layout.body_groups
        if group.kind.num_redundant
    ]
    return jnp.concatenate([jnp.zeros((0,), q.dtype), *parts])
