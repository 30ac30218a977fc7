"""Which rows of the constraints belong to which part of a scene."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._types import Coordinates, Real
from ._functions import constraint, driven, drives_at, redundancy
from ._layout import Layout
from ._parameters import Parameters
from ._user_functions import vector_of
from ._view import evaluate, View


def members(layout: Layout) -> list[tuple[str, ...]]:
    """The names of all joints, constraints and drives, as their rows follow each other."""
    joined = [group.names for group in layout.joint_groups]
    joined += [(name,) for name, _ in layout.constraints]
    return joined + [group.names for group in layout.drive_groups]


def rows_of(layout: Layout, q: Coordinates, args: Parameters) -> dict[str, slice]:
    """The rows of each by name; those within bodies stand between joints and drives."""

    def of_joints(q: Coordinates) -> list[Array]:
        view = View(layout, q)
        groups = zip(layout.joint_groups, args.tables["joints"], strict=True)
        found = [evaluate(group, view, numbers) for group, numbers in groups]
        own = [vector_of(name, fn, view, args) for name, fn in layout.constraints]
        return found + [rows[None] for rows in own]

    def of_drives(q: Coordinates) -> list[Array]:
        view = View(layout, q)
        pairs = drives_at(layout, jnp.zeros((), q.dtype), args)
        return [evaluate(group, view, numbers) for group, numbers in pairs]

    def of_all(q: Coordinates) -> Array:
        return constraint(layout, q, args)

    shapes = [x.shape for x in jax.eval_shape(of_joints, q)]
    num_joined = len(shapes)
    shapes += [x.shape for x in jax.eval_shape(of_drives, q)]
    places, first = {}, 0
    for k, (names, shape) in enumerate(zip(members(layout), shapes, strict=True)):
        if k == num_joined and layout.has_constraints:
            first = jax.eval_shape(of_all, q).size
        for name in names:
            places[name] = slice(first, first + shape[1])
            first += shape[1]
    return places


def check_reacting(
    joint: str, rows: dict[str, slice], ends: dict[str, tuple[str, str]]
) -> None:
    """Raises for what is no joint or drive between two bodies."""
    if joint in rows and joint not in ends:
        raise ValueError(
            f"'{joint}' is a constraint of your own, between no two bodies: it has "
            f"`scene.multipliers(sol, '{joint}')`, and `-B^T` of these is its force."
        )
    if joint not in rows:
        joints = [name for name in rows if name in ends]
        raise ValueError(f"There is no joint '{joint}'; there are {joints}.")


def row_names(
    layout: Layout, q: Coordinates, args: Parameters, rows: dict[str, slice]
) -> list[str]:
    """A name for each row of all constraints, in the order of multipliers."""
    inside = jax.eval_shape(lambda q: constraint(layout, q, args), q).size
    outside = jax.eval_shape(lambda q: redundancy(layout, q, args), q).size
    last = max([inside, *(place.stop for place in rows.values())])
    names = [str(k) for k in range(last + outside)]
    for name, place in rows.items():
        several = place.stop - place.start > 1
        for k in range(place.start, place.stop):
            names[k] = f"{name}[{k - place.start}]" if several else name
    return names


def first_dependent(
    layout: Layout, q: Coordinates, t: Real, args: Parameters, places: dict[str, slice]
) -> str | None:
    """The first joint with a row that those before it determine already."""
    start = jnp.asarray(t, q.dtype)
    held = []
    if layout.has_constraints:
        held += [*jax.jacfwd(lambda x: constraint(layout, x, args))(q)]
    if layout.drives:
        held += [*jax.jacfwd(lambda x: driven(layout, x, start, args))(q)]
    joined = {k for place in places.values() for k in range(place.start, place.stop)}
    # What bodies have of their own stands before.
    taken = [row for k, row in enumerate(held) if k not in joined]
    taken += [*jax.jacfwd(lambda x: redundancy(layout, x, args))(q)]
    for name, place in places.items():
        taken += held[place]
        if np.linalg.matrix_rank(np.array(taken)) < len(taken):
            return name
    return None
