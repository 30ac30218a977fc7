"""Which rows of the constraints belong to which part of a scene."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._types import Coordinates
from ._functions import constraint, drives_at, evaluate, redundancy
from ._layout import Layout
from ._parameters import Parameters
from ._view import View


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
        return found + [function(view, args)[None] for _, function in layout.constraints]

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
